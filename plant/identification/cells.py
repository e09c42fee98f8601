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
from scipy.interpolate import PchipInterpolator

from cosim.core.arrays import Array, Flags
from cosim.core.errors import Fault, refuse
from plant.bench import Bench
from plant.identification.protocol import CHANNELS, Protocol
from plant.identification.recordings import Recording

RAIL_STEPS = 1.5  # converter steps from the end of the range within which a reading is saturated
RAIL_SLACK = 0.01  # share of the range that a voltmeter may exceed
MIN_POINTS = 3  # points of a curve
RAIL_ERRORS = 3.0  # distance of a point from the rail in standard errors, so that chance selects no points


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
        return float(self.volts_of(np.zeros(1), np.linspace(self.volts[0], self.volts[-1], 4001))[0])

    def volts_of(self, forces: Array, grid: Array) -> Array:
        """Return the voltages of forces, by interpolation between the voltages of a grid."""
        loads = self.force(grid)
        order = np.argsort(loads)
        return np.interp(forces, loads[order], grid[order])

    def force(self, volts: Array) -> Array:
        """Return force [N] or moment [N m] for voltages."""
        low, high = self.volts[0], self.volts[-1]
        slopes = self.curve([low, high], 1)
        inside = self.curve(np.clip(volts, low, high))
        return np.asarray(inside + slopes[0] * np.minimum(volts - low, 0.0) + slopes[1] * np.maximum(volts - high, 0.0))

    @property
    def cross_validation_errors(self) -> Array:
        """Return leave-one-out errors at the inner points."""
        errors = []
        for k in range(1, self.loads.size - 1):
            others = replace(self, loads=np.delete(self.loads, k), volts=np.delete(self.volts, k))
            errors.append(float(others.force(self.volts[k])) - self.loads[k])
        return np.array(errors)

    def as_json(self) -> dict[str, Any]:
        """Return the calibration for identify.json."""
        return {
            "loads": self.loads.tolist(),
            "volts": self.volts.tolist(),
            "error": self.error,
            "left_one_out": self.cross_validation_errors.tolist(),
            "at_the_rail": list(self.saturated_loads),
        }


Cells = Mapping[str, Cell]


def at_rail(bench: Bench, volts: Array, margin: Array | float = 0.0) -> Flags:
    """Return True for readings at a limit of the converter: saturated, or within `margin` [V] if that is more."""
    least = np.maximum(RAIL_STEPS * bench.converter_range / bench.converter_levels, margin)
    result: Flags = (volts <= least) | (volts >= bench.converter_range - least)
    return result


def calibrate(protocol: Protocol, hung: Mapping[str, Sequence[Recording]]) -> dict[str, Cell]:
    """Calibrate the load cells by simulated loads or measured points, and return them by channel.

    Args:
        hung: Channel → recording of each load; not used for a cell with measured points.

    Raises:
        InputError: The unsaturated points of a cell are too few, or the voltage is not monotonic in the load.
    """
    cells, faults, limit = {}, list[Fault](), protocol.bench.converter_range
    for channel in CHANNELS:
        cell, unit, text = protocol.file.cells[channel], protocol.load_in_si(channel), ""
        points = cell.points
        if not points:
            hanging = zip(cell.loads, hung[channel], strict=True)
            points = [(load, float(r.volts[channel].mean())) for load, r in hanging]
        loads, volts = np.array([(load * unit, v) for load, v in points]).T
        error = cell.error * cell.full_scale * unit
        per_load = abs(float(np.ptp(volts))) / (float(np.ptp(loads)) or 1.0)
        margin = np.where(loads == 0, 0.0, RAIL_ERRORS * error * per_load)  # zero load is exact
        rail = at_rail(protocol.bench, volts, margin)
        order = np.argsort(volts[~rail])
        f, v = loads[~rail][order], volts[~rail][order]
        steps = np.diff(f)
        turns = (np.diff(v) <= 0) | (steps * (np.median(steps) if steps.size else 0.0) <= 0)
        if (beyond := (volts < -RAIL_SLACK * limit) | (volts > (1.0 + RAIL_SLACK) * limit)).any():
            text = f"a point has {volts[beyond][0]:g} V, beyond the converter's 0 to {limit:g} V; write volts, or "
            text += "`converter_range` under `parameters`"
        elif f.size < MIN_POINTS:
            text = f"{f.size} of {loads.size} points are inside the converter's range and beyond their error of its "
            text += f"ends, and {MIN_POINTS} are needed; measure more points inside it"
        elif turns.any():
            low, high = v[np.argmax(turns)], v[np.argmax(turns) + 1]
            text = f"between {low:.4g} V and {high:.4g} V the load turns back; measure those points again"
        if text:
            faults.append(protocol.yaml.fault(("cells", channel), text, key=True))
        cells[channel] = Cell(f, v, error, tuple(loads[rail].tolist()))
    refuse(faults)
    return cells
