"""Test 4: lag of the tilt after a step and after sines, and of the thrust after a step of the duty.

§4.5.4, App. D.3.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cosim.core.arrays import Array
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
from plant.identification.protocol import SineTest, StepTest
from plant.identification.recordings import Recording

BEFORE = 0.3  # [s] before a step in a fit
SETTLED = (0.68, 0.88)  # [s] after the step, window of the end value in App. D.3.4
SMOOTHED_ROWS = 9  # rows of the mean in App. D.3.4
DECIBEL, DEGREE = 20.0, 180.0 / np.pi


def _smoothing(half: int, width: float) -> Array:
    """Return the mask of a Gaussian mean over 2·half + 1 rows."""
    mask = np.exp(-0.5 * (np.arange(-half, half + 1) / width) ** 2)
    return np.asarray(mask / mask.sum())


def after_step(m: Measurement, *, draw: bool = True, thrust: bool = False) -> Result:
    """Return τ from a fit of F_x(t), of the thrust if `thrust`, and by 63 %, rise time and slope (§4.3.4)."""
    channel, name, title = ("z", "lag_of_thrust", "thrust") if thrust else ("x", "lag", "horizontal force")
    window = (m.test.at - BEFORE, m.test.window[1])
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

    hand = np.array([_by_hand(r, m.printed_force(r, channel), m.test) for r in m.recordings])
    numbers = [(name, "s", _mean_and_half(hand[:, 0])[0], m.true("lag"))]
    origin = f"Test 4, fit of the {title} after a step"
    result, each, _ = estimated(m, "thrust_step" if thrust else "step", lags, channel, numbers, origin)
    ways = []
    for k, way in enumerate(("63 %", "rise time", "slope")):
        mean, half = _mean_and_half(hand[:, k])
        result.details[way] = {"mean": mean, "half_width_of_one": half}
        ways.append(f"{1000 * mean:.1f} ± {1000 * half:.1f} ms by {way}")
    mean, half = float(each.mean()), float(1.96 * each.std(ddof=1))
    result.details["single_fits"] = {"mean": mean, "half_width_of_one": half}
    single = f"single fits {1000 * mean:.1f} ± {1000 * half:.1f} ms (± is 1.96 σ of one test)."
    result.notes.append(f"As the thesis reads it: {', '.join(ways)}; {single}")
    if not thrust and m.truth:
        result.notes.append("63 % of sin α after 25° comes at 0.961 τ, for the sine bends before the angle settles.")
    if draw:
        result.figures = [_step_figure(m, result.estimates[0].value, thrust=thrust)]
    return result


def _step_response(m: Measurement, r: Recording, lags: Array, *, thrust: bool = False) -> Array:
    """Return the sine of the tilt, or with `thrust` the duty, after each lag and the low pass, shape (rows, lags)."""
    if thrust:
        effective = np.maximum(r.duty, -m.bench.thrust_offset / m.bench.thrust_slope)
        table = np.stack([held_lag(effective, r.step, tau) for tau in lags], axis=1)
    else:
        table = np.sin(tilt_response(m.bench, r.time, r.servo_duty, lags))
    return low_pass(table, r.step, m.test.low_pass)


def _mean_and_half(values: Array) -> tuple[float, float]:
    """Return mean and 1.96 σ of the finite values."""
    finite = values[np.isfinite(values)]
    mean = float(finite.mean()) if finite.size else float("nan")
    return mean, 1.96 * float(finite.std(ddof=1)) if finite.size > 1 else float("nan")


def _by_hand(r: Recording, force: Array, test: StepTest) -> tuple[float, float, float]:
    """Return τ by 63 %, by rise time over 2.2, and by the initial slope (App. D.3.4)."""
    time = r.time - test.at
    start = float(force[(time > -BEFORE) & (time < 0)].mean())
    smooth = np.convolve(force - start, _smoothing(1, 10.0), mode="same")
    rows = (time >= 0) & (time <= test.window[1] - test.at)
    t, y = time[rows], smooth[rows]
    end = float(y[(t >= SETTLED[0]) & (t <= SETTLED[1])].mean()) if (t[-1] >= SETTLED[1]) else float(y[-10:].mean())
    y = y / end

    def time_of(level: float) -> float:
        above = np.flatnonzero(y >= level)
        if not above.size or above[0] == 0:
            return float("nan")
        k = int(above[0])
        return float(t[k] - (t[k] - t[k - 1]) * (y[k] - level) / (y[k] - y[k - 1]))

    slope = float(np.polyfit(t[:3], y[:3], 1)[0])
    return time_of(0.63), (time_of(0.9) - time_of(0.1)) / 2.2, 1.0 / slope if slope > 0 else float("nan")


def _step_figure(m: Measurement, tau: float, *, thrust: bool) -> Figure:
    channel, window, gram = "z" if thrust else "x", (m.test.at - 0.1, m.test.at + 0.9), 1000.0 / m.bench.gravity
    x, y = [], []
    for r in m.recordings:
        rows = r.rows(window)
        x += [*(r.time[rows] - m.test.at), np.nan]
        y += [*gram * m.force(r, channel)[rows], np.nan]
    r = m.recordings[0]
    rows = r.rows(window)
    shape = _step_response(m, r, np.array([tau]), thrust=thrust)[rows, 0]
    forces = [gram * m.force(q, channel)[rows] for q in m.recordings if q.time.size == r.time.size]
    slope, offset = np.polyfit(shape, np.mean(forces, axis=0), 1)
    tests = (f"{len(m.recordings)} tests", np.array(x), np.array(y), "s0")
    fit = (f"fit, τ = {1000 * tau:.1f} ms", r.time[rows] - m.test.at, offset + slope * shape, "true")
    of = "Thrust after a step of the duty" if thrust else "Horizontal force after a step of the tilt"
    counterpart = "" if thrust else "Fig 4.16"
    return Figure(f"{of}: tests and fit", "time after the step [s]", "gf", [tests, fit], counterpart=counterpart)


# -- sines ----------------------------------------------------------------------------------


def after_sines(m: Measurement, *, draw: bool = True) -> Result:
    """Return τ from sines fitted at known frequencies, compared with the bench equations."""
    test, by_frequency = m.test, group_by_frequency(m.recordings, m.test)
    frequencies = np.array(sorted(by_frequency))
    count = min(map(len, by_frequency.values()))
    chosen = [[(by_frequency[w][k], w) for w in frequencies] for k in range(count)]
    firsts = [by_frequency[w][0] for w in frequencies]
    tables = np.array([sine(r, _step_response(m, r, LAGS), w, test) for r, w in zip(firsts, frequencies, strict=True)])

    def amplitudes(using: Cells) -> Array:
        return np.array([[sine(r, m.force(r, "x", using), w, test) for r, w in row] for row in chosen])

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
    numbers = [("lag", "s", by_magnitude, m.true("lag"))]
    result, _, _ = estimated(m, "frequency", lags, "x", numbers, "Test 4, sines fitted")
    tau = result.estimates[0].value
    c = amplitudes(m.cells)
    place = int(np.argmin(np.abs(LAGS - tau)))
    ideal = 1.0 / (1.0 + 1j * frequencies * LAGS[place])
    points = c / scale(c)[:, [place]] / tables[:, place] * ideal
    ours = DECIBEL * np.log10(np.abs(points)), np.angle(points) * DEGREE
    means = [interval(values)[:2] for values in ours]
    result.details = {"frequency": frequencies.tolist()}
    for name, (mean, half), by_hand in zip(("magnitude_db", "phase_deg"), means, thesis, strict=True):
        result.details |= {name: mean.tolist(), f"{name}_half": half.tolist()}
        result.details[f"thesis_{name}"] = by_hand.mean(axis=0).tolist()
    rows = np.arange(-(SMOOTHED_ROWS // 2), SMOOTHED_ROWS // 2 + 1)
    gain = float(np.mean(np.cos(frequencies[-1] * m.recordings[0].step * rows)))
    result.notes.append(
        f"The mean of nine rows costs the thesis' points {-DECIBEL * np.log10(abs(gain)):.2f} dB at "
        f"{frequencies[-1]:g} rad/s. Ours are compared with the same commands through the bench's equations: hold, "
        "dead band, sine of the angle."
    )
    if draw:
        result.figures = _sine_figures(frequencies, tau, thesis, ours, means)
    return result


def group_by_frequency(recordings: Sequence[Recording], test: SineTest) -> dict[float, list[Recording]]:
    """Return recordings by the protocol's closest frequency."""
    groups: dict[float, list[Recording]] = {}
    for r in recordings:
        groups.setdefault(frequency_of(r, test), []).append(r)
    return groups


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


def sine(r: Recording, values: Array, w: float, test: SineTest) -> Any:
    """Return the complex amplitude of a sine with known frequency, plus constant, after the skipped part.

    Values of shape (rows, n) give n amplitudes.
    """
    rows = r.time >= test.lead + test.skip
    basis = _sine_basis(w * (r.time[rows] - test.lead))
    a, b, _ = np.linalg.lstsq(basis, values[rows], rcond=None)[0]
    return a + 1j * b


def _sines_by_hand(chosen: Sequence[Sequence[tuple[Recording, float]]], m: Measurement) -> tuple[Array, Array]:
    """Return magnitude [dB] and phase [°] from maximum and minimum of the filtered force, as in the thesis.

    Values are relative to the lowest frequency.
    """
    mask = _smoothing(SMOOTHED_ROWS // 2, 100.0)
    skips = dict(zip(m.test.frequencies, m.test.thesis_skip, strict=False))
    size, phase = np.empty((2, len(chosen), len(chosen[0])))
    for k, row in enumerate(chosen):
        for j, (r, w) in enumerate(row):
            begin = m.test.lead + skips.get(w, 0.0) * 2.0 * np.pi / w
            rows = (r.time >= begin) & (r.time < begin + 2.0 * np.pi / w + 1e-9)
            y = np.convolve(m.printed_force(r, "x"), mask, mode="same")[rows]
            t = r.time[rows] - m.test.lead
            size[k, j] = 0.5 * (y.max() - y.min())
            phase[k, j] = (270.0 - w * float(t[np.argmin(y)]) * DEGREE + 180.0) % 360.0 - 180.0
    return DECIBEL * np.log10(size / size[:, :1]), phase - phase[:, :1]


def _sine_figures(
    w: Array, tau: float, thesis: Sequence[Array], ours: Sequence[Array], means: Sequence[tuple[Array, Array]]
) -> list[Figure]:
    import control

    grid = np.geomspace(w.min(), w.max() * 1.5, 80)
    response = control.frequency_response(control.tf([1.0], [tau, 1.0]), grid)
    curves = DECIBEL * np.log10(np.abs(response.complex)), np.angle(response.complex) * DEGREE
    x, apart = np.repeat(w[None], ours[0].shape[0], axis=0).ravel(), 10**0.012  # offset for visibility
    figures = []
    for k, (title, unit) in enumerate((("magnitude", "dB"), ("phase", "°"))):
        mean, half = means[k]
        axes, line = ("frequency [rad/s]", unit), (f"first order, τ = {1000 * tau:.1f} ms", grid, curves[k], "true")
        single = [
            ("thesis' estimator", x / apart, thesis[k].ravel(), "dots pale"),
            ("sines fitted", x * apart, ours[k].ravel(), "dots"),
            line,
        ]
        averaged = [("thesis' estimator, mean", w, thesis[k].mean(axis=0), "s1"), line]
        bars = [(w, mean - half, mean + half)]
        figures.append(Figure(f"Tilt response, {title}: single tests", *axes, single, counterpart="Fig 4.17", log=True))
        title = f"Tilt response, {title}: means with 95 % intervals"
        figures.append(Figure(title, *axes, averaged, bars=bars, counterpart="Fig 4.18", log=True))
    return figures
