"""Replays through the native FMU of a model's class, of which one library serves every variant.

The FMU that is delivered replays one log too: where the two are not equal, or there is no native one, every replay is
through FMUs in Python, and it is said.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.base.text import plain
from cosim.estimation.problem import Problem
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.loading.build_native import class_fmu
from cosim.loading.file import LoadedModel
from cosim.logs.log import Log
from cosim.refinement.proof.measure import Evidence, replays
from cosim.refinement.proof.refined_models import Variant
from cosim.refinement.record import OTHER_HORIZONS, Part, Replayed, Replays
from cosim.residuals.windows import Replay

EQUAL = 1e-9  # of max(1, largest value), within which native replays are those of the delivered FMU
LogSets = Mapping[Part, Sequence[Log]]


@dataclass(frozen=True)
class Replayer:
    """What replays variants on every set of logs: the fitting problem, where FMUs run, and within what limits."""

    problem: Problem
    sets: LogSets
    worker: Worker | None
    limits: Limits | None

    def every(self, variants: Mapping[str, Variant]) -> Replayed:
        """Replays of every variant on every set; a variant that stands for two is replayed once."""
        horizons = [] if self.problem.table else list(OTHER_HORIZONS.values())
        done: dict[int, dict[Part, dict[float, Evidence]]] = {}
        for variant in variants.values():
            if id(variant) not in done:
                done[id(variant)] = {part: self._on(variant, logs, horizons) for part, logs in self.sets.items()}
        return {name: done[id(variant)] for name, variant in variants.items()}

    def one(self, variant: Variant, log: Log) -> Replay:
        """One log over the model's own horizon."""
        return self._on(variant, [log])[variant.model.horizon][0][1]

    def _on(self, variant: Variant, logs: Sequence[Log], horizons: Sequence[float] = ()) -> dict[float, Evidence]:
        return replays(variant, self.problem, logs, horizons, self.worker, self.limits)


def replayed(
    replayer: Replayer,
    loaded: LoadedModel,
    variants: Mapping[str, Variant],
    have_python: Callable[[], None],
    scratch: Path,
) -> tuple[Replayed, Replays]:
    """Replays of every variant, and through what: natively where that can be and equals the delivered FMU.

    have_python: called before replays of variants in Python; the FMU of "after" is there in any case
    """
    try:
        fmu = class_fmu(loaded, scratch / "class.fmu")
    except InputError as error:
        have_python()
        return replayer.every(variants), Replays(through="python", why=error.faults[0].message)
    native = {id(v): v.natively(fmu) for v in variants.values()}
    played = replayer.every({name: native[id(v)] for name, v in variants.items()})
    part: Part = "validation" if "validation" in replayer.sets else "estimation"
    logs = replayer.sets[part]
    k = min(range(len(logs)), key=lambda i: logs[i].rows)
    after = variants["after"]
    apart = difference(played["after"][part][after.model.horizon][k][1], replayer.one(after, logs[k]))
    if apart <= EQUAL:
        return played, Replays(through="native", log=logs[k].path.name, apart=apart)
    why = f"replays of {logs[k].path.name} through it and through plant.fmu are {plain(apart, 2)} apart"
    have_python()
    return replayer.every(variants), Replays(through="python", why=why, log=logs[k].path.name, apart=apart)


def difference(one: Replay, other: Replay) -> float:
    """The largest difference of an output, of max(1, its largest value); infinite where only one predicts."""
    return max((_apart(values, other.outputs[name]) for name, values in one.outputs.items()), default=0.0)


def _apart(one: Array, other: Array) -> float:
    there = np.isfinite(other)
    if not np.array_equal(there, np.isfinite(one)):
        return float("inf")
    if not there.any():
        return 0.0
    return float(np.max(np.abs(one[there] - other[there])) / max(1.0, float(np.max(np.abs(other[there])))))


def warnings_of(way: Replays) -> Iterator[str]:
    """A native FMU that does not equal the one in Python; nothing where there is none to be had."""
    if way.through == "python" and way.log:
        yield f"the native FMU of the model is not used: {way.why}; every error is that of FMUs in Python"
