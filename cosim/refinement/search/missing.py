"""Missing acceleration of a model in each row, and the contribution of a hypothesis to it.

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

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.core.linear_algebra import least_squares
from cosim.estimation.data import count_unscored
from cosim.estimation.fit import Fit
from cosim.estimation.kernel.kernel import DEVIATION, Data, Filtered, single_steps
from cosim.estimation.noise_model import Noise
from cosim.estimation.problem import Problem
from cosim.refinement.decision.posterior import CERTAIN

MOST_ROWS = 3000  # largest number of smoothed rows of a log
LOGS = 2  # number of smoothed logs, from the first
NUDGE = 1e-4  # difference step relative to the size of a state; kernel steps are smooth on this scale


@dataclass(frozen=True, eq=False)
class MissingInput:
    """Missing input d of each forced equation in the rows of a log, with its standard deviation.

    Units are units of the state per second.
    """

    time: Array
    equations: tuple[str, ...]
    value: Array
    sigma: Array
    states: Array  # all kernel states, filtered by the base fit

    def rows(self, data: Data) -> slice:
        """Return the smoothed rows of the log."""
        first = round((self.time[0] - data.start) / data.step)
        return slice(first, first + len(self.time))


Smoothed = Sequence[tuple[int, MissingInput]]  # index of a log in the problem, and its smoothed input


def rows_of_delay(problem: Problem, p: Array, step: float) -> int:
    """Return the number of rows of commands before a step that a delay may reach back to."""
    delay = problem.layout.delay
    return 2 + math.ceil(p[delay] / step if delay >= 0 else 0.0)


class Steps:
    """Single kernel steps from any row of a log."""

    def __init__(self, problem: Problem, index: int, values: Mapping[str, float]) -> None:
        self.problem, self.kernel, self.data = problem, problem.kernel, problem.logs[index]
        # Unknown inputs keep their usual correlation time.
        self.p = problem.numbers(problem.of_log({**problem.values, **values}, index))
        self.back = rows_of_delay(problem, self.p, self.data.step)

    def step(self, rows: Rows, states: Array, memories: Array) -> tuple[Array, Array]:
        """Return the state at the next row and the outputs at each row."""
        return single_steps(self.kernel, self.data, self.p, (rows, states, memories), self.back)

    def outputs_along(self, run: Filtered, count: int) -> Array:
        """Return the outputs of the first rows along filtered states, or of a free run."""
        if not self.problem.layout.is_free_run:
            return self.step(np.arange(count), run.states, run.memory)[1]
        begin, memory = self.problem.begin_replay(run, 0), np.zeros(self.problem.layout.memory)
        return np.asarray(self.kernel.simulate(self.data, self.p, begin, memory).outputs[:count])


def smooth_logs(problem: Problem, base: Fit) -> tuple[Smoothed, Array, Array]:
    """Smooth the first logs; return the results of each log, and all values and standard deviations stacked.

    Of free runs these are the filtered deviations of the outputs.
    """
    if not problem.layout.is_free_run:
        return smooth_unknown_inputs(problem, base)
    found = [(k, _deviations(problem, base, k)) for k in smoothed_logs(problem)]
    return found, np.vstack([m.value for _, m in found]), np.vstack([m.sigma for _, m in found])


def smooth_unknown_inputs(problem: Problem, base: Fit, every: int = 1) -> tuple[Smoothed, Array, Array]:
    """Return the smoothed missing inputs of the first logs; of free runs what drives the deviations.

    Args:
        every: Rows between two linearizations.
    """
    found = [(k, _smooth_log(problem, base, k, every)) for k in smoothed_logs(problem)]
    return found, np.vstack([m.value for _, m in found]), np.vstack([m.sigma for _, m in found])


def _smooth_log(problem: Problem, base: Fit, index: int, every: int) -> MissingInput:
    """Return the smoothed missing input of a log."""
    layout, values = problem.layout, {**problem.values, **base.values}
    data, noise = problem.data(values, index), loosen_noise(problem, base.noise)
    run = problem.run(values, noise, index, states=True)
    rows, reached = min(len(data.u), MOST_ROWS), list(layout.stochastic)
    x, P, Q = run.states[:rows, reached], run.covariances, np.diag(problem.densities(noise)) * data.step
    scored, places = slice(min(count_unscored(data), rows - 1), rows - 1), list(layout.noisy)
    if P is None:  # a kernel without covariances: the filtered inputs, as uncertain as before any reading
        sigma = np.tile(np.exp(0.5 * noise.power), (rows, 1))
        return MissingInput(data.times[scored], layout.forced, x[scored, places], sigma[scored], run.states[scored])
    if layout.is_free_run:
        F = _transitions_of_deviations(problem, values, noise, index)[:rows]
        ahead = np.einsum("kij,kj->ki", F, x)
    else:
        ahead, F = _linear(problem, Steps(problem, index, base.values), run, rows, every)
    smooth, P = x.copy(), P[:rows].copy()
    for k in range(rows - 2, -1, -1):
        spread = F[k] @ P[k] @ F[k].T + Q
        gain = least_squares(spread, F[k] @ P[k]).T
        smooth[k] += gain @ (smooth[k + 1] - ahead[k])
        P[k] += gain @ (P[k + 1] - spread) @ gain.T
    sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2)[:, places], 0.0))
    return MissingInput(data.times[scored], layout.forced, smooth[scored, places], sigma[scored], run.states[scored])


def _deviations(problem: Problem, base: Fit, index: int) -> MissingInput:
    """Return the filtered deviations of the outputs of a free run."""
    layout, data = problem.layout, problem.logs[index]
    run = problem.run({**problem.values, **base.values}, loosen_noise(problem, base.noise), index, states=True)
    rows = slice(count_unscored(data), min(len(data.u), MOST_ROWS))
    places = [k for k, name in enumerate(layout.states) if name.startswith(DEVIATION)]
    assert run.covariances is not None
    variances = np.diagonal(run.covariances, axis1=1, axis2=2)[rows, [layout.stochastic.index(k) for k in places]]
    return MissingInput(data.times[rows], layout.forced, run.states[rows, places], np.sqrt(variances), run.states[rows])


def _transitions_of_deviations(problem: Problem, values: Mapping[str, float], noise: Noise, index: int) -> Array:
    """Return the transition of a free run's random states from each row to the next.

    These are the deviations a row earlier, what drives the deviations, the deviations, and constants.
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
    """Return the indices of the logs to smooth."""
    return range(min(LOGS, len(problem.logs)))


def unknown_inputs(problem: Problem, at: Fit, units: Mapping[str, str]) -> dict[str, float]:
    """Return forced state → size of its unknown input relative to the derivatives of states with the same unit.

    Args:
        units: Units of the states.
    """
    names, powers = problem.layout.forced, np.exp(0.5 * at.noise.power)
    largest: dict[tuple[str, int], float] = {}  # unit and order → range of the derivatives
    orders = [1] * len(problem.layout.noisy)
    if problem.layout.is_free_run:  # 2 for an output whose velocity is hidden
        matrix = problem.kernel.responses(problem.logs[0], problem.x0[0])[1]  # type: ignore[attr-defined]
        orders = [1 + bool(matrix[:, j].any()) for j in range(len(orders), 2 * len(orders))]
    kinds = {n: (units[n], order) for n, order in zip(names, orders, strict=True)}
    runs = [problem.run({**problem.values, **at.values}, at.noise, k, states=True) for k in range(len(problem.logs))]
    for name, place in zip(names, problem.layout.forced_places, strict=True):
        change = [
            np.diff(run.states[count_unscored(d) :, place], kinds[name][1]) / d.step
            for run, d in zip(runs, problem.logs, strict=True)
        ]
        low, high = np.quantile(np.concatenate(change), (0.5 * (1.0 - CERTAIN), 0.5 * (1.0 + CERTAIN)))
        largest[kinds[name]] = max(largest.get(kinds[name], np.finfo(float).tiny), float(high - low))
    return {n: float(p) / largest[kinds[n]] for n, p in zip(names, powers, strict=True)}


def loosen_noise(problem: Problem, noise: Noise) -> Noise:
    """Return noise with which a filter follows model errors.

    A fit without unknown inputs counts model errors as sensor noise; the stated sensor noise then replaces it.
    """
    bare = np.allclose(noise.power, problem.noise.smallest)
    sensors = np.minimum(noise.sensors, np.log(problem.r)) if bare else noise.sensors
    return replace(problem.plain, sensors=sensors, power=np.maximum(noise.power, problem.noise.plain))


def contributions(problem: Problem, base: Fit, after: Fit, index: int) -> Array:
    """Return the contribution of a claim to each equation.

    Both steps start from the refined estimate of the measured states and from their own estimate of the rest.
    """
    layout, data = problem.layout, problem.logs[index]
    runs = [problem.run({**problem.values, **f.values}, f.noise, index, states=True) for f in (base, after)]
    if layout.is_free_run:
        change = (runs[1].states - runs[0].states)[:, layout.forced_places]
        return np.asarray(change[min(count_unscored(data), len(change) - 1) : MOST_ROWS])
    rows, shared = min(len(data.u), MOST_ROWS) - 1, list(layout.stochastic)
    states = [np.array([problem.drop_unknown_inputs(x) for x in run.states[:rows]]) for run in runs]
    states[0][:, shared] = states[1][:, shared]
    without, with_it = (
        Steps(problem, index, f.values).step(np.arange(rows), x, run.memory)[0]
        for f, x, run in zip((base, after), states, runs, strict=True)
    )
    return np.asarray((with_it - without)[min(count_unscored(data), rows) :, layout.forced_places] / data.step)


def _linear(problem: Problem, steps: Steps, run: Filtered, rows: int, every: int) -> tuple[Array, Array]:
    """Return the prediction of each next row from the filtered states, and its derivative by finite differences."""
    reached, states, memory = list(problem.layout.stochastic), run.states[: rows - 1], run.memory[: rows - 1]
    size = NUDGE * np.maximum(np.abs(states[:, reached]).max(axis=0), np.sqrt(np.diag(problem.P0)))
    size = np.where(size > 0.0, size, NUDGE)  # A fixed parameter per log may be 0.
    every_row, some = np.arange(rows - 1), np.arange(0, rows - 1, every)
    ahead, F = steps.step(every_row, states, memory)[0][:, reached], np.empty((rows - 1, len(reached), len(reached)))
    for j, state in enumerate(reached):
        nudged = states[some].copy()
        nudged[:, state] += size[j]
        F[:, :, j] = ((steps.step(some, nudged, memory[some])[0][:, reached] - ahead[some]) / size[j])[
            every_row // every
        ]
    return ahead, F
