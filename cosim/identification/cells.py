"""Load cells: voltage to force by a shape-preserving cubic through calibration points that carry error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from cosim.arrays import Array
from cosim.identification.protocol import CHANNELS, Protocol
from cosim.identification.recordings import Recording, load_in_si
from plant.bench import Bench

RAIL = 1.5  # steps of the converter within which a reading is at the end of its range
MOST_AT_RAIL = 0.01  # share of the readings of a load


@dataclass(frozen=True)
class Cell:
    """Calibration points in SI, in the order of their voltage; each load is off by `error`, a standard deviation.

    left_out: loads whose readings were at the end of the converter's range
    """

    loads: Array
    volts: Array
    error: float
    left_out: tuple[float, ...] = ()

    @cached_property
    def curve(self) -> Any:
        """Load over voltage (Fritsch-Carlson); straight beyond the points."""
        from scipy.interpolate import PchipInterpolator

        return PchipInterpolator(self.volts, self.loads)

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
        return np.asarray(
            inside + slopes[0] * np.minimum(volts - low, 0.0) + slopes[1] * np.maximum(volts - high, 0.0)
        )

    def moved(self, point: int, amount: float) -> Cell:
        """The same with one load off by an amount."""
        loads = self.loads.copy()
        loads[point] += amount
        return replace(self, loads=loads)

    @property
    def left_one_out(self) -> Array:
        """What a curve without each inner point misses it by."""
        inner = range(1, self.loads.size - 1)
        return np.array(
            [
                float(replace(self, loads=np.delete(self.loads, k), volts=np.delete(self.volts, k)).force(self.volts[k]))
                - self.loads[k]
                for k in inner
            ]
        )


Cells = Mapping[str, Cell]


def at_rail(known: Bench, volts: Array) -> Array:
    """Whether readings are at an end of the converter's range."""
    margin = RAIL * known.converter_range / known.converter_levels
    result: Array = (volts <= margin) | (volts >= known.converter_range - margin)
    return result


def cell_of(loads: Sequence[float], volts: Sequence[float], error: float, left_out: Sequence[float] = ()) -> Cell:
    """A cell from its points; ValueError where the voltage does not rise or fall with the load throughout."""
    order = np.argsort(volts)
    f, v = np.asarray(loads, float)[order], np.asarray(volts, float)[order]
    steps = np.diff(f)
    if not (np.all(np.diff(v) > 0) and (np.all(steps > 0) or np.all(steps < 0))):
        bad = next((k for k in range(steps.size) if v[k + 1] <= v[k] or steps[k] * np.median(steps) <= 0), 0)
        raise ValueError(f"between {v[bad]:.4g} V and {v[bad + 1]:.4g} V the load turns back; measure those points again")
    return Cell(f, v, error, tuple(left_out))


def calibrated(protocol: Protocol, hung: Mapping[str, Sequence[Recording]]) -> dict[str, Cell]:
    """The cells, from loads hung on a bench that is played or from points as measured; ValueError as `cell_of`."""
    cells, known = {}, protocol.known
    for channel in CHANNELS:
        cell, unit = protocol.file.cells[channel], load_in_si(protocol, channel)
        if cell.points:
            pairs = [(load * unit, volts, bool(at_rail(known, np.array([volts]))[0])) for load, volts in cell.points]
        else:
            readings = [r.volts[channel] for r in hung[channel]]
            pairs = [
                (load * unit, float(v.mean()), bool(at_rail(known, v).mean() > MOST_AT_RAIL))
                for load, v in zip(cell.loads, readings, strict=True)
            ]
        kept = [(f, v) for f, v, rail in pairs if not rail]
        try:
            cells[channel] = cell_of(
                [f for f, _ in kept], [v for _, v in kept], cell.error * cell.full_scale * unit,
                [f for f, _, rail in pairs if rail],
            )  # fmt: skip
        except ValueError as error:
            raise ValueError(f"cells.{channel}: {error}") from None
    return cells


def force_of(recording: Recording, cells: Cells, channel: str, rest: tuple[float, float] | None) -> Array:
    """Force of a cell over a recording; its tare is what it reads at rest, None leaves it in."""
    cell, volts = cells[channel], recording.volts[channel]
    drift = 0.0 if rest is None else float(volts[recording.rows(rest)].mean()) - cell.zero
    return cell.force(volts - drift)
