"""Load cells: conversion of voltage to force by a cubic through uncertain calibration points.

The thesis uses a piecewise cubic through every point (interp1), including its error. Here one cubic is fitted to all
points if monotonic, else the piecewise cubic is used.
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

RAIL = 1.5  # converter steps from the end of the range within which a reading is saturated
RAIL_SLACK = 0.01  # share of the range that a voltmeter may exceed
LEAST_POINTS = 3  # points of a curve
NEAR_RAIL = 3.0  # distance of a point from the rail in standard errors, so that chance selects no points


@dataclass(frozen=True)
class Cell:
    """Calibration points in SI, ordered by voltage; `error` is the standard deviation of each load.

    Attributes:
        left_out: Loads with saturated readings.
    """

    loads: Array
    volts: Array
    error: float
    left_out: tuple[float, ...] = ()
    smooth: bool = True

    @cached_property
    def curve(self) -> Any:
        """Return load as a function of voltage."""
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
        """Return the cell with the thesis' cubic."""
        return replace(self, smooth=False)

    @cached_property
    def zero(self) -> float:
        """Return the voltage of zero load on the curve."""
        grid = np.linspace(self.volts[0], self.volts[-1], 4001)
        loads = self.force(grid)
        order = np.argsort(loads)
        return float(np.interp(0.0, loads[order], grid[order]))

    def force(self, volts: Array) -> Array:
        """Return force [N] or moment [N m]."""
        low, high = self.volts[0], self.volts[-1]
        slopes = self.curve([low, high], 1)
        inside = self.curve(np.clip(volts, low, high))
        return np.asarray(inside + slopes[0] * np.minimum(volts - low, 0.0) + slopes[1] * np.maximum(volts - high, 0.0))

    def moved(self, point: int, amount: float) -> Cell:
        """Return the cell with one load changed."""
        loads = self.loads.copy()
        loads[point] += amount
        return replace(self, loads=loads)

    @property
    def left_one_out(self) -> Array:
        """Return the error at each inner point of a curve without the point."""
        missed = []
        for k in range(1, self.loads.size - 1):
            rest = replace(self, loads=np.delete(self.loads, k), volts=np.delete(self.volts, k))
            missed.append(float(rest.force(self.volts[k])) - self.loads[k])
        return np.array(missed)


Cells = Mapping[str, Cell]


def at_rail(known: Bench, volts: Array) -> Flags:
    """Return True for saturated readings."""
    margin = RAIL * known.converter_range / known.converter_levels
    result: Flags = (volts <= margin) | (volts >= known.converter_range - margin)
    return result


def cell_of(loads: Sequence[float], volts: Sequence[float], error: float, left_out: Sequence[float] = ()) -> Cell:
    """Return a cell from its points.

    Raises:
        ValueError: The voltage is not monotonic in the load.
    """
    order = np.argsort(volts)
    f, v = np.asarray(loads, float)[order], np.asarray(volts, float)[order]
    steps = np.diff(f)
    if not (np.all(np.diff(v) > 0) and (np.all(steps > 0) or np.all(steps < 0))):
        bad = next((k for k in range(steps.size) if v[k + 1] <= v[k] or steps[k] * np.median(steps) <= 0), 0)
        place = f"between {v[bad]:.4g} V and {v[bad + 1]:.4g} V"
        raise ValueError(f"{place} the load turns back; measure those points again")
    return Cell(f, v, error, tuple(left_out))


def calibrated(protocol: Protocol, hung: Mapping[str, Sequence[Recording]]) -> dict[str, Cell]:
    """Return the cells from simulated loads or measured points.

    Raises:
        ValueError: As in `cell_of`.
    """
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
    """Return a cell from its unsaturated points.

    Raises:
        ValueError: Too few points are unsaturated.
    """
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
    """Return True for points at the rail, or within their own error of it."""
    loads, volts = np.array(pairs).T
    per_load = abs(float(np.ptp(volts))) / (float(np.ptp(loads)) or 1.0)
    margin = max(RAIL * known.converter_range / known.converter_levels, NEAR_RAIL * error * per_load)
    exact = RAIL * known.converter_range / known.converter_levels
    near = [exact if load == 0 else margin for load in loads]  # zero load is exact
    return [bool(v <= m or v >= known.converter_range - m) for v, m in zip(volts, near, strict=True)]


def force_of(recording: Recording, cells: Cells, channel: str, rest: tuple[float, float] | None) -> Array:
    """Return the force of a cell without tare.

    Args:
        rest: Window of the tare; None for the thesis' reading, tare included.
    """
    cell, volts = cells[channel], recording.volts[channel]
    if rest is None:
        return cell.as_printed.force(volts)
    drift = float(volts[recording.rows(rest)].mean()) - cell.zero
    return cell.force(volts - drift)
