"""Test 4, in frequency: horizontal force behind sines of the tilt (§4.5.4, App. D.3.4)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.base.arrays import Array
from plant.bench import Bench
from plant.identification.cells import Cells, force_of
from plant.identification.command_response import LAGS, low_pass, tilt_response
from plant.identification.commanded import frequency_of
from plant.identification.estimates import Figure, Result, interval, least, made, shifts_of
from plant.identification.protocol import SineTest
from plant.identification.recordings import Recording

SMOOTHING = 9  # rows of the mean in App. D.3.4
DECIBEL, DEGREE = 20.0, 180.0 / np.pi


def analyse(
    recordings: Sequence[Recording],
    cells: Cells,
    known: Bench,
    test: SineTest,
    truth: Bench | None,
    *,
    draw: bool = True,
) -> Result:
    """τ from sines fitted at their known frequency, against those of the bench's equations behind the same commands."""
    by_frequency = grouped(recordings, test)
    frequencies = np.array(sorted(by_frequency))
    count = min(len(found) for found in by_frequency.values())
    chosen = [[by_frequency[w][k] for w in frequencies] for k in range(count)]
    tables = np.array([_table(by_frequency[w][0], w, known, test) for w in frequencies])  # frequency, lag

    def amplitudes(using: Cells) -> Array:
        return np.array(
            [
                [sine(r, force_of(r, using, "x", test.rest), w, test) for r, w in zip(row, frequencies, strict=True)]
                for row in chosen
            ]
        )

    def scale(c: Array) -> Array:
        """Force per sine of the tilt at each lag, shape (repetitions, lags)."""
        return np.asarray(
            (np.conj(tables).T[None] * c[:, None, :]).sum(axis=2).real / (np.abs(tables) ** 2).sum(axis=0)
        )

    def lags(using: Cells) -> Array:
        c = amplitudes(using)
        cost = (np.abs(c[:, None, :] - scale(c)[:, :, None] * tables.T[None]) ** 2).sum(axis=2)
        return least(LAGS, cost)[:, None]

    each = lags(cells)
    thesis_db, thesis_degrees = _by_hand(chosen, frequencies, cells, test)
    fitted = _fit_magnitudes(frequencies, thesis_db.mean(axis=0))
    names = [("lag", "s", fitted, truth.lag if truth else np.nan)]
    result = Result("frequency", made(names, each, shifts_of(lags, cells, "x", each), "Test 4, sines fitted"))
    tau = result.estimates[0].value
    c = amplitudes(cells)
    place = int(np.argmin(np.abs(LAGS - tau)))
    ideal = 1.0 / (1.0 + 1j * frequencies * LAGS[place])
    points = c / scale(c)[:, [place]] / tables[:, place] * ideal
    db, degrees = DECIBEL * np.log10(np.abs(points)), np.angle(points) * DEGREE
    none = np.zeros((0, frequencies.size))
    (m_db, h_db, *_), (m_deg, h_deg, *_) = interval(db, none), interval(degrees, none)
    smoothing = DECIBEL * np.log10(abs(_mean_of_nine(frequencies[-1], recordings[0].step)))
    result.more = {
        "frequency": frequencies.tolist(),
        "magnitude_db": m_db.tolist(),
        "magnitude_db_half": h_db.tolist(),
        "phase_deg": m_deg.tolist(),
        "phase_deg_half": h_deg.tolist(),
        "thesis_magnitude_db": thesis_db.mean(axis=0).tolist(),
        "thesis_phase_deg": thesis_degrees.mean(axis=0).tolist(),
    }
    result.notes.append(
        f"The mean of nine rows costs the thesis' points {-smoothing:.2f} dB at {frequencies[-1]:g} rad/s. Ours are "
        "held against the same commands through the bench's equations: hold, dead band, sine of the angle."
    )
    if draw:
        result.figures = _figures(
            frequencies, tau, (thesis_db, thesis_degrees), (db, degrees), (m_db, h_db, m_deg, h_deg)
        )
    return result


def grouped(recordings: Sequence[Recording], test: SineTest) -> dict[float, list[Recording]]:
    """Recordings by frequency: that of the protocol's whose sine comes nearest to the command."""
    found: dict[float, list[Recording]] = {}
    for r in recordings:
        found.setdefault(frequency_of(r, test), []).append(r)
    return found


def sine(r: Recording, values: Array, w: float, test: SineTest) -> complex:
    """Complex amplitude of the sine of a known frequency, beside a constant, after what is skipped."""
    rows = r.time >= test.lead + test.skip
    t = r.time[rows] - test.lead
    basis = np.column_stack((np.sin(w * t), np.cos(w * t), np.ones_like(t)))
    a, b, _ = np.linalg.lstsq(basis, values[rows], rcond=None)[0]
    return complex(a, b)


def _table(r: Recording, w: float, known: Bench, test: SineTest) -> Array:
    """The same of sin α by the equations, a lag each."""
    shapes = low_pass(np.sin(tilt_response(known, r.time, r.servo_duty, LAGS)), r.step, test.low_pass)
    rows = r.time >= test.lead + test.skip
    t = r.time[rows] - test.lead
    basis = np.column_stack((np.sin(w * t), np.cos(w * t), np.ones_like(t)))
    a, b, _ = np.linalg.lstsq(basis, shapes[rows], rcond=None)[0]
    return np.asarray(a + 1j * b)


def _by_hand(
    chosen: Sequence[Sequence[Recording]], frequencies: Array, cells: Cells, test: SineTest
) -> tuple[Array, Array]:
    """Magnitude [dB] and phase [°] against the lowest frequency, from least and largest of the smoothed force."""
    mask = np.exp(-0.5 * (np.arange(-4, 5) / 100.0) ** 2)
    mask /= mask.sum()
    skips = [*test.thesis_skip, *(0.0 for _ in frequencies)]
    size, phase = np.empty((len(chosen), frequencies.size)), np.empty((len(chosen), frequencies.size))
    for k, row in enumerate(chosen):
        for j, (r, w) in enumerate(zip(row, frequencies, strict=True)):
            begin = test.lead + skips[j] * 2.0 * np.pi / w
            rows = (r.time >= begin) & (r.time < begin + 2.0 * np.pi / w + 1e-9)
            y = np.convolve(force_of(r, cells, "x", None), mask, mode="same")[rows]
            t = r.time[rows] - test.lead
            size[k, j] = 0.5 * (y.max() - y.min())
            phase[k, j] = (270.0 - w * float(t[np.argmin(y)]) * DEGREE + 180.0) % 360.0 - 180.0
    return DECIBEL * np.log10(size / size[:, :1]), phase - phase[:, :1]


def _fit_magnitudes(w: Array, db: Array) -> float:
    """τ of the first-order line nearest to magnitudes in dB."""
    lines = -10.0 * np.log10(1.0 + (w[None] * LAGS[:, None]) ** 2)
    return float(least(LAGS, ((lines - db) ** 2).sum(axis=1)[None])[0])


def _mean_of_nine(w: float, step: float) -> float:
    """Gain of a mean over nine rows."""
    return float(np.mean(np.cos(w * step * np.arange(-(SMOOTHING // 2), SMOOTHING // 2 + 1))))


def _figures(
    w: Array,
    tau: float,
    thesis: tuple[Array, Array],
    ours: tuple[Array, Array],
    means: tuple[Array, Array, Array, Array],
) -> list[Figure]:
    import control

    grid = np.geomspace(w.min(), w.max() * 1.5, 80)
    response = control.frequency_response(control.tf([1.0], [tau, 1.0]), grid)
    curves = DECIBEL * np.log10(np.abs(response.complex)), np.angle(response.complex) * DEGREE
    x, apart = np.repeat(w[None], ours[0].shape[0], axis=0).ravel(), 10**0.012  # so that neither hides the other
    m_db, h_db, m_deg, h_deg = means
    found = []
    for title, unit, curve, by_hand, own, mean, half in (
        ("magnitude", "dB", curves[0], thesis[0], ours[0], m_db, h_db),
        ("phase", "°", curves[1], thesis[1], ours[1], m_deg, h_deg),
    ):
        found.append(
            Figure(
                f"Bode {title}: single tests",
                "frequency [rad/s]",
                unit,
                [
                    ("thesis' estimator", x / apart, by_hand.ravel(), "dots pale"),
                    ("sines fitted", x * apart, own.ravel(), "dots"),
                    (f"first order, τ = {1000 * tau:.1f} ms", grid, curve, "true"),
                ],
                counterpart="Fig 4.17",
                log=True,
            )
        )
        found.append(
            Figure(
                f"Bode {title}: means with 95 % intervals",
                "frequency [rad/s]",
                unit,
                [
                    ("thesis' estimator, mean", w, by_hand.mean(axis=0), "s1"),
                    (f"first order, τ = {1000 * tau:.1f} ms", grid, curve, "true"),
                ],
                bars=[(w, mean - half, mean + half)],
                counterpart="Fig 4.18",
                log=True,
            )
        )
    return found
