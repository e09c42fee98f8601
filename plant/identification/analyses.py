"""Analyses of the tests on a bench: for each test two estimators, notes and figures.

Test 1, thrust over the duty without ground effect: §4.5.1, eqs 4.15-4.22, App. D.3.1. Test 2, ground effect over the
height: §4.5.2, eqs 4.23-4.28, App. D.3.2. Test 3, projections of the thrust: §4.5.3, App. D.3.3. Test 4, lags of tilt
and thrust: §4.5.4, App. D.3.4. Test 5, moment of the weight: §4.5.5, eq 4.10, App. D.3.5.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import optimize, stats
from scipy.signal.windows import gaussian

from cosim.core.arrays import Array, Flags
from cosim.model.namespaces import arrays
from plant.identification.estimates import (
    LAGS,
    Figure,
    Measurement,
    Result,
    estimated,
    held_lag,
    interval,
    least,
    low_pass,
    tilt_response,
)
from plant.identification.protocol import HeightTest, SineTest
from plant.identification.recordings import Recording, at_rail
from plant.powertrain import assembly_moment, ground_effect

POLYNOMIAL_DEGREES = (1, 2, 3)
DUTY_MARGIN = 0.02  # [%] margin of duty to the cell's range and to zero thrust, because of the low pass
MEMORY_TIME_CONSTANTS = 5.0  # number of lags and low passes after which the influence of a higher duty is below 1 %
MIN_LINE_ROWS, MIN_LINE_RANGE = 50, 0.1  # rows of a repetition, [%] of its ramp with thrust, for a line
MIDDLE_DUTY = 6.0  # [%] origin of polynomials in the duty
CHEESEMAN_BENNETT = 2.0
BEFORE = 0.3  # [s] before a step in a fit
END_WINDOW_S = (0.68, 0.88)  # [s] after the step, window of the end value in App. D.3.4
SMOOTHED_ROWS = 9  # rows of the mean in App. D.3.4
DECIBEL, DEGREE = 20.0, 180.0 / np.pi


def rows_with_thrust(m: Measurement) -> tuple[float, float, list[Flags], list[Array], int]:
    """Return rows in the window and the cell's range where T = max(0, a + b·δ), eq 4.20, is positive.

    Rows are selected by command only, because a selection by reading would bias the line. Thrust begins at the kink of
    the equation that is fitted to all readings.

    Returns:
        Highest duty within the range of the cells [%], and highest duty of zero thrust [%]; of each repetition the
        rows, and the duty in them after lag and low pass [%]; number of rows within the range, with or without
        thrust.
    """
    cell, recent, tops, end = m.cells["z"], list[Array](), list[float](), np.inf
    for r in m.recordings:
        # for each row the highest duty that still influences its reading
        count = math.ceil(MEMORY_TIME_CONSTANTS * (m.bench.lag + m.test.low_pass) / r.step)
        before = np.pad(r.duty, (count, 0), mode="edge")
        recent.append(np.lib.stride_tricks.sliding_window_view(before, count + 1).max(axis=1))
        v, window = r.volts["z"], m.inside(r)
        beyond = at_rail(m.bench, v) | (v < cell.volts[0]) | (v > cell.volts[-1] + 0.1 * np.ptp(cell.volts))
        end = min(end, float(recent[-1][window & beyond].min(initial=np.inf)) - DUTY_MARGIN)
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
    above = [k & (d > begins + DUTY_MARGIN) for k, d in zip(inside, following, strict=True)]
    return end, begins, above, [d[k] for d, k in zip(following, above, strict=True)], whole


def zero_thrust(duty: Array, thrust: Array) -> float:
    """Return δ₀ [%] of T = b·max(0, δ − δ₀). If a line without a kink fits best, δ₀ is below all duties."""

    def explained(start: float) -> float:
        """Return the sum of squares explained by a line that starts at zero thrust."""
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

    def thrusts(of: Measurement) -> list[Array]:
        return [_thrust(of, r)[k] - bow for (r, k), bow in zip(own, bows, strict=True)]

    def lines(of: Measurement) -> Array:
        return np.array([np.polyfit(d, y, 1)[::-1] for d, y in zip(delayed, thrusts(of), strict=True)])

    # estimator of the thesis: all samples with equal weight over the commanded duty, cell as calibrated
    duty = np.concatenate([r.duty[k] for r, k in own])
    raw = np.concatenate([1000.0 / m.bench.gravity * m.thesis_force(r, "z")[k] for r, k in own])
    slope, offset = np.polyfit(duty, raw, 1).tolist()
    line = lines(m).mean(axis=0)
    bows = [_bow(m, r, line, begins)[k] for r, k in own]
    if idle and line[1] > 0:  # the first estimate of zero thrust came from uncorrected ramps
        line = lines(m).mean(axis=0)
        delayed = [_delayed_duty(m, r, -line[0] / line[1])[k] for r, k in own]
        bows = [_bow(m, r, line, -line[0] / line[1])[k] for r, k in own]
    thesis = {"thrust_offset": offset, "thrust_slope": slope}
    result = estimated(m, "thrust_line", lines, "z", thesis, "Test 1, line by repetition")
    thrust, r2 = thrusts(m), float(np.corrcoef(duty, raw)[0, 1] ** 2)
    degree, errors = least_degree(delayed, thrust)
    result.details = {"degree": degree, "rmse_left_out_gf": errors, "r2": r2, "highest_duty": end}
    result.details["readings_without_thrust"] = idle
    sufficient = f"lowest degree within one standard error of the best: {degree}"
    result.notes.append(f"r² = {r2:.4f} (eq 4.22); {sufficient}")
    if idle:
        result.warnings.append(
            f"{idle} of {whole} readings have no thrust, because thrust begins at {begins:.2f} %: "
            "T = max(0, a + b·δ) is not linear there, so they are not used"
        )
    top = max(float(r.duty[m.inside(r)].max()) for r in m.recordings)
    if end < top - 1e-9:
        result.notes.append(
            f"Above a duty of {end + DUTY_MARGIN:.2f} %, the vertical cell is out of range, so only samples with a "
            f"duty below {end:.2f} % are used; the runs reach {top:.2f} %. "
            "A cell with a larger range would cover the whole range of the duty."
        )
    if degree > 1:
        result.warnings.append(
            f"the thrust is nonlinear: the cross-validation error is {errors[degree]:.3g} gf with degree {degree}, and "
            f"{errors[1]:.3g} gf with a line; choose a `window` around the operating duty, and check the calibration"
        )
    grid = np.linspace(duty.min(), duty.max(), 60)
    basis = np.stack((np.ones_like(grid), grid))
    a, b = (e.value for e in result.estimates)
    covariance = np.cov(result.each.T) / len(result.each) + result.shifts.T @ result.shifts
    half = stats.t.ppf(0.975, len(result.each) - 1) * np.sqrt(np.einsum("ik,ij,jk->k", basis, covariance, basis))
    fitted, some = a + b * grid, slice(None, None, max(1, duty.size // 1500))
    drawn = [
        ("readings", duty[some], raw[some], "dots"),
        ("unbiased", grid, fitted, "true"),
        ("thesis' estimator", grid, offset + slope * grid, "s1"),
        ("printed, eq 4.20", grid, -2076.0 + 359.9 * grid, "reference"),
    ]
    band, title = ("95 % of the line", grid, fitted - half, fitted + half), "Thrust over duty: readings and lines"
    result.figures = [Figure(title, "duty [%]", "gf", drawn, band, counterparts=("4.10", "4.11"))]
    return result


def _thrust(m: Measurement, r: Recording) -> Array:
    """Return the thrust [gf] without the ground effect."""
    return m.gram_force(r, "z") / _gain_at(m, r)


def _gain_at(m: Measurement, r: Recording) -> Array:
    """Return the ground effect's gain at the height of each row."""
    gain: Array = ground_effect(arrays(), r.height, m.bench.propeller_radius, m.bench.ground_effect_exponent)
    return gain


def _delayed_duty(m: Measurement, r: Recording, begins: float) -> Array:
    """Return the duty after lag and low pass; commands are limited to at least `begins`, the duty of zero thrust."""
    return low_pass(held_lag(np.maximum(r.duty, begins), r.step, m.bench.lag), r.step, m.test.low_pass)


def _bow(m: Measurement, r: Recording, line: Array, begins: float) -> Array:
    """Return the error [gf] of readings on ramps, because the low pass filters voltages and the cell is nonlinear."""
    cell, gain, gram = m.cells["z"], _gain_at(m, r), 1000.0 / m.bench.gravity
    steady = line[0] + line[1] * held_lag(np.maximum(r.duty, begins), r.step, m.bench.lag)
    volts = cell.volts_of(steady * gain / gram, np.linspace(0.0, m.bench.converter_range, 4001))
    read = gram * cell.force(low_pass(volts, r.step, m.test.low_pass)) / gain
    return np.asarray(read - low_pass(steady, r.step, m.test.low_pass))


def least_degree(duty: Sequence[Array], thrust: Sequence[Array]) -> tuple[int, dict[int, float]]:
    """Return the lowest degree that is nearly as good as the best, and the cross-validation error by degree."""
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
        """Return Γ relative to Γ at the free height."""
        return gamma(exponent, heights) / gamma(exponent, [free])

    def forces(force: Callable[[Recording], Array], chosen: dict[float, list[Recording]] = main) -> Array:
        """Return mean forces, shape (heights, repetitions); the free height is last."""
        least = min(len(chosen[h]) for h in (*heights, free))
        rows = [[float(force(r)[m.inside(r)].mean()) for r in chosen[h][:least]] for h in (*heights, free)]
        return np.array(rows)

    def gains(of: Measurement, estimate: Callable[[Array], Array] = np.asarray) -> Array:
        """Return jackknife pseudo-values of an estimate from Γ, by default Γ itself, shape (repetitions, heights)."""
        f = forces(lambda r: of.force(r, "z"))
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
    raw = forces(lambda r: m.thesis_force(r, "z"))
    ratios = raw[:-1] / raw[-1]
    good = ratios > 1.0
    z, g = np.repeat((heights / radius)[:, None], ratios.shape[1], axis=1)[good], ratios[good]
    x, y, w = np.log(1.0 / (4.0 * z)), np.log((g - 1.0) / g), 1.0 / z
    thesis = {"ground_effect_exponent": float((w * x * y).sum() / (w * x * x).sum()) if good.any() else np.nan}
    origin = "Test 2, fit on Γ, 1/Z̄"
    result = estimated(m, "ground_effect", lambda of: gains(of, fitted), "z", thesis, origin)
    estimate, dropped = result.estimates[0], int((~good).sum())
    if dropped:
        result.notes.append(
            f"{dropped} of {good.size} single ratios are Γ ≤ 1, where ln((Γ−1)/Γ) is undefined: the thesis' "
            "estimator omits them and is therefore biased."
        )
    result.details = {"heights_over_radius": (heights / radius).tolist(), "dropped": dropped}
    for chosen in others:
        run = next(iter(chosen.values()))[0]
        duty = float(np.median(run.duty[run.rows(m.test.window)]))
        if main.keys() - chosen.keys():
            result.warnings.append(f"the runs at a duty of {duty:.4g} % are not used, because heights are missing")
            continue
        f = forces(lambda r: m.force(r, "z"), chosen)
        off = f[:-1].mean(axis=1) / f[-1].mean() - relative(estimate.value)
        result.details["validation_rmse"] = rms = float(np.sqrt(np.mean(off**2)))
        result.notes.append(f"Validation at {duty:g} % duty, not used in the fit: error of Γ {rms:.4f} (rms).")
    # figures, over the height in propeller radii
    grid = np.linspace(0.5, 3.3, 90)

    def curve(k: float) -> Array:
        return gamma(k, grid, 1.0)

    measured, (mean, half, *_) = forces(lambda r: m.force(r, "z")), interval(gains(m))
    single, over = measured[:-1] / measured[-1], heights / radius
    several = [(f"k = {k:g}", grid, curve(k), f"s{n}") for n, k in enumerate((1.5, 1.75, 2.0, 2.25, 2.5))]
    readings = ("single ratios", np.repeat(over, single.shape[1]), single.ravel(), "dots")
    models = [
        (f"k = {estimate.value:.3f}", grid, curve(estimate.value), "true"),
        ("Cheeseman and Bennett, k = 2", grid, curve(CHEESEMAN_BENNETT), "reference"),
    ]
    band, bars = ("95 % of k", grid, curve(estimate.high), curve(estimate.low)), [(over, mean - half, mean + half)]
    axes, title = ("height / radius", "Γ"), "Ground effect over height: readings, means with 95 % intervals, models"
    result.figures = [
        Figure("Ground effect Γ over height, for several exponents k", *axes, several, counterparts=("4.6",)),
        Figure(title, *axes, [readings, *models], band, bars, ("4.12", "4.13")),
    ]
    return result


def height_of(r: Recording, test: HeightTest) -> float:
    """Return the height of a run [m], limited to `free_height`."""
    return min(round(float(np.median(r.height[r.rows(test.window)])), 4), test.free_height)


def sets_by_duty(recordings: Sequence[Recording], test: HeightTest) -> list[dict[float, list[Recording]]]:
    """Return height → recordings for each duty; the duty with most recordings is first, the validation duty last."""
    sets: dict[float, dict[float, list[Recording]]] = {}
    for r in recordings:
        duty = round(float(np.median(r.duty[r.rows(test.window)])), 3)
        sets.setdefault(duty, {}).setdefault(height_of(r, test), []).append(r)
    validation = None if test.validation_duty is None else round(test.validation_duty, 3)
    order = sorted(sets, key=lambda d: (d == validation, -sum(map(len, sets[d].values()))))
    return [sets[d] for d in order]


# -- projections and moment over the tilt ----------------------------------------------------


def projection(m: Measurement) -> Result:
    """Return factors on cos α and sin α in F_z and F_x, ideally 1.

    Forces are relative to the thrust of the upright propeller.
    """
    test = m.test
    functions: Sequence[tuple[str, str, Any]] = (("z", "vertical", np.cos), ("x", "horizontal", np.sin))

    def factor(of: Measurement, r: Recording, c: str, f: Any) -> float:
        """Return the factor of a run on a function of the tilt, after the low pass."""
        s, y = low_pass(f(m.tilt(r)), r.step, test.low_pass)[m.inside(r)], of.force(r, c)[m.inside(r)]
        return float(y @ s / (s @ s) / of.force(r, "z")[r.rows(test.hold)].mean())

    def factors(of: Measurement) -> Array:
        return np.array([[factor(of, r, c, f) for c, _, f in functions] for r in m.recordings])

    # thesis: thrust of five rows of the fifth test, commanded angle, no tare
    fifth = m.recordings[min(4, len(m.recordings) - 1)]
    total = float(m.thesis_force(fifth, "z")[m.inside(fifth)][:5].mean())
    thesis = {f"{name}_projection": m.printed_factor(c, f) / total for c, name, f in functions}
    result = estimated(m, "projection", factors, "zx", thesis, "Test 3, over cos α and sin α")
    first, same = m.recordings[0], _equally_long(m)
    alpha = m.tilt(first)[m.inside(first)]
    total = np.mean([m.gram_force(r, "z")[r.rows(test.hold)].mean() for r in same])
    for c, name, f in functions:
        data = np.array([m.gram_force(r, c)[m.inside(r)] for r in same])
        line = (f"T·{f.__name__} α", np.degrees(alpha), total * f(alpha))
        result.figures.append(_over_tilt(f"{name.capitalize()} force", "gf", data, line, ("4.14", "4.15")))
    return result


def moment(m: Measurement) -> Result:
    """Return the arm l [m] of M = m_PA·g·l·sin α, with an offset for each test."""
    bench = m.bench

    def per_arm(alpha: Array) -> Array:
        return np.asarray(assembly_moment(arrays(), alpha, bench.assembly_mass, bench.gravity, 1.0))

    def arms(of: Measurement) -> Array:
        rows = []
        for r in m.recordings:
            s = low_pass(per_arm(m.tilt(r)), r.step, m.test.low_pass)[m.inside(r)]
            s = s - s.mean()
            rows.append([float(s @ of.force(r, "m")[m.inside(r)] / (s @ s))])
        return np.array(rows)

    thesis = {"assembly_arm": m.printed_factor("m", per_arm)}
    result = estimated(m, "moment", arms, "m", thesis, "Test 5, with an offset a test")
    first = m.recordings[0]
    volts = first.volts["m"][m.inside(first)]
    twentieths = np.split(volts, [k * volts.size // 20 for k in range(1, 20)])
    change = float(np.ptp([np.median(part) for part in twentieths]))
    steps = change / (bench.converter_range / bench.converter_levels)
    result.details = {"steps_of_converter": steps}
    result.notes.append(
        f"Over the whole tilt the cell voltage changes by {steps:.1f} converter steps ({1000 * change:.1f} mV): noise "
        "and the low pass make changes below one step measurable."
    )
    alpha, arm = first.commanded_tilt(m.bench)[m.inside(first)], result.estimates[0].value
    line = (f"m·g·l·sin α, l = {1000 * arm:.4f} mm", np.degrees(alpha), 1000.0 * arm * per_arm(alpha))
    data = 1000.0 * np.array([m.force(r, "m")[m.inside(r)] for r in _equally_long(m)])
    result.figures = [_over_tilt("Moment", "mN·m", data, line, ("4.19", "4.20"))]
    return result


def _equally_long(m: Measurement) -> list[Recording]:
    """Return recordings with the first one's number of rows."""
    count = m.inside(m.recordings[0]).sum()
    return [r for r in m.recordings if m.inside(r).sum() == count]


def _over_tilt(
    name: str, unit: str, data: Array, model: tuple[str, Array, Array], counterparts: Sequence[str]
) -> Figure:
    """Return the figure of readings, shape (tests, rows), over the tilt, with the range of 95 % of them.

    Args:
        model: Label, tilt [°] and value of each row.
    """
    label, angle, values = model
    some, few = (slice(None, None, max(1, angle.size // count)) for count in (100, 10))
    spread = 1.96 * np.sqrt(((data - values) ** 2).sum(axis=0) / max(1, len(data) - 1))
    order = np.argsort(angle, kind="stable")
    readings = ("readings", np.tile(angle[some], len(data)), data[:, some].ravel(), "dots")
    lines = [readings, (label, angle[order], values[order], "true")]
    ends = [(angle[few], (values - spread)[few], (values + spread)[few])]
    return Figure(f"{name} over the tilt", "tilt [°]", unit, lines, bars=ends, counterparts=counterparts)


# -- lags after a step and after sines --------------------------------------------------------


def _smoothed(values: Array, rows: int, width: float) -> Array:
    """Return the Gaussian mean over some rows."""
    mask = gaussian(rows, width)
    return np.convolve(values, mask / mask.sum(), mode="same")


def after_step(m: Measurement, *, thrust: bool = False) -> Result:
    """Return the time constant τ after a step of the command, fitted to the horizontal force, or to the thrust.

    For comparison, the result also has τ by the methods of the thesis (§4.3.4): from the time to 63 %, from the rise
    time divided by 2.2, and from the initial slope.
    """
    channel, name, title = ("z", "lag_of_thrust", "thrust") if thrust else ("x", "lag", "horizontal force")
    at, window, axes = m.test.at, (m.test.at - BEFORE, m.test.window[1]), ("time after the step [s]", "gf")

    def lags(of: Measurement) -> Array:
        cost = []
        for r in m.recordings:
            rows = r.rows(window)
            table, y = _step_response(m, r, LAGS, thrust=thrust)[rows], of.force(r, channel)[rows]
            table, y = table - table.mean(axis=0), y - y.mean()
            cost.append(y @ y - ((table / np.sqrt((table**2).sum(axis=0))).T @ y) ** 2)
        return least(LAGS, np.array(cost))[:, None]

    # thesis: each test by 63 %, by rise time over 2.2, and by the initial slope
    by_hand = [_by_hand(r.time - at, m.thesis_force(r, channel), m.test.window[1] - at) for r in m.recordings]
    ways = dict(zip(("63 %", "rise time", "slope"), np.array(by_hand).T, strict=True))
    origin, details = f"Test 4, fit of the {title} after a step", dict[str, Any]()
    result = estimated(m, "thrust_step" if thrust else "step", lags, channel, {name: np.nan}, origin)
    for way, values in (ways | {"single_fits": result.each.ravel()}).items():
        known = values[np.isfinite(values)]
        half = 1.96 * float(known.std(ddof=1)) if known.size > 1 else np.nan
        details[way] = {"mean": float(known.mean()) if known.size else np.nan, "half_width_of_one": half}
    result.estimates = [result.estimates[0]._replace(thesis=details["63 %"]["mean"])]
    result.details = details
    shown = [f"{1000 * d['mean']:.1f} ± {1000 * d['half_width_of_one']:.1f} ms" for d in details.values()]
    result.notes.append(
        f"By the methods of the thesis: {shown[0]} by 63 %, {shown[1]} by rise time, {shown[2]} by slope; "
        f"single fits {shown[3]} (± is 1.96 σ of one test)."
    )
    tau, first, window = result.estimates[0].value, m.recordings[0], (at - 0.1, at + 0.9)
    x = np.concatenate([np.append(r.time[r.rows(window)] - at, np.nan) for r in m.recordings])
    y = np.concatenate([np.append(m.gram_force(r, channel)[r.rows(window)], np.nan) for r in m.recordings])
    rows = first.rows(window)
    shape = _step_response(m, first, np.array([tau]), thrust=thrust)[rows, 0]
    forces = [m.gram_force(r, channel)[rows] for r in m.recordings if r.time.size == first.time.size]
    slope, offset = np.polyfit(shape, np.mean(forces, axis=0), 1)
    tests = (f"{len(m.recordings)} tests", x, y, "s0")
    fit = (f"fit, τ = {1000 * tau:.1f} ms", first.time[rows] - at, offset + slope * shape, "true")
    of = "Thrust after a step of the duty" if thrust else "Horizontal force after a step of the tilt"
    counterparts = () if thrust else ("4.16",)
    result.figures = [Figure(f"{of}: tests and fit", *axes, [tests, fit], counterparts=counterparts)]
    return result


def _step_response(m: Measurement, r: Recording, lags: Array, *, thrust: bool = False) -> Array:
    """Return the sine of the tilt, or with `thrust` the duty, after each lag and the low pass, shape (rows, lags)."""
    if thrust:
        effective = np.maximum(r.duty, -m.bench.thrust_offset / m.bench.thrust_slope)
        table = np.stack([held_lag(effective, r.step, tau) for tau in lags], axis=1)
    else:
        table = np.sin(tilt_response(m.bench, r.time, r.servo_duty, lags))
    return low_pass(table, r.step, m.test.low_pass)


def _by_hand(time: Array, force: Array, end: float) -> tuple[float, float, float]:
    """Return τ by 63 %, by rise time over 2.2, and by the initial slope, of a step at zero time (App. D.3.4)."""
    start = float(force[(time > -BEFORE) & (time < 0)].mean())
    rows = (time >= 0) & (time <= end)
    t, y = time[rows], _smoothed(force - start, 3, 10.0)[rows]
    settled = (t >= END_WINDOW_S[0]) & (t <= END_WINDOW_S[1]) if t[-1] >= END_WINDOW_S[1] else slice(-10, None)
    y = y / float(y[settled].mean())

    def time_of(level: float) -> float:
        k = int(np.argmax(y >= level))
        return float(t[k] - (t[k] - t[k - 1]) * (y[k] - level) / (y[k] - y[k - 1])) if k else np.nan

    slope = float(np.polyfit(t[:3], y[:3], 1)[0])
    return time_of(0.63), (time_of(0.9) - time_of(0.1)) / 2.2, 1.0 / slope if slope > 0 else np.nan


# -- sines ----------------------------------------------------------------------------------


def after_sines(m: Measurement) -> Result:
    """Return τ from sines fitted at known frequencies, compared with the bench equations."""
    test, by_frequency = m.test, dict[float, list[Recording]]()
    for r in m.recordings:
        by_frequency.setdefault(frequency_of(r, test), []).append(r)
    frequencies = np.array(sorted(by_frequency))
    count = min(map(len, by_frequency.values()))
    chosen = [[(by_frequency[w][k], w) for w in frequencies] for k in range(count)]
    tables = np.array([_sine(r, _step_response(m, r, LAGS), w, test) for r, w in chosen[0]])

    def amplitudes(of: Measurement) -> Array:
        return np.array([[_sine(r, of.force(r, "x"), w, test) for r, w in row] for row in chosen])

    def scale(c: Array) -> Array:
        """Return the force per sine of the tilt at each lag, shape (repetitions, lags)."""
        along = (np.conj(tables).T[None] * c[:, None, :]).sum(axis=2).real
        return np.asarray(along / (np.abs(tables) ** 2).sum(axis=0))

    def lags(of: Measurement) -> Array:
        c = amplitudes(of)
        cost = (np.abs(c[:, None, :] - scale(c)[:, :, None] * tables.T[None]) ** 2).sum(axis=2)
        return least(LAGS, cost)[:, None]

    thesis = _sines_by_hand(chosen, m)
    # τ of a first-order fit to the thesis' magnitudes
    lines = -10.0 * np.log10(1.0 + (frequencies[None] * LAGS[:, None]) ** 2)
    by_magnitude = float(least(LAGS, ((lines - thesis[0].mean(axis=0)) ** 2).sum(axis=1)[None])[0])
    result = estimated(m, "frequency", lags, "x", {"lag": by_magnitude}, "Test 4, sines fitted")
    tau, c = result.estimates[0].value, amplitudes(m)
    place = int(np.argmin(np.abs(LAGS - tau)))
    points = c / scale(c)[:, [place]] / tables[:, place] * (1.0 / (1.0 + 1j * frequencies * LAGS[place]))
    rows = np.arange(-(SMOOTHED_ROWS // 2), SMOOTHED_ROWS // 2 + 1)
    gain = float(np.mean(np.cos(frequencies[-1] * m.recordings[0].step * rows)))
    result.notes.append(
        f"The thesis smooths the force over nine rows, which reduces its amplitudes by "
        f"{-DECIBEL * np.log10(abs(gain)):.2f} dB at {frequencies[-1]:g} rad/s. The amplitudes here are compared with "
        "a simulation of the bench under the same commands, with the hold of the command, the dead band of the servo "
        "and the sine of the tilt angle."
    )
    grid = np.geomspace(frequencies.min(), frequencies.max() * 1.5, 80)
    response = 1.0 / (1.0 + 1j * tau * grid)
    x, apart = np.repeat(frequencies[None], count, axis=0).ravel(), 10**0.012  # offset for visibility
    result.details = {"frequency": frequencies.tolist()}
    for key, unit, by_hand, ours, curve in (
        ("magnitude_db", "dB", thesis[0], DECIBEL * np.log10(np.abs(points)), DECIBEL * np.log10(np.abs(response))),
        ("phase_deg", "°", thesis[1], np.angle(points) * DEGREE, np.angle(response) * DEGREE),
    ):
        mean, half, *_ = interval(ours)
        result.details |= {key: mean.tolist(), f"{key}_half": half.tolist()}
        result.details[f"thesis_{key}"] = by_hand.mean(axis=0).tolist()
        drawn = [
            ("thesis' estimator", x / apart, by_hand.ravel(), "dots pale"),
            ("sines fitted", x * apart, ours.ravel(), "dots"),
            ("thesis' estimator, mean", frequencies, by_hand.mean(axis=0), "s1"),
            (f"first order, τ = {1000 * tau:.1f} ms", grid, curve, "true"),
        ]
        bars, title = [(frequencies, mean - half, mean + half)], f"Tilt response, {key.partition('_')[0]}"
        result.figures.append(
            Figure(title, "frequency [rad/s]", unit, drawn, bars=bars, counterparts=("4.17", "4.18"), log=True)
        )
    return result


def frequency_of(r: Recording, test: SineTest) -> float:
    """Return the frequency of the protocol [rad/s] that is nearest to that of a run's command."""
    rows = r.time >= test.lead
    t, command = r.time[rows] - test.lead, r.servo_duty[rows] - r.servo_duty[rows].mean()

    def squared_misfit(w: float) -> float:
        basis = _sine_basis(w * t)
        rest = command - basis @ np.linalg.lstsq(basis, command, rcond=None)[0]
        return float(rest @ rest)

    return min(test.frequencies, key=squared_misfit)


def _sine_basis(angle: Array) -> Array:
    """Return sine, cosine and constant, one column each."""
    return np.column_stack((np.sin(angle), np.cos(angle), np.ones_like(angle)))


def _sine(r: Recording, values: Array, w: float, test: SineTest) -> Any:
    """Return the complex amplitude of a sine with known frequency, plus constant, after the skipped part.

    Values of shape (rows, n) give n amplitudes.
    """
    rows = r.time >= test.lead + test.skip
    a, b, _ = np.linalg.lstsq(_sine_basis(w * (r.time[rows] - test.lead)), values[rows], rcond=None)[0]
    return a + 1j * b


def _sines_by_hand(chosen: list[list[tuple[Recording, float]]], m: Measurement) -> tuple[Array, Array]:
    """Return magnitude [dB] and phase [°] from extrema of the filtered force, as in the thesis.

    Values are relative to the lowest frequency.
    """
    size, phase = np.empty((2, len(chosen), len(chosen[0])))
    for k, row in enumerate(chosen):
        for j, (r, w) in enumerate(row):
            begin = m.test.lead + m.test.skipped_by_thesis(w)
            rows = (r.time >= begin) & (r.time < begin + 2.0 * np.pi / w + 1e-9)
            y = _smoothed(m.thesis_force(r, "x"), SMOOTHED_ROWS, 100.0)[rows]
            t = r.time[rows] - m.test.lead
            size[k, j] = 0.5 * (y.max() - y.min())
            phase[k, j] = (270.0 - w * float(t[np.argmin(y)]) * DEGREE + 180.0) % 360.0 - 180.0
    return DECIBEL * np.log10(size / size[:, :1]), phase - phase[:, :1]
