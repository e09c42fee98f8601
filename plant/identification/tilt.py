"""Tests 3 to 5 over the tilt: projections of the thrust, lags of tilt and thrust, moment of the weight.

§4.5.3, App. D.3.3; §4.5.4, App. D.3.4; §4.5.5, eq 4.10, App. D.3.5.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import stats
from scipy.signal.windows import gaussian

from cosim.core.arrays import Array
from cosim.model.namespaces import arrays
from plant.identification.cells import Cells
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
from plant.identification.protocol import SineTest
from plant.identification.recordings import Recording
from plant.powertrain import assembly_moment

BIN = np.radians(2.5)
BEFORE = 0.3  # [s] before a step in a fit
SETTLED = (0.68, 0.88)  # [s] after the step, window of the end value in App. D.3.4
SMOOTHED_ROWS = 9  # rows of the mean in App. D.3.4
DECIBEL, DEGREE = 20.0, 180.0 / np.pi


def projection(m: Measurement) -> Result:
    """Return factors on cos α and sin α in F_z and F_x, ideally 1.

    Forces are relative to the thrust held upright.
    """
    test = m.test
    functions: Sequence[tuple[str, str, Any]] = (("z", "vertical", np.cos), ("x", "horizontal", np.sin))

    def runs(c: str, f: Any, using: Cells) -> Iterator[tuple[Array, Array, Array, float]]:
        """Yield tilt, its function after the low pass, and force in the window, and the thrust, of each run."""
        for r in m.recordings:
            w, alpha = m.inside(r), m.tilt(r)
            thrust = float(m.force(r, "z", using)[r.rows(test.hold)].mean())
            yield alpha[w], low_pass(f(alpha), r.step, test.low_pass)[w], m.force(r, c, using)[w], thrust

    def factors(using: Cells) -> Array:
        each = [[y @ s / (s @ s) / thrust for _, s, y, thrust in runs(c, f, using)] for c, _, f in functions]
        return np.array(each).T

    # thesis: thrust of five rows of the fifth test, commanded angle, no tare
    fifth = m.recordings[min(4, len(m.recordings) - 1)]
    total = float(m.printed_force(fifth, "z")[m.inside(fifth)][:5].mean())
    thesis = {f"{name}_projection": m.printed_factor(c, f) / total for c, name, f in functions}
    result = estimated(m, "projection", factors, "zx", thesis, "Test 3, over cos α and sin α")
    # deviation of the functions themselves, in bins of the angle
    edges, largest = BIN * np.arange(-36, 37), {}
    for letter, (c, _, f) in zip("VH", functions, strict=True):
        off = [
            stats.binned_statistic(alpha, y / thrust - s, "mean", edges).statistic  # NaN for an empty bin
            for alpha, s, y, thrust in runs(c, f, m.cells)
        ]
        largest[letter] = float(np.nanmax(np.abs(np.mean(off, axis=0))))
    result.details = {"largest_deviation": largest}
    result.notes.append(
        f"V(α) is off cos α by {largest['V']:.4f} at most, H(α) off sin α by {largest['H']:.4f}, in bins of 2.5°: sine "
        "and cosine project it."
    )
    first, same = m.recordings[0], _equally_long(m)
    alpha = m.tilt(first)[m.inside(first)]
    total = np.mean([m.gram_force(r, "z")[r.rows(test.hold)].mean() for r in same])
    for c, name, f in functions:
        data = np.array([m.gram_force(r, c)[m.inside(r)] for r in same])
        line = (f"T·{f.__name__} α", np.degrees(alpha), total * f(alpha))
        result.figures += _over_tilt(f"{name.capitalize()} force", "gf", data, line, (120, 10), ("4.14", "4.15"))
    return result


def moment(m: Measurement) -> Result:
    """Return the arm l [m] of M = m_PA·g·l·sin α, with an offset for each test."""
    bench = m.bench

    def per_arm(alpha: Array) -> Array:
        return np.asarray(assembly_moment(arrays(), alpha, bench.assembly_mass, bench.gravity, 1.0))

    def arms(using: Cells) -> Array:
        rows = []
        for r in m.recordings:
            s = low_pass(per_arm(m.tilt(r)), r.step, m.test.low_pass)[m.inside(r)]
            s = s - s.mean()
            rows.append([float(s @ m.force(r, "m", using)[m.inside(r)] / (s @ s))])
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
        f"Over the whole tilt the cell moves by {steps:.1f} steps of the converter ({1000 * change:.1f} mV): noise and "
        "the low pass, not its resolution, let it be read."
    )
    alpha, arm = first.commanded_tilt(m.bench)[m.inside(first)], result.estimates[0].value
    line = (f"m·g·l·sin α, l = {1000 * arm:.4f} mm", np.degrees(alpha), 1000.0 * arm * per_arm(alpha))
    data = 1000.0 * np.array([m.force(r, "m")[m.inside(r)] for r in _equally_long(m)])
    result.figures = _over_tilt("Moment", "mN·m", data, line, (90, 12), ("4.19", "4.20"))
    return result


def _equally_long(m: Measurement) -> list[Recording]:
    """Return recordings with the first one's number of rows."""
    count = m.inside(m.recordings[0]).sum()
    return [r for r in m.recordings if m.inside(r).sum() == count]


def _over_tilt(
    name: str,
    unit: str,
    data: Array,
    model: tuple[str, Array, Array],
    drawn: tuple[int, int],
    counterparts: Sequence[str],
) -> list[Figure]:
    """Return the figures of readings and their range over the tilt.

    Args:
        data: Readings, shape (tests, rows).
        model: Label, tilt [°] and value of each row.
        drawn: About how many readings of a test, and how many ranges.
    """
    label, angle, values = model
    some, few = (slice(None, None, max(1, angle.size // count)) for count in drawn)
    spread = 1.96 * np.sqrt(((data - values) ** 2).sum(axis=0) / max(1, len(data) - 1))
    order = np.argsort(angle, kind="stable")
    line = (label, angle[order], values[order], "true")
    readings = ("readings", np.tile(angle[some], len(data)), data[:, some].ravel(), "dots")
    ends = [(angle[few], (values - spread)[few], (values + spread)[few])]
    title, axes, (first, second) = f"{name} over the tilt", ("tilt [°]", unit), counterparts
    return [
        Figure(f"{title}: readings and model", *axes, [readings, line], counterpart=f"Fig {first}"),
        Figure(f"{title}: range of 95 % of the readings", *axes, [line], bars=ends, counterpart=f"Fig {second}"),
    ]


# -- lags after a step and after sines --------------------------------------------------------


def _smoothed(values: Array, rows: int, width: float) -> Array:
    """Return the Gaussian mean over some rows."""
    mask = gaussian(rows, width)
    return np.convolve(values, mask / mask.sum(), mode="same")


def after_step(m: Measurement, *, thrust: bool = False) -> Result:
    """Return τ from a fit of F_x(t), of the thrust if `thrust`, and by 63 %, rise time and slope (§4.3.4)."""
    channel, name, title = ("z", "lag_of_thrust", "thrust") if thrust else ("x", "lag", "horizontal force")
    at, window = m.test.at, (m.test.at - BEFORE, m.test.window[1])
    shapes: dict[bytes, Array] = {}  # simulated repetitions share commands; measured ones have their own

    def lags(using: Cells) -> Array:
        cost = []
        for r in m.recordings:
            chosen = r.rows(window)
            if (key := r.time.tobytes() + (r.duty if thrust else r.servo_duty).tobytes()) not in shapes:
                table = _step_response(m, r, LAGS, thrust=thrust)[chosen]
                table = table - table.mean(axis=0)
                shapes[key] = table / np.sqrt((table**2).sum(axis=0))
            y = m.force(r, channel, using)[chosen]
            y = y - y.mean()
            cost.append(y @ y - (shapes[key].T @ y) ** 2)
        return least(LAGS, np.array(cost))[:, None]

    # thesis: each test by 63 %, by rise time over 2.2, and by the initial slope
    by_hand = [_by_hand(r.time - at, m.printed_force(r, channel), m.test.window[1] - at) for r in m.recordings]
    ways = dict(zip(("63 %", "rise time", "slope"), np.array(by_hand).T, strict=True))
    origin, details = f"Test 4, fit of the {title} after a step", dict[str, Any]()
    result = estimated(m, "thrust_step" if thrust else "step", lags, channel, {name: np.nan}, origin)
    for way, values in (ways | {"single_fits": result.each.ravel()}).items():
        known = values[np.isfinite(values)]
        half = 1.96 * float(known.std(ddof=1)) if known.size > 1 else np.nan
        details[way] = {"mean": float(known.mean()) if known.size else np.nan, "half_width_of_one": half}
    result.estimates = [replace(result.estimates[0], thesis=details["63 %"]["mean"])]
    result.details = details
    shown = [f"{1000 * d['mean']:.1f} ± {1000 * d['half_width_of_one']:.1f} ms" for d in details.values()]
    result.notes.append(
        f"As the thesis reads it: {shown[0]} by 63 %, {shown[1]} by rise time, {shown[2]} by slope; "
        f"single fits {shown[3]} (± is 1.96 σ of one test)."
    )
    if not thrust and m.truth:
        result.notes.append("63 % of sin α after 25° comes at 0.961 τ, for the sine bends before the angle settles.")
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
    counterpart = "" if thrust else "Fig 4.16"
    axes = "time after the step [s]", "gf"
    result.figures = [Figure(f"{of}: tests and fit", *axes, [tests, fit], counterpart=counterpart)]
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
    settled = (t >= SETTLED[0]) & (t <= SETTLED[1]) if t[-1] >= SETTLED[1] else slice(-10, None)
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

    def amplitudes(using: Cells) -> Array:
        return np.array([[_sine(r, m.force(r, "x", using), w, test) for r, w in row] for row in chosen])

    def scale(c: Array) -> Array:
        """Return the force per sine of the tilt at each lag, shape (repetitions, lags); tables by frequency and lag."""
        along = (np.conj(tables).T[None] * c[:, None, :]).sum(axis=2).real
        return np.asarray(along / (np.abs(tables) ** 2).sum(axis=0))

    def lags(using: Cells) -> Array:
        c = amplitudes(using)
        cost = (np.abs(c[:, None, :] - scale(c)[:, :, None] * tables.T[None]) ** 2).sum(axis=2)
        return least(LAGS, cost)[:, None]

    thesis = _sines_by_hand(chosen, m)
    # τ of a first-order fit to the thesis' magnitudes
    lines = -10.0 * np.log10(1.0 + (frequencies[None] * LAGS[:, None]) ** 2)
    by_magnitude = float(least(LAGS, ((lines - thesis[0].mean(axis=0)) ** 2).sum(axis=1)[None])[0])
    result = estimated(m, "frequency", lags, "x", {"lag": by_magnitude}, "Test 4, sines fitted")
    tau, c = result.estimates[0].value, amplitudes(m.cells)
    place = int(np.argmin(np.abs(LAGS - tau)))
    points = c / scale(c)[:, [place]] / tables[:, place] * (1.0 / (1.0 + 1j * frequencies * LAGS[place]))
    rows = np.arange(-(SMOOTHED_ROWS // 2), SMOOTHED_ROWS // 2 + 1)
    gain = float(np.mean(np.cos(frequencies[-1] * m.recordings[0].step * rows)))
    result.notes.append(
        f"The mean of nine rows costs the thesis' points {-DECIBEL * np.log10(abs(gain)):.2f} dB at "
        f"{frequencies[-1]:g} rad/s. Ours are compared with the same commands through the bench's equations: hold, "
        "dead band, sine of the angle."
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
        axes, line = ("frequency [rad/s]", unit), (f"first order, τ = {1000 * tau:.1f} ms", grid, curve, "true")
        single = [
            ("thesis' estimator", x / apart, by_hand.ravel(), "dots pale"),
            ("sines fitted", x * apart, ours.ravel(), "dots"),
            line,
        ]
        averaged = [("thesis' estimator, mean", frequencies, by_hand.mean(axis=0), "s1"), line]
        bars, title = [(frequencies, mean - half, mean + half)], f"Tilt response, {key.partition('_')[0]}"
        result.figures += [
            Figure(f"{title}: single tests", *axes, single, counterpart="Fig 4.17", log=True),
            Figure(f"{title}: means with 95 % intervals", *axes, averaged, None, bars, "Fig 4.18", log=True),
        ]
    return result


def frequency_of(r: Recording, test: SineTest) -> float:
    """Return the protocol's frequency [rad/s] nearest a run's command."""
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
    """Return magnitude [dB] and phase [°] from maximum and minimum of the filtered force, as in the thesis.

    Values are relative to the lowest frequency.
    """
    size, phase = np.empty((2, len(chosen), len(chosen[0])))
    for k, row in enumerate(chosen):
        for j, (r, w) in enumerate(row):
            begin = m.test.lead + m.test.skipped_by_thesis(w)
            rows = (r.time >= begin) & (r.time < begin + 2.0 * np.pi / w + 1e-9)
            y = _smoothed(m.printed_force(r, "x"), SMOOTHED_ROWS, 100.0)[rows]
            t = r.time[rows] - m.test.lead
            size[k, j] = 0.5 * (y.max() - y.min())
            phase[k, j] = (270.0 - w * float(t[np.argmin(y)]) * DEGREE + 180.0) % 360.0 - 180.0
    return DECIBEL * np.log10(size / size[:, :1]), phase - phase[:, :1]
