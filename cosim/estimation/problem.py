"""From logs to a fitting problem: the kernel for what they hold, and where each starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from cosim.arrays import Array, Flags, Rows
from cosim.estimation.candidates import neutral_values
from cosim.estimation.noise_model import Noise, NoiseLimits, NoiseRange, noise_range
from cosim.estimation.readings import Readings, readings_of
from cosim.kernel.backend import kernel
from cosim.kernel.interface import DISTURBANCE, MEMORY, Data, Filtered, Kernel, Layout, Simulated
from cosim.kernel.settling import settling
from cosim.logs.log import Log, slowness
from plant.integrate import substeps
from plant.model import Model
from plant.namespaces import SCALAR

UNSCORED = 1.0  # [s] of each log, in which the filter settles; see `unscored`
RANGE_FROM, RANGE_ROWS = 10.0, 500  # [s] of the first log and rows at least, for the range of the process noise

SAME, ALIKE = 0.5, 1e-5  # of NLL, and of what a wrong model makes of it, by which fewer substeps may change it
STARTING = 0.2  # [s] within which a measurement still counts as of the start
TOO_QUIET, UNKNOWN = 0.1, 1e-4  # of a stated standard deviation, below which it is no sensor's; where none is stated
JITTER = 0.01  # of a row, from which rows are no longer taken to be equally far apart
USUAL_MEMORY = 0.15  # [s] for which an unknown input lasts, where nothing is known of it: longer than a few rows
LONGEST_MEMORY = 0.1  # of a log
WITHIN = 10.0  # times, by which a stated variance of a sensor is believed: a standard deviation of its logarithm


def build_problem(
    model: Model,
    logs: Sequence[Log],
    unnamed: bool = False,
    noise: Mapping[str, float] | None = None,
    sensors: Mapping[str, float] | None = None,
    settings: Settings | None = None,
) -> Problem:
    """Kernel and data; an output that only some logs hold is missing in the others.

    `noise`: standard deviations of outputs as the study states them; `sensors`: errors known already.
    """
    settings = settings or Settings()
    measured = tuple(q.name for q in model.outputs if any(q.name in log.outputs for log in logs))
    compiled = kernel(model, measured, unnamed)
    layout = compiled.layout
    settle = settling(model, [layout.states[k] for k in layout.driven])
    data = [as_data(model, log, layout, settle, settings.interpolated) for log in logs]
    readings = [readings_of(d.y, unscored(d)) for d in data]
    stated = {name: sigma * sigma for name, sigma in (noise or {}).items()}
    variance = {q.name: model.sensor_variance.get(q.name, 1.0) for q in model.outputs} | stated
    r = np.array([variance[name] for name in measured])
    x0 = [start_state(model, d, measured, layout.states) for d in data]
    values = {**dict.fromkeys(layout.parameters, 0.0), **neutral_values(model), **(sensors or {})}
    values[MEMORY] = USUAL_MEMORY * max(slowness(d.step) for d in data)
    late = {
        f"{kind.name}.value": [measured.index(n) for n in kind.affected() if n in measured]
        for kind in model.sensors
        if kind.late
    }
    known = np.array([name in model.sensor_variance for name in measured])
    free = np.array([name not in stated for name in measured])
    problem = Problem(compiled, data, readings, x0, np.empty((0, 0)), r, values, settle, settings, late, known, free)
    return replace(problem, P0=start_covariance(model, problem))


@dataclass(frozen=True)
class Settings:
    """What a study says of its logs.

    interpolated: inputs that run straight from row to row
    tolerance:    base parameter → how far it may be off, as a share of it: the half-width that holds 95 %
    """

    interpolated: frozenset[str] = frozenset()
    tolerance: Mapping[str, float] = field(default_factory=dict)


def as_data(model: Model, log: Log, layout: Layout, settle: float, interpolated: frozenset[str] = frozenset()) -> Data:
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
    away = np.zeros((rows, 1))
    away[grid, 0] = grid - (log.time - log.time[0]) / log.step  # rows by which a reading is older than its row
    late = None
    if np.max(np.abs(away)) > JITTER:
        late = np.repeat(away, len(measured), axis=1)
        u = _as_acted(log, u, grid)
    data = Data(log.step, float(log.time[0]), u, y, substeps(log.step, model.substep), 0, interpolated, late)
    return replace(data, settle=int(min(settle / log.step, unscored(data))))


def _as_acted(log: Log, u: Array, grid: Rows) -> Array:
    """The mean of each command over each equal step, where it was given at times between: its impulse is exact."""
    edges = np.arange(len(u) + 1, dtype=np.float64)
    given = (log.time - log.time[0]) / log.step
    commands = u[grid]
    lasting = np.vstack([np.zeros(u.shape[1]), np.cumsum(commands[:-1] * np.diff(given)[:, None], axis=0)])
    # the last command goes on, and so does the first before it was given
    times = np.concatenate([[min(0.0, given[0]) - 1.0], given, [edges[-1] + 1.0]])
    total = np.vstack(
        [
            lasting[0] + commands[0] * (times[0] - given[0]),
            lasting,
            lasting[-1] + commands[-1] * (times[-1] - given[-1]),
        ]
    )
    return np.column_stack([np.diff(np.interp(edges, times, column)) for column in total.T])


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
    names = [name for name in layout.uncertain if not name.startswith(DISTURBANCE)]
    if not known.keys() >= set(names):
        ranges = dict(zip(layout.states, _range(problem).tolist(), strict=True))
        known = {name: ranges[name] ** 2 or 1.0 for name in names} | known
    return np.diag([known.get(name, 0.0) for name in layout.uncertain])


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
    noise, values = problem.plain, {**problem.values, **(values or {})}
    exact = problem.scored(values, noise).nll
    most = max(log.substeps for log in problem.logs)
    for n in (2**k for k in range(10) if 2**k < most):
        coarse = replace(problem, logs=[replace(log, substeps=min(n, log.substeps)) for log in problem.logs])
        if abs(coarse.scored(values, noise).nll - exact) < max(SAME, ALIKE * abs(exact)):
            return coarse
    return problem


def halved(problem: Problem) -> Problem:
    """One log as two; the second starts where the filter is then."""
    (log,), (x0,) = problem.logs, problem.x0
    half = len(log.u) // 2
    halves = [log.rows(0, half), log.rows(half, len(log.u))]
    reached = problem.run(problem.values, problem.plain, 0, states=True).states[half]
    readings = [readings_of(d.y, unscored(d)) for d in halves]
    return replace(problem, logs=halves, readings=readings, x0=[x0, reached])


@dataclass(frozen=True)
class Scored:
    """Errors and variances of the scored measurements of all logs in one row, and how many are each log's.

    rows: row of its log in which each was measured
    """

    errors: Array
    variances: Array
    counts: tuple[int, ...]
    rows: Rows

    @property
    def nll(self) -> float:
        """½ Σ (ln 2πs + e²/s); infinite where the filter has diverged."""
        return sum(self.by_log)

    @property
    def terms(self) -> Array:
        """½ (ln 2πs + e²/s) of each measurement."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(0.5 * (np.log(2 * np.pi * self.variances) + self.errors**2 / self.variances))

    @property
    def by_log(self) -> tuple[float, ...]:
        """NLL of each log."""
        sums = [float(part.sum()) for part in np.split(self.terms, np.cumsum(self.counts)[:-1])]
        return tuple(v if np.isfinite(v) else np.inf for v in sums)


@dataclass
class Problem:
    """Logs, kernel and what is known beforehand: start states, measurement variances, values of all parameters.

    readings: what else there is to the measurements of each log
    r:      stated variance of each output; `stated` those that somebody did state, `adjusted` those that a fit may move
    settle: [s] until the lags of the model that was given have forgotten an unknown start
    late:   parameter that is a latency → places of the outputs that are late by it
    """

    kernel: Kernel
    logs: Sequence[Data]
    readings: Sequence[Readings]
    x0: Sequence[Array]
    P0: Array
    r: Array
    values: Mapping[str, float]
    settle: float
    settings: Settings
    late: Mapping[str, Sequence[int]]
    stated: Flags
    adjusted: Flags
    sensing: Noise | None = None  # noise of sensors as fitted once; None: as stated
    trusted: bool = False  # equations are: no unknown input is free

    def with_noise(self, levels: Mapping[str, float]) -> Problem:
        """The problem with a first guess of the noise [standard deviation] of some outputs."""
        guess = [levels.get(name, 0.0) ** 2 for name in self.layout.outputs]
        return replace(self, r=np.where(np.array(guess) > 0.0, guess, self.r))

    @property
    def layout(self) -> Layout:
        """What stands where in the kernel's arrays."""
        return self.kernel.layout

    @property
    def samples(self) -> int:
        """Number of scored measurements."""
        return int(sum(readings.scored.sum() for readings in self.readings))

    @cached_property
    def noise(self) -> NoiseRange:
        """How large process noise can be."""
        step = self.logs[0].step
        rows = round((UNSCORED * slowness(step) + max(RANGE_FROM, RANGE_ROWS * step)) / step)
        logs = [log.rows(0, rows) for log in self.logs]
        measured = [np.isfinite(log.y).any(axis=0) for log in logs]
        # the first log, and those that measure what it does not
        taken = [k for k in range(len(logs)) if k == 0 or np.any(measured[k] & ~measured[0])]
        short = replace(
            self,
            logs=[logs[k] for k in taken],
            readings=[readings_of(logs[k].y, unscored(logs[k])) for k in taken],
            x0=[self.x0[k] for k in taken],
            sensing=None,  # limits do not move with what was fitted
        )
        return noise_range(lambda power: short.scored(self.values, short.at(power)).variances, len(self.layout.noisy))

    def at(self, power: Array) -> Noise:
        """Unknown inputs of this power; memory and sensors as they are known so far."""
        if self.sensing is not None:
            return replace(self.sensing, power=power)
        return Noise(power, float(np.log(self.values[MEMORY])), np.log(self.r), np.full(len(self.r), -np.inf))

    @property
    def plain(self) -> Noise:
        """Unknown inputs that are plainly detected, or none where equations are trusted."""
        return self.at(self.noise.smallest if self.trusted else self.noise.plain)

    @cached_property
    def limits(self) -> NoiseLimits:
        """Limits of what is random, and what is said of the sensors as a weak prior."""
        ny, now = len(self.r), self.at(self.noise.plain)
        steps, longest = [d.step for d in self.logs], max(len(d.u) * d.step for d in self.logs)
        finest = np.max([r.resolution for r in self.readings], axis=0)
        spread = np.max([r.spread for r in self.readings], axis=0)
        stated = np.log(self.r)
        least = np.where(self.stated, TOO_QUIET, UNKNOWN) ** 2 * np.exp(stated)
        low = np.log(np.maximum(least, finest**2 / 12.0))
        high = np.maximum(np.log(np.maximum(spread**2, 1e-300)), stated + np.log(100.0))
        low, high = (np.where(self.adjusted, limit, stated) for limit in (np.minimum(low, high), high))
        timed = np.isfinite(now.timing)
        in_time = np.full(ny, 2.0 * np.log(1e-3 * min(steps))), np.full(ny, 2.0 * np.log(4.0 * max(steps)))
        wide = np.full(ny, np.inf)
        power = len(self.layout.noisy)
        memory = np.log([2.0 * min(steps), max(LONGEST_MEMORY * longest, 4.0 * min(steps))])
        if not self.layout.coloured or self.trusted:
            memory = np.full(2, now.memory)
        return NoiseLimits(
            low=np.concatenate([self.noise.smallest, memory[:1], low, np.where(timed, in_time[0], now.timing)]),
            high=np.concatenate(
                [
                    self.noise.smallest if self.trusted else self.noise.largest,
                    memory[1:],
                    high,
                    np.where(timed, in_time[1], now.timing),
                ]
            ),
            mean=np.concatenate([np.zeros(power + 1), stated, np.zeros(ny)]),
            sigma=np.concatenate(
                [np.full(power + 1, np.inf), np.where(self.stated & self.adjusted, np.log(WITHIN), np.inf), wide]
            ),
        )

    def undisturbed(self, state: Array) -> Array:
        """A state of the kernel without unknown inputs, of which no prediction is made."""
        plain = state.copy()
        if self.layout.coloured:
            plain[self.layout.noise_places] = 0.0
        return plain

    def numbers(self, values: Mapping[str, float]) -> Array:
        """Values of the parameters in the kernel's order."""
        return np.array([values[name] if name in values else self.values[name] for name in self.layout.parameters])

    def densities(self, noise: Noise) -> Array:
        """q of every stochastic state, its unit squared per second, 0 where no noise enters.

        An unknown input of variance σ² that lasts T is driven by 2·σ²/T.
        """
        q = np.zeros(len(self.layout.stochastic))
        power = np.exp(noise.power)
        q[list(self.layout.noisy)] = 2.0 * power / np.exp(noise.memory) if self.layout.coloured else power
        return q

    def lateness(self, values: Mapping[str, float], index: int) -> dict[int, float]:
        """Rows by which readings are late, by the place of their output; nothing where none are."""
        step = self.logs[index].step
        late = {k: values.get(name, self.values[name]) / step for name, places in self.late.items() for k in places}
        return late if any(late.values()) else {}

    def data(self, values: Mapping[str, float], index: int) -> Data:
        """A log with its late readings put where they belong.

        To the nearest row; by how much of a row they are older or younger than that, the filter takes into account.
        """
        data, late = self.logs[index], self.lateness(values, index)
        if not late:
            return data
        whole = {k: round(rows) for k, rows in late.items()}
        y = Readings.earlier(data.y, whole)
        older = np.zeros_like(y) if data.late is None else np.nan_to_num(Readings.earlier(data.late, whole))
        for k, rows in late.items():
            older[:, k] += rows - whole[k]
        return replace(data, y=y, late=older)

    def variances(self, noise: Noise, index: int) -> Array:
        """Variance of each reading of a log: its sensor's, and what an error of its time stamp makes of its speed."""
        r = np.exp(noise.sensors)
        if not np.isfinite(noise.timing).any():
            return r
        speed = self.readings[index].slopes / self.logs[index].step
        return np.asarray(r + np.exp(noise.timing) * speed**2)

    def run(self, values: Mapping[str, float], noise: Noise, index: int, *, states: bool = False) -> Filtered:
        """Filter one log."""
        return self.filtered(self.data(values, index), values, noise, index, states=states)

    def filtered(
        self, data: Data, values: Mapping[str, float], noise: Noise, index: int, *, states: bool = False
    ) -> Filtered:
        """Filter what might have been measured in place of a log."""
        lasting = {MEMORY: float(np.exp(noise.memory))} if self.layout.coloured else {}
        p, P0 = self.numbers({**values, **lasting}), self.P0.copy()
        if self.layout.coloured:
            places = list(self.layout.noisy)
            P0[places, places] = np.exp(noise.power)
        variances = self.variances(noise, index)
        return self.kernel.run(data, p, self.x0[index], P0, self.densities(noise), variances, states=states)

    def innovations(self, values: Mapping[str, float], noise: Noise, index: int) -> tuple[Array, Array]:
        """Errors and variances (rows, outputs) of a log, in the rows in which the readings were logged."""
        filtered = self.run(values, noise, index)
        e, s = filtered.errors, filtered.variances
        for k, late in self.lateness(values, index).items():
            e[:, k], s[:, k] = np.roll(e[:, k], round(late)), np.roll(s[:, k], round(late))
        return e, s

    def scored(self, values: Mapping[str, float], noise: Noise, only: Sequence[int] | None = None) -> Scored:
        """Filter all logs, or some."""
        errors, variances, rows = [], [], []
        for index in range(len(self.logs)) if only is None else only:
            (e, s), valid = self.innovations(values, noise, index), self.readings[index].scored
            errors.append(e[valid])
            variances.append(s[valid])
            rows.append(np.nonzero(valid)[0])
        return Scored(np.concatenate(errors), np.concatenate(variances), tuple(map(len, errors)), np.concatenate(rows))
