"""Simulations that try how an FMU behaves: reset, rollback, own steps, memory, other folders. In the worker process."""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.blocks.component import Signal
from cosim.blocks.description import Way, library_of
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.model_exchange import ModelExchange2
from cosim.isolation.memory import resident
from cosim.probing.log_runs import Course, Fmu, begin, bound_row, put_row, run_along, step_row

Moment = Literal["both", "before", "inside"]
WARM, INSTANCES = 3, 12  # instances before and during the measurement of memory


class TriedFmu(FmuBlock):
    """An FMU with start values set before initialization mode, inside it, or at both moments.

    Attributes:
        moment: When start values are set.
    """

    moment: Moment = "both"

    def reset_and_begin(self, start: float, stop: float) -> None:
        """Reset the FMU and enter initialization mode."""
        with self.instance.check_calls():
            self.instance.fmu.reset()
        self._begin(start, stop)

    def _is_set_again(self, name: str) -> bool:
        return self.moment != "before" and super()._is_set_again(name)

    def _begin(self, start: float, stop: float) -> None:
        values = self.start_values
        try:
            self.start_values = {} if self.moment == "inside" else values
            super()._begin(start, stop)
        finally:
            self.start_values = values
        if self.moment == "inside":
            with self.instance.check_calls():
                self._values.set(values)


@dataclass(frozen=True, eq=False)
class Trial:
    """An FMU, its interface and the inputs of a trial.

    Attributes:
        recorded: Names of variables that are read beside the outputs.
        moment: When start values are set.
    """

    fmu: Fmu
    way: Way
    course: Course
    recorded: frozenset[str] = frozenset()
    moment: Moment = "both"

    def with_values(self, values: Mapping[str, Any], moment: Moment = "both") -> Trial:
        """Return the trial with further start values."""
        return replace(self, fmu=replace(self.fmu, values={**self.fmu.values, **values}), moment=moment)

    def along(self, course: Course) -> Trial:
        """Return the trial with other inputs."""
        return replace(self, course=course)

    def unpacked_in(self, place: Path) -> Trial:
        """Return the trial with the FMU unpacked elsewhere."""
        return replace(self, fmu=replace(self.fmu, place=place))

    def by(self, way: Way) -> Trial:
        """Return the trial by another interface."""
        return replace(self, way=way)

    def signals(self) -> tuple[Signal, ...]:
        """Return the variables that are read, outputs first."""
        return self._block().outputs

    def _block(self) -> TriedFmu:
        fmu = self.fmu
        values = fmu.description, fmu.values, frozenset(self.course.inputs)
        block = TriedFmu(fmu.name, fmu.path, *values, way=self.way, recorded=self.recorded)
        block.moment = self.moment
        return block

    @contextmanager
    def opened(self) -> Iterator[tuple[TriedFmu, Any]]:
        """Yield an instance before its initialization, and the row of its signals."""
        with closing(self._block()) as block:
            yield block, bound_row(block, self.course, self.fmu.place)


def outputs_of(trial: Trial) -> tuple[Array, SimulationError | None]:
    """Return the outputs along the course, and the error that ended it early."""
    with trial.opened() as (block, row):
        return run_along(block, row, trial.course)


def time_of(trial: Trial) -> float:
    """Return the duration of a simulation, loading included [s]."""
    begin = time.monotonic()
    outputs_of(trial)
    return time.monotonic() - begin


def outputs_again(trial: Trial) -> tuple[Array, Array]:
    """Return the outputs of two simulations one after the other, between which the library stays loaded."""
    import fmpy

    with trial.opened() as (block, row):
        library, _ = library_of(trial.fmu.place, block.description, block.calls.identifier) or (None, "")
        kept = ctypes.CDLL(str(library))
        first, _ = run_along(block, row, trial.course)
    second, _ = outputs_of(trial)
    fmpy.freeLibrary(kept._handle)
    return first, second


def outputs_together(trial: Trial) -> tuple[Array, Array]:
    """Return the outputs of two instances that exist at the same time."""
    with trial.opened() as (first, row), trial.opened() as (second, other):
        return run_along(first, row, trial.course)[0], run_along(second, other, trial.course)[0]


def outputs_in(trial: Trial, folder: Path) -> Array:
    """Return the outputs of an FMU that runs in another working directory."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        return outputs_of(trial)[0]
    finally:
        os.chdir(before)


def outputs_after_reset(trial: Trial) -> Array:
    """Return the outputs of an FMU that has been simulated and reset."""
    course = trial.course
    with trial.opened() as (block, row):
        run_along(block, row, course)
        block.reset_and_begin(float(course.time[0]), float(course.time[-1]) + course.step)
        put_row(block, row, course, 0)
        return run_along(block, row, course)[0]


def outputs_after_rollback(trial: Trial, at: int) -> tuple[Array, Array]:
    """Return the outputs from a row on, and the same again after the state of that row is restored."""
    with trial.opened() as (block, row):
        first, width = len(block.inputs), len(block.outputs)
        begin(block)
        parts: list[Array] = []
        _go(block, row, trial.course, range(at))
        state = block.instance.save_state()
        for repeated in (False, True):
            if repeated:
                block.instance.restore_state(state)
                block.instance.time = float(trial.course.time[at])
            block.get()
            table = [row[first : first + width]]
            table += _go(block, row, trial.course, range(at, trial.course.time.size - 1))
            parts.append(np.array(table))
        return parts[0], parts[1]


def _go(block: FmuBlock, row: Any, course: Course, rows: range) -> list[list[float]]:
    """Step through a course and return the outputs."""
    table, first = [], len(block.inputs)
    for k in rows:
        step_row(block, row, course, k)
        table.append(row[first : first + len(block.outputs)])
    return table


def outputs_with_step(trial: Trial, step: float, count: int) -> Array:
    """Return the outputs after each of `count` steps with the first inputs of the course held."""
    course = trial.course
    held = {n: np.repeat(v[:1], count + 1) for n, v in course.inputs.items()}
    times = np.asarray(course.time[0] + step * np.arange(count + 1), np.float64)
    return outputs_of(trial.along(Course(course.name, times, held, {}, step)))[0]


def growth(trial: Trial) -> float:
    """Return the growth of this process per instance [bytes]."""
    size = 0
    for k in range(WARM + INSTANCES):
        if k == WARM:
            size = resident(os.getpid())
        with trial.opened() as (block, _):
            block.start()
    return (resident(os.getpid()) - size) / INSTANCES


def event_shares(trial: Trial) -> tuple[dict[str, int], int]:
    """Return the number of events by kind along a course in model exchange, and the number of steps."""
    with trial.opened() as (block, row):
        table, _ = run_along(block, row, trial.course)
        calls = block.calls
        assert isinstance(calls, ModelExchange2)
        return dict(calls.event_counts), max(1, len(table) - 1)
