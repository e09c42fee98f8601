"""A page of a command: its server, its state for the browser, and the time until it is closed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Self

from cosim.base.messages import Note
from cosim.server.answers import Answer, Handler, Request, page_answer
from cosim.server.local_server import Server

TICK = 0.1  # [s] between two states sent to a page
FIRST_PAGE = 20.0  # [s] until a page must have been opened
RELOAD = 2.0  # [s] without a page, as during a reload, after which the server ends


class ServedPage:
    """A page whose state is sent to the browser at each change; a context manager.

    Subclasses add routes and parts of the state. State is read and written in any thread.

    Args:
        html: The page.
        port: 0 for any free port.
        state: State at the beginning.
    """

    def __init__(self, html: str, port: int = 0, **state: Any) -> None:
        self._lock = threading.RLock()
        self._state: dict[str, Any] = state
        self._version = 0
        routes: dict[str, Handler] = {
            "GET /": lambda request: page_answer(html),
            "GET /events": lambda request: Answer(events=self._events(request)),
        }
        self.server = Server({**routes, **self.routes()}, port)

    def routes(self) -> Mapping[str, Handler]:
        """Return further routes."""
        return {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.server.close()

    def update(self, **state: Any) -> None:
        """Change parts of the state; a page shows them within `TICK`."""
        with self._lock:
            self._state |= state
            self._version += 1

    def state(self) -> dict[str, Any]:
        """Return the whole state, as JSON allows it."""
        with self._lock:
            return {**self._state}

    def version(self) -> Any:
        """Return a value that changes with the state."""
        return self._version

    def _events(self, request: Request) -> Iterator[Any]:
        last: Any = None
        while not request.is_closing(TICK if last is not None else 0.0):
            version = self.version()
            if version == last:
                yield None
                continue
            last = version
            yield self.state()

    def wait_for_close(self, say: Callable[[str], None], first: float = FIRST_PAGE, reload: float = RELOAD) -> None:
        """Serve until the last page is closed, or until a stop.

        Args:
            first: Longest time until the first page [s].
        """
        since = time.monotonic()
        try:
            if self.server.streams or (first and not self.server.opened):
                say(Note("the page stays until it is closed in the browser; Ctrl-C ends it"))
            while self.server.streams or time.monotonic() - since < (reload if self.server.opened else first):
                if self.server.streams:  # Without a page, a reload has its full time.
                    since = time.monotonic()
                time.sleep(TICK)
        finally:
            self.server.close()
