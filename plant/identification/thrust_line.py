"""Test 1: thrust without ground effect over the duty (§4.5.1, eqs 4.15-4.22, App. D.3.1)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.base.arrays import Array, Flags
from cosim.model.namespaces import arrays
from plant.bench import Bench
from plant.identification import messages
from plant.identification.cells import Cell, Cells, at_rail
from plant.identification.command_response import held_lag, low_pass
from plant.identification.estimates import (
    Figure,
    Measurement,
    Result,
    make_estimates,
    shifts_of,
)
from plant.identification.protocol import Test
from plant.identification.recordings import Recording
from plant.powertrain import ground_effect

DEGREES = (1, 2, 3)
MARGIN = 0.02  # [%] margin of duty to the cell's range and to zero thrust, since a low pass has memory
MEMORY = 5.0  # lags and low passes after which a higher duty is forgotten to 1 %
MIN_ROWS, MIN_DUTY_RANGE = 50, 0.1  # rows of a repetition, [%] of its ramp with thrust, for a line


@dataclass(frozen=True)
class LineReadings:
    """Readings of a line fit.

    Attributes:
        end: Highest duty within the range of the cells [%].
        dead_end: Highest duty of zero thrust [%].
        chosen: Rows of each repetition.
        delayed: Duty in these rows after lag and low pass [%].
        idle: Number of rows within the range but without thrust, of `whole` rows within the range.
    """

    end: float
    dead_end: float
    chosen: Sequence[Flags]
    delayed: Sequence[Array]
    idle: int
    whole: int

    @property
    def is_sufficient(self) -> bool:
        """Return True if every repetition has enough rows and range of duty for a line."""
        return all(d.size >= MIN_ROWS and np.ptp(d) >= MIN_DUTY_RANGE for d in self.delayed)


def rows_with_thrust(m: Measurement) -> LineReadings:
    """Return rows in the window and the cell's range where T = max(0, a + b·δ), eq 4.20, is positive.

    Selection is by command only: zero thrust ends at the kink of the equation fitted to all readings.
    """
    bench, test, end = m.bench, m.test, highest_duty(m)
    inside = [r.rows(test.window) & (recent <= end) for r, recent in _recent_duty(m)]
    thrust = [_thrust(m, r, k) for r, k in zip(m.recordings, inside, strict=True)]
    delayed = [_delay_duty(r, bench, test, -np.inf)[k] for r, k in zip(m.recordings, inside, strict=True)]
    if min(d.size for d in delayed) < MIN_ROWS:
        return LineReadings(end, -np.inf, inside, delayed, 0, sum(d.size for d in delayed))
    begins = dead_end(np.concatenate(delayed), np.concatenate(thrust))
    following = [_delay_duty(r, bench, test, begins) for r in m.recordings]
    above = [k & (d > begins + MARGIN) for k, d in zip(inside, following, strict=True)]
    whole = sum(int(k.sum()) for k in inside)
    idle = whole - sum(int(k.sum()) for k in above)
    return LineReadings(end, begins, above, [d[k] for d, k in zip(following, above, strict=True)], idle, whole)


def _thrust(m: Measurement, r: Recording, rows: Flags, using: Cells | None = None) -> Array:
    """Return the thrust [gf] without the ground effect."""
    return m.gram * m.force(r, "z", using)[rows] / _gain(r, rows, m.bench)


def dead_end(duty: Array, thrust: Array) -> float:
    """Return δ₀ [%] of T = b·max(0, δ − δ₀).

    The result is below all duties if a plain line fits best.
    """
    middle = float(duty.mean())
    order = np.argsort(duty)
    x, y = duty[order] - middle, thrust[order]
    slope, offset = np.polyfit(x, y, 1)
    edges = np.linspace(x[0], x[-1], 401)[:-1]

    def above(values: Array) -> Array:
        """Return sums over the values above each edge."""
        sums = np.append(np.cumsum(values[::-1])[::-1], 0.0)
        return np.asarray(sums[np.searchsorted(x, edges, side="right")])

    n, sx, sxx, sy, sxy = (above(v) for v in (np.ones_like(x), x, x * x, y, x * y))
    square, product = sxx - 2.0 * edges * sx + edges**2 * n, sxy - edges * sy
    gained = np.divide(product * np.maximum(product, 0.0), square, out=np.zeros_like(square), where=square > 1e-12)
    best = int(np.argmax(gained))
    crossing = -offset / slope if slope > 0 else -np.inf
    if crossing <= x[0] and float(y @ y) - float(((y - offset - slope * x) ** 2).sum()) >= gained[best]:
        return float(middle + crossing)
    here = float(edges[best])
    for _ in range(20):  # zero of the line through the values above, iterated to the last digit
        rows = x > here
        if rows.sum() < 3:
            break
        slope, offset = np.polyfit(x[rows], y[rows], 1)
        there = -offset / slope if slope > 0 else here
        if not abs(there - here) > 1e-9 or not x[0] <= there < x[-1]:
            break
        here = float(there)
    return middle + here


def analyse(m: Measurement, *, draw: bool = True) -> Result:
    """Return the line a + b·δ [gf, gf/%], and the lowest sufficient degree of one to three."""
    cells, bench, test = m.cells, m.bench, m.test
    rows = rows_with_thrust(m)
    own, delayed = list(zip(m.recordings, rows.chosen, strict=True)), rows.delayed
    bows = [np.zeros_like(d) for d in delayed]  # [gf] error of a reading on a ramp

    def thrusts(using: Cells) -> list[Array]:
        return [_thrust(m, r, k, using) - bow for (r, k), bow in zip(own, bows, strict=True)]

    def lines(using: Cells) -> Array:
        return np.array([np.polyfit(d, y, 1)[::-1] for d, y in zip(delayed, thrusts(using), strict=True)])

    # thesis: all samples with equal weight over the commanded duty, cell as calibrated
    duty = np.concatenate([r.duty[k] for r, k in own])
    raw = np.concatenate([m.gram * m.printed_force(r, "z")[k] for r, k in own])
    slope, offset = np.polyfit(duty, raw, 1)
    names = [
        ("thrust_offset", "gf", float(offset), m.true("thrust_offset")),
        ("thrust_slope", "gf/%", float(slope), m.true("thrust_slope")),
    ]
    line = lines(cells).mean(axis=0)
    bows = [_bow(r, line, cells["z"], bench, test, rows.dead_end)[k] for r, k in own]
    if rows.idle and line[1] > 0:  # the first estimate of zero thrust came from uncorrected ramps
        line = lines(cells).mean(axis=0)
        begins = -line[0] / line[1]
        delayed = [_delay_duty(r, bench, test, begins)[k] for r, k in own]
        bows = [_bow(r, line, cells["z"], bench, test, begins)[k] for r, k in own]
    each = lines(cells)
    shifts = shifts_of(lines, cells, "z", each)
    result = Result("thrust_line", make_estimates(names, each, shifts, "Test 1, line by repetition"))
    thrust = thrusts(cells)
    degree, errors = least_degree(delayed, thrust)
    r2 = float(np.corrcoef(duty, raw)[0, 1] ** 2)
    result.details = {"degree": degree, "rmse_left_out_gf": errors, "r2": r2}
    result.details |= {"highest_duty": rows.end, "readings_without_thrust": rows.idle}
    result.notes.append(messages.DEGREE(r2=r2, degree=degree))
    _add_notes(result, m, rows)
    if degree > 1:
        _bend(result, degree, errors, np.concatenate(delayed), np.concatenate(thrust))
    if draw:
        result.figures = _figures(result, duty, raw, each, shifts)
    return result


def _add_notes(result: Result, m: Measurement, rows: LineReadings) -> None:
    """Add notes on excluded readings and their reasons."""
    if rows.idle:
        result.warnings.append(messages.IDLE_READINGS(idle=rows.idle, total=rows.whole, duty=rows.dead_end))
    top = max(float(r.duty[r.rows(m.test.window)].max()) for r in m.recordings)
    if rows.end < top - 1e-9:
        result.notes.append(messages.SHORT_RANGE(limit=rows.end + MARGIN, end=rows.end, top=top))


def _bend(result: Result, degree: int, errors: dict[int, float], duty: Array, thrust: Array) -> None:
    """Extend the intervals to all tangents of a curve of `degree`, and add a warning that the thrust is nonlinear."""
    curve = np.poly1d(np.polyfit(duty - 6.0, thrust, degree))
    grid = np.linspace(duty.min(), duty.max(), 101)
    slopes = curve.deriv()(grid - 6.0)
    spans = {"thrust_slope": slopes, "thrust_offset": curve(grid - 6.0) - slopes * grid}
    reason = f"the thrust bends: degree {degree} misses repetitions left out by {errors[degree]:.3g} gf, a line by "
    reason += f"{errors[1]:.3g} gf"
    for k, e in enumerate(result.estimates):
        low, high = min(e.low, float(spans[e.name].min())), max(e.high, float(spans[e.name].max()))
        origin = f"{e.origin}; {reason}, so the interval reaches over the tangents"
        result.estimates[k] = replace(e, low=low, high=high, origin=origin)
    result.warnings.append(messages.BENT_THRUST(reason=reason, low=duty.min(), high=duty.max()))


def _gain(r: Recording, rows: Flags, bench: Bench) -> Array:
    gain: Array = ground_effect(arrays(), r.height[rows], bench.propeller_radius, bench.ground_effect_exponent)
    return gain


def _delay_duty(r: Recording, bench: Bench, test: Test, dead_end: float) -> Array:
    """Return the duty after lag and low pass, with commands limited to at least `dead_end`, the duty of zero thrust."""
    return low_pass(held_lag(np.maximum(r.duty, dead_end), r.step, bench.lag), r.step, test.low_pass)


def _bow(r: Recording, line: Array, cell: Cell, bench: Bench, test: Test, dead_end: float) -> Array:
    """Return the error [gf] of readings on ramps: the low pass filters volts, and the cell's curve bends."""
    effective = held_lag(np.maximum(r.duty, dead_end), r.step, bench.lag)
    steady = line[0] + line[1] * effective
    everywhere = np.ones(r.time.size, dtype=bool)
    gain, gram = _gain(r, everywhere, bench), 1000.0 / bench.gravity
    grid = np.linspace(0.0, bench.converter_range, 4001)
    forces = cell.force(grid)
    order = np.argsort(forces)
    volts = np.interp(steady * gain / gram, forces[order], grid[order])
    read = gram * cell.force(low_pass(volts, r.step, test.low_pass)) / gain
    return np.asarray(read - low_pass(steady, r.step, test.low_pass))


def _recent_duty(m: Measurement) -> Iterator[tuple[Recording, Array]]:
    """Yield each recording, and for each row the highest recent duty that still influences the reading."""
    highest: dict[bytes, Array] = {}
    for r in m.recordings:
        if (key := r.duty.tobytes()) not in highest:
            count = math.ceil(MEMORY * (m.bench.lag + m.test.low_pass) / r.step)
            before = np.pad(r.duty, (count, 0), mode="edge")
            highest[key] = np.lib.stride_tricks.sliding_window_view(before, count + 1).max(axis=1)
        yield r, highest[key]


@dataclass(frozen=True)
class Beyond:
    """Reading beyond the range of cell z: recording, row, and the highest recent duty that influences it [%]."""

    recording: int
    row: int
    duty: float


def first_beyond(m: Measurement) -> Beyond | None:
    """Return the reading beyond the range of the cell at the lowest duty, or None."""
    first, cell = None, m.cells["z"]
    for k, (r, recent) in enumerate(_recent_duty(m)):
        v = r.volts["z"]
        beyond = at_rail(m.bench, v) | (v < cell.volts[0]) | (v > cell.volts[-1] + 0.1 * np.ptp(cell.volts))
        rows = np.flatnonzero(r.rows(m.test.window) & beyond)
        if rows.size and (duty := float(recent[rows].min())) < (first.duty if first else np.inf):
            first = Beyond(k, int(rows[np.argmin(recent[rows])]), duty)
    return first


def highest_duty(m: Measurement) -> float:
    """Return the highest duty within all cells' ranges.

    Selection is by command, equal for all: selection by value would bias the line.
    """
    first = first_beyond(m)
    end = np.inf if first is None else first.duty - MARGIN
    return min(end, max(float(r.duty[r.rows(m.test.window)].max()) for r in m.recordings))


def least_degree(duty: Sequence[Array], thrust: Sequence[Array]) -> tuple[int, dict[int, float]]:
    """Return the lowest degree about as good as the best."""
    means, spreads = {}, {}
    for degree in DEGREES:
        x = [np.vander(d - 6.0, degree + 1) for d in duty]
        gram = [a.T @ a for a in x]
        side = [a.T @ y for a, y in zip(x, thrust, strict=True)]
        rmse = []
        for k, (a, y) in enumerate(zip(x, thrust, strict=True)):
            theta = np.linalg.solve(sum(gram) - gram[k], sum(side) - side[k])
            rmse.append(float(np.sqrt(np.mean((a @ theta - y) ** 2))))
        means[degree], spreads[degree] = float(np.mean(rmse)), float(np.std(rmse, ddof=1) / np.sqrt(len(rmse)))
    best = min(means, key=lambda d: means[d])
    return next(d for d in DEGREES if means[d] <= means[best] + spreads[best]), means


def _figures(result: Result, duty: Array, raw: Array, each: Array, shifts: Array) -> list[Figure]:
    from scipy import stats

    grid = np.linspace(duty.min(), duty.max(), 60)
    basis = np.stack((np.ones_like(grid), grid))
    a, b = (e.value for e in result.estimates)
    covariance = np.cov(each.T) / each.shape[0] + shifts.T @ shifts
    half = stats.t.ppf(0.975, each.shape[0] - 1) * np.sqrt(np.einsum("ik,ij,jk->k", basis, covariance, basis))
    line, some = a + b * grid, slice(None, None, max(1, duty.size // 1500))
    thesis = result.estimates[0].thesis + result.estimates[1].thesis * grid
    printed = -2076.0 + 359.9 * grid
    bins = np.linspace(duty.min(), duty.max(), 9)
    place = np.clip(np.digitize(duty, bins) - 1, 0, 7)
    filled = [k for k in range(8) if (place == k).sum() > 1]
    spread = np.array([1.96 * np.std((raw - a - b * duty)[place == k], ddof=1) for k in filled])
    middle = 0.5 * (bins[1:] + bins[:-1])[filled]
    axes, unbiased = ("duty [%]", "gf"), ("unbiased", grid, line, "true")
    readings, estimator = ("readings", duty[some], raw[some], "dots"), ("thesis' estimator", grid, thesis, "s1")
    banded = [unbiased, ("printed, eq 4.20", grid, printed, "reference")]
    band = ("95 % of the line", grid, line - half, line + half)
    bars = [(middle, a + b * middle - spread, a + b * middle + spread)]
    lines = [readings, unbiased, estimator]
    return [
        Figure("Thrust over duty: readings and fitted lines", *axes, lines, counterpart="Fig 4.10"),
        Figure("Thrust over duty: line with its 95 % band", *axes, banded, band, bars, counterpart="Fig 4.11"),
    ]
