"""Inputs of a running simulation set by functions of Python."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.base.arrays import Array
from cosim.base.errors import Fault, refuse
from cosim.master.inbox import Control, targets_of
from cosim.master.observer import ObservedRun, Observer
from cosim.system.system import System

InputFunction = Callable[[float, Mapping[str, float]], Any]  # time [s], signals → value, None to hold the last
NamedFunctions = Mapping[str, InputFunction]  # `component.input` → function


class InputFunctions(Observer):
    """Functions that are called with new rows and return values of inputs."""

    def __init__(self, functions: NamedFunctions) -> None:
        self._functions, self._last = dict(functions), dict[str, Any]()
        self._columns: Sequence[str] = ()
        self._control: Control | None = None

    def check(self, system: System) -> None:
        """Raise InputError for names that cannot be set, and for what is no function."""
        targets = targets_of(system)
        reasons = [targets.objection(name) for name in self._functions]
        reasons += [
            f"{n} is of type {type(f).__name__}; give a function of time and signals"
            for n, f in self._functions.items()
            if not callable(f)
        ]
        refuse([Fault(Path("inputs"), 0, 0, reason) for reason in reasons if reason])

    def begin(self, run: ObservedRun) -> None:
        """Note the signals of a run."""
        self._columns, self._control = run.columns, run.control

    def rows(self, time: Array, values: Array) -> None:
        """Call the functions with the last of new rows, and set values that are new."""
        signals = dict(zip(self._columns, values[-1].tolist(), strict=True))
        given = {name: function(float(time[-1]), signals) for name, function in self._functions.items()}
        new = {n: v for n, v in given.items() if v is not None and (n not in self._last or self._last[n] != v)}
        if new and self._control is not None:
            self._control.set(new)
            self._last |= new
