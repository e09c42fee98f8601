"""Load cells: voltage to force by a cubic through calibration points that carry error.

The thesis reads a piecewise cubic that goes through every point (interp1) and so takes on its error; ours is the one
cubic nearest to all of them, where that keeps their shape (rises or falls throughout), else the piecewise one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from cosim.base.arrays import Array, Flags
from plant.bench import Bench
from plant.identification.protocol import CHANNELS, Protocol
from plant.identification.recordings import Recording, load_in_si

RAIL = 1.5  # steps of the converter within which a reading is at the end of its range
RAIL_SLACK = 0.01  # of the range, by which a voltmeter may read beyond the converter's end
LEAST_POINTS = 3  # for a curve
NEAR_RAIL = 3.0  # standard errors of a load, in voltage, that a point keeps from the rail: or chance chooses it


@dataclass(frozen=True)
class Cell:
    """Calibration points in SI, in the order of their voltage; each load is off by `error`, a standard deviation.

    left_out: loads whose readings were at the end of the converter's range
    """

    loads: Array
    volts: Array
    error: float
    left_out: tuple[float, ...] = ()
    smooth: bool = True

    @cached_property
    def curve(self) -> Any:
        """Load over voltage, called with (voltages, order of the derivative)."""
        from scipy.interpolate import PchipInterpolator

        if self.smooth:
            middle = float(self.volts.mean())
            cubic = np.polyfit(self.volts - middle, self.loads, min(3, self.volts.size - 2))
            slope = np.polyval(np.polyder(cubic), np.linspace(self.volts[0], self.volts[-1], 101) - middle)
            if np.all(slope > 0) or np.all(slope < 0):
                return lambda v, order=0: np.polyval(np.polyder(cubic, order), np.asarray(v) - middle)
        return PchipInterpolator(self.volts, self.loads)

    @property
    def as_printed(self) -> Cell:
        """The same, read by the piecewise cubic of the thesis."""
        return replace(self, smooth=False)

    @cached_property
    def zero(self) -> float:
        """Voltage at which the curve says no load."""
        grid = np.linspace(self.volts[0], self.volts[-1], 4001)
        loads = self.force(grid)
        order = np.argsort(loads)
        return float(np.interp(0.0, loads[order], grid[order]))

    def force(self, volts: Array) -> Array:
        """Force [N] or moment [N m] for voltages."""
        low, high = self.volts[0], self.volts[-1]
        slopes = self.curve([low, high], 1)
        inside = self.curve(np.clip(volts, low, high))
        return np.asarray(inside + slopes[0] * np.minimum(volts - low, 0.0) + slopes[1] * np.maximum(volts - high, 0.0))

    def moved(self, point: int, amount: float) -> Cell:
        """The same with one load off by an amount."""
        loads = self.loads.copy()
        loads[point] += amount
        return replace(self, loads=loads)

    @property
    def left_one_out(self) -> Array:
        """What a curve without each inner point misses it by."""
        missed = []
        for k in range(1, self.loads.size - 1):
            rest = replace(self, loads=np.delete(self.loads, k), volts=np.delete(self.volts, k))
            missed.append(float(rest.force(self.volts[k])) - self.loads[k])
        return np.array(missed)


Cells = Mapping[str, Cell]


def at_rail(known: Bench, volts: Array) -> Flags:
    """Whether readings are at an end of the converter's range."""
    margin = RAIL * known.converter_range / known.converter_levels
    result: Flags = (volts <= margin) | (volts >= known.converter_range - margin)
    return result


def cell_of(loads: Sequence[float], volts: Sequence[float], error: float, left_out: Sequence[float] = ()) -> Cell:
    """A cell from its points; ValueError where the voltage does not rise or fall with the load throughout."""
    order = np.argsort(volts)
    f, v = np.asarray(loads, float)[order], np.asarray(volts, float)[order]
    steps = np.diff(f)
    if not (np.all(np.diff(v) > 0) and (np.all(steps > 0) or np.all(steps < 0))):
        bad = next((k for k in range(steps.size) if v[k + 1] <= v[k] or steps[k] * np.median(steps) <= 0), 0)
        place = f"between {v[bad]:.4g} V and {v[bad + 1]:.4g} V"
        raise ValueError(f"{place} the load turns back; measure those points again")
    return Cell(f, v, error, tuple(left_out))


def calibrated(protocol: Protocol, hung: Mapping[str, Sequence[Recording]]) -> dict[str, Cell]:
    """The cells, from loads hung on a bench that is played or from points as measured; ValueError as `cell_of`."""
    cells = {}
    for channel in CHANNELS:
        cell, unit = protocol.file.cells[channel], load_in_si(protocol, channel)
        points = cell.points
        if not points:
            hanging = zip(cell.loads, hung[channel], strict=True)
            points = [(load, float(r.volts[channel].mean())) for load, r in hanging]
        pairs = [(load * unit, volts) for load, volts in points]
        try:
            cells[channel] = _cell_inside(pairs, cell.error * cell.full_scale * unit, protocol.known)
        except ValueError as fault:
            raise ValueError(f"cells.{channel}: {fault}") from None
    return cells


def _cell_inside(pairs: Sequence[tuple[float, float]], error: float, known: Bench) -> Cell:
    """Return a cell from its points inside the converter's range; ValueError if they are too few."""
    for _, reading in pairs:
        if not -RAIL_SLACK <= reading / known.converter_range <= 1.0 + RAIL_SLACK:
            cure = "write volts, or `converter_range` under `parameters`"
            raise ValueError(
                f"a point has {reading:g} V, beyond the converter's 0 to {known.converter_range:g} V; {cure}"
            )
    rail = _at_the_rail(pairs, error, known)
    kept = [pair for pair, out in zip(pairs, rail, strict=True) if not out]
    if len(kept) < LEAST_POINTS:
        message = f"{len(kept)} points are inside the converter's range, and {LEAST_POINTS} are needed"
        if len(kept) < len(pairs):
            message += f"; {len(pairs) - len(kept)} others are at an end of it, or within their error of it"
        raise ValueError(f"{message}; measure more points inside it")
    left_out = [load for (load, _), out in zip(pairs, rail, strict=True) if out]
    loads, volts = zip(*kept, strict=True)
    return cell_of(loads, volts, error, left_out)


def _at_the_rail(pairs: Sequence[tuple[float, float]], error: float, known: Bench) -> list[bool]:
    """Points whose voltage is at an end of the converter's range, or so near that their own error decides it."""
    loads, volts = np.array(pairs).T
    per_load = abs(float(np.ptp(volts))) / (float(np.ptp(loads)) or 1.0)
    margin = max(RAIL * known.converter_range / known.converter_levels, NEAR_RAIL * error * per_load)
    exact = RAIL * known.converter_range / known.converter_levels
    near = [exact if load == 0 else margin for load in loads]  # no load is known for sure
    return [bool(v <= m or v >= known.converter_range - m) for v, m in zip(volts, near, strict=True)]


def force_of(recording: Recording, cells: Cells, channel: str, rest: tuple[float, float] | None) -> Array:
    """Force of a cell over a recording; the tare is read at rest. None: as the thesis reads it, tare and all."""
    cell, volts = cells[channel], recording.volts[channel]
    if rest is None:
        return cell.as_printed.force(volts)
    drift = float(volts[recording.rows(rest)].mean()) - cell.zero
    return cell.force(volts - drift)
