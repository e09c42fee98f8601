"""Progress of a function in a notebook: one line that replaces itself, below the cell."""

from __future__ import annotations

import functools
import inspect
import sys
import time
from collections.abc import Callable
from html import escape
from importlib import import_module
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")
AFTER, EVERY = 1.0, 0.25  # [s] until the line appears, and between its changes
Show = Callable[[str, str], Callable[[str, str], object]]  # of text and HTML; the result replaces them


def shows_progress(function: Callable[P, T]) -> Callable[P, T]:
    """Return a function that shows its progress in a notebook, unless its argument `progress` is used."""
    if "progress" not in inspect.signature(function).parameters:
        return function

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        show = None if "progress" in kwargs else _display()
        if show is None:
            return function(*args, **kwargs)
        line = ProgressLine(function.__name__, show)
        try:
            return function(*args, **{**kwargs, "progress": line})  # type: ignore[arg-type]
        finally:
            line.end()

    return call


class ProgressLine:
    """A line with a bar that appears after a second and changes a few times per second.

    Args:
        activity: Name of the function.
        show: Function that displays text and HTML, and returns the function that replaces them.
        clock: Seconds.
    """

    def __init__(self, activity: str, show: Show, clock: Callable[[], float] = time.monotonic) -> None:
        self.activity, self._show, self._clock = activity, show, clock
        self._start = self._changed = clock()
        self._replace: Callable[[str, str], object] | None = None
        self._last = ""

    def __call__(self, first: Any, second: Any) -> None:
        """Take (completed steps, all steps) or (stage, completed share)."""
        now = self._clock()
        if now - self._start < AFTER or now - self._changed < EVERY:
            return
        self._changed = now
        stage, share = (str(first), float(second)) if isinstance(first, str) else ("", first / max(second, 1))
        self._last = f"{self.activity}: {stage + ', ' if stage else ''}{share:.0%}, {now - self._start:.0f} s"
        bar = f'<progress max="1" value="{share:.3f}"></progress> ' if share > 0.0 else ""
        self._put(self._last, f"{bar}<small>{escape(self._last)}</small>")

    def end(self) -> None:
        """Replace the bar with the duration; do nothing if it never appeared."""
        if self._replace is not None:
            text = f"{self.activity}: {self._clock() - self._start:.1f} s"
            self._put(text, f"<small>{escape(text)}</small>")

    def _put(self, text: str, html: str) -> None:
        if self._replace is None:
            self._replace = self._show(text, html)
        else:
            self._replace(text, html)


def _display() -> Show | None:
    """Return a function that displays text and HTML, or None outside of notebooks."""
    python = sys.modules.get("IPython")  # a notebook has imported it
    shell = None if python is None else python.get_ipython()
    if not hasattr(shell, "kernel"):
        return None
    display: Any = import_module("IPython.display").display

    def show(text: str, html: str) -> Callable[[str, str], object]:
        handle = display({"text/plain": text, "text/html": html}, raw=True, display_id=True)
        return lambda text, html: handle.update({"text/plain": text, "text/html": html}, raw=True)

    return show
