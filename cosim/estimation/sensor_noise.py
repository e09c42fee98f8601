"""Sensor noise in the logs, which may differ from the noise stated by the model."""

from __future__ import annotations

import math

import numpy as np

from cosim.core.arrays import Array, Flags, NamedValues
from cosim.core.text import join_names, plain, written
from cosim.estimation.fit import Fit
from cosim.estimation.problem import Noise, Problem
from cosim.estimation.subject.interface import Subject
from cosim.logs.channel_noise import surprise, white_noise

OFF = 1.5  # ratio from which a level differs from the noise; accuracy is about 10 %
STAMPS_ERR, WILD = 5.0, 9.0  # standard deviations of the test; limit on squared innovations
SMOOTH = 0.3  # share of a channel's level that may come from motion between rows


def noise_levels(problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
    """Return output → noise standard deviation, where it can be estimated, and output → first guess of it.

    The level is the deviation of readings from four neighbours, which also contains fast motion. The model's own run
    estimates the share of motion. For outputs with a large share, such as sensors slower than the motion, the guess is
    the level of both together.
    """
    noise, both = {}, {}
    runs = [problem.simulate(problem.values, index).outputs for index in range(len(problem.logs))]
    for j, name in enumerate(problem.layout.outputs):
        columns = [log.y[:, j] for log in problem.logs]
        simulated = [np.where(np.isfinite(y), run[:, j], np.nan) for y, run in zip(columns, runs, strict=True)]
        read, motion = (white_noise(np.concatenate([surprise(y) for y in each])) for each in (columns, simulated))
        both[name] = read
        if motion < SMOOTH * read:
            noise[name] = math.sqrt(read**2 - motion**2)
    return noise, both | noise


def erring_stamps(problem: Problem, at: Fit) -> Flags:
    """Return outputs whose time stamps seem to have errors.

    Innovations then grow with the rate of change. The statistic is Rao's score test of a variance τ²·ẏ² at τ = 0:
    Σ ½ ẏ²/s·(e²/s − 1) over √(Σ ½ (ẏ²/s)²). Such errors are independent from row to row; those of a wrong model are
    not, so that ẏe/s must not be correlated with that of the next row.
    """

    def statistics(index: int) -> Array:
        """Return score, information, sum of products of neighbours and of their squares, for each output of a log."""
        readings = problem.readings[index]
        e, s = problem.innovations(at.values, at.noise, index)
        speed = readings.slopes / problem.logs[index].step
        with np.errstate(invalid="ignore"):
            share = np.where(readings.scored, speed**2 / s, 0.0)
            share = share - share.sum(axis=0) / np.maximum(1, readings.scored.sum(axis=0)) * readings.scored
            squares = np.minimum(e**2 / s, WILD)  # a few outliers are no clock error
            spread = np.where(readings.scored, squares - 1.0, 0.0)
            moved = np.where(readings.scored, np.copysign(np.sqrt(squares * speed**2 / s), speed * e), 0.0)
        neighbours = moved[1:] * moved[:-1]
        sums = 0.5 * share * spread, 0.5 * share**2, neighbours, neighbours**2
        return np.array([each.sum(axis=0) for each in sums])

    scores, information, products, squares = np.sum([*map(statistics, range(len(problem.logs)))], axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        is_significant = scores / np.sqrt(information) > STAMPS_ERR
        is_white = ~(products / np.sqrt(squares) > STAMPS_ERR)
    return np.asarray(is_significant & is_white & ~np.isfinite(at.noise.timing) & problem.adjusted)


def noise_warnings(problem: Problem, noise: Noise, subject: Subject) -> tuple[str, ...]:
    """Return warnings about estimated noise that differs from the stated noise or is not stated."""
    names, units = problem.layout.outputs, {q.name: written(q.unit) for q in subject.outputs}
    levels = dict(zip(names, np.exp(0.5 * noise.sensors).tolist(), strict=True))
    stated = {n: s for n, s, known in zip(names, np.sqrt(problem.r).tolist(), problem.stated, strict=True) if known}
    unstated = {n: level for n, level in levels.items() if n not in stated}
    different = {n: levels[n] for n, s in stated.items() if not s / OFF <= levels[n] <= OFF * s}
    warnings = []
    if different:
        both = (f"{n} {plain(s, 2)}, not {plain(stated[n], 2)} {units[n]}".rstrip() for n, s in different.items())
        warnings.append(
            f"the noise in the logs differs from the stated noise ({'; '.join(both)}); the noise of the "
            f"logs is used. Write {_line(different)} into the study to state it"
        )
    if unstated:
        warnings.append(
            f"the model does not state the noise of {join_names([*unstated])} (sensor_variance); the logs show "
            f"{_line(unstated)}, which is used. Write it into the study to state another"
        )
    stamps = zip(names, np.exp(0.5 * noise.timing).tolist(), strict=True)
    if erring := [f"{name} by {plain(t, 2)} s" for name, t in stamps if t > 0.0]:
        warnings.append(
            f"time stamps seem to err from row to row, with a standard deviation: {join_names(erring)}. Their "
            "readings count less where they change fast; record with a better clock to use them fully"
        )
    return tuple(warnings)


def cell_warnings(problem: Problem, subject: Subject) -> tuple[str, ...]:
    """Return a warning about sensors that read in cells."""
    finest = np.max([r.resolution for r in problem.readings], axis=0)
    units = {q.name: written(q.unit) for q in subject.outputs}
    pairs = zip(problem.layout.outputs, finest.tolist(), strict=True)
    cells = [f"{name} reads in cells of {plain(cell)} {units[name]}".rstrip() for name, cell in pairs if cell > 0.0]
    text = (
        f"the readings repeat a few values: {join_names(cells)}. The noise of such a sensor is at least its "
        "cell over √12; this is read off the logs, and no candidate"
    )
    return (text,) if cells else ()


def _line(levels: NamedValues) -> str:
    return f"`noise: {{{', '.join(f'{name}: {level:.2g}' for name, level in levels.items())}}}`"
