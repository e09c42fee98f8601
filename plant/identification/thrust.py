"""Tests 1 and 2: thrust over the duty without ground effect, and ground effect over the height.

§4.5.1, eqs 4.15-4.22, App. D.3.1; §4.5.2, eqs 4.23-4.28, App. D.3.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import optimize, stats

from cosim.core.arrays import Array, Flags
from cosim.model.namespaces import arrays
from plant.identification.cells import Cells, at_rail
from plant.identification.estimates import Figure, Measurement, Result, estimated, held_lag, interval, low_pass
from plant.identification.protocol import HeightTest
from plant.identification.recordings import Recording
from plant.powertrain import ground_effect

POLYNOMIAL_DEGREES = (1, 2, 3)
MARGIN = 0.02  # [%] margin of duty to the cell's range and to zero thrust, since a low pass has memory
MEMORY = 5.0  # lags and low passes after which a higher duty is forgotten to 1 %
MIN_LINE_ROWS, MIN_LINE_RANGE = 50, 0.1  # rows of a repetition, [%] of its ramp with thrust, for a line
MIDDLE_DUTY = 6.0  # [%] origin of polynomials in the duty
CHEESEMAN_BENNETT = 2.0


def rows_with_thrust(m: Measurement) -> tuple[float, float, list[Flags], list[Array], int]:
    """Return rows in the window and the cell's range where T = max(0, a + b·δ), eq 4.20, is positive.

    Selection is by command only, equal for all: selection by value would bias the line. Zero thrust ends at the kink of
    the equation fitted to all readings.

    Returns:
        Highest duty within the range of the cells [%], and highest duty of zero thrust [%]; of each repetition the
        rows, and the duty in them after lag and low pass [%]; number of rows within the range, with or without thrust.
    """
    cell, recent, tops, end = m.cells["z"], list[Array](), list[float](), np.inf
    for r in m.recordings:
        # for each row the highest duty that still influences its reading
        count = math.ceil(MEMORY * (m.bench.lag + m.test.low_pass) / r.step)
        before = np.pad(r.duty, (count, 0), mode="edge")
        recent.append(np.lib.stride_tricks.sliding_window_view(before, count + 1).max(axis=1))
        v, window = r.volts["z"], m.inside(r)
        beyond = at_rail(m.bench, v) | (v < cell.volts[0]) | (v > cell.volts[-1] + 0.1 * np.ptp(cell.volts))
        end = min(end, float(recent[-1][window & beyond].min(initial=np.inf)) - MARGIN)
        tops.append(float(r.duty[window].max()))
    end = min(end, max(tops))
    inside = [m.inside(r) & (d <= end) for r, d in zip(m.recordings, recent, strict=True)]
    delayed = [_delayed_duty(m, r, -np.inf)[k] for r, k in zip(m.recordings, inside, strict=True)]
    whole = sum(d.size for d in delayed)
    if min(d.size for d in delayed) < MIN_LINE_ROWS:
        return end, -np.inf, inside, delayed, whole
    thrust = [_thrust(m, r)[k] for r, k in zip(m.recordings, inside, strict=True)]
    begins = zero_thrust(np.concatenate(delayed), np.concatenate(thrust))
    following = [_delayed_duty(m, r, begins) for r in m.recordings]
    above = [k & (d > begins + MARGIN) for k, d in zip(inside, following, strict=True)]
    return end, begins, above, [d[k] for d, k in zip(following, above, strict=True)], whole


def zero_thrust(duty: Array, thrust: Array) -> float:
    """Return δ₀ [%] of T = b·max(0, δ − δ₀); it is below all duties if a plain line fits best."""

    def explained(start: float) -> float:
        """Return the sum of squares that a line from zero thrust explains."""
        ramp = np.maximum(duty - start, 0.0)
        product = max(0.0, float(ramp @ thrust))
        return product * product / max(float(ramp @ ramp), 1e-12)

    edges = np.linspace(duty.min(), duty.max(), 401)[:-1]
    slope, offset = np.polyfit(duty, thrust, 1).tolist()
    crossing = -offset / slope if slope > 0 else np.inf
    best = max(([crossing] if crossing <= edges[0] else []) + edges.tolist(), key=explained)
    if best == crossing:
        return float(crossing)
    around = best - (edges[1] - edges[0]), best + (edges[1] - edges[0])
    return float(optimize.minimize_scalar(lambda start: -explained(start), bounds=around, options={"xatol": 1e-9}).x)


def thrust_line(m: Measurement) -> Result:
    """Return the line a + b·δ [gf, gf/%], and the lowest sufficient degree of one to three."""
    end, begins, chosen, delayed, whole = rows_with_thrust(m)
    own, idle = list(zip(m.recordings, chosen, strict=True)), whole - sum(d.size for d in delayed)
    bows = [np.zeros_like(d) for d in delayed]  # [gf] error of a reading on a ramp

    def thrusts(using: Cells) -> list[Array]:
        return [_thrust(m, r, using)[k] - bow for (r, k), bow in zip(own, bows, strict=True)]

    def lines(using: Cells) -> Array:
        return np.array([np.polyfit(d, y, 1)[::-1] for d, y in zip(delayed, thrusts(using), strict=True)])

    # thesis: all samples with equal weight over the commanded duty, cell as calibrated
    duty = np.concatenate([r.duty[k] for r, k in own])
    raw = np.concatenate([1000.0 / m.bench.gravity * m.printed_force(r, "z")[k] for r, k in own])
    slope, offset = np.polyfit(duty, raw, 1).tolist()
    line = lines(m.cells).mean(axis=0)
    bows = [_bow(m, r, line, begins)[k] for r, k in own]
    if idle and line[1] > 0:  # the first estimate of zero thrust came from uncorrected ramps
        line = lines(m.cells).mean(axis=0)
        delayed = [_delayed_duty(m, r, -line[0] / line[1])[k] for r, k in own]
        bows = [_bow(m, r, line, -line[0] / line[1])[k] for r, k in own]
    thesis = {"thrust_offset": offset, "thrust_slope": slope}
    result = estimated(m, "thrust_line", lines, "z", thesis, "Test 1, line by repetition")
    thrust, r2 = thrusts(m.cells), float(np.corrcoef(duty, raw)[0, 1] ** 2)
    degree, errors = least_degree(delayed, thrust)
    result.details = {"degree": degree, "rmse_left_out_gf": errors, "r2": r2}
    result.details |= {"highest_duty": end, "readings_without_thrust": idle}
    sufficient = f"lowest degree within one standard error of the best: {degree}"
    result.notes.append(f"r² = {r2:.4f} (eq 4.22); {sufficient}")
    if idle:
        result.warnings.append(
            f"{idle} of {whole} readings are without thrust, which begins at {begins:.2f} %: "
            "T = max(0, a + b·δ) is no line there, and they are left out"
        )
    top = max(float(r.duty[m.inside(r)].max()) for r in m.recordings)
    if end < top - 1e-9:
        result.notes.append(
            f"The vertical cell leaves its range above {end + MARGIN:.2f} %; samples below {end:.2f} % are "
            f"used, not up to {top:.2f} %: a cell of a larger range would show the rest."
        )
    if degree > 1:
        _extend_to_tangents(result, degree, errors, np.concatenate(delayed), np.concatenate(thrust))
    # figures
    grid = np.linspace(duty.min(), duty.max(), 60)
    basis = np.stack((np.ones_like(grid), grid))
    a, b = (e.value for e in result.estimates)
    covariance = np.cov(result.each.T) / len(result.each) + result.shifts.T @ result.shifts
    half = stats.t.ppf(0.975, len(result.each) - 1) * np.sqrt(np.einsum("ik,ij,jk->k", basis, covariance, basis))
    fitted, some = a + b * grid, slice(None, None, max(1, duty.size // 1500))
    bins = np.linspace(duty.min(), duty.max(), 9)
    spread = stats.binned_statistic(duty, raw - a - b * duty, _reach, bins).statistic
    middle, spread = (0.5 * (bins[1:] + bins[:-1]))[spread > 0], spread[spread > 0]
    axes, unbiased = ("duty [%]", "gf"), ("unbiased", grid, fitted, "true")
    readings, estimator = (
        ("readings", duty[some], raw[some], "dots"),
        ("thesis' estimator", grid, offset + slope * grid, "s1"),
    )
    banded = [unbiased, ("printed, eq 4.20", grid, -2076.0 + 359.9 * grid, "reference")]
    band = ("95 % of the line", grid, fitted - half, fitted + half)
    bars = [(middle, a + b * middle - spread, a + b * middle + spread)]
    result.figures = [
        Figure(
            "Thrust over duty: readings and fitted lines",
            *axes,
            [readings, unbiased, estimator],
            counterpart="Fig 4.10",
        ),
        Figure("Thrust over duty: line with its 95 % band", *axes, banded, band, bars, counterpart="Fig 4.11"),
    ]
    return result


def _reach(values: Array) -> float:
    """Return 1.96 standard deviations of some values, 0 for fewer than two."""
    return 1.96 * float(np.std(values, ddof=1)) if len(values) > 1 else 0.0


def _extend_to_tangents(result: Result, degree: int, errors: Mapping[int, float], duty: Array, thrust: Array) -> None:
    """Extend the intervals to all tangents of a curve of `degree`, and warn that the thrust is nonlinear."""
    curve = np.poly1d(np.polyfit(duty - MIDDLE_DUTY, thrust, degree))
    grid = np.linspace(duty.min(), duty.max(), 101)
    slopes = curve.deriv()(grid - MIDDLE_DUTY)
    offsets = curve(grid - MIDDLE_DUTY) - slopes * grid
    reason = f"the thrust bends: degree {degree} misses repetitions left out by {errors[degree]:.3g} gf, a line by "
    reason += f"{errors[1]:.3g} gf"
    for k, (e, span) in enumerate(zip(result.estimates, (offsets, slopes), strict=True)):
        low, high = min(e.low, float(span.min())), max(e.high, float(span.max()))
        origin = f"{e.origin}; {reason}, so the interval reaches over the tangents"
        result.estimates[k] = replace(e, low=low, high=high, origin=origin)
    result.warnings.append(
        f"{reason}. The intervals of thrust_offset and thrust_slope reach over the tangents from {duty.min():.2f} to "
        f"{duty.max():.2f} %; choose a `window` about the duty that is flown, and look at the cell's calibration"
    )


def _thrust(m: Measurement, r: Recording, using: Cells | None = None) -> Array:
    """Return the thrust [gf] without the ground effect."""
    return m.gram_force(r, "z", using) / _gain_at(m, r)


def _gain_at(m: Measurement, r: Recording) -> Array:
    """Return the ground effect's gain at the height of each row."""
    gain: Array = ground_effect(arrays(), r.height, m.bench.propeller_radius, m.bench.ground_effect_exponent)
    return gain


def _delayed_duty(m: Measurement, r: Recording, begins: float) -> Array:
    """Return the duty after lag and low pass, with commands limited to at least `begins`, the duty of zero thrust."""
    return low_pass(held_lag(np.maximum(r.duty, begins), r.step, m.bench.lag), r.step, m.test.low_pass)


def _bow(m: Measurement, r: Recording, line: Array, begins: float) -> Array:
    """Return the error [gf] of readings on ramps: the low pass filters volts, and the cell's curve bends."""
    cell, gain, gram = m.cells["z"], _gain_at(m, r), 1000.0 / m.bench.gravity
    steady = line[0] + line[1] * held_lag(np.maximum(r.duty, begins), r.step, m.bench.lag)
    volts = cell.volts_of(steady * gain / gram, np.linspace(0.0, m.bench.converter_range, 4001))
    read = gram * cell.force(low_pass(volts, r.step, m.test.low_pass)) / gain
    return np.asarray(read - low_pass(steady, r.step, m.test.low_pass))


def least_degree(duty: Sequence[Array], thrust: Sequence[Array]) -> tuple[int, dict[int, float]]:
    """Return the lowest degree about as good as the best, and the mean error of repetitions left out by degree."""
    means, spreads = {}, {}
    every = [np.stack((d - MIDDLE_DUTY, y)) for d, y in zip(duty, thrust, strict=True)]
    for degree in POLYNOMIAL_DEGREES:
        rmse = []
        for k, (x, y) in enumerate(every):
            others = np.concatenate([*every[:k], *every[k + 1 :]], axis=1)
            curve = np.polyfit(others[0], others[1], degree)
            rmse.append(float(np.sqrt(np.mean((np.polyval(curve, x) - y) ** 2))))
        means[degree], spreads[degree] = float(np.mean(rmse)), float(stats.sem(rmse))
    best = min(means, key=lambda d: means[d])
    return next(d for d in POLYNOMIAL_DEGREES if means[d] <= means[best] + spreads[best]), means


# -- ground effect --------------------------------------------------------------------------


def ground_effect_exponent(m: Measurement) -> Result:
    """Return the exponent k by least squares on Γ.

    The thesis uses ln((Γ−1)/Γ) (4.24), which is undefined for Γ ≤ 1.
    """
    main, *others = sets_by_duty(m.recordings, m.test)
    heights = np.array(sorted(h for h in main if h < m.test.free_height))
    free, radius = max(main), m.bench.propeller_radius

    def gamma(exponent: float, z: Any, radius: float = radius) -> Array:
        return np.asarray(ground_effect(arrays(), np.asarray(z, float), radius, exponent))

    def relative(exponent: float) -> Array:
        """Return Γ relative to that at the free height."""
        return gamma(exponent, heights) / gamma(exponent, [free])

    def forces(force: Callable[[Recording], Array], chosen: dict[float, list[Recording]] = main) -> Array:
        """Return mean forces, shape (heights, repetitions), free height last."""
        least = min(len(chosen[h]) for h in (*heights, free))
        rows = [[float(force(r)[m.inside(r)].mean()) for r in chosen[h][:least]] for h in (*heights, free)]
        return np.array(rows)

    def gains(using: Cells, estimate: Callable[[Array], Array] = np.asarray) -> Array:
        """Return jackknife pseudo-values of an estimate from Γ, by default Γ itself, shape (repetitions, heights)."""
        f = forces(lambda r: m.force(r, "z", using))
        every, count = np.arange(f.shape[1]), f.shape[1]
        chosen = [every, *(np.delete(every, k) for k in every)]
        whole, *fewer = (estimate(f[:-1, rows].mean(axis=1) / f[-1, rows].mean()) for rows in chosen)
        return np.asarray(count * whole - (count - 1) * np.array(fewer))

    def fitted(gain: Array) -> Array:
        """Return the best k for measured Γ with weights 1/Z̄ (4.27)."""
        roots = np.sqrt(radius / heights)

        def weighted(k: Array) -> Array:
            return np.asarray(roots * (relative(k[0]) - gain))

        exact = dict.fromkeys(("ftol", "xtol", "gtol"), 1e-14)
        return np.asarray(optimize.least_squares(weighted, CHEESEMAN_BENNETT, "3-point", (0.3, 6.0), **exact).x)

    # thesis: ln((Γ−1)/Γ) = k·ln(1/(4Z̄)) with weights 1/Z̄, over all usable ratios
    raw = forces(lambda r: m.printed_force(r, "z"))
    ratios = raw[:-1] / raw[-1]
    good = ratios > 1.0
    z, g = np.repeat((heights / radius)[:, None], ratios.shape[1], axis=1)[good], ratios[good]
    x, y, w = np.log(1.0 / (4.0 * z)), np.log((g - 1.0) / g), 1.0 / z
    thesis = {"ground_effect_exponent": float((w * x * y).sum() / (w * x * x).sum()) if good.any() else np.nan}
    origin = "Test 2, fit on Γ, 1/Z̄"
    result = estimated(m, "ground_effect", lambda using: gains(using, fitted), "z", thesis, origin)
    estimate, dropped = result.estimates[0], int((~good).sum())
    if dropped:
        result.notes.append(
            f"{dropped} of {good.size} single ratios are Γ ≤ 1, where ln((Γ−1)/Γ) has no value: the thesis' "
            "estimator leaves them out and is biased by it."
        )
    result.details = {"heights_over_radius": (heights / radius).tolist(), "dropped": dropped}
    for chosen in others:
        run = next(iter(chosen.values()))[0]
        duty = float(np.median(run.duty[run.rows(m.test.window)]))
        if main.keys() - chosen.keys():
            result.warnings.append(f"the runs at {duty:.4g} % are not used: not every height has one; correct the duty")
            continue
        f = forces(lambda r: m.force(r, "z"), chosen)
        off = f[:-1].mean(axis=1) / f[-1].mean() - relative(estimate.value)
        result.details["validation_rmse"] = rms = float(np.sqrt(np.mean(off**2)))
        result.notes.append(f"Validation at {duty:g} % of duty, not used in the fit: Γ is missed by {rms:.4f} (rms).")
    # figures, over the height in propeller radii
    grid = np.linspace(0.5, 3.3, 90)

    def curve(k: float) -> Array:
        return gamma(k, grid, 1.0)

    measured, (mean, half, *_) = forces(lambda r: m.force(r, "z")), interval(gains(m.cells))
    single, over = measured[:-1] / measured[-1], heights / radius
    several = [(f"k = {k:g}", grid, curve(k), f"s{n}") for n, k in enumerate((1.5, 1.75, 2.0, 2.25, 2.5))]
    readings = ("single ratios", np.repeat(over, single.shape[1]), single.ravel(), "dots")
    models = [
        (f"k = {estimate.value:.3f}", grid, curve(estimate.value), "true"),
        ("Cheeseman and Bennett, k = 2", grid, curve(CHEESEMAN_BENNETT), "reference"),
    ]
    band, bars = ("95 % of k", grid, curve(estimate.high), curve(estimate.low)), [(over, mean - half, mean + half)]
    axes, title = ("height / radius", "Γ"), "Ground effect over height: means with 95 % intervals"
    result.figures = [
        Figure("Ground effect Γ over height, for several exponents k", *axes, several, counterpart="Fig 4.6"),
        Figure("Ground effect over height: readings and models", *axes, [readings, *models], counterpart="Fig 4.12"),
        Figure(title, *axes, models, band=band, bars=bars, counterpart="Fig 4.13"),
    ]
    return result


def height_of(r: Recording, test: HeightTest) -> float:
    """Return a run's height [m], at most `free_height`."""
    return min(round(float(np.median(r.height[r.rows(test.window)])), 4), test.free_height)


def sets_by_duty(recordings: Sequence[Recording], test: HeightTest) -> list[dict[float, list[Recording]]]:
    """Return for each duty the recordings by height; most recordings first, the validation duty last."""
    sets: dict[float, dict[float, list[Recording]]] = {}
    for r in recordings:
        duty = round(float(np.median(r.duty[r.rows(test.window)])), 3)
        sets.setdefault(duty, {}).setdefault(height_of(r, test), []).append(r)
    validation = None if test.validation_duty is None else round(test.validation_duty, 3)
    order = sorted(sets, key=lambda d: (d == validation, -sum(map(len, sets[d].values()))))
    return [sets[d] for d in order]
