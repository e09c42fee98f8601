"""The part of each derivative that a model lacks, in each row, and the contribution of a hypothesis to it.

Each forced equation has an unknown input, a state of the filter. A Rauch-Tung-Striebel smoother (1965) estimates it in
each row from the readings before and after, along the filtered states x̂ with covariances P,

    xₖ = x̂ₖ + G·(xₖ₊₁ − f(x̂ₖ))      G = P·F'·(F·P·F' + Q)⁻¹      F = ∂f/∂x by differences of single kernel steps

The power of the unknown inputs is the fitted power, at least `NoiseRange.plain`. The contribution of a hypothesis is a
model step with the hypothesis minus a step without, divided by the step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.core.arrays import Array, NamedValues, Rows
from cosim.core.linear_algebra import least_squares
from cosim.estimation.data import count_unscored
from cosim.estimation.fit import Fit
from cosim.estimation.kernel.kernel import DEVIATION, Filtered
from cosim.estimation.problem import Noise, Problem
from cosim.refinement.decision.posterior import CERTAIN

MAX_SMOOTHED_ROWS = 3000  # largest number of smoothed rows of a log
LOGS = 2  # number of smoothed logs, from the first
NUDGE = 1e-4  # difference step relative to the size of a state; kernel steps are smooth at this scale


@dataclass(frozen=True, eq=False)
class MissingInput:
    """Missing input d of each forced equation in the rows of the first logs, log after log.

    The unit of d is the unit of the state per second.

    Attributes:
        rows: Rows of each log.
        sigma: Standard deviation of `value`.
        states: All kernel states, filtered by the base fit.
    """

    equations: tuple[str, ...]
    rows: Sequence[slice]
    time: Array
    value: Array
    sigma: Array
    states: Array

    def of_logs(self, tables: Sequence[Array]) -> Array:
        """Return the rows `rows` of a table for each log, log after log."""
        return np.concatenate([table[rows] for table, rows in zip(tables, self.rows, strict=False)])

    def by_log(self, values: Array) -> list[Array]:
        """Return values of all rows split by log."""
        return np.split(values, np.cumsum([rows.stop - rows.start for rows in self.rows])[:-1])


def next_rows(problem: Problem, values: NamedValues, index: int, points: tuple[Rows, Array, Array]) -> Array:
    """Return the states at the next row for each of some rows with given states and memories."""
    runs = problem.simulate_from(values, index, (points[0].tolist(), *points[1:]))
    return np.array([run.states[1] for run in runs])


def smooth_logs(problem: Problem, base: Fit, every: int = 1, *, deviations: bool = False) -> MissingInput:
    """Return the smoothed missing inputs of the first logs; for free runs, the inputs that drive the deviations.

    Args:
        every: Rows between two linearizations.
        deviations: For free runs, return the filtered deviations of the outputs instead.
    """
    layout, noise, found = problem.layout, loosen_noise(problem, base.noise), list[tuple[Any, ...]]()
    names, reached = layout.uncertain, list(layout.stochastic)
    places = [k for k, name in enumerate(names) if name.startswith(DEVIATION)] if deviations else list(layout.noisy)
    for index in smoothed_logs(problem):
        data, run = problem.data(base.values, index), problem.run(base.values, noise, index)
        count = min(len(data.u), MAX_SMOOTHED_ROWS)
        last = count if deviations else count - 1
        scored, x = slice(min(count_unscored(data), last), last), run.states[:count, reached]
        if run.covariances is None:  # filtered inputs, with the uncertainty before any reading
            sigma = np.tile(np.exp(0.5 * noise.power), (count, 1))
        else:
            P = run.covariances[:count]
            if not deviations:
                if layout.is_free_run:
                    F = _transitions_of_deviations(problem, base.values, noise, index)[:count]
                    ahead = np.einsum("kij,kj->ki", F, x)
                else:
                    ahead, F = _linear(problem, base.values, index, run, count, every)
                x, P = _smooth(x, P, ahead, F, np.diag(problem.densities(noise)) * data.step)
            sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2)[:, places], 0.0))
        found.append((scored, data.times[scored], x[scored, places], sigma[scored], run.states[scored]))
    rows, *parts = zip(*found, strict=True)
    return MissingInput(layout.forced, rows, *map(np.concatenate, parts))


def _smooth(x: Array, P: Array, ahead: Array, F: Array, Q: Array) -> tuple[Array, Array]:
    """Return smoothed states and covariances, from filtered ones, their predictions and transition matrices."""
    x, P = x.copy(), P.copy()
    for k in range(len(x) - 2, -1, -1):
        spread = F[k] @ P[k] @ F[k].T + Q
        gain = least_squares(spread, F[k] @ P[k]).T
        x[k] += gain @ (x[k + 1] - ahead[k])
        P[k] += gain @ (P[k + 1] - spread) @ gain.T
    return x, P


def _transitions_of_deviations(problem: Problem, values: NamedValues, noise: Noise, index: int) -> Array:
    """Return the transition matrices of a free run's random states, from each row to the next.

    Random states are the previous row's deviations, the inputs that drive deviations, the deviations, and constants.
    """
    layout, data = problem.layout, problem.data(values, index)
    ny, n = len(layout.outputs), len(layout.stochastic)
    F = np.tile(np.eye(n), (len(data.u), 1, 1))
    earlier, drive, deviation = (slice(k * ny, (k + 1) * ny) for k in (0, 1, 2))
    _, propagation = problem.kernel.responses(data, problem.start(values, index)[0])  # type: ignore[attr-defined]
    F[:, earlier, earlier], F[:, earlier, deviation] = 0.0, np.eye(ny)
    F[:, drive, drive] *= math.exp(-data.step / math.exp(noise.memory))
    F[:, deviation, deviation], F[:, deviation, earlier] = propagation[:, :ny], propagation[:, ny:]
    F[:, deviation, drive] = data.step * np.eye(ny)
    return F


def smoothed_logs(problem: Problem) -> range:
    """Return the indices of the logs that are smoothed."""
    return range(min(LOGS, len(problem.logs)))


def unknown_inputs(problem: Problem, at: Fit, units: Mapping[str, str]) -> dict[str, float]:
    """Return forced state → size of its unknown input relative to the derivatives of states with the same unit.

    Args:
        units: Units of the states.
    """
    names, powers = problem.layout.forced, np.exp(0.5 * at.noise.power)
    largest: dict[tuple[str, int], float] = {}  # unit and order → range of the derivatives
    orders = [1] * len(problem.layout.noisy)
    if problem.layout.is_free_run:  # 2 if the velocity of the output is hidden
        matrix = problem.kernel.responses(problem.logs[0], problem.x0[0])[1]  # type: ignore[attr-defined]
        orders = [1 + bool(matrix[:, j].any()) for j in range(len(orders), 2 * len(orders))]
    kinds = {n: (units[n], order) for n, order in zip(names, orders, strict=True)}
    runs = [problem.run(at.values, at.noise, k) for k in range(len(problem.logs))]
    for name, place in zip(names, problem.layout.forced_places, strict=True):
        change = [
            np.diff(run.states[count_unscored(d) :, place], kinds[name][1]) / d.step
            for run, d in zip(runs, problem.logs, strict=True)
        ]
        low, high = np.quantile(np.concatenate(change), (0.5 * (1.0 - CERTAIN), 0.5 * (1.0 + CERTAIN)))
        largest[kinds[name]] = max(largest.get(kinds[name], np.finfo(float).tiny), float(high - low))
    return {n: float(p) / largest[kinds[n]] for n, p in zip(names, powers, strict=True)}


def loosen_noise(problem: Problem, noise: Noise) -> Noise:
    """Return noise with which the filter's unknown inputs follow model errors.

    A fit without unknown inputs counts model errors as sensor noise; the stated sensor noise then replaces it.
    """
    bare = np.allclose(noise.power, problem.noise.smallest)
    sensors = np.minimum(noise.sensors, np.log(problem.r)) if bare else noise.sensors
    return replace(problem.plain, sensors=sensors, power=np.maximum(noise.power, problem.noise.plain))


def contributions(problem: Problem, base: Fit, after: Fit, index: int) -> Array:
    """Return the contribution of a claim to each forced equation in the smoothed rows.

    Both steps (with and without the claim) start from the refined model's estimate of measured states, and from their
    own estimates of the other states.
    """
    layout, data = problem.layout, problem.logs[index]
    runs = [problem.run(f.values, f.noise, index) for f in (base, after)]
    if layout.is_free_run:
        change = (runs[1].states - runs[0].states)[:, layout.forced_places]
        return np.asarray(change[min(count_unscored(data), len(change) - 1) : MAX_SMOOTHED_ROWS])
    rows, shared = min(len(data.u), MAX_SMOOTHED_ROWS) - 1, list(layout.stochastic)
    states = [np.array([problem.drop_unknown_inputs(x) for x in run.states[:rows]]) for run in runs]
    states[0][:, shared] = states[1][:, shared]
    without, with_it = (
        next_rows(problem, f.values, index, (np.arange(rows), x, run.memory[:rows]))
        for f, x, run in zip((base, after), states, runs, strict=True)
    )
    return np.asarray((with_it - without)[min(count_unscored(data), rows) :, layout.forced_places] / data.step)


def _linear(
    problem: Problem, values: NamedValues, index: int, run: Filtered, rows: int, every: int
) -> tuple[Array, Array]:
    """Return the prediction of each next row from the filtered states, and its derivative by finite differences."""
    reached, states, memory = list(problem.layout.stochastic), run.states[: rows - 1], run.memory[: rows - 1]
    size = NUDGE * np.maximum(np.abs(states[:, reached]).max(axis=0), np.sqrt(np.diag(problem.P0)))
    size = np.where(size > 0.0, size, NUDGE)  # a fixed parameter per log may be 0
    every_row, some = np.arange(rows - 1), np.arange(0, rows - 1, every)
    ahead = next_rows(problem, values, index, (every_row, states, memory))[:, reached]
    F = np.empty((rows - 1, len(reached), len(reached)))
    for j, state in enumerate(reached):
        nudged = states[some].copy()
        nudged[:, state] += size[j]
        moved = next_rows(problem, values, index, (some, nudged, memory[some]))[:, reached]
        F[:, :, j] = ((moved - ahead[some]) / size[j])[every_row // every]
    return ahead, F
