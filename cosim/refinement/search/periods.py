"""Likely periods of forces that repeat along a position, before a score test.

A force that repeats many times over the travel promises nothing at another period, and no fit finds its own from there.
A matched filter (North 1943) turns the innovations of the base fit into estimates of the force in each row; its
coefficients are the response of the innovations to forces that repeat fast. The estimates, ordered by position, show
the period as a line of their spectrum (a periodogram at unequal distances), relative to the spectrum of white noise
after the same filter. A score test of the strongest lines and of the usual periods decides, and climbs from
those that can lead to a fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from operator import itemgetter

import numpy as np

from cosim.core.arrays import Array
from cosim.core.linear_algebra import least_squares
from cosim.estimation.kernel.kernel import DEVIATION
from cosim.estimation.parallel import in_parallel
from cosim.estimation.screen import SHARE, ScoreTest
from cosim.estimation.subject.candidates import Candidate, Free

RADIAN = 2.0 * math.pi  # standard deviations of a position in the shortest period: one radian of its phase
LINES = 3  # strongest lines that a score test compares
LASTING = 100  # rows over which the innovations answer a force
PROBES = (4.0, 12.0, 36.0)  # periods of the forces that show the response, in distances from row to row
DRAWS = 16  # white noises whose mean spectrum is the background of a line
SEED = 0  # seed of these noises
FINE = 4  # cells of the shortest period, and points of the spectrum for each cycle over the travel
AROUND = 2  # cycles over the travel on each side, over which the background is smoothed
MOST_CELLS = 2**18
SHORT = 1e-3  # least number of cells over which a force is spread
FARTHEST, NEAREST, MOST_STEPS = 2.0, 0.5, 12  # cycles over the travel by which a period is then varied; and how often
OFF = 0.4  # least share of the gain within half a cycle over the travel, from the next line or cycle: sinc²(½)


def with_likely_periods(
    test: ScoreTest, candidates: Sequence[Candidate], known: Sequence[str], required: Callable[[Candidate], float]
) -> tuple[list[Candidate], dict[str, float]]:
    """Return the candidates and their periods, those that promise most; the test then uses them.

    Args:
        known: Names of candidates in the fit, which keep their periods.
        required: Candidate → least predicted gain with which it is fitted.
    """
    chosen = [_with_period(test, c, required) if c.repeats and c.name not in known else c for c in candidates]
    periods = {c.repeats[0]: test.values[c.repeats[0]] for c in chosen if c.repeats and c.name not in known}
    return chosen, periods


def _with_period(test: ScoreTest, c: Candidate, required: Callable[[Candidate], float]) -> Candidate:
    name, along = c.repeats
    (period,) = (f for f in c.free if f.name == name)
    sizes = [f for f in c.free if f.neutral is not None]
    positions, sigma, answers = _along(test, along)
    period = replace(period, low=min(max(period.low, RADIAN * sigma), period.high))
    travel = float(np.ptp(np.concatenate(positions)))
    if not (travel > 0.0 and math.isfinite(travel)):
        return c

    def row(value: float, f: Free) -> Array:
        return test.row({name: value - test.values[name], f.name: SHARE * f.size})

    apart = float(np.median(np.abs(np.concatenate([np.diff(q) for q in positions]))))  # from row to row
    probes = [min(max(times * apart, period.low), period.high) for times in PROBES]
    responses = in_parallel(lambda value: _by_row(test, row(value, sizes[0])), probes)
    response = _response(positions, probes, responses)
    usual = [start[name] for start in c.starts]
    tried = dict.fromkeys([*usual, *_lines(positions, answers, response, period.low, period.high)])

    def gain(value: float) -> float:
        return test.gain([row(value, f) for f in sizes])[0]

    among = max(1, round(travel / period.low))  # periods apart by a cycle over the travel
    gains = in_parallel(gain, [*tried])
    climbs = [pair for pair in zip(tried, gains, strict=True) if pair[1] > OFF * required(replace(c, among=among))]
    peaks = [_climbed(gain, *pair, period, travel) for pair in climbs] or zip(tried, gains, strict=True)
    best, _ = max(peaks, key=itemgetter(1))
    test.values[name] = best
    size = best**2 / (2.0 * math.pi * travel)  # moves the phase over the travel by 1
    free = tuple(replace(period, size=size) if f.name == name else f for f in c.free)
    return replace(c, free=free, among=among, starts=({**c.starts[0], name: best},))


def _climbed(
    gain: Callable[[float], float], best: float, most: float, period: Free, travel: float
) -> tuple[float, float]:
    """Return the period of a local maximum of the gain, and this gain, near a period whose gain is known."""
    apart = FARTHEST
    for _ in range(MOST_STEPS):
        others = [1.0 / (1.0 / best + cycles / travel) for cycles in (-apart, apart)]
        inside = [value for value in others if period.low <= value <= period.high] or [best]
        other, more = max(zip(inside, in_parallel(gain, inside), strict=True), key=itemgetter(1))
        if more > most:
            best, most = other, more
        elif apart > NEAREST:
            apart *= 0.5
        else:
            break
    return best, most


def _along(test: ScoreTest, name: str) -> tuple[list[Array], float, list[Array]]:
    """Return the positions in all rows of each log, and the normalised innovations in all but the first.

    Between them stands the standard deviation of the position: that of its sensor, or of the filtered state if larger.
    Along a finer force, the filter does not know the phase, and its slopes only stand for process noise.
    """
    problem, layout = test.problem, test.problem.layout
    places = [layout.states.index(n) for n in (name, DEVIATION + name) if n in layout.states]
    runs = [problem.run(test.values, test.noise, k, states=True) for k in range(len(problem.logs))]
    at = [run.states[:, places].sum(axis=1) for run in runs]
    own = [k for k, place in enumerate(layout.stochastic) if place in places]
    known = [run.covariances[:, own][:, :, own] for run in runs if run.covariances is not None]
    variances = [np.median(np.concatenate(known).sum(axis=(1, 2)))] if known and own else []
    variances += [np.exp(test.noise.sensors[layout.outputs.index(name)])] if name in layout.outputs else []
    sigma = math.sqrt(max(0.0, *map(float, variances))) if variances else 0.0
    return at, sigma, _by_row(test, test.residual)


def _by_row(test: ScoreTest, numbers: Array) -> list[Array]:
    """Return numbers of the scored readings of each log, shape (rows − 1, outputs); 0 for others and the first row."""
    parts = test.scored.of_each_log(numbers[: len(test.scored.errors)])
    tables = [np.zeros(log.y.shape) for log in test.problem.logs]
    for table, part, readings in zip(tables, parts, test.problem.readings, strict=True):
        table.put(readings.places, part)
    return [table[1:] for table in tables]


def _response(positions: Sequence[Array], periods: Sequence[float], answers: Sequence[Sequence[Array]]) -> Array:
    """Return the response of the innovations to a force in a row, shape (LASTING, outputs), by least squares.

    Args:
        positions: In all rows of each log.
        periods: Periods of sines along the position.
        answers: For each period, the innovations of each log.
    """
    products, against = np.zeros((LASTING, LASTING)), np.zeros((LASTING, answers[0][0].shape[1]))
    for period, of_logs in zip(periods, answers, strict=True):
        for q, answer in zip(positions, of_logs, strict=True):
            force = np.sin(math.pi * (q[:-1] + q[1:]) / period) * np.sinc(np.diff(q) / period)  # mean over the row
            late = np.stack([np.pad(force, (k, 0))[: len(force)] for k in range(LASTING)])
            products += late @ late.T
            against += late @ answer
    return least_squares(products, against, rcond=1e-6)


def _spread(amounts: Array, ends: Array, count: int) -> Array:
    """Return amounts spread evenly over the cells from each end to the next, for a spectrum.

    A force that repeats within a row has no mean over the row, and spread over its cells no line in the spectrum.
    """
    from_, to = np.minimum(ends[:-1], ends[1:]), np.maximum(ends[:-1], ends[1:])
    to = np.maximum(to, from_ + SHORT)
    density, bends = amounts / (to - from_), np.zeros(count + 2)
    for at, sign in ((from_, 1.0), (to, -1.0)):  # the integral bends at both ends
        cell = at.astype(np.intp)
        bends += sign * np.bincount(cell, density * (cell + 1 - at), len(bends))
        bends += sign * np.bincount(cell + 1, density * (at - cell), len(bends))
    return np.asarray(np.cumsum(bends)[:count])


def _lines(
    positions: Sequence[Array], answers: Sequence[Array], response: Array, low: float, high: float
) -> Iterator[float]:
    """Yield the periods of the strongest lines in the spectrum of the forces that the innovations show."""
    first = min(float(p.min()) for p in positions)
    travel = max(float(p.max()) for p in positions) - first
    width = max(low / FINE, travel / MOST_CELLS)
    count = int(travel / width) + 2
    points = 2 ** math.ceil(math.log2(FINE * count))

    def spectrum(tables: Sequence[Array]) -> Array:
        cells = np.zeros(count)
        for at, table in zip(positions, tables, strict=True):
            late = np.pad(table, ((0, LASTING), (0, 0)))
            force = np.sum([late[k : k + len(table)] @ response[k] for k in range(LASTING)], axis=0)
            cells += _spread(force, (at - first) / width, count)
        return np.abs(np.fft.rfft(cells, points)) ** 2

    from scipy.ndimage import uniform_filter1d

    random = np.random.default_rng(SEED)
    draws = (spectrum([np.where(a, random.standard_normal(a.shape), 0.0) for a in answers]) for _ in range(DRAWS))
    background = uniform_filter1d(sum(draws) / DRAWS, 1 + 2 * round(AROUND * points * width / travel), mode="nearest")
    height = spectrum(answers) / np.maximum(background, 1e-300)
    frequency = np.arange(len(height)) / (points * width)
    height[(frequency * low > 1.0) | (frequency * high < 1.0)] = 0.0
    beside = max(1, round(2.0 * points * width / travel))
    for _ in range(LINES):
        peak = int(np.argmax(height))
        if not height[peak] > 0.0:
            return
        yield 1.0 / float(frequency[peak])
        height[max(0, peak - beside) : peak + beside + 1] = 0.0
