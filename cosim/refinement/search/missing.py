"""Missing acceleration of a model in each row, and the contribution of a hypothesis to it.

The missing input is estimated as follows. The equations are linearized along the filtered states of the base fit by
single kernel steps. Each forced equation has an unknown input d, estimated by a Rauch-Tung-Striebel smoother (1965):

    δ⁺ = F·δ + (f(x̄) − x̄⁺) + w      y − g(x̄) = C·δ + v      d among the δ

The power of d is the fitted power, at least `NoiseRange.plain`. The contribution of a hypothesis is a model step with
the hypothesis minus a step without, divided by the step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.core.arrays import Array, Flags, Rows
from cosim.core.linear_algebra import least_squares, solution
from cosim.estimation.data import count_unscored
from cosim.estimation.fit import DIFFERENCE, Fit
from cosim.estimation.kernel.kernel import DEVIATION, Data, Filtered, single_steps
from cosim.estimation.noise_model import Noise
from cosim.estimation.problem import Problem

MOST_ROWS = 3000  # largest number of smoothed rows of a log
LOGS = 2  # number of smoothed logs, from the first
NUDGE = 1e-4  # difference step relative to the size of a state; kernel steps are smooth on this scale
NONE = 1e-6  # distance of ln input power from the minimum that counts as zero


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


class Steps:
    """Single kernel steps from any row of a log."""

    def __init__(self, problem: Problem, index: int, values: Mapping[str, float]) -> None:
        self.problem, self.kernel, self.data = problem, problem.kernel, problem.logs[index]
        layout = problem.layout
        # Unknown inputs keep their usual correlation time.
        self.p = problem.numbers(problem.of_log({**problem.values, **values}, index))
        late = self.p[layout.delay] / self.data.step if layout.delay >= 0 else 0.0
        self.back = 2 + math.ceil(late)  # rows of commands before a step that a delay may reach back to

    def step(self, rows: Rows, states: Array, memories: Array) -> tuple[Array, Array]:
        """Return the state at the next row and the outputs at each row."""
        return single_steps(self.kernel, self.data, self.p, (rows, states, memories), self.back)

    def outputs_along(self, run: Filtered, count: int) -> Array:
        """Return the outputs of the first rows along filtered states, or of a free run."""
        if not self.problem.layout.is_free_run:
            return self.step(np.arange(count), run.states, run.memory)[1]
        begin, memory = self.problem.begin_replay(run, 0), np.zeros(self.problem.layout.memory)
        return np.asarray(self.kernel.simulate(self.data, self.p, begin, memory).outputs[:count])


def smooth_log(problem: Problem, base: Fit, index: int, every: int = 1) -> MissingInput:
    """Return the smoothed missing input of a log.

    Args:
        every: Rows between two linearizations.
    """
    layout, data = problem.layout, problem.logs[index]
    noise = loosen_noise(problem, base.noise)
    run = problem.run({**problem.values, **base.values}, noise, index, states=True)
    rows = min(len(data.u), MOST_ROWS)
    if layout.is_free_run:
        return _deviations(problem, run, slice(count_unscored(data), rows), index)
    model = _linear(problem, Steps(problem, index, base.values), run.states, run.memory, rows, every)
    readings = problem.data({**problem.values, **base.values}, index).y[:rows]
    value, sigma = _smooth(problem, model, run.states, noise, index, readings)
    scored = slice(min(count_unscored(data), rows - 1), rows - 1)
    return MissingInput(data.times[scored], layout.forced, value[scored], sigma[scored], run.states[:rows][scored])


def _deviations(problem: Problem, run: Filtered, rows: slice, index: int) -> MissingInput:
    """Return the filtered deviations of the outputs of a free run."""
    layout, data = problem.layout, problem.logs[index]
    places = [k for k, name in enumerate(layout.states) if name.startswith(DEVIATION)]
    assert run.covariances is not None
    variances = np.diagonal(run.covariances, axis1=1, axis2=2)[rows, [layout.stochastic.index(k) for k in places]]
    return MissingInput(data.times[rows], layout.forced, run.states[rows, places], np.sqrt(variances), run.states[rows])


def smooth_unknown_inputs(problem: Problem, base: Fit, every: int = 1) -> tuple[Smoothed, Array, Array]:
    """Return the smoothed missing inputs; of free runs what drives the deviations, not the deviations themselves."""
    if not problem.layout.is_free_run:
        return smooth_logs(problem, base, every)
    return _stacked([(k, _drive_of_deviations(problem, base, k)) for k in smoothed_logs(problem)])


def _drive_of_deviations(problem: Problem, base: Fit, index: int) -> MissingInput:
    """Return the smoothed unknown inputs of a free run."""
    layout, values, noise = problem.layout, {**problem.values, **base.values}, loosen_noise(problem, base.noise)
    run, data = problem.run(values, noise, index, states=True), problem.data(values, index)
    rows = min(len(data.u), MOST_ROWS)
    places = [layout.states.index(name) for name in layout.outputs]
    F, C = deviations_of(problem, values, noise, index)
    nothing = np.zeros((rows, F.shape[1]))
    model = _Linear(F[:rows], nothing, C[:rows], run.states[:rows, places])
    value, sigma = _smooth(problem, model, np.zeros_like(run.states), noise, index, data.y[:rows])
    scored = slice(min(count_unscored(data), rows - 1), rows - 1)
    return MissingInput(data.times[scored], layout.forced, value[scored], sigma[scored], run.states[:rows][scored])


def deviations_of(problem: Problem, values: Mapping[str, float], noise: Noise, index: int) -> tuple[Array, Array]:
    """Return a free run's random states as linear model: transition from each row to the next, and readings."""
    layout, data = problem.layout, problem.data(values, index)
    rows, ny, n = len(data.u), len(layout.outputs), len(layout.stochastic)
    F, C = np.zeros((rows, n, n)), np.zeros((rows, ny, n))
    earlier, drive, deviation = (slice(k * ny, (k + 1) * ny) for k in range(3))
    begin = problem.start(values, index)[0]
    slopes, propagation = problem.kernel.responses(data, begin)  # type: ignore[attr-defined]
    F[:, earlier, deviation] = C[:, :, deviation] = np.eye(ny)
    F[:, 3 * ny :, 3 * ny :], C[:, :, 3 * ny :] = np.eye(n - 3 * ny), slopes
    F[:, drive, drive] = math.exp(-data.step / math.exp(noise.memory)) * np.eye(ny)
    F[:, deviation, deviation], F[:, deviation, earlier] = propagation[:, :ny], propagation[:, ny:]
    F[:, deviation, drive] = data.step * np.eye(ny)
    return F, C


def of_every_row(problem: Problem, at: Fit, index: int) -> MissingInput:
    """Return a free run's states and deviations in every row."""
    run = problem.run({**problem.values, **at.values}, at.noise, index, states=True)
    return _deviations(problem, run, slice(0, len(run.states)), index)


class DriveResponses:
    """Changes of a free run's innovations by additions to its unknown inputs.

    The additions are small enough that the filter, with all its gains, stays the same.
    """

    def __init__(self, problem: Problem, at: Fit) -> None:
        self.problem, self.scored = problem, problem.score({**problem.values, **at.values}, at.noise)
        self.filters = [self._filter(at, k) for k in range(len(problem.logs))]

    def _filter(self, at: Fit, index: int) -> tuple[Array, Array]:
        """Return the filter's transition between rows, and the readings."""
        problem, values, noise = self.problem, {**self.problem.values, **at.values}, at.noise
        data, places = problem.data(values, index), list(problem.layout.noisy)
        F, C = deviations_of(problem, values, noise, index)
        Q = np.diag(problem.densities(noise)) * data.step
        r, P0 = np.broadcast_to(problem.variances(noise, index), data.y.shape), problem.P0.copy()
        P0[places, places] = np.exp(noise.power)
        P, moves = P0, np.empty_like(F)
        for k in range(len(F)):
            before, measured = P0 if k <= data.settle else P, np.isfinite(data.y[k])
            gain, after = _gain(before, C[k], measured, r[k])
            moves[k] = F[k] - F[k] @ gain @ C[k]
            P = F[k] @ after @ F[k].T + Q
            H = C[k, measured]  # The filter takes the readings of a row one after the other.
            root = np.linalg.cholesky(H @ before @ H.T + np.diag(r[k, measured]))
            C[k, measured] = np.linalg.solve(root / np.diag(root), H)
        return moves, C

    def __call__(self, equation: int, columns: Sequence[Array]) -> Array:
        """Return changes of the scored innovations per standard deviation.

        The shape is (innovations, columns).

        Args:
            columns: Additions to the unknown input of an equation in each row, one array (rows, columns) for each log.
        """
        changes, ny = [], len(self.problem.layout.outputs)
        for k, ((moves, C), added) in enumerate(zip(self.filters, columns, strict=True)):
            x, change = np.zeros((moves.shape[1], added.shape[1])), np.empty((len(moves), ny, added.shape[1]))
            added = self.problem.logs[k].step * added
            for row in range(len(moves)):
                change[row] = -C[row] @ x
                x = moves[row] @ x
                x[2 * ny + equation] += added[row]
            changes.append(change.reshape(-1, added.shape[1])[self.problem.readings[k].places])
        return np.asarray(np.concatenate(changes) / np.sqrt(self.scored.variances)[:, None])


def smoothed_logs(problem: Problem) -> range:
    """Return the indices of the logs to smooth."""
    return range(min(LOGS, len(problem.logs)))


def smooth_logs(problem: Problem, base: Fit, every: int = 1) -> tuple[Smoothed, Array, Array]:
    """Smooth the first logs; return the results of each log, and all values and standard deviations stacked."""
    return _stacked([(k, smooth_log(problem, base, k, every)) for k in smoothed_logs(problem)])


def _stacked(parts: Smoothed) -> tuple[Smoothed, Array, Array]:
    """Return smoothed logs, and all values and standard deviations stacked."""
    return parts, np.vstack([m.value for _, m in parts]), np.vstack([m.sigma for _, m in parts])


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
        low, high = np.percentile(np.concatenate(change), (2.5, 97.5))
        largest[kinds[name]] = max(largest.get(kinds[name], 1e-300), float(high - low))
    return {n: float(p) / largest[kinds[n]] for n, p in zip(names, powers, strict=True)}


def loosen_noise(problem: Problem, noise: Noise) -> Noise:
    """Return noise with which a filter follows model errors.

    A fit without unknown inputs counts model errors as sensor noise; the stated sensor noise then replaces it.
    """
    bare = bool(np.all(noise.power <= problem.noise.smallest + NONE))
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
    without, with_it = (Steps(problem, index, f.values) for f in (base, after))
    shared, forced = list(layout.stochastic), layout.forced_places
    rows = min(len(data.u), MOST_ROWS)
    added = np.full((rows, len(forced)), np.nan)
    without_states, with_states = (np.empty((rows - 1, len(layout.states))) for _ in runs)
    for k in range(rows - 1):
        without_states[k] = problem.drop_unknown_inputs(runs[0].states[k])
        with_states[k] = problem.drop_unknown_inputs(runs[1].states[k])
    without_states[:, shared] = with_states[:, shared]
    plain = without.step(np.arange(rows - 1), without_states, runs[0].memory)[0]
    fuller = with_it.step(np.arange(rows - 1), with_states, runs[1].memory)[0]
    added[: rows - 1] = (fuller - plain)[:, forced] / data.step
    return added[min(count_unscored(data), rows - 1) : rows - 1]


def scale_to_missing(problem: Problem, at: Fit, column: int, term: Array, lacking: Array) -> Array:
    """Return a term scaled by regression to the missing input.

    The part that parameters without prior can imitate is projected out, because the fit has already used it. A term
    with the wrong sign scales to zero. What parameters of a free run do to an unknown input is not known.
    """
    rows = []
    for f in at.free:
        if f.prior is None and not problem.layout.is_free_run:
            step = DIFFERENCE * f.size * (1.0 if at.values[f.name] + DIFFERENCE * f.size <= f.high else -1.0)
            nudged = replace(at, values={**at.values, f.name: at.values[f.name] + step})
            added = [contributions(problem, at, nudged, k)[:, column] for k in smoothed_logs(problem)]
            rows.append(np.concatenate(added) / step)
    if rows and np.isfinite(rows).all() and np.isfinite(term).all():
        basis = np.array(rows).T
        term = term - basis @ least_squares(basis, term)
    power = float(term @ term)
    return np.asarray(max(0.0, float(lacking @ term) / power) * term if power > 0.0 else term)


@dataclass(frozen=True, eq=False)
class _Linear:
    """Linearization about the filtered states, δ⁺ = F·δ + b and y − g = C·δ; F and b lack the last row."""

    F: Array
    b: Array
    C: Array
    g: Array


def _linear(problem: Problem, steps: Steps, states: Array, memory: Array, rows: int, every: int) -> _Linear:
    """Return the linearization, from finite differences of steps."""
    reached = list(problem.layout.stochastic)
    size = NUDGE * np.maximum(np.abs(states[:rows, reached]).max(axis=0), np.sqrt(np.diag(problem.P0)))
    size = np.where(size > 0.0, size, NUDGE)  # A fixed parameter per log may be 0.
    n, ny = len(reached), problem.logs[0].y.shape[1]
    F, C = np.zeros((rows, n, n)), np.zeros((rows, ny, n))
    b, g = np.zeros((rows, n)), np.zeros((rows, ny))
    every_row, some = np.arange(rows - 1), np.arange(0, rows - 1, every)
    ahead, g[:-1] = steps.step(every_row, states[: rows - 1], memory[: rows - 1])
    b[:-1] = ahead[:, reached] - states[1:rows, reached]
    for j, state in enumerate(reached):
        nudged = states[some].copy()
        nudged[:, state] += size[j]
        next_states, outputs = steps.step(some, nudged, memory[some])
        F[:-1, :, j] = ((next_states - ahead[some])[:, reached] / size[j])[every_row // every]
        C[:-1, :, j] = ((outputs - g[some]) / size[j])[every_row // every]
    return _Linear(F, b, C, g)


def _smooth(problem: Problem, model: _Linear, states: Array, noise: Noise, index: int, y: Array) -> tuple[Array, Array]:
    """Filter and smooth δ; return the unknown inputs and their standard deviation."""
    layout, data = problem.layout, problem.logs[index]
    places, rows, n = list(layout.noisy), len(y), model.F.shape[1]
    r = np.broadcast_to(problem.variances(noise, index), data.y.shape)
    x, P = np.zeros(n), problem.P0.copy()
    P[places, places] = np.exp(noise.power)
    Q = np.diag(problem.densities(noise)) * data.step
    ahead, spread = np.zeros((rows, n)), np.zeros((rows, n, n))
    after, spread_after = np.zeros_like(ahead), np.zeros_like(spread)
    for k in range(rows - 1):
        ahead[k], spread[k] = x, P
        e, wide = y[k] - model.g[k], np.zeros((y.shape[1], n))
        measured = np.isfinite(e)
        wide[:, : model.C.shape[2]] = model.C[k]
        K, P = _gain(P, wide, measured, r[k])
        x = x + K[:, measured] @ (e[measured] - wide[measured] @ x)
        after[k], spread_after[k] = x, P
        x, P = model.F[k] @ x + model.b[k], model.F[k] @ P @ model.F[k].T + Q
    last = rows - 2
    for k in range(last - 1, -1, -1):
        gain = least_squares(spread[k + 1], model.F[k] @ spread_after[k]).T
        after[k] += gain @ (after[k + 1] - ahead[k + 1])
        spread_after[k] += gain @ (spread_after[k + 1] - spread[k + 1]) @ gain.T
    deviation = np.sqrt(np.maximum(np.diagonal(spread_after, axis1=1, axis2=2)[:, places], 0.0))
    return states[:rows][:, layout.noise_places] + after[:, places], deviation


def _gain(P: Array, C: Array, measured: Flags, r: Array) -> tuple[Array, Array]:
    """Return the gain of a row's measurements, 0 for a missing one, and the covariance after them."""
    K = np.zeros((len(P), len(C)))
    if not measured.any():
        return K, P
    H = C[measured]
    K[:, measured] = solution(H @ P @ H.T + np.diag(r[measured]), H @ P).T
    P = P - K[:, measured] @ H @ P
    return K, 0.5 * (P + P.T)
