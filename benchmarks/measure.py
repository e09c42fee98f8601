"""Measures of all benchmarks: ratios of times, and FMUs in FMPy to compare with."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from types import MappingProxyType
from typing import Any

ROUNDS = 9
NO_VALUES: Mapping[str, float] = MappingProxyType({})
Seconds = Callable[[], float]


def median_ratio(one: Seconds, other: Seconds, rounds: int = ROUNDS) -> float:
    """Return the median ratio of two times, measured in turn; each function returns its own seconds."""
    one(), other()
    return median(one() / other() for _ in range(rounds))


@contextmanager
def running(path: Path, way: str = "CoSimulation", start: Mapping[str, float] = NO_VALUES) -> Iterator[Any]:
    """Yield an instance of FMPy in step or continuous-time mode; it has `references`, `output_names` and `order`."""
    import fmpy

    description = fmpy.read_model_description(str(path))
    fmu = fmpy.instantiate_fmu(fmpy.extract(str(path), tempfile.mkdtemp(dir=path.parent)), description, way)
    fmu.references = {v.name: v.valueReference for v in description.modelVariables}
    fmu.output_names = [v.name for v in description.modelVariables if v.causality == "output"]
    fmu.order = len(description.derivatives)
    fmu.setupExperiment(startTime=0.0)
    fmu.enterInitializationMode()
    for name, value in start.items():
        fmu.setReal([fmu.references[name]], [value])
    fmu.exitInitializationMode()
    if way == "ModelExchange":
        fmu.newDiscreteStates()
        fmu.enterContinuousTimeMode()
    yield fmu
    fmu.terminate()
    fmu.freeInstance()
