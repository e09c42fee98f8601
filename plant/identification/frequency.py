"""Test 4 with sines: horizontal force after sinusoidal tilt commands (§4.5.4, App. D.3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from plant.identification import messages
from plant.identification.cells import Cells
from plant.identification.command_response import LAGS, low_pass, tilt_response
from plant.identification.estimates import Figure, Measurement, Result, interval, least, make_estimates, shifts_of
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
    if draw:
        result.figures = _figures(frequencies, tau, thesis, ours, means)
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
