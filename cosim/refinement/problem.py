"""From logs to a fitting problem: the kernel for what they hold, and where each starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cosim.arrays import Array
from cosim.kernel.backend import kernel
from cosim.kernel.interface import Data, Filtered, Kernel, Layout, Simulated
from cosim.kernel.settling import settling
from cosim.logs.log import Log, slowness
from cosim.refinement.candidates import neutral_values
from cosim.refinement.process_noise import NoiseRange, noise_range
from plant.integrate import substeps
from plant.model import Model
from plant.namespaces import SCALAR

UNSCORED = 1.0  # [s] of each log, in which the filter settles; see `unscored`
RANGE_FROM, RANGE_ROWS = 10.0, 500  # [s] of the first log and rows at least, for the range of the process noise

SAME = 0.5  # of NLL, by which fewer substeps may change it
STARTING = 0.2  # [s] within which a measurement still counts as of the start


def build_problem(
    model: Model,
    logs: Sequence[Log],
    unnamed: bool = False,
    noise: Mapping[str, float] | None = None,
    sensors: Mapping[str, float] | None = None,
) -> Problem:
    """Kernel and data; an output that only some logs hold is missing in the others.

    `noise`: standard deviations of outputs where they are not the model's own; `sensors`: errors known already.
    """
    measured = tuple(q.name for q in model.outputs if any(q.name in log.outputs for log in logs))
    compiled = kernel(model, measured, unnamed)
    layout = compiled.layout
    settle = settling(model, [layout.states[k] for k in layout.driven])
    data = [as_data(model, log, layout, settle) for log in logs]
    variance = {q.name: model.sensor_variance.get(q.name, 1.0) for q in model.outputs}
    variance |= {name: sigma * sigma for name, sigma in (noise or {}).items()}
    r = np.array([variance[name] for name in measured])
    x0 = [start_state(model, d, measured, layout.states) for d in data]
    values = {**dict.fromkeys(layout.parameters, 0.0), **neutral_values(model), **(sensors or {})}
    problem = Problem(compiled, data, x0, np.empty((0, 0)), r, values, settle)
    return replace(problem, P0=start_covariance(model, problem))


def as_data(model: Model, log: Log, layout: Layout, settle: float) -> Data:
    """A log as the filter takes it: equal steps; where a row is missing the command is held and nothing is measured.

    settle: [s] until lags have forgotten an unknown start, see `settling`
    """
    measured = layout.outputs
    grid = log.grid
    rows = int(grid[-1]) + 1
    held = np.searchsorted(grid, np.arange(rows), side="right") - 1
    u = np.column_stack([log.inputs[q.name][held] for q in model.inputs])
    y = np.full((rows, len(measured)), np.nan)
    for j, name in enumerate(measured):
        if name in log.outputs:
            y[grid, j] = log.outputs[name]
    data = Data(log.step, float(log.time[0]), u, y, substeps(log.step, model.substep))
    return replace(data, settle=int(min(settle / log.step, unscored(data))))


def unscored(data: Data) -> int:
    """Rows at the start of a log that are not scored: the filter settles."""
    return round(UNSCORED * slowness(data.step) / data.step)


def start_state(model: Model, data: Data, measured: Sequence[str], states: Sequence[str]) -> Array:
    """The model's own start, with what is measured near the start of the log in its place."""
    own = dict(zip((s.name for s in model.states), model.start(), strict=True))
    start = own | _first_measured(model, data, measured)
    return np.array([start.get(name, 0.0) for name in states])


def start_covariance(model: Model, problem: Problem) -> Array:
    """P0 of the stochastic states: 10·r of what every log measures at its start, else what the model says of it.

    Of a state of which it says nothing, the squared range of the model's own run on the commands, or 1 without.
    """
    layout = problem.layout
    measured = set.intersection(*(set(_first_measured(model, data, layout.outputs)) for data in problem.logs))
    known = {n: 10 * v for n, v in zip(layout.outputs, problem.r.tolist(), strict=True) if n in measured}
    known = {**model.start_variance, **known}
    names = layout.uncertain
    if not known.keys() >= set(names):
        ranges = dict(zip(layout.states, _range(problem).tolist(), strict=True))
        known = {name: ranges[name] ** 2 or 1.0 for name in names} | known
    return np.diag([known[name] for name in names])


def _range(problem: Problem) -> Array:
    """Of each state, the range within which the model's own run moves; 0 at rest.

    0 also where the run is further from what was measured than that itself moves, as the run of an unstable model is.
    """
    runs = [own_run(problem, index) for index in range(len(problem.logs))]
    for log, run in zip(problem.logs, runs, strict=True):
        there = np.isfinite(log.y)
        apart = np.abs(np.where(there, run.outputs - np.where(there, log.y, 0.0), 0.0)).max(axis=0)
        span = np.where(there, log.y, -np.inf).max(axis=0) - np.where(there, log.y, np.inf).min(axis=0)
        if not np.all((apart <= span) | ~there.any(axis=0)):  # also where it has run to infinity
            return np.zeros(len(problem.layout.states))
    low, high = np.percentile(np.vstack([run.states for run in runs]), (1, 99), axis=0)
    return np.asarray(high - low)


def own_run(problem: Problem, index: int) -> Simulated:
    """The model on the commands of a log, free of noise; NaN from where it runs away."""
    p, memory = problem.numbers(problem.values), np.zeros(problem.layout.memory)
    return problem.kernel.simulate(problem.logs[index], p, problem.x0[index], memory)


def _first_measured(model: Model, data: Data, measured: Sequence[str]) -> dict[str, float]:
    """State → its first measurement, of the states that an output shows and that are measured near the start."""
    shown, first = _shown(model), {}
    early = data.y[: round(STARTING * slowness(data.step) / data.step) + 1]
    for j, name in enumerate(measured):
        column = early[:, j][~np.isnan(early[:, j])]
        if name in shown and len(column):
            first[name] = float(column[0])
    return first


def _shown(model: Model) -> set[str]:
    """States that outputs of their name show as they are, not with a factor or turned: tried at one state."""
    state = tuple(value + 0.01 * (k + 1) for k, value in enumerate(model.start()))
    values = dict(zip((s.name for s in model.states), state, strict=True))
    outputs = model.equations(SCALAR).output(0.0, state, model.start_command())
    return {q.name for q, y in zip(model.outputs, outputs, strict=True) if values.get(q.name) == y}


def varied_inputs(model: Model, logs: Sequence[Log]) -> list[str]:
    """Inputs that are not constant in some log."""
    return [q.name for q in model.inputs if any(np.ptp(log.inputs[q.name]) > 1e-9 for log in logs)]


def coarsened(problem: Problem, values: Mapping[str, float] | None = None) -> Problem:
    """The problem with the fewest substeps that give a model's likelihood as the model's own number does.

    values: where that model is not the base model; an effect that is awake may need finer steps
    """
    log_q, values = problem.noise.plain, {**problem.values, **(values or {})}
    exact = problem.scored(values, log_q).nll
    most = max(log.substeps for log in problem.logs)
    for n in (2**k for k in range(10) if 2**k < most):
        coarse = replace(problem, logs=[replace(log, substeps=min(n, log.substeps)) for log in problem.logs])
        if abs(coarse.scored(values, log_q).nll - exact) < SAME:
            return coarse
    return problem


def halved(problem: Problem) -> Problem:
    """One log as two; the second starts where the filter is then."""
    (log,), (x0,) = problem.logs, problem.x0
    half = len(log.u) // 2
    halves = [
        replace(log, u=log.u[:half], y=log.y[:half]),
        replace(log, start=log.start + half * log.step, u=log.u[half:], y=log.y[half:]),
    ]
    reached = problem.run(problem.values, problem.noise.plain, 0, states=True).states[half]
    return replace(problem, logs=halves, x0=[x0, reached])


@dataclass(frozen=True)
class Scored:
    """Errors and variances of the scored measurements of all logs in one row, and how many are each log's."""

    errors: Array
    variances: Array
    counts: tuple[int, ...]

    @property
    def nll(self) -> float:
        """½ Σ (ln 2πs + e²/s); infinite where the filter has diverged."""
        return sum(self.by_log)

    @property
    def by_log(self) -> tuple[float, ...]:
        """NLL of each log."""
        with np.errstate(over="ignore", invalid="ignore"):
            terms = 0.5 * (np.log(2 * np.pi * self.variances) + self.errors**2 / self.variances)
        sums = [float(part.sum()) for part in np.split(terms, np.cumsum(self.counts)[:-1])]
        return tuple(v if np.isfinite(v) else np.inf for v in sums)


@dataclass
class Problem:
    """Logs, kernel and what is known beforehand: start states, measurement variances, values of all parameters.

    settle: [s] until the lags of the model that was given have forgotten an unknown start
    """

    kernel: Kernel
    logs: Sequence[Data]
    x0: Sequence[Array]
    P0: Array
    r: Array
    values: Mapping[str, float]
    settle: float

    @property
    def layout(self) -> Layout:
        """What stands where in the kernel's arrays."""
        return self.kernel.layout

    @property
    def samples(self) -> int:
        """Number of scored measurements."""
        return int(sum(np.isfinite(log.y[unscored(log) :]).sum() for log in self.logs))

    @cached_property
    def noise(self) -> NoiseRange:
        """How large process noise can be."""
        step = self.logs[0].step
        rows = round((UNSCORED * slowness(step) + max(RANGE_FROM, RANGE_ROWS * step)) / step)
        logs = [replace(log, u=log.u[:rows], y=log.y[:rows]) for log in self.logs]
        measured = [np.isfinite(log.y).any(axis=0) for log in logs]
        # the first log, and those that measure what it does not
        taken = [k for k in range(len(logs)) if k == 0 or np.any(measured[k] & ~measured[0])]
        short = replace(self, logs=[logs[k] for k in taken], x0=[self.x0[k] for k in taken])
        return noise_range(lambda log_q: short.scored(self.values, log_q).variances, len(self.layout.noisy))

    def numbers(self, values: Mapping[str, float]) -> Array:
        """Values of the parameters in the kernel's order."""
        return np.array([values[name] for name in self.layout.parameters])

    def densities(self, log_q: Array) -> Array:
        """q of every stochastic state, its unit squared per second: e^(ln q) where noise enters, else 0."""
        q = np.zeros(len(self.layout.stochastic))
        q[list(self.layout.noisy)] = np.exp(log_q)
        return q

    def run(self, values: Mapping[str, float], log_q: Array, index: int, *, states: bool = False) -> Filtered:
        """Filter one log."""
        p, q = self.numbers(values), self.densities(log_q)
        return self.kernel.run(self.logs[index], p, self.x0[index], self.P0, q, self.r, states=states)

    def scored(self, values: Mapping[str, float], log_q: Array, only: Sequence[int] | None = None) -> Scored:
        """Filter all logs, or some."""
        errors, variances = [], []
        for index in range(len(self.logs)) if only is None else only:
            filtered = self.run(values, log_q, index)
            first = unscored(self.logs[index])
            valid = ~np.isnan(self.logs[index].y[first:].ravel())
            errors.append(filtered.errors[first:].ravel()[valid])
            variances.append(filtered.variances[first:].ravel()[valid])
        return Scored(np.concatenate(errors), np.concatenate(variances), tuple(map(len, errors)))
