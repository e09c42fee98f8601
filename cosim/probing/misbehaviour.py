"""Misbehaviour of an FMU that one step does not show: repetition, other folders, reset, saved states and memory."""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from cosim.core.arrays import Array
from cosim.core.errors import FmuError, SimulationError
from cosim.fmi.description import Way, library_of, ways
from cosim.probing.log_runs import SAME, Course, Fmu, outputs_along, put_row, run_along, sine_course
from cosim.probing.own_step import excited_course
from cosim.probing.prober import Prober

WARM, INSTANCES = 2, 6  # instances before and during the measurement of memory
LEAK = 1e6  # growth per instance that is no waste of the allocator [bytes]
NOISE = 5.0  # difference relative to that of equal simulations, from which it is another result


def misbehaviour(fmu: Path) -> Iterator[str]:
    """Yield a sentence on each misbehaviour of an FMU along small sines; nothing of one that fails at its start."""
    with Prober(fmu) as prober:
        way, *_ = ways(prober.description)
        if prober.description.fmiVersion.startswith("1"):
            return
        course = excited_course(prober, sine_course(prober.description, {}))
        start = time.monotonic()
        try:
            first, stop = prober.call(outputs_along, prober.fmu, course, way)
        except (SimulationError, FmuError):
            return
        if stop is not None or not first.size:
            return
        limits = prober.hurried(time.monotonic() - start)

        def tried(job: Callable[..., Any], *arguments: Any) -> Any:
            try:
                return prober.call(job, way, prober.fmu, course, *arguments, limits=limits)
            except (SimulationError, FmuError) as error:
                return error

        again = tried(outputs_again)
        noise = np.zeros(first.shape[1]) if isinstance(again, Exception) else _gaps(first, again)
        yield from _on_difference("a second simulation", first, again)
        yield from _on_difference(
            "a simulation in another working directory", first, tried(outputs_in, str(prober.place)), noise
        )
        yield from _on_difference("a simulation after a reset", first, tried(outputs_after_reset), noise)
        part = prober.description.coSimulation
        if way == "co-simulation" and (
            getattr(part, "canGetAndSetFMUstate", False) or getattr(part, "canGetAndSetFMUState", False)
        ):
            both = tried(outputs_after_restoring, len(first) // 3)
            table, again = (first, both) if isinstance(both, Exception) else both
            yield from _on_difference("a repetition from a saved state", table, again, noise)
        grown = tried(growth)
        if not isinstance(grown, Exception) and grown > LEAK:
            yield f"keeps {grown / 1e6:.2g} MB of memory for each instance after its end"


def _gaps(table: Array, other: Array) -> Array:
    """Return the largest difference of each output; infinite for tables of different length."""
    if table.shape != other.shape:
        return np.full(table.shape[1], np.inf)
    return np.asarray(np.nan_to_num(np.abs(other - table)).max(axis=0, initial=0.0))


def _on_difference(what: str, table: Array, other: Array | Exception, noise: Array | float = 0.0) -> Iterator[str]:
    """Yield a sentence on outputs that differ from those of an equal simulation, or on a failure."""
    if isinstance(other, Exception):
        yield f"{what} fails: {other}"
        return
    size, gaps = np.maximum(np.abs(table).max(axis=0), SAME), _gaps(table, other)
    if share := float((gaps / size)[gaps > SAME * size + NOISE * noise].max(initial=0.0)):
        yield f"{what} has other outputs, by {share:.2g} of their largest value"


# -- in the worker --------------------------------------------------------------------------------


def outputs_again(way: Way, fmu: Fmu, course: Course) -> Array:
    """Return the outputs of a second simulation, between which and the first the library stays loaded."""
    import fmpy

    with fmu.opened(course, way) as (block, row):
        library, _ = library_of(fmu.place, block.description, block.calls.about.modelIdentifier) or (None, "")
        kept = ctypes.CDLL(str(library))
        run_along(block, row, course)
    table, _ = outputs_along(fmu, course, way)
    fmpy.freeLibrary(kept._handle)
    return table


def outputs_in(way: Way, fmu: Fmu, course: Course, folder: str) -> Array:
    """Return the outputs of an FMU that runs in another working directory."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        return outputs_along(fmu, course, way)[0]
    finally:
        os.chdir(before)


def outputs_after_reset(way: Way, fmu: Fmu, course: Course) -> Array:
    """Return the outputs of an FMU that has been simulated and reset."""
    with fmu.opened(course, way) as (block, row):
        run_along(block, row, course)
        with block.instance.check_calls():
            block.instance.fmu.reset()
        block._begin(float(course.time[0]), float(course.time[-1]) + course.step)
        put_row(block, row, course, 0)
        return run_along(block, row, course)[0]


def outputs_after_restoring(way: Way, fmu: Fmu, course: Course, at: int) -> tuple[Array, Array]:
    """Return the outputs from a row on, and the same again after the state of that row is restored."""
    with fmu.opened(course, way) as (block, row):
        _, early = run_along(block, row, course.first(at + 1))
        state = block.instance.save_state()
        table, stop = run_along(block, row, course, at)
        block.instance.restore_state(state)
        block.instance.time = float(course.time[at])
        repeated, failure = run_along(block, row, course, at)
        if error := early or stop or failure:
            raise error
        return table, repeated


def growth(way: Way, fmu: Fmu, course: Course) -> float:
    """Return the growth of this process per instance [bytes]."""
    size = 0
    for k in range(WARM + INSTANCES):
        if k == WARM:
            size = psutil.Process().memory_info().rss
        with fmu.opened(course, way) as (block, _):
            block.start()
    return float(psutil.Process().memory_info().rss - size) / INSTANCES
