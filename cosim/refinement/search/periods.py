"""Likely periods of forces that repeat along a position, before a score test.

A force that repeats hundreds of times over the travel promises nothing at another period, and no fit finds its own from
there. The innovations of the base fit, ordered by position, show it as a line of their spectrum (a periodogram at
unequal distances). A score test of the strongest lines and of the usual periods decides, and climbs from the best if
that can lead to a fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from cosim.base.arrays import Array
from cosim.estimation.parallel import in_parallel
from cosim.estimation.screen import SHARE, ScoreTest
from cosim.kernel.kernel import DEVIATION
from cosim.subject.candidates import Candidate, Free

LINES = 3  # strongest lines that a score test compares
LASTING = 5  # rows over which the innovations answer a force
FINE = 4  # cells of the shortest period, and points of the spectrum for each cycle over the travel
AROUND = 50  # cycles over the travel on each side, whose mean power is the background of a line
MOST_CELLS = 2**18
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
    positions, answers = _along(test, along)
    travel = float(np.ptp(np.concatenate(positions)))
    if not (travel > 0.0 and math.isfinite(travel)):
        return c
    usual = [start[name] for start in c.starts]
    tried = dict.fromkeys([*usual, *_lines(positions, answers, period.low, period.high)])
    sizes = [f for f in c.free if f.neutral is not None]

    def gain(value: float) -> float:
        apart = value - test.values[name]
        return test.gain([test.row({name: apart, f.name: SHARE * f.size}) for f in sizes])[0]

    among = max(1, round(travel / period.low))  # periods apart by a cycle over the travel
    best, most = _best(gain, [*tried])
    if most > OFF * required(replace(c, among=among)):
        best = _climbed(gain, best, most, period, travel)
    test.values[name] = best
    size = best**2 / (2.0 * math.pi * travel)  # moves the phase over the travel by 1
    free = tuple(replace(f, size=size) if f.name == name else f for f in c.free)
    return replace(c, free=free, among=among, starts=({**c.starts[0], name: best},))


def _climbed(gain: Callable[[float], float], best: float, most: float, period: Free, travel: float) -> float:
    """Return the period of a local maximum of the gain, near one whose gain is known."""
    apart = FARTHEST
    for _ in range(MOST_STEPS):
        others = [1.0 / (1.0 / best + cycles / travel) for cycles in (-apart, apart)]
        other, more = _best(gain, [value for value in others if period.low <= value <= period.high] or [best])
        if more > most:
            best, most = other, more
        elif apart > NEAREST:
            apart *= 0.5
        else:
            break
    return best


def _best(gain: Callable[[float], float], periods: Sequence[float]) -> tuple[float, float]:
    """Return the period that gains most, and its gain."""
    gains = in_parallel(gain, periods)
    return max(zip(periods, gains, strict=True), key=lambda pair: pair[1])


def _along(test: ScoreTest, name: str) -> tuple[list[Array], list[Array]]:
    """Return the positions in the middle of the rows of each log, and the normalised innovations at their ends."""
    problem, states = test.problem, test.problem.layout.states
    places = [states.index(n) for n in (name, DEVIATION + name) if n in states]
    positions, answers = [], []
    for index in range(len(problem.logs)):
        run = problem.run(test.values, test.noise, index, states=True)
        at = run.states[:, places].sum(axis=1)
        middle = 0.5 * (at[:-1] + at[1:])
        with np.errstate(invalid="ignore"):
            answer = np.nan_to_num(run.errors / np.sqrt(run.variances), posinf=0.0, neginf=0.0)[1:]
        answer[~test.problem.readings[index].scored[1:]] = 0.0
        moves = np.isfinite(middle)
        positions.append(middle[moves])
        answers.append(answer[moves])
    return positions, answers


def _lines(positions: Sequence[Array], answers: Sequence[Array], low: float, high: float) -> Iterator[float]:
    """Yield the periods of the strongest lines in the spectrum of the innovations along the position."""
    first = min(float(p.min()) for p in positions)
    travel = max(float(p.max()) for p in positions) - first
    width = max(low / FINE, travel / MOST_CELLS)
    count = int(travel / width) + 1
    points = 2 ** math.ceil(math.log2(FINE * count))
    power = np.zeros(points // 2 + 1)
    for j in range(answers[0].shape[1]):
        for late in range(LASTING):
            cells = np.zeros(count)
            for at, answer in zip(positions, answers, strict=True):
                places = ((at[: len(at) - late] - first) / width).astype(np.intp)
                cells += np.bincount(places, answer[late:, j], count)
            power += np.abs(np.fft.rfft(cells, points)) ** 2 / max(
                1e-300, sum(float(a[:, j] @ a[:, j]) for a in answers)
            )
    frequency = np.arange(len(power)) / (points * width)
    reach = max(1, round(AROUND * points * width / travel))
    total = np.concatenate([[0.0], np.cumsum(power)])
    ends = np.arange(len(power))
    left, right = np.maximum(ends - reach, 0), np.minimum(ends + reach + 1, len(power))
    height = power / np.maximum((total[right] - total[left]) / (right - left), 1e-300)
    height[(frequency * low > 1.0) | (frequency * high < 1.0)] = 0.0
    beside = max(1, round(2.0 * points * width / travel))
    for _ in range(LINES):
        peak = int(np.argmax(height))
        if not height[peak] > 0.0:
            return
        yield 1.0 / float(frequency[peak])
        height[max(0, peak - beside) : peak + beside + 1] = 0.0
