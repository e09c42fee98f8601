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
from cosim.base.errors import InputError
from plant.bench import Bench
from plant.identification import messages
from plant.identification.protocol import CHANNELS, Protocol
from plant.identification.recordings import Recording, load_in_si

RAIL = 1.5  # converter steps from the end of the range within which a reading is saturated
RAIL_SLACK = 0.01  # share of the range that a voltmeter may exceed
MIN_POINTS = 3  # points of a curve
NEAR_RAIL = 3.0  # distance of a point from the rail in standard errors, so that chance selects no points


@dataclass(frozen=True)
class Cell:
    """Calibration points in SI, ordered by voltage; `error` is the standard deviation of each load.

    Attributes:
        saturated_loads: Loads with saturated readings.
    """

    loads: Array
    volts: Array
    error: float
    saturated_loads: tuple[float, ...] = ()
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

    @cached_property
    def zero(self) -> float:
        """Return the voltage of zero load on the curve."""
        grid = np.linspace(self.volts[0], self.volts[-1], 4001)
        loads = self.force(grid)
        order = np.argsort(loads)
        return float(np.interp(0.0, loads[order], grid[order]))

    def force(self, volts: Array) -> Array:
        """Return force [N] or moment [N m] for voltages."""
        low, high = self.volts[0], self.volts[-1]
        slopes = self.curve([low, high], 1)
        inside = self.curve(np.clip(volts, low, high))
        return np.asarray(inside + slopes[0] * np.minimum(volts - low, 0.0) + slopes[1] * np.maximum(volts - high, 0.0))

    def shift_load(self, point: int) -> Cell:
        """Return the cell with one load off by its error."""
        loads = self.loads.copy()
        loads[point] += self.error
        return replace(self, loads=loads)

    def _without(self, point: int) -> Cell:
        """Return the cell without one point."""
        return replace(self, loads=np.delete(self.loads, point), volts=np.delete(self.volts, point))

    @property
    def cross_validation_errors(self) -> Array:
        """Return leave-one-out errors at the inner points."""
        errors = []
        for k in range(1, self.loads.size - 1):
            errors.append(float(self._without(k).force(self.volts[k])) - self.loads[k])
        return np.array(errors)


Cells = Mapping[str, Cell]


def at_rail(bench: Bench, volts: Array, margin: Array | float = 0.0) -> Flags:
    """Return True for readings at a limit of the converter: saturated, or within `margin` [V] if that is more."""
    least = np.maximum(RAIL * bench.converter_range / bench.converter_levels, margin)
    result: Flags = (volts <= least) | (volts >= bench.converter_range - least)
    return result


def cell_of(loads: Sequence[float], volts: Sequence[float], error: float, saturated: Sequence[float] = ()) -> Cell:
    """Return a cell from its calibration points.

    Args:
        error: Standard deviation of each load.
        saturated: Loads with saturated readings.

    Raises:
        ValueError: The voltage is not monotonic in the load; its argument is a message.
    """
    order = np.argsort(volts)
    f, v = np.asarray(loads, float)[order], np.asarray(volts, float)[order]
    steps = np.diff(f)
    if not (np.all(np.diff(v) > 0) and (np.all(steps > 0) or np.all(steps < 0))):
        bad = next((k for k in range(steps.size) if v[k + 1] <= v[k] or steps[k] * np.median(steps) <= 0), 0)
        raise ValueError(messages.LOAD_TURNS_BACK(low=v[bad], high=v[bad + 1]))
    return Cell(f, v, error, tuple(saturated))


def calibrate(protocol: Protocol, hung: Mapping[str, Sequence[Recording]]) -> dict[str, Cell]:
    """Calibrate the load cells by simulated loads or measured points, and return them by channel.

    Args:
        hung: Channel → recording of each load; not used for a cell with measured points.

    Raises:
        InputError: The points of a cell give no curve.
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
            cells[channel] = _cell_inside(pairs, cell.error * cell.full_scale * unit, protocol.bench)
        except ValueError as error:
            raise InputError([protocol.yaml.fault(("cells", channel), error.args[0], key=True)]) from None
    return cells


def _cell_inside(pairs: Sequence[tuple[float, float]], error: float, bench: Bench) -> Cell:
    """Return a cell from its unsaturated points.

    Raises:
        ValueError: Too few points are unsaturated, or as in `cell_of`.
    """
    loads, volts = np.array(pairs).T
    shares = volts / bench.converter_range
    beyond = (shares < -RAIL_SLACK) | (shares > 1.0 + RAIL_SLACK)
    if beyond.any():
        raise ValueError(messages.POINT_BEYOND_CONVERTER(value=volts[beyond][0], limit=bench.converter_range))
    per_load = abs(float(np.ptp(volts))) / (float(np.ptp(loads)) or 1.0)
    rail = at_rail(bench, volts, np.where(loads == 0, 0.0, NEAR_RAIL * error * per_load))  # zero load is exact
    inside = ~rail
    if inside.sum() < MIN_POINTS:
        raise ValueError(messages.TOO_FEW_POINTS_IN_RANGE(count=int(inside.sum()), total=len(pairs), least=MIN_POINTS))
    return cell_of(loads[inside].tolist(), volts[inside].tolist(), error, loads[rail].tolist())


def force_of(recording: Recording, cells: Cells, channel: str, rest: tuple[float, float] | None) -> Array:
    """Return the force of a cell without tare.

    Args:
        rest: Window of the tare; None for the thesis' reading, tare included.
    """
    cell, volts = cells[channel], recording.volts[channel]
    if rest is None:
        return replace(cell, smooth=False).force(volts)  # the thesis' cubic
    drift = float(volts[recording.rows(rest)].mean()) - cell.zero
    return cell.force(volts - drift)
