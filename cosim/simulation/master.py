"""The master: steps every component of a system over equal communication steps and records one row a step.

Gauss-Seidel and Jacobi are the same loop. They differ in which transfers a stage makes right before it
steps (`Stage.pulls`) and which wait for the end of the step (`System.held`); Jacobi makes none before.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, MutableSequence

import numpy as np

from cosim.errors import SimulationError, Terminated, stopped
from cosim.isolation.rows import ADVANCE, CALLS, GET, OTHER, PUT, Rows
from cosim.results import Results
from cosim.simulation.system import System
from cosim.simulation.wiring import Transfer

Copies = tuple[tuple[tuple[int, int], ...], tuple[tuple[int, int, list[float]], ...]]
SETTLE = 10  # sweeps after which initial values that still change are called an error
PROGRESS_EVERY = 50


class StoppedRun(Exception):
    """A run that ended early: the error, and the rows recorded so far."""

    def __init__(self, error: SimulationError, results: Results) -> None:
        super().__init__(str(error))
        self.error, self.results = error, results


def simulate(
    system: System,
    steps: int,
    h: float,
    progress: Callable[[int], None] | None = None,
    rows: Rows | None = None,
) -> Results:
    """Run `steps` communication steps of `h` [s]: steps + 1 rows. StoppedRun where a component fails.

    rows: where they are written, shape (steps + 1, columns); in memory without
    """
    components = [stage.component for stage in system.stages]
    row = (ctypes.c_double * len(system.columns))()
    rows = rows or Rows.in_memory(steps + 1, len(system.columns))
    table, made, doing = rows.table, rows.made, rows.doing
    time = system.start + h * np.arange(steps + 1, dtype=np.float64)  # counted, not summed
    place = {name: k for k, name in reversed(list(enumerate(c.partition(".")[0] for c in system.columns)))}
    stages = [(_calls(k), s.component, *_copies(s.pulls, system.seed, steps + 1)) for k, s in enumerate(system.stages)]
    held, held_noisy = _copies(system.held, system.seed, steps + 1)
    here, there, size = ctypes.addressof(row), table.ctypes.data, ctypes.sizeof(row)
    done = 0
    try:
        for component in components:
            component.bind(row, place.get(component.name, 0))
        for k, component in enumerate(components):
            doing[0] = CALLS * k + OTHER
            component.open(system.start, float(time[-1]))
        _initialize(stages, (held, held_noisy), row, doing)
        for k, component in enumerate(components):
            doing[0] = CALLS * k + OTHER
            component.start()
        ctypes.memmove(there, here, size)
        done = made[0] = 1
        for k in range(1, steps + 1):
            t = system.start + (k - 1) * h
            for (putting, advancing, getting), component, plain, noisy in stages:
                for source, target in plain:
                    row[target] = row[source]
                for source, target, samples in noisy:
                    row[target] = row[source] + samples[k]
                doing[0] = putting
                component.put()
                doing[0] = advancing
                component.advance(t, h)
                doing[0] = getting
                component.get()
            for source, target in held:
                row[target] = row[source]
            for source, target, samples in held_noisy:
                row[target] = row[source] + samples[k]
            ctypes.memmove(there + k * size, here, size)
            done = made[0] = k + 1
            if progress is not None and k % PROGRESS_EVERY == 0:
                progress(k)
    except (SimulationError, KeyboardInterrupt, Terminated) as stop:
        error = stopped(stop, float(time[max(0, done - 1)]))
        raise StoppedRun(error, Results(time[:done], system.columns, table[:done], system.units)) from None
    finally:
        for k, component in enumerate(components):
            doing[0] = CALLS * k + OTHER
            component.close()
    return Results(time, system.columns, table, system.units)


def _copies(transfers: tuple[Transfer, ...], seed: int, count: int) -> Copies:
    """Transfers as (from, to) and, where noise is on them, (from, to, samples)."""
    noisy = [(t, samples) for t in transfers if (samples := t.samples(seed, count)) is not None]
    names = {t.name for t, _ in noisy}
    return (
        tuple((t.source, t.target) for t in transfers if t.name not in names),
        tuple((t.source, t.target, samples) for t, samples in noisy),
    )


def _calls(number: int) -> tuple[int, int, int]:
    """What is written before putting, advancing and getting of a component."""
    return CALLS * number + PUT, CALLS * number + ADVANCE, CALLS * number + GET


def _initialize(
    stages: list[tuple],  # type: ignore[type-arg]
    held: Copies,
    row: ctypes.Array[ctypes.c_double],
    doing: MutableSequence[int],
) -> None:
    """Exchange values in initialization mode until none changes: outputs are current there."""

    def pull(plain: tuple[tuple[int, int], ...], noisy: tuple[tuple[int, int, list[float]], ...]) -> None:
        for source, target in plain:
            row[target] = row[source]
        for source, target, samples in noisy:
            row[target] = row[source] + samples[0]

    for _ in range(SETTLE):
        before = bytes(row)
        for (putting, _, getting), component, *copies in stages:
            pull(*copies)
            doing[0] = putting
            component.put()
            doing[0] = getting
            component.get()
        pull(*held)
        if bytes(row) == before:
            return
    raise SimulationError(
        "initialization", 0.0, f"values still change after {SETTLE} exchanges: an algebraic loop without a fixed point"
    )
