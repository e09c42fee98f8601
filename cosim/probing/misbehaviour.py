"""Checks of an FMU by repeated simulations: repetition, working folder, reset, saved states, memory."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Iterator
from contextlib import chdir, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from cosim.core.arrays import Array
from cosim.core.errors import FmuError, SimulationError
from cosim.fmi.description import Way, library_of, ways
from cosim.probing.places import excited_course
from cosim.probing.prober import (
    RANDOM_DIFFERENCE_RATIO,
    SAME,
    Course,
    Fmu,
    outputs_along,
    probing,
    put_row,
    run_along,
    sine_course,
)

WARM, INSTANCES = 2, 6  # instances created before and during the measurement of memory
LEAKED_BYTES = 1e6  # growth per instance that exceeds allocator overhead [bytes]


def misbehaviour(fmu: Path) -> Iterator[str]:
    """Yield a sentence on each misbehaviour of an FMU along small sines.

    For an FMU that fails at its start, nothing is yielded.
    """
    with probing(fmu) as prober:
        way, *_ = ways(prober.description)
        if prober.description.fmiVersion.startswith("1"):
            return
        course = excited_course(prober, sine_course(prober.description))
        start = time.monotonic()
        try:
            first, stop = prober.call(outputs_along, prober.fmu, course, way)
        except (SimulationError, FmuError):
            return
        if stop is not None or not first.size:
            return
        trials: dict[str, tuple[Any, ...]] = {
            "a second simulation": (outputs_again,),
            "a simulation in another working directory": (outputs_in, str(prober.fmu.place)),
            "a simulation after a reset": (outputs_after_reset,),
        }
        part = prober.description.coSimulation
        if way == "co-simulation" and part.canGetAndSetFMUstate:
            trials["a repetition from a saved state"] = outputs_after_restoring, len(first) // 3
        with prober.hurry(time.monotonic() - start):
            noise = np.zeros(first.shape[1])
            for what, (job, *arguments) in trials.items():
                try:
                    table, other = prober.call(job, way, prober.fmu, course, *arguments)
                except (SimulationError, FmuError) as error:
                    yield f"{what} fails: {error}"
                    continue
                table = first if table is None else table
                gaps, size = np.full(first.shape[1], np.inf), np.maximum(np.abs(table).max(axis=0), SAME)
                if table.shape == other.shape:
                    gaps = np.nan_to_num(np.abs(other - table)).max(axis=0, initial=0.0)
                if share := float((gaps / size)[gaps > SAME * size + RANDOM_DIFFERENCE_RATIO * noise].max(initial=0.0)):
                    yield f"{what} gives different outputs, by {share:.2g} of their largest value"
                noise = gaps if job is outputs_again else noise
            with suppress(SimulationError, FmuError):
                if (grown := prober.call(growth, way, prober.fmu, course)) > LEAKED_BYTES:
                    yield f"leaks {grown / 1e6:.2g} MB of memory per instance"


# -- in the worker --------------------------------------------------------------------------------


# Each function returns reference outputs (None: outputs of an ordinary simulation) and outputs to compare with them.


def outputs_again(way: Way, fmu: Fmu, course: Course) -> tuple[None, Array]:
    """Return the outputs of a second simulation in the same process; the library stays loaded in between."""
    import fmpy

    with fmu.opened(course, way) as (block, row):
        library, _ = library_of(fmu.place, block.description, block.instance.about.modelIdentifier) or (None, "")
        kept = ctypes.CDLL(str(library))
        run_along(block, row, course)
    table, _ = outputs_along(fmu, course, way)
    fmpy.freeLibrary(kept._handle)
    return None, table


def outputs_in(way: Way, fmu: Fmu, course: Course, folder: str) -> tuple[None, Array]:
    """Return the outputs of an FMU in another working directory."""
    with chdir(folder):
        return None, outputs_along(fmu, course, way)[0]


def outputs_after_reset(way: Way, fmu: Fmu, course: Course) -> tuple[None, Array]:
    """Return the outputs of an FMU after a simulation and a reset."""
    with fmu.opened(course, way) as (block, row):
        run_along(block, row, course)
        with block.instance.check_calls():
            block.instance.fmu.reset()
        block.begin(float(course.time[0]), float(course.time[-1]) + course.step)
        put_row(block, row, course, 0)
        return None, run_along(block, row, course)[0]


def outputs_after_restoring(way: Way, fmu: Fmu, course: Course, at: int) -> tuple[Array, Array]:
    """Return the outputs from a row on, and again after restoring the state saved at that row."""
    with fmu.opened(course, way) as (block, row):
        _, early = run_along(block, row, course.first(at + 1))
        state = block.save_state()
        table, stop = run_along(block, row, course, at)
        block.restore_state(state)
        block.instance.time = float(course.time[at])
        repeated, failure = run_along(block, row, course, at)
        if error := early or stop or failure:
            raise error
        return table, repeated


def growth(way: Way, fmu: Fmu, course: Course) -> float:
    """Return the memory growth of this process per instance [bytes]."""
    size = 0
    for k in range(WARM + INSTANCES):
        if k == WARM:
            size = psutil.Process().memory_info().rss
        with fmu.opened(course, way) as (block, _):
            block.start()
    return float(psutil.Process().memory_info().rss - size) / INSTANCES
