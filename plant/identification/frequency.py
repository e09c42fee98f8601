"""Test 4 with sines: horizontal force after sinusoidal tilt commands (§4.5.4, App. D.3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from plant.identification import messages
from plant.identification.cells import Cells
from plant.identification.command_response import LAGS, low_pass, tilt_response
from plant.identification.commanded import frequency_of
from plant.identification.estimates import Figure, Measurement, Result, interval, least, make_estimates, shifts_of
from plant.identification.misfit import Misfit, misfit, residuals, sine_basis
from plant.identification.protocol import SineTest
from plant.identification.recordings import Recording

SMOOTHING = 9  # rows of the mean in App. D.3.4
DECIBEL, DEGREE = 20.0, 180.0 / np.pi


def analyse(m: Measurement, *, draw: bool = True) -> Result:
    """Return τ from sines fitted at known frequencies, compared with the bench equations."""
    test, by_frequency = m.test, group_by_frequency(m.recordings, m.test)
    frequencies = np.array(sorted(by_frequency))
    count = min(map(len, by_frequency.values()))
    chosen = [[(by_frequency[w][k], w) for w in frequencies] for k in range(count)]
    firsts = [by_frequency[w][0] for w in frequencies]
    tables = np.array([sine(r, _response(m, r, LAGS), w, test) for r, w in zip(firsts, frequencies, strict=True)])

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

    each = lags(m.cells)
    thesis = _by_hand(chosen, m)
    fitted = _fit_magnitudes(frequencies, thesis[0].mean(axis=0))
    names = [("lag", "s", fitted, m.true("lag"))]
    result = Result(
        "frequency", make_estimates(names, each, shifts_of(lags, m.cells, "x", each), "Test 4, sines fitted")
    )
    tau = result.estimates[0].value
    c = amplitudes(m.cells)
    place = int(np.argmin(np.abs(LAGS - tau)))
    ideal = 1.0 / (1.0 + 1j * frequencies * LAGS[place])
    points = c / scale(c)[:, [place]] / tables[:, place] * ideal
    ours = DECIBEL * np.log10(np.abs(points)), np.angle(points) * DEGREE
    none = np.zeros((0, frequencies.size))
    means = [interval(values, none)[:2] for values in ours]
    smoothing = DECIBEL * np.log10(abs(_mean_of_nine(frequencies[-1], m.recordings[0].step)))
    result.details = {"frequency": frequencies.tolist()}
    for name, (mean, half) in zip(("magnitude_db", "phase_deg"), means, strict=True):
        result.details |= {name: mean.tolist(), f"{name}_half": half.tolist()}
    for name, values in zip(("magnitude_db", "phase_deg"), thesis, strict=True):
        result.details[f"thesis_{name}"] = values.mean(axis=0).tolist()
    result.notes.append(messages.THESIS_SINES(loss=-smoothing, frequency=frequencies[-1]))
    _judge(m, result, chosen, c, tables)
    if draw:
        result.figures = _figures(frequencies, tau, thesis, ours, means)
    return result


def _judge(
    m: Measurement, result: Result, chosen: Sequence[Sequence[tuple[Recording, float]]], c: Array, tables: Array
) -> None:
    """Add a warning for an early or late force, or a response that is not of first order.

    Phases and amplitudes are tested separately: the thrust of a run changes amplitudes only. A calibration error is
    common to all frequencies and cancels.
    """
    frequencies = np.array([w for _, w in chosen[0]])
    place = int(np.argmin(np.abs(LAGS - result.estimates[0].value)))
    slopes = np.gradient(np.log(tables), np.log(LAGS), axis=1)[:, place]
    ratio = np.log(c / tables[:, place])
    # phase noise is reading noise divided by amplitude and the root of the number of rows
    rows = np.array([sum(r.time >= m.test.lead + m.test.skip) for r, _ in chosen[0]])
    weights = np.sqrt(rows) * np.abs(c).mean(axis=0)
    phase = misfit(
        np.array([residuals(p * weights, (slopes.imag * weights)[:, None]) for p in ratio.imag]),
        np.zeros((0, frequencies.size)),
        1,
    )
    basis = np.column_stack((np.ones(frequencies.size), slopes.real))
    size = misfit(np.array([residuals(s, basis) for s in ratio.real]), np.zeros((0, frequencies.size)), 2)
    if phase is not None and phase.is_significant:
        delay = _delay_beside_lag(frequencies, c.mean(axis=0), tables, weights)
        miss = DEGREE * float(np.abs(phase.mean / weights).max())
        template = messages.EARLY_SINES if delay < 0.0 else messages.LATE_SINES
        result.warnings.append(template(miss=miss, delay=abs(delay)))
    if size is not None and size.is_significant:
        result.warnings.append(messages.WRONG_SIZES(miss=100.0 * float(np.abs(size.mean).max())))
    beyond = harmonics(m, chosen, result.estimates[0].value)
    if beyond is not None and beyond.is_significant:
        result.warnings.append(messages.HARMONICS(size=float(np.abs(beyond.mean).max())))


def _delay_beside_lag(frequencies: Array, amplitudes: Any, tables: Any, weights: Array) -> float:
    """Return the delay [s] with which some lag explains the phases best.

    Args:
        amplitudes: Complex amplitude of the force at each frequency.
        tables: Complex amplitude by the equations, shape (frequencies, lags).
        weights: Reciprocal of the standard error of each phase.
    """
    phases, squares = np.angle(amplitudes[:, None] / tables), weights**2
    delays = -(squares * frequencies) @ phases / (squares @ frequencies**2)
    misses = squares @ (phases + frequencies[:, None] * delays) ** 2
    return float(delays[int(np.argmin(misses))])


def harmonics(m: Measurement, chosen: Sequence[Sequence[tuple[Recording, float]]], tau: float) -> Misfit | None:
    """Return second and third harmonics [gf] beyond the response at the lag `tau`.

    Args:
        chosen: For each repetition, the recording and frequency [rad/s] of each sine.
    """
    shapes = [_response(m, r, np.array([tau]))[:, 0] for r, _ in chosen[0]]

    def averages(using: Cells) -> Array:
        rows = []
        for row in chosen:
            values: list[Array] = []
            for (r, w), shape in zip(row, shapes, strict=True):
                force, size = m.gram * m.force(r, "x", using), min(r.time.size, shape.size)
                along = sine(r, force, w, m.test) / sine(chosen[0][len(values)][0], shape, w, m.test)
                rest = force[:size] - abs(along) * shape[:size]
                times = r.time[:size]
                use = times >= m.test.lead + m.test.skip
                angle = w * (times[use] - m.test.lead)
                basis = [f(k * angle) for k in (1, 2, 3) for f in (np.sin, np.cos)]
                sizes = np.linalg.lstsq(np.column_stack((*basis, np.ones_like(angle))), rest[use], rcond=None)[0]
                values.append(sizes[2:6] * np.sqrt(use.sum() / longest))
            rows.append(np.concatenate(values))
        return np.array(rows)

    longest = max(int((r.time >= m.test.lead + m.test.skip).sum()) for r, _ in chosen[0])
    each = averages(m.cells)
    return misfit(each, shifts_of(averages, m.cells, "x", each), 0)


def group_by_frequency(recordings: Sequence[Recording], test: SineTest) -> dict[float, list[Recording]]:
    """Return recordings by the protocol's closest frequency."""
    groups: dict[float, list[Recording]] = {}
    for r in recordings:
        groups.setdefault(frequency_of(r, test), []).append(r)
    return groups


def sine(r: Recording, values: Array, w: float, test: SineTest) -> Any:
    """Return the complex amplitude of a sine with known frequency, plus constant, after the skipped part.

    Values of shape (rows, n) give n amplitudes.
    """
    rows = r.time >= test.lead + test.skip
    basis = sine_basis(w * (r.time[rows] - test.lead))
    a, b, _ = np.linalg.lstsq(basis, values[rows], rcond=None)[0]
    return a + 1j * b


def _response(m: Measurement, r: Recording, lags: Array) -> Array:
    """Return sin α by the equations, as the cells read it, one column for each lag."""
    return low_pass(np.sin(tilt_response(m.bench, r.time, r.servo_duty, lags)), r.step, m.test.low_pass)


def _by_hand(chosen: Sequence[Sequence[tuple[Recording, float]]], m: Measurement) -> tuple[Array, Array]:
    """Return magnitude [dB] and phase [°] from maximum and minimum of the filtered force, as in the thesis.

    Values are relative to the lowest frequency.
    """
    mask = np.exp(-0.5 * (np.arange(-4, 5) / 100.0) ** 2)
    mask /= mask.sum()
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


def _fit_magnitudes(w: Array, db: Array) -> float:
    """Return τ of a first-order fit to magnitudes."""
    lines = -10.0 * np.log10(1.0 + (w[None] * LAGS[:, None]) ** 2)
    return float(least(LAGS, ((lines - db) ** 2).sum(axis=1)[None])[0])


def _mean_of_nine(w: float, step: float) -> float:
    """Return a nine-row mean's gain at the frequency w."""
    return float(np.mean(np.cos(w * step * np.arange(-(SMOOTHING // 2), SMOOTHING // 2 + 1))))


def _figures(
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
