"""Live pages of running commands: a run with changes and pause, a sweep, a refinement; each with stop and report."""

from __future__ import annotations

import math
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from starlette.requests import Request
from starlette.responses import Response

from cosim.core.arrays import Array
from cosim.core.errors import CosimError, InputError, Interrupted, Signalled, SweepStopped, Terminated
from cosim.master.observer import Control, ObservedRun, Observer
from cosim.pages.rows import Recording
from cosim.pages.runs import RunPlace, ViewedRun
from cosim.pages.server import FIRST_PAGE, RELOAD, Handler, Json, Part, ServedPage, html_response
from cosim.pages.view_page import Viewer, view_html
from cosim.refinement.stages import STAGE_MESSAGES, Watcher, stage_number
from cosim.report.template import render
from cosim.simulation.criteria import sentence
from cosim.simulation.run_signals import Run
from cosim.sweeps.runs import RunResult
from cosim.sweeps.sampling import share_interval
from cosim.sweeps.workflow import CriterionLimit, RunsObserver

TEMPLATE = Path(__file__).with_name("templates") / "work.html.j2"
FINAL = ("finished", "stopped", "failed")
NO_NUMBERS = {"Boolean", "String", "Binary", "Enumeration"}
LARGEST_BOUND = 2**31 - 1  # larger bounds are limits of the type, not of the variable
BINS = 24  # of a histogram
MAX_FAILURES = 5  # reasons on the page
MAX_RANKED = 12  # hypotheses on the page


class WorkPage(ServedPage):
    """The page of a running command; a context manager around the command's work.

    Args:
        title: Heading until the name is known.
        port: 0 for any free port.
        html: HTML of the page, by default that of sweeps and refinements.

    Attributes:
        activity: Noun for the work, e.g. `run`.
        report: File of the report, shown after the end.
    """

    activity = "run"

    def __init__(self, title: str, port: int = 0, html: str = "", part: Part | None = None) -> None:
        self.report: Path | None = None
        self._begin, self._has_begun = monotonic(), False
        html = html or render(TEMPLATE, {"heading": title, "activity": self.activity}, is_report=False)
        super().__init__(html, port, part, phase="starting", title=title, message="", report=False)

    def routes(self) -> Mapping[str, Handler]:
        """Return the routes of the page."""
        return {**super().routes(), "POST /stop": self._stop, "GET /report.html": self._show_report}

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *_: object) -> None:
        if error is None:
            self.update(phase="finished")
            return
        if left := getattr(error, "left", None):
            self.report = left / "report.html"
        message = str(error) if isinstance(error, CosimError) else type(error).__name__
        if isinstance(error, (Interrupted, Signalled)):
            message = f"stopped at t = {error.time:.6g} s; the rows so far are kept"
        is_stop = isinstance(error, (Interrupted, Signalled, SweepStopped, KeyboardInterrupt, Terminated))
        self.update(phase="stopped" if is_stop else "failed", message=message)

    def update(self, **state: Any) -> None:
        """Change parts of the state."""
        with self._lock:
            self._has_begun |= state.get("phase") == "running"
            super().update(**state)

    @property
    def has_ended(self) -> bool:
        """Return True if the work has ended."""
        return self._state["phase"] in FINAL

    def state(self) -> dict[str, Any]:
        """Return the complete state as JSON data."""
        with self._lock:
            elapsed = self._state.get("elapsed") or monotonic() - self._begin
            if self.has_ended:
                self._state["elapsed"] = elapsed
            is_there = self.has_ended and self.report is not None and self.report.is_file()
        return {**super().state(), "elapsed": elapsed, "report": is_there}

    def check_running(self) -> None:
        """Raise InputError if the work has ended."""
        if self.has_ended:
            raise InputError.at(Path(self.activity), f"the {self.activity} has ended; changes are no longer possible")

    def _stop(self, request: Request, _: Any) -> Response:
        """Stop the work like Ctrl-C does."""
        self.check_running()
        self.update(phase="stopping")
        # SIGTERM if Ctrl-C is ignored, as for background jobs of a shell
        number = signal.SIGTERM if signal.getsignal(signal.SIGINT) is signal.SIG_IGN else signal.SIGINT
        if hasattr(signal, "pthread_kill"):  # this also interrupts a wait of the main thread
            signal.pthread_kill(threading.main_thread().ident or 0, number)
        else:
            signal.raise_signal(number)
        return Json({"ok": True})

    def _show_report(self, request: Request, _: Any) -> Response:
        if self.report is None:
            return Json({"error": "not found"}, 404)
        return html_response(self.report.read_text(encoding="utf-8"), alone=True)

    def wait_for_close(self, say: Callable[[str], None], first: float = FIRST_PAGE, reload: float = RELOAD) -> None:
        """Serve until the last page is closed; if the work could not begin, return at once."""
        super().wait_for_close(say, first if self._has_begun else 0.0, reload)


class LiveRun(WorkPage, Observer):
    """An observer that draws the rows of a run in the signal browser and accepts changes from the page."""

    def __init__(self, title: str, port: int = 0) -> None:
        self._run, self._control = ObservedRun((), 0, 0.0, 1.0), None  # type: tuple[ObservedRun, Control | None]
        self._rows = Recording({}, {})
        viewer = Viewer([ViewedRun(RunPlace(title, title, Path(title)), self._rows)], None)
        self._runs = viewer.runs
        self._inputs: list[str] = []  # variables that can be changed
        self._rate = (0.0, 0.0)  # clock time of the first row [s], and its simulated time [s]
        super().__init__(title, port, view_html(title, is_live=True), viewer)

    # -- observer --------------------------------------------------------------------------------

    def begin(self, run: ObservedRun) -> None:
        """Prepare for the rows of a run."""
        title = str(self._state["title"])
        with self._lock:
            self._run, self._control = run, run.control
            self._rows = Recording({}, {name: run.units.get(name, "") for name in run.columns})
            self._runs[:] = [ViewedRun(RunPlace(title, title, Path(title), display=run.display), self._rows)]
        names = {v.name for v in (run.control.variables if run.control is not None else ()) if v.is_input}
        self._inputs = [column for column in run.columns if column in names]
        self.update(phase="starting", total=run.rows, start=run.start, step=run.step, made=id(run))

    def rows(self, time: Array, values: Array) -> None:
        """Store new rows for the page."""
        if not self._rows.rows:
            self._rate = monotonic(), float(time[0])
            self.update(phase="running")
        self._rows.append(np.vstack((time, values.T)))

    def end(self) -> None:
        """Show that the files of the run are being written."""
        self.update(phase="writing")

    def show_outcome(self, made: Run) -> None:
        """Show the criteria and the report of a complete run."""
        self.report = made.report
        self.update(title=made.title, message="; ".join(map(sentence, made.criteria)))

    # -- state -----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Return the complete state as JSON data."""
        state, run, control = super().state(), self._run, self._control
        rows, now = self._rows.rows, self._rows.span()[1] if self._rows.rows else run.start
        since, first = self._rate
        duration = monotonic() - since
        if state["phase"] == "running":
            speed = (now - first) / duration if rows > 1 and duration > 0.0 else None
            self._state["speed"] = state["speed"] = speed
            if control is not None and control.paused:
                state["phase"] = "paused"
        state["changes"] = [
            {
                "at": run.start + change.point * run.step,
                "set": {f"{c}.{v}": value for c, values in change.values.items() for v, value in values.items()},
            }
            for change in (control.changes if control is not None else ())
        ]
        last = {name: float(self._rows.column(name)[rows - 1]) for name in self._inputs if rows}
        state["values"] = {name: value if math.isfinite(value) else None for name, value in last.items()}
        return {**state, "rows": rows, "now": now, "end": run.start + run.step * max(0, run.rows - 1)}

    # -- requests ---------------------------------------------------------------------------------

    def routes(self) -> Mapping[str, Handler]:
        """Return the routes of the page."""
        own = {"GET /variables": self._variables, "POST /set": self._set, "POST /pause": self._pause}
        return {**super().routes(), **own}

    def _variables(self, request: Request, _: Any) -> Response:
        """Return the variables that can be changed."""
        variables = []
        for v in self._control.variables if self._control is not None else ():
            if v.shape:
                continue
            start = {str(number): name for name, number in v.items.items()}.get(str(v.start), v.start)
            about = {
                "input": v.is_input,
                "start": start if isinstance(start, int | float | str | bool | None) else str(start),
                "bounds": [bound if abs(bound) < LARGEST_BOUND else None for bound in v.bounds],
                "items": list(v.items),
                **{key: getattr(v, key) for key in ("name", "kind", "unit", "description")},
            }
            variables.append(about)
        return Json(variables)

    def _controlled(self) -> Control:
        """Return the object that controls the run; raise InputError if the run has not begun or has ended."""
        self.check_running()
        if self._control is None or self._state["phase"] == "writing":
            raise InputError.at(Path(self.activity), "the run has not started or has ended; changes are not possible")
        return self._control

    def _set(self, request: Request, values: Any) -> Response:
        """Change the variables to the values that the page sends."""
        if not isinstance(values, dict) or not all(isinstance(v, (str, int, float, bool)) for v in values.values()):
            raise InputError.at(Path("set"), "give variables with numbers, text, true or false")
        control = self._controlled()
        kinds = {v.name: v.kind for v in control.variables}
        set_values = control.set({n: v if kinds.get(n) in NO_NUMBERS else _as_number(v) for n, v in values.items()})
        self.update()
        return Json({"set": set_values})

    def _pause(self, request: Request, is_pause: Any) -> Response:
        """Pause or continue the run."""
        if not isinstance(is_pause, bool):
            raise InputError.at(Path("pause"), "give true or false")
        self._controlled().paused = is_pause
        self.update()
        return Json({"paused": is_pause})


def _as_number(value: Any) -> Any:
    """Convert text of a plain number to a number; return other values unchanged."""
    for kind in (int, float) if isinstance(value, str) else ():
        with suppress(ValueError):
            number = kind(value.strip().replace("\u2212", "-"))
            return number if math.isfinite(number) else value
    return value


class LiveSweep(WorkPage, RunsObserver):
    """An observer of a sweep's runs that shows them on a page."""

    activity = "sweep"

    def __init__(self, title: str, port: int = 0) -> None:
        self._limits: Sequence[CriterionLimit] = ()
        self._runs: list[tuple[str, Sequence[float], Sequence[bool]]] = []  # status, values and outcomes of criteria
        self._total = self._earlier = 0
        self._since = 0.0
        super().__init__(title, port)

    def begin(self, title: str, count: int, limits: Sequence[CriterionLimit], earlier: Iterable[RunResult]) -> None:
        """Prepare for the runs of a sweep; `earlier` are the results of a stopped sweep that this call resumes."""
        self._limits, self._total, self._since = limits, count, monotonic()
        self.add([*earlier])
        self._earlier = len(self._runs)
        self.update(phase="running", title=title)

    def add(self, results: Sequence[RunResult]) -> None:
        """Store the outcomes of finished runs."""
        with self._lock:
            self._runs += [(str(result.status), result.values, result.met) for result in results]
        self.update()

    def state(self) -> dict[str, Any]:
        """Return the complete state as JSON data."""
        with self._lock:
            runs = [*self._runs]
        complete = [run for run in runs if run[0] == "ok"]
        failures = Counter(status for status, *_ in runs if status != "ok")
        criteria = []
        for k, limit in enumerate(self._limits):
            of, met = len(complete), sum(outcomes[k] for *_, outcomes in complete)
            low, high = share_interval(met, of)  # confidence interval of the share of runs that meet the criterion
            values = np.array([run[1][k] for run in complete])
            values = values[np.isfinite(values)]
            counts, ends = list[int](), (0.0, limit.max)
            if values.size:
                least, most = min(limit.max, float(values.min())), max(limit.max, float(np.quantile(values, 0.98)))
                margin = 0.05 * (most - least) or 1.0
                ends = least - margin, most + margin
                counts = np.histogram(np.clip(values, *ends), BINS, ends)[0].tolist()
            about = {"name": limit.name, "max": limit.max, "unit": limit.unit, "met": met, "of": of}
            about |= {"low": low, "high": high, "undefined": of - values.size}
            criteria.append({**about, "counts": counts, "ends": [*ends]})
        made, passed = len(runs) - self._earlier, monotonic() - self._since
        rate = made / passed if made and not self.has_ended else None
        return {
            **super().state(),
            "done": len(runs),
            "total": self._total,
            "failed": len(runs) - len(complete),
            "rate": rate,
            "remaining": (self._total - len(runs)) / rate if rate else None,
            "criteria": criteria,
            "failures": [{"why": why, "count": n} for why, n in [*failures.items()][:MAX_FAILURES]],
        }


class LiveRefine(WorkPage, Watcher):
    """A watcher of a refinement that shows its progress on a page, and passes it on to the terminal."""

    activity = "refinement"

    def __init__(self, title: str, port: int = 0, progress: Any = None) -> None:
        self._progress = progress
        self._number, self._words, self._share = 0, "", 0.0
        self._times: list[float] = []  # start time of each stage [s]
        self._ranking: list[dict[str, Any]] = []
        self._fitted = 0
        super().__init__(title, port)

    def __call__(self, stage: str, share: float) -> None:
        """Show the current stage and its finished share."""
        if self._progress is not None:
            self._progress(stage, share)
        with self._lock:
            number, _ = stage_number(stage)
            while len(self._times) < number:
                self._times.append(monotonic())
            self._number, self._words, self._share = max(number, self._number), stage, share
        self.update(phase="running")

    def ranking(self, hypotheses: Sequence[Any]) -> None:
        """Show the best hypotheses so far."""
        base = next((h.score for h in hypotheses if not h.names), None)
        best = sorted(hypotheses, key=lambda h: h.score)[:MAX_RANKED]
        self._fitted = len(hypotheses)
        self._ranking = [{"names": list(h.names), "gain": None if base is None else base - h.score} for h in best]
        self.update()

    def show_verdict(self, record: Mapping[str, Any], report: Path) -> None:
        """Show the sentence of the verdict and the report."""
        self.report = report
        self.update(message=str(record["sentence"]))

    def state(self) -> dict[str, Any]:
        """Return the complete state as JSON data."""
        state = super().state()
        with self._lock:
            times = [*self._times, self._begin + state["elapsed"]]
            done = len(STAGE_MESSAGES) if state["phase"] == "finished" else self._number - 1
            stages = [
                {
                    "words": words[0],
                    "state": "done" if k < done else "now" if k == done and not self.has_ended else "waiting",
                    "seconds": times[k + 1] - times[k] if k < len(self._times) else None,
                }
                for k, words in enumerate(STAGE_MESSAGES)
            ]
            now = {"words": self._words, "share": self._share, "done": max(0, done), "total": len(STAGE_MESSAGES)}
            return {**state, **now, "stages": stages, "ranking": self._ranking, "fitted": self._fitted}
