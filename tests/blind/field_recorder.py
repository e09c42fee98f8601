"""Recorder of readings: noise, rounding, outliers, wrong time stamps and lost cells."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from tests.blind.field_rig import Array, Random, Rig

FAULTS = ("quantised", "outliers", "jitter", "dropouts", "noise", "timing")
OUTLIER_SHARE, OUTLIER_SIZE = 0.005, 30.0  # of the cells; in standard deviations


@dataclass(frozen=True)
class Recorder:
    """Settings of a study's recorder; a fault that is absent has its harmless value.

    noise:     output → true standard deviation over the stated standard deviation
    quantum:   output → quantization step, in standard deviations of the output's noise
    outliers:  share of the cells
    jitter:    largest deviation of a row from its time, as a share of a step; the time stamp is correct
    lost:      share of lost rows (`whole_rows`) or lost cells; `hole`: number of consecutive lost rows in each log
    timing:    standard deviation [s] of wrong time stamps, over the time in which readings move by their noise
    """

    faults: tuple[str, ...] = ()
    noise: dict[str, float] = field(default_factory=dict)
    quantum: dict[str, float] = field(default_factory=dict)
    outliers: float = 0.0
    jitter: float = 0.0
    lost: float = 0.0
    whole_rows: bool = False
    hole: int = 0
    timing: float = 0.0

    @classmethod
    def draw(cls, rng: Random, outputs: Sequence[str], longest_hole: int) -> Self:
        """Return a recorder with one or two random faults."""
        faults = tuple(sorted(str(f) for f in rng.choice(FAULTS, rng.integers(1, 3), replace=False)))
        noise = {o: float(np.exp(rng.uniform(np.log(0.4), np.log(2.5)))) for o in outputs}
        coarse = [o for o in outputs if rng.random() < 0.6] or [str(rng.choice(outputs))]
        quantum = {o: float(rng.uniform(1.0, 4.0)) for o in coarse}
        jitter, lost, timing = (float(rng.uniform(*between)) for between in ((0.05, 0.2), (0.01, 0.03), (1.0, 3.0)))
        whole, hole = bool(rng.random() < 0.5), int(rng.integers(3, longest_hole + 1)) * int(rng.random() < 0.3)
        return cls(
            faults,
            noise if "noise" in faults else dict.fromkeys(outputs, 1.0),
            quantum if "quantised" in faults else {},
            OUTLIER_SHARE if "outliers" in faults else 0.0,
            jitter if "jitter" in faults else 0.0,
            lost if "dropouts" in faults else 0.0,
            whole,
            hole if "dropouts" in faults else 0,
            timing if "timing" in faults else 0.0,
        )

    def times(self, rng: Random, count: int, step: float) -> Array:
        """Return the true times of the rows [s]."""
        away = self.jitter * rng.uniform(-1.0, 1.0, count)
        away[0] = 0.0
        return np.round((np.arange(count) + away) * step, 6)

    def deviations(self, rig: Rig) -> Array:
        """Return the true standard deviation of each sensor's noise."""
        return np.array([sigma * self.noise[o] for o, sigma in rig.outputs.items()])

    def stamp_error(self, rig: Rig, readings: Array) -> float:
        """Return the standard deviation of wrong time stamps [s], half a step at most."""
        moving = np.sqrt(np.mean(np.gradient(readings, rig.step, axis=0) ** 2, axis=0))
        return min(0.5 * rig.step, self.timing * float(np.median(self.deviations(rig) / moving)))

    def variances(self, rig: Rig, readings: Array, stamp_error: float, kept: Array) -> Array:
        """Return the variance of each cell about the true reading, without outliers; infinite for a missing cell."""
        cells = np.array([self.quantum.get(o, 0.0) for o in rig.outputs]) * self.deviations(rig)
        slopes = np.gradient(readings, rig.step, axis=0)
        return np.where(kept, self.deviations(rig) ** 2 + cells**2 / 12.0 + (stamp_error * slopes) ** 2, np.inf)

    def rows_to_keep(self, rng: Random, count: int, width: int) -> Array:
        """Return which cells are recorded, shape (rows, outputs)."""
        if not self.lost:
            return np.ones((count, width), bool)
        drawn = rng.random((count, 1 if self.whole_rows else width)) >= self.lost
        kept = np.broadcast_to(drawn, (count, width)).copy()
        if self.hole:
            begin = int(rng.integers(count // 4, 3 * count // 4))
            kept[begin : begin + self.hole] = False
        kept[[0, -1]] = True
        return kept

    def spoil(self, rng: Random, rig: Rig, readings: Array, noise: Array, stamp_error: float) -> Array:
        """Return all cells with errors of time stamps, noise, quantization and outliers."""
        slopes = np.gradient(readings, rig.step, axis=0)
        cells = readings + stamp_error * rng.standard_normal((len(readings), 1)) * slopes + noise
        for number, (output, sigma) in enumerate(zip(rig.outputs, self.deviations(rig), strict=True)):
            if output in self.quantum:
                quantum = self.quantum[output] * sigma
                cells[:, number] = quantum * np.round(cells[:, number] / quantum)
        hit = rng.random(cells.shape) < self.outliers
        return cells + hit * rng.choice([-1.0, 1.0], cells.shape) * OUTLIER_SIZE * self.deviations(rig)
