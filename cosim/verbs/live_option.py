"""The options --live and --port: a live page while a command works, and after its end until the page is closed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Annotated, Any

import typer

from cosim.base.errors import Terminated
from cosim.base.messages import Note
from cosim.verbs.terminal import LAST, say_finding, say_note

PAGES = {"run": "LiveRun", "sweep": "LiveSweep", "refine": "LiveRefine"}  # verb → class of its page
Live = Annotated[bool, typer.Option("--live", help="Open a page that shows the work while it goes on.")]
Port = Annotated[
    int | None,
    typer.Option("--port", min=0, max=65535, help="Port of the live page (default: any free port); implies --live."),
]


@contextmanager
def live_page(verb: str, title: str, *, live: bool, port: int | None, **settings: Any) -> Iterator[Any]:
    """Yield the live page of a verb, None without --live; keep it open until the user closes it."""
    if not live and port is None:
        yield None
        return
    from cosim.pages import work_pages
    from cosim.pages.server import open_page

    page = getattr(work_pages, PAGES[verb])(title, port or 0, **settings)
    LAST.append(lambda: _wait(page))
    is_open = open_page(page.url, title)
    (say_note if is_open else say_finding)(Note(f"live page: {page.url}"))
    with page:
        yield page


def _wait(page: Any) -> None:
    with suppress(KeyboardInterrupt, Terminated):  # The exit code is that of the work.
        page.wait_for_close(say_note)
