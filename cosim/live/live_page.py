"""Page of a running command: its server, its state for the browser, stop, and the time after the end."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cosim.base.errors import CosimError, InputError, Interrupted, Signalled, SweepStopped, Terminated
from cosim.base.messages import Note
from cosim.base.version import __version__
from cosim.report.template import DESK, render
from cosim.server.answers import Answer, Handler, Request, json_answer, report_answer
from cosim.server.served_page import FIRST_PAGE, RELOAD, ServedPage

TEMPLATE = Path(__file__).with_name("templates") / "live.html.j2"
FINAL = ("finished", "stopped", "failed")


class LivePage(ServedPage):
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
        self._begin, self._has_begun = time.monotonic(), False
        about = {"heading": title, "activity": self.activity, "version": __version__, "data": '{"rows": 0}'}
        html = render(TEMPLATE, about, also=DESK)
        super().__init__(html, port, phase="starting", title=title, message="", report=False)

    def routes(self) -> Mapping[str, Handler]:
        """Return further routes."""
        return {"POST /stop": self._stop, "GET /report.html": self._show_report}

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *_: object) -> None:
        if error is None:
            self.update(phase="finished")
            return
        is_stop = isinstance(error, (Interrupted, Signalled, SweepStopped, KeyboardInterrupt, Terminated))
        left = getattr(error, "left", None)
        if left is not None:
            self.report = left / "report.html"
        message = str(error) if isinstance(error, CosimError) else type(error).__name__
        if isinstance(error, (Interrupted, Signalled)):
            message = Note(f"stopped at t = {error.time:.6g} s; the rows so far are kept")
        self.update(phase="stopped" if is_stop else "failed", message=message)

    # -- state -----------------------------------------------------------------------------------

    def update(self, **state: Any) -> None:
        """Change parts of the state; a page shows them within `TICK`."""
        with self._lock:
            self._has_begun |= state.get("phase") == "running"
            super().update(**state)

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

    # -- requests ---------------------------------------------------------------------------------

    def check_running(self) -> None:
        """Raise InputError after the end of the work."""
        if self.has_ended:
            raise InputError.at(Path(self.activity), f"the {self.activity} has ended, so that nothing can be changed")

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
        """Serve until the last page is closed; work that could not begin needs no page."""
        super().wait_for_close(say, first if self._has_begun else 0.0, reload)


def stop_command() -> None:
    """Send this process the signal of Ctrl-C; if it ignores that one, as in the background of a shell, SIGTERM."""
    number = signal.SIGTERM if signal.getsignal(signal.SIGINT) is signal.SIG_IGN else signal.SIGINT
    if hasattr(signal, "pthread_kill"):  # Interrupts a wait of the main thread, too.
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        signal.raise_signal(number)
