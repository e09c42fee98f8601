"""Page of a running command: its server, its state for the browser, stop, and the time after the end."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Self

from cosim.base.errors import CosimError, InputError, Interrupted, SweepStopped
from cosim.base.version import __version__
from cosim.live import messages
from cosim.report.template import render
from cosim.server.answers import Answer, Handler, Request, json_answer, page_answer, report_answer
from cosim.server.local_server import Server

TEMPLATE = Path(__file__).with_name("templates") / "live.html.j2"
TICK = 0.1  # [s] between two states sent to a page
FIRST_PAGE = 20.0  # [s] after the end until a page must have been opened
RELOAD = 2.0  # [s] without a page, as during a reload, after which the server ends
FINAL = ("finished", "stopped", "failed")


class LivePage:
    """The page of one command: `run`, `sweep` or `refine`; a context manager around the command's work.

    Subclasses add routes and parts of the state. State is read and written in any thread.

    Args:
        activity: Noun for the work, e.g. `run`.
        title: Heading until the name is known.
        port: 0 for any free port.

    Attributes:
        report: File of the report, shown after the end.
    """

    activity = "run"

    def __init__(self, title: str, port: int = 0) -> None:
        self.report: Path | None = None
        self._lock = threading.RLock()
        self._begin = time.monotonic()
        self._state: dict[str, Any] = {"phase": "starting", "title": title, "message": "", "report": False}
        self._version, self._has_begun = 0, False
        html = render(
            TEMPLATE, {"heading": title, "activity": self.activity, "version": __version__, "data": '{"rows": 0}'}
        )
        routes: dict[str, Handler] = {
            "GET /": lambda request: page_answer(html),
            "GET /events": lambda request: Answer(events=self._events(request)),
            "POST /stop": self._stop,
            "GET /report.html": self._show_report,
        }
        self.server = Server({**routes, **self.routes()}, port)

    def routes(self) -> Mapping[str, Handler]:
        """Return further routes."""
        return {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *_: object) -> None:
        if error is None:
            self.update(phase="finished")
            return
        is_stop = isinstance(error, (Interrupted, SweepStopped, KeyboardInterrupt))
        left = getattr(error, "left", None)
        if left is not None:
            self.report = left / "report.html"
        message = str(error) if isinstance(error, CosimError) else type(error).__name__
        if isinstance(error, Interrupted):
            message = messages.STOPPED(time=error.time)
        self.update(phase="stopped" if is_stop else "failed", message=message)

    # -- state -----------------------------------------------------------------------------------

    def update(self, **state: Any) -> None:
        """Change parts of the state; a page shows them within `TICK`."""
        with self._lock:
            self._has_begun |= state.get("phase") == "running"
            self._state |= state
            self._version += 1

    @property
    def has_ended(self) -> bool:
        """Return whether the work has ended."""
        return self._state["phase"] in FINAL

    def state(self) -> dict[str, Any]:
        """Return the whole state, as JSON allows it."""
        with self._lock:
            elapsed = self._state.get("elapsed") or time.monotonic() - self._begin
            if self.has_ended:
                self._state["elapsed"] = elapsed
            is_there = self.has_ended and self.report is not None and self.report.is_file()
            return {**self._state, "elapsed": elapsed, "report": is_there}

    def version(self) -> Any:
        """Return a value that changes with the state."""
        return self._version, self.has_ended

    def _events(self, request: Request) -> Iterator[Any]:
        last: Any = None
        while not request.is_closing(TICK if last is not None else 0.0):
            version = self.version()
            if version == last:
                yield None
                continue
            last = version
            yield self.state()

    # -- requests ---------------------------------------------------------------------------------

    def check_running(self) -> None:
        """Raise InputError after the end of the work."""
        if self.has_ended:
            raise InputError.at(Path(self.activity), messages.NOT_RUNNING(activity=self.activity))

    def _stop(self, request: Request) -> Answer:
        """Stop the work as Ctrl-C does."""
        self.check_running()
        self.update(phase="stopping")
        stop_command()
        return json_answer({"ok": True})

    def _show_report(self, request: Request) -> Answer:
        return report_answer(self.report) if self.report is not None else json_answer({"error": "not found"}, 404)

    # -- after the end ----------------------------------------------------------------------------

    def wait_for_close(self, say: Callable[[str], None], first: float = FIRST_PAGE, reload: float = RELOAD) -> None:
        """Serve until the last page is closed, or until a stop.

        Args:
            first: Longest time until the first page [s]; none after work that could not begin.
        """
        since, first = time.monotonic(), first if self._has_begun else 0.0
        try:
            if self.server.streams or (first and not self.server.opened):
                say(messages.PAGE_STAYS())
            while time.monotonic() - since < (reload if self.server.opened else first):
                if self.server.streams:
                    since = time.monotonic()
                time.sleep(TICK)
        finally:
            self.server.close()


def stop_command() -> None:
    """Send this process the signal of Ctrl-C; if it ignores that one, as in the background of a shell, SIGTERM."""
    number = signal.SIGTERM if signal.getsignal(signal.SIGINT) is signal.SIG_IGN else signal.SIGINT
    if hasattr(signal, "pthread_kill"):  # Interrupts a wait of the main thread, too.
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        signal.raise_signal(number)
