"""Notebook display: HTML of results, and a progress line below the cell."""

from __future__ import annotations

import functools
import inspect
import sys
import time
from collections.abc import Callable, Sequence
from html import escape
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")
FIRST_LINE_S, LINE_INTERVAL_S = 1.0, 0.25  # [s] until the line appears, and between its changes
WIDTH = 79  # characters of the line


def shows_progress(function: Callable[P, T]) -> Callable[P, T]:
    """Return the function with a progress line in notebooks, unless the caller passes `progress`."""
    if "progress" not in inspect.signature(function).parameters:
        return function

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        python = sys.modules.get("IPython")  # a notebook has imported it
        if "progress" in kwargs or python is None or not hasattr(python.get_ipython(), "kernel"):
            return function(*args, **kwargs)
        start = shown = time.monotonic()

        def show(first: Any, second: Any) -> None:
            """Show progress, given as (completed steps, all steps) or (stage, completed share)."""
            nonlocal shown
            now = time.monotonic()
            if now - start >= FIRST_LINE_S and now - shown >= LINE_INTERVAL_S:
                stage, share = (f"{first}, ", second) if isinstance(first, str) else ("", first / max(second, 1))
                print(
                    f"\r{function.__name__}: {stage}{share:.0%}, {now - start:.0f} s".ljust(WIDTH), end="", flush=True
                )
                shown = now

        try:
            return function(*args, **{**kwargs, "progress": show})  # type: ignore[arg-type]
        finally:
            if shown > start:
                print(f"\r{function.__name__}: {time.monotonic() - start:.1f} s".ljust(WIDTH))

    return call


def heading(title: str, text: str = "") -> str:
    """Return HTML of a line with a bold title, followed by a text."""
    return f"<p><b>{escape(title)}</b>{': ' if text else ''}{escape(text)}</p>"


def table(header: Sequence[str], rows: Sequence[Sequence[str]], omitted: int = 0) -> str:
    """Return HTML of a table, with the number of omitted rows below."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    lines = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    note = f"<p>… and {omitted} more</p>" if omitted > 0 else ""
    return f"<table><tr>{head}</tr>{lines}</table>{note}"
