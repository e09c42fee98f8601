"""Live page of a run: rows while they appear, changes of parameters and inputs, pause."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.live.envelope import Envelope
from cosim.live.live_page import LivePage
from cosim.master.inbox import Control
from cosim.master.observer import ObservedRun, Observer
from cosim.server.answers import Answer, Handler, Request, json_answer
from cosim.simulation.criteria import sentence
from cosim.simulation.workflow import Outcome
from cosim.system.events import Variable

MAX_GROUPS = 4000  # groups of rows in an answer
NO_COLUMNS = ObservedRun((), 0, 0.0, 1.0)
NO_NUMBERS = {"Boolean", "String", "Binary", "Enumeration"}
LARGEST_BOUND = 2**31 - 1  # larger bounds are those of a type
HEAD = struct.Struct("<5d")  # first time, time between groups, groups, signals, rows so far


class LiveRun(LivePage, Observer):
    """An observer that draws the rows of a run on a page and takes changes from it."""

    activity = "run"

    def __init__(self, title: str, port: int = 0) -> None:
        self._run, self._envelope = NO_COLUMNS, Envelope(0)
        self._control: Control | None = None
        self._inputs: list[int] = []  # places of the inputs that can be changed
        self._rate = (0.0, 0.0)  # time of the first row on the clock [s], and its simulated time [s]
        super().__init__(title, port)

    # -- observer --------------------------------------------------------------------------------

    def begin(self, run: ObservedRun) -> None:
        """Prepare for the rows of a run."""
        with self._lock:
            self._run, self._envelope, self._control = run, Envelope(len(run.columns)), run.control
        names = {v.name for v in (run.control.variables if run.control is not None else ()) if v.is_input}
        self._inputs = [k for k, column in enumerate(run.columns) if column in names]
        self.update(phase="starting", total=run.rows, start=run.start, step=run.step, made=id(run))

    def rows(self, time: Array, values: Array) -> None:
        """Keep the extremes of new rows."""
        if not self._envelope.rows:
            self._rate = _now(), float(time[0])
            self.update(phase="running")
        self._envelope.add(values)

    def end(self) -> None:
        """Show that the files of the run are being written."""
        self.update(phase="writing")

    def show_outcome(self, outcome: Outcome) -> None:
        """Show the criteria and the report of a complete run."""
        self.report = outcome.folder / "report.html"
        title = str(outcome.manifest["scenario"]["name"])
        self.update(title=title, message="; ".join(sentence(c) for c in outcome.manifest["criteria"]))

    # -- state -----------------------------------------------------------------------------------

    def version(self) -> Any:
        """Return a value that changes with the state."""
        return (*super().version(), self._envelope.rows, self._is_paused())

    def state(self) -> dict[str, Any]:
        """Return the whole state."""
        state, rows, run = super().state(), self._envelope.rows, self._run
        now = run.start + run.step * max(0, rows - 1)
        since, first = self._rate
        duration = _now() - since
        if state["phase"] == "running":
            speed = (now - first) / duration if rows > 1 and duration > 0.0 else None
            self._state["speed"] = state["speed"] = speed
            if self._is_paused():
                state["phase"] = "paused"
        state["changes"], state["values"] = self._changes(), self._values()
        return {**state, "rows": rows, "now": now, "end": run.start + run.step * max(0, run.rows - 1)}

    def _values(self) -> dict[str, float | None]:
        """Return the current values of the inputs that can be changed."""
        last = self._envelope.last()
        return {self._run.columns[k]: _finite(float(last[k])) for k in self._inputs}

    def _is_paused(self) -> bool:
        return self._control is not None and self._control.paused

    def _changes(self) -> list[dict[str, Any]]:
        run = self._run
        return [
            {
                "at": run.start + change.point * run.step,
                "set": {f"{c}.{v}": value for c, values in change.values.items() for v, value in values.items()},
            }
            for change in (self._control.changes if self._control is not None else ())
        ]

    # -- requests ---------------------------------------------------------------------------------

    def routes(self) -> Mapping[str, Handler]:
        """Return the routes of rows and changes."""
        return {
            **super().routes(),
            "GET /about": self._about,
            "GET /rows": self._rows,
            "POST /set": self._set,
            "POST /pause": self._pause,
        }

    def _about(self, request: Request) -> Answer:
        """Return signals and variables that can be changed."""
        run = self._run
        signals = [{"name": name, "unit": run.units.get(name, "")} for name in run.columns]
        variables = [
            {
                "name": v.name,
                "input": v.is_input,
                "kind": v.kind,
                "unit": v.unit,
                "start": _start(v),
                "bounds": [_finite(bound) if abs(bound) < LARGEST_BOUND else None for bound in v.bounds],
                "items": list(v.items),
                "description": v.description,
            }
            for v in (self._control.variables if self._control is not None else ())
            if not v.shape
        ]
        return json_answer({"signals": signals, "variables": variables})

    def _rows(self, request: Request) -> Answer:
        """Return least and largest values of groups of rows within a time window, and the last row, as doubles."""
        run, envelope = self._run, self._envelope
        try:
            places = [int(k) for k in request.query.get("signals", "").split(",") if k]
            begin, end = (
                float(request.query.get(name, default)) for name, default in (("from", "-inf"), ("to", "inf"))
            )
            count = min(MAX_GROUPS, max(1, int(request.query.get("count", "1000"))))
        except ValueError as error:
            message = f"is {error!s}; give numbers"
            raise InputError.at(Path("rows"), message) from None
        if any(not 0 <= k < len(run.columns) for k in places) or math.isnan(begin) or math.isnan(end):
            raise InputError.at(Path("rows"), f"is {places}; give places of signals")
        first, last = (int(max(0.0, min((t - run.start) / run.step, run.rows))) for t in (begin, end))
        found = envelope.extremes(places, first - 1, last + 2, count)
        head = HEAD.pack(
            run.start + found.first * run.step, found.size * run.step, found.low.shape[1], len(places), envelope.rows
        )
        parts = (found.low, found.high, envelope.last()[places])
        body = b"".join([head, *(np.ascontiguousarray(part, "<f8").tobytes() for part in parts)])
        return Answer(body, "application/octet-stream")

    def _controlled(self) -> Control:
        """Return the control of the run; raise InputError before its begin and after its end."""
        self.check_running()
        if self._control is None or self._state["phase"] == "writing":
            raise InputError.at(Path(self.activity), f"the {self.activity} has ended, so that nothing can be changed")
        return self._control

    def _set(self, request: Request) -> Answer:
        """Change variables."""
        values = request.content
        if not isinstance(values, dict) or not all(isinstance(v, (str, int, float, bool)) for v in values.values()):
            message = "is no mapping; give variables with numbers, text, true or false"
            raise InputError.at(Path("set"), message)
        control = self._controlled()
        kinds = {v.name: v.kind for v in control.variables}
        set_values = control.set({n: v if kinds.get(n) in NO_NUMBERS else _number(v) for n, v in values.items()})
        self.update()
        return json_answer({"set": set_values})

    def _pause(self, request: Request) -> Answer:
        """Pause or continue."""
        if not isinstance(request.content, bool):
            message = f"is {request.content}; give true or false"
            raise InputError.at(Path("pause"), message)
        self._controlled().paused = request.content
        self.update()
        return json_answer({"paused": request.content})


def _start(variable: Variable) -> Any:
    """Return the start value as the page shows it: that of an enumeration by name."""
    names = {str(number): name for name, number in variable.items.items()}
    start = names.get(str(variable.start), variable.start)
    return start if isinstance(start, (int, float, str, bool)) or start is None else str(start)


def _now() -> float:
    return time.monotonic()


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _number(value: Any) -> Any:
    """Return text of a plain number as a number, and other values as they are."""
    if not isinstance(value, str):
        return value
    text = value.strip().replace("\u2212", "-")
    for kind in (int, float):
        try:
            number = kind(text)
        except ValueError:
            continue
        return number if math.isfinite(number) else value
    return value
