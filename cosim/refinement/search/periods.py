"""Likely periods of forces that repeat along a position, before a score test.

A force that repeats many times over the travel promises nothing at another period, and no fit finds its own from there.
The innovations of the base fit, ordered by position, show the period as a line of their spectrum. Behind the force they
are late by the response of the machine, which both directions of motion shift to opposite sides, so that each direction
has a spectrum of its own. A score test of the strongest lines and of the usual periods decides, and climbs from the
best.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from cosim.core.arrays import Array
from cosim.estimation.fit import DIFFERENCE
from cosim.estimation.kernel.kernel import DEVIATION
from cosim.estimation.parallel import in_parallel
from cosim.estimation.screen import SHARE, ScoreTest
from cosim.estimation.subject.candidates import Candidate

RADIAN = 2.0 * math.pi  # standard deviations of a position in the shortest period: one radian of its phase
LINES = 3  # strongest lines that a score test compares


def with_likely_periods(
    test: ScoreTest, candidates: Sequence[Candidate], known: Sequence[str]
) -> tuple[list[Candidate], dict[str, float]]:
    """Return the candidates and their periods, those that promise most; the test then uses them.

    Args:
        known: Names of candidates in the fit, which keep their periods.
    """
    chosen = [_with_period(test, c) if c.repeats and c.name not in known else c for c in candidates]
    periods = {c.repeats[0]: test.values[c.repeats[0]] for c in chosen if c.repeats and c.name not in known}
    return chosen, periods


def _with_period(test: ScoreTest, c: Candidate) -> Candidate:
    name, along = c.repeats
    (period,) = (f for f in c.free if f.name == name)
    sizes = [f for f in c.free if f.neutral is not None]
    positions, sigma = _along(test, along)
    low = min(max(period.low, RADIAN * sigma), period.high)
    travel = float(np.ptp(np.concatenate(positions)))
    if not 0.0 < travel < math.inf:
        return c

    def gain(value: float) -> float:
        start = {name: value - test.values[name]}
        return test.gain([test.row(start | {f.name: SHARE * f.size}) for f in sizes])[0]

    def at(cycles: float, value: float) -> float:
        """Return the period with some more cycles over the travel."""
        return min(max(1.0 / (1.0 / value + cycles / travel), low), period.high)

    tried = [*(start[name] for start in c.starts), *_lines(test, positions, low, period.high)]
    near = tried[int(np.argmax(in_parallel(gain, tried)))]
    climb = minimize_scalar(
        lambda cycles: -gain(at(cycles, near)), bounds=(-1.0, 1.0), method="bounded", options={"xatol": DIFFERENCE}
    )
    best = test.values[name] = at(float(climb.x), near)
    size = best**2 / (RADIAN * travel)  # moves the phase over the travel by 1
    free = tuple(replace(f, low=low, size=size) if f.name == name else f for f in c.free)
    return replace(c, free=free, among=max(1, round(travel / low)), starts=({**c.starts[0], name: best},))


def _along(test: ScoreTest, name: str) -> tuple[list[Array], float]:
    """Return the positions in all rows of each log, and their standard deviation.

    It is that of the sensor, or of the filtered state if larger. Along a finer force, the filter does not know the
    phase, and its slopes only stand for process noise.
    """
    problem, layout = test.problem, test.problem.layout
    places = [layout.states.index(n) for n in (name, DEVIATION + name) if n in layout.states]
    runs = [problem.run(test.values, test.noise, k) for k in range(len(problem.logs))]
    own = [k for k, place in enumerate(layout.stochastic) if place in places]
    known = [run.covariances[:, own][:, :, own] for run in runs if run.covariances is not None]
    variances = [0.0]
    if known and own:
        variances.append(float(np.median(np.concatenate(known).sum(axis=(1, 2)))))
    if name in layout.outputs:
        variances.append(float(np.exp(test.noise.sensors[layout.outputs.index(name)])))
    return [run.states[:, places].sum(axis=1) for run in runs], math.sqrt(max(variances))


def _lines(test: ScoreTest, positions: Sequence[Array], low: float, high: float) -> Iterator[float]:
    """Yield the periods of the strongest lines in the spectrum of the innovations along the position."""
    from scipy.signal import find_peaks  # only here: it takes half a second to import

    frequency, height = spectrum_along([*zip(positions, innovations_of_logs(test), strict=True)], low)
    height[frequency * high < 1.0] = 0.0
    peaks, _ = find_peaks(height, distance=2 * 2)  # two cycles over the travel
    strongest = sorted(peaks, key=lambda peak: -height[peak])[:LINES]
    yield from (1.0 / float(frequency[peak]) for peak in strongest)


def innovations_of_logs(test: ScoreTest) -> list[Array]:
    """Return the normalised innovations of each log, shape (rows, outputs), beside what free parameters imitate."""
    tables = []
    parts = test.scored.of_each_log(test.residual[: len(test.scored.errors)])
    for part, readings, log in zip(parts, test.problem.readings, test.problem.logs, strict=True):
        tables.append(np.zeros(log.y.shape))
        tables[-1].put(readings.places, part)
    return tables


def spectrum_along(tracks: Sequence[tuple[Array, Array]], low: float) -> tuple[Array, Array]:
    """Return the frequencies and the spectrum of tables along positions, each direction of motion by itself.

    Args:
        tracks: Positions and table of each log, shapes (rows,) and (rows, columns).
        low: Shortest period.
    """
    first = min(float(q.min()) for q, _ in tracks)
    count = 2 + int(2.0 * (max(float(q.max()) for q, _ in tracks) - first) / low)  # two cells in the shortest period
    cells = np.zeros((2, tracks[0][1].shape[1], count))
    for q, table in tracks:
        middle = (2.0 * (0.5 * (q[1:] + q[:-1]) - first) / low).astype(np.intp)
        for direction, moving in enumerate((np.diff(q) > 0.0, np.diff(q) < 0.0)):
            for column, values in enumerate(table[1:].T):
                cells[direction, column] += np.bincount(middle[moving], values[moving], count)
    height = np.sum(np.abs(np.fft.rfft(cells, 2 * count)) ** 2, axis=(0, 1))
    frequency = np.arange(len(height)) / (count * low)
    height[frequency * low > 1.0] = 0.0
    return frequency, height
