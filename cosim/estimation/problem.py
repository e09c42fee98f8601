"""Fitting problem: logs, filter kernel and prior knowledge."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from cosim.core.arrays import Array, Flags, NamedValues, Rows
from cosim.core.linear_algebra import pseudo_inverse
from cosim.estimation.data import UNEVEN, Readings, count_unscored, readings_of, shifted
from cosim.estimation.kernel.kernel import (
    CORRELATION_TIME,
    Data,
    Filtered,
    Inputs,
    Kernel,
    Layout,
    Simulated,
    filter_all,
)
from cosim.estimation.subject.candidates import Free, own, spread

RANGE_ROWS = 500  # scored rows for the range of the process noise, the same of each log
MIN_NOISE_SHARE = 1e-4  # share of a first guess of the noise below which no sensor lies
LONGEST_MEMORY = 0.1  # share of a log
WITHIN = 10.0  # factor between stated and actual noise: on the variance one standard deviation of the prior of its log
TINY = float(np.finfo(float).tiny)
PARAMETER_STEP = float(np.sqrt(np.finfo(float).eps))  # of differences, relative to max(1, value)


@dataclass(frozen=True)
class Settings:
    """Settings of a study that concern its logs.

    Attributes:
        interpolated: Inputs that are interpolated between rows.
        tolerance: Base parameter → relative tolerance: half-width of the 95 % interval of its prior.
        per_log: Parameters with a separate value for each group of logs.
        groups: File of a log → name of its group.
    """

    interpolated: frozenset[str] = frozenset()
    tolerance: NamedValues = field(default_factory=dict)
    per_log: tuple[str, ...] = ()
    groups: Mapping[Path, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Origin:
    """Group of a log, and states with an initial reading: index of the state → index of the output."""

    group: str
    initial: Mapping[int, int]


@dataclass(frozen=True)
class Scored:
    """Innovations e and variances s of all measurements in the likelihood, log by log, and their count in each log.

    Attributes:
        rows: Row of each measurement in its log.
    """

    errors: Array
    variances: Array
    counts: tuple[int, ...]
    rows: Rows

    @property
    def nll(self) -> float:
        """Return the negative log-likelihood ½ Σ (ln 2πs + e²/s); infinite for a diverged filter."""
        sums = [float(part.sum()) for part in self.of_each_log(self.terms)]
        return sum(sums) if np.isfinite(sums).all() else math.inf

    @property
    def terms(self) -> Array:
        """Return ½ (ln 2πs + e²/s) of each measurement."""
        with np.errstate(over="ignore", invalid="ignore"):
            return 0.5 * (np.log(2 * np.pi * self.variances) + self.errors**2 / self.variances)

    def of_each_log(self, numbers: Any) -> list[Any]:
        """Return the values of all measurements as a list with one array per log."""
        return np.split(numbers, np.cumsum(self.counts)[:-1])


@dataclass
class Problem:
    """Logs, kernel and prior knowledge: start states, measurement variances, parameter values.

    Attributes:
        readings: Readings of each log, with slopes and resolutions.
        r: Noise variance of each output.
        shown: Noise variance of each output as estimated from its readings; 0 if unknown; None if not estimated.
        stated: True for each output with a stated noise variance.
        adjusted: True for each output whose noise variance is free in a fit.
        late, lagging: Latency parameter, and time constant of a sensor → indices of its outputs.
        own: Free parameters with a value per group of logs.
        origins: Group and initial readings of each log.
    """

    kernel: Kernel
    logs: Sequence[Data]
    r: Array
    values: NamedValues
    settings: Settings
    late: Mapping[str, Sequence[int]]
    lagging: Mapping[str, Sequence[int]]
    stated: Flags
    adjusted: Flags
    readings: Sequence[Readings] = ()
    x0: Sequence[Array] = ()
    P0: Array = field(default_factory=lambda: np.empty((0, 0)))
    shown: Array | None = None
    sensing: Noise | None = None  # fitted sensor noise; None for stated noise
    trusted: bool = False  # True if equations count as exact: no unknown input is free
    scatter: float = 1.0  # scatter of estimates relative to white residuals; scales the priors
    own: tuple[Free, ...] = ()
    origins: Sequence[Origin] = ()
    ranges: list[NoiseRange] = field(default_factory=list)  # of process noise; derived problems share it

    @property
    def layout(self) -> Layout:
        """Return the layout of the kernel's arrays."""
        return self.kernel.layout

    @property
    def samples(self) -> int:
        """Return the number of measurements in the likelihood."""
        return int(sum(readings.scored.sum() for readings in self.readings))

    @property
    def price(self) -> float:
        """Return ½ ln N, half of BIC: the log-likelihood gain that pays for a parameter."""
        return 0.5 * float(np.log(max(2, self.samples)))

    @property
    def noise(self) -> NoiseRange:
        """Return the search range of process noise; derived problems share the range of the first one."""
        if not self.ranges:
            found = self._noise_range()
            if self.layout.is_free_run:
                # the error of a free run is as large as the motion, from row to row far more than the noise
                fastest = np.maximum(self._largest("spread") / self.values[CORRELATION_TIME], TINY)
                found = replace(found, largest=np.maximum(found.largest, 2.0 * np.log(fastest)))
            self.ranges.append(found)
        return self.ranges[0]

    def _noise_range(self) -> NoiseRange:
        """Return the range in which fits search the noise power.

        The smallest level must have no visible effect even at the longest correlation time. Otherwise a fit with a
        longer correlation time would gain from an unknown input that should be inactive.
        """
        short, count, finite = self._short(), len(self.layout.noisy), np.finfo(float)
        nothing = np.full(count, GRID[0])

        def levels(marks: Sequence[float], **memory: Any) -> Array:
            def logarithms(power: Array) -> Array:
                variances = short.score(self.values, replace(short.at(power), **memory)).variances
                return np.asarray(np.log(np.abs(variances)))  # rounding may cause a negative variance

            least, found = logarithms(nothing), np.empty((len(marks), count))
            for k in range(count):
                powers = np.where(np.arange(count) == k, GRID[:, None], nothing)
                rises = np.array([np.mean(logarithms(power) - least) for power in powers])
                rises = np.nan_to_num(rises, nan=finite.max).clip(finite.tiny, finite.max)
                found[:, k] = np.interp(np.log(marks), np.log(np.maximum.accumulate(rises)), GRID)
            return found

        (smallest,) = levels([SMALLEST_RISE], memory=float(np.log(self.longest_memory)))
        quiet, plain, largest = levels([0.5 * PLAIN_RISE, PLAIN_RISE, LARGEST_RISE])
        return NoiseRange(np.minimum(smallest, quiet), quiet, plain, largest)

    def _largest(self, property: str) -> Array:
        """Return the largest value over all logs of a property of `Readings`, for each output."""
        return np.asarray(np.max([getattr(readings, property) for readings in self.readings], axis=0))

    def _short(self) -> Problem:
        """Return the problem on the first rows of the logs, to find the range of the noise.

        If the filter diverges from a log, simulated outputs of the model replace the measurements of all logs.
        """
        rows = count_unscored(self.logs[0]) + RANGE_ROWS // len(self.logs)
        short = replace(self.first_rows(rows), sensing=None)  # limits must not depend on fitted noise
        nothing = short.at(np.full(len(self.layout.noisy), GRID[0]))

        def follows(index: int) -> bool:
            """Return True if the innovations of each output are smaller than the output's standard deviation."""
            errors, read = short.innovations(self.values, nothing, index)[0], short.logs[index].y
            with np.errstate(over="ignore", invalid="ignore"):
                pairs = [(e[np.isfinite(y)], y[np.isfinite(y)]) for e, y in zip(errors.T, read.T, strict=True)]
                return all(bool(np.sqrt(np.mean(e**2)) <= np.std(y)) for e, y in pairs if y.size and np.ptp(y) > 0.0)

        if all(map(follows, range(len(short.logs)))):
            return short
        # The variances of a filter that diverges from measurements are meaningless. With simulated outputs, it cannot
        # diverge.
        runs = [
            np.where(np.isfinite(log.y), short.simulate(self.values, k).outputs, np.nan)
            for k, log in enumerate(short.logs)
        ]
        return replace(short, logs=[replace(log, y=y) for log, y in zip(short.logs, runs, strict=True)])

    def first_rows(self, rows: int) -> Problem:
        """Return the problem with only the first `rows` rows of each log."""
        logs = [log.rows(0, rows) for log in self.logs]
        return replace(self, logs=logs, readings=[*map(readings_of, logs)])

    @property
    def longest_memory(self) -> float:
        """Return the longest correlation time of unknown inputs [s]."""
        longest = max(len(d.u) * d.step for d in self.logs)
        return max(LONGEST_MEMORY * longest, 2.0 * min(d.step for d in self.logs))

    def at(self, power: Array) -> Noise:
        """Return the noise with a given unknown input power."""
        if self.sensing is not None:
            return replace(self.sensing, power=power)
        return Noise(power, float(np.log(self.values[CORRELATION_TIME])), np.log(self.r), np.full(len(self.r), -np.inf))

    @property
    def plain(self) -> Noise:
        """Return the noise with which fits begin.

        Each unknown input has the smallest level that is detectable; with trusted equations, its lower limit.
        """
        return self.at(self.noise.smallest if self.trusted else self.noise.plain)

    @cached_property
    def limits(self) -> NoiseLimits:
        """Return the limits of the noise in a fit, with stated sensor noise as weak prior."""
        now, steps = self.at(self.noise.plain), [d.step for d in self.logs]
        stated, decade = np.log(self.r), np.log(WITHIN)
        least = np.where(self.stated, 1.0 / WITHIN, MIN_NOISE_SHARE) ** 2 * self.r
        low = np.log(np.maximum(least, self._largest("resolution") ** 2 / 12.0))  # the variance of rounding
        high = np.maximum(np.log(np.maximum(self._largest("spread") ** 2, TINY)), stated + 2.0 * decade)
        if self.layout.is_free_run and not self.trusted:  # unknown inputs must explain errors of the model
            most = np.log(np.maximum(self.r, 0.0 if self.shown is None else self.shown))
            low, high = np.maximum(low, stated - decade), np.minimum(high, most + decade)
        low, high = (np.where(self.adjusted, limit, stated) for limit in (np.minimum(low, high), high))
        timed = np.isfinite(now.timing)
        shortest, longest = (
            np.where(timed, 2.0 * np.log(t), now.timing) for t in (UNEVEN * min(steps), 0.5 * max(steps))
        )
        memory, largest = np.log([2.0 * min(steps), self.longest_memory]), self.noise.largest
        if self.trusted or not len(largest):
            largest, memory = self.noise.smallest, np.full(2, now.memory)
        within = np.where(self.stated & self.adjusted, decade, np.inf)
        return NoiseLimits(
            low=Noise(self.noise.smallest, memory[0], low, shortest).vector,
            high=Noise(largest, memory[1], high, longest).vector,
            mean=Noise(0.0 * largest, 0.0, stated, np.zeros_like(stated)).vector,
            sigma=Noise(largest + np.inf, np.inf, within, np.full_like(stated, np.inf)).vector,
        )

    def drop_unknown_inputs(self, state: Array) -> Array:
        """Return a state within bounds, with unknown inputs zero."""
        plain = state.copy()
        for f in self.own:
            place = self.layout.constants[f.parameter]
            plain[place] = min(max(plain[place], f.low), f.high)
        plain[self.layout.noise_places] = 0.0
        return plain

    def numbers(self, values: NamedValues) -> Array:
        """Return the parameter values as an array in the kernel's order; missing values come from the problem."""
        return np.array([values[name] if name in values else self.values[name] for name in self.layout.parameters])

    def parameters(self, values: NamedValues, index: int) -> Array:
        """Return the parameter values for a log as an array in the kernel's order."""
        return self.numbers(self.of_log(values, index))

    def of_log(self, values: NamedValues, index: int) -> NamedValues:
        """Return the parameter values for a log, including values of its group."""
        return {**values, **{name: value for name, (value, _) in self._own(values, index).items()}}

    def start(self, values: NamedValues, index: int) -> tuple[Array, Array]:
        """Return the start state of a log, and the factor L of the covariance L·L' that is added to P0.

        L has shape (stochastic states, parameters per log). A state initialized from its first reading satisfies the
        sensor equation y = g(x, θ) at the start, so that x and θ are correlated,

            x₀ ← x₀ + G⁻¹(y − g(x₀, θ))      δx = −G⁻¹ ∂g/∂θ · δθ      G = ∂g/∂x
        """
        layout, own, x0 = self.layout, self._own(values, index), self.x0[index]
        places, spreads = [layout.constants[name] for name in own], np.array([s for _, s in own.values()])
        x, factor = x0.copy(), np.zeros((len(x0), len(places)))
        x[places] = [value for value, _ in own.values()]
        factor[places, range(len(places))] = spreads
        if own and (initial := self.origins[index].initial):
            first = self.logs[index].rows(0, 1)

            def read(state: Array) -> Array:
                return self.simulate(values, index, state, first).outputs[0, list(initial.values())]

            def slope(place: int) -> Array:
                step = PARAMETER_STEP * max(1.0, abs(float(x[place])))
                return (read(x + step * (np.arange(len(x)) == place)) - y) / step

            y, states = read(x), list(initial)
            gain = pseudo_inverse(np.column_stack([*map(slope, states)]))
            factor[states] = -gain @ np.column_stack([*map(slope, places)]) * spreads
            x[states] += gain @ (x0[states] - y)
        return x, factor[list(layout.stochastic)]

    def _own(self, values: NamedValues, index: int) -> dict[str, tuple[float, float]]:
        """Return name → (value, standard deviation) in a log, for the parameters with a value per group of logs."""
        constants = {}
        for name in self.layout.constants:
            group = self.origins[index].group
            value = next(v[n] for n in (own(name, group), name) for v in (values, self.values) if n in v)
            constants[name] = value, values.get(spread(name, group), 0.0)
        return constants

    def densities(self, noise: Noise) -> Array:
        """Return the process noise density q of each stochastic state [unit²/s].

        An unknown input with variance σ² and correlation time T is driven by 2·σ²/T.
        """
        q = np.zeros(len(self.layout.stochastic))
        q[list(self.layout.noisy)] = 2.0 * np.exp(noise.power) / np.exp(noise.memory)
        return q

    def in_rows(self, of: Mapping[str, Sequence[int]], values: NamedValues, index: int) -> dict[int, float]:
        """Return output index → latency or time constant of its sensor, in rows; empty if all are zero."""
        step, values = self.logs[index].step, self.of_log(values, index) if of else values
        rows = {k: values.get(name, self.values[name]) / step for name, places in of.items() for k in places}
        return rows if any(rows.values()) else {}

    def data(self, values: NamedValues, index: int) -> Data:
        """Return a log in which late readings are in the rows of their measurement, with the lags of sensors.

        Readings move by whole rows; the filter accounts for the remaining fraction.
        """
        data, late = self.logs[index], self.in_rows(self.late, values, index)
        if lags := self.in_rows(self.lagging, values, index):
            data = replace(data, lags=np.array([lags.get(k, 0.0) for k in range(data.y.shape[1])]))
        if not late:
            return data
        whole = {k: round(rows) for k, rows in late.items()}
        y = shifted(data.y, whole)
        older = np.zeros_like(y) if data.late is None else np.nan_to_num(shifted(data.late, whole))
        for k, rows in late.items():
            older[:, k] += rows - whole[k]
        return replace(data, y=y, late=older)

    def variances(self, noise: Noise, index: int) -> Array:
        """Return the noise variance of each reading; errors of time stamps increase it where a signal changes fast."""
        r = np.exp(noise.sensors)
        if not np.isfinite(noise.timing).any():
            return r
        speed = self.readings[index].slopes / self.logs[index].step
        return r + np.exp(noise.timing) * speed**2

    def run(
        self, values: NamedValues, noise: Noise, index: int, *, states: bool = True, data: Data | None = None
    ) -> Filtered:
        """Filter a log.

        Args:
            index: Number of the log.
            states: Return the filtered states and their covariances too.
            data: Measurements to filter, by default those of the log.
        """
        return self.kernel.run(*self._inputs(values, noise, index, data), states=states)

    def _inputs(self, values: NamedValues, noise: Noise, index: int, data: Data | None = None) -> Inputs:
        """Return the arguments of the kernel's filter for a log."""
        data = self.data(values, index) if data is None else data
        x0, more = self.start(values, index)
        p = self.numbers({**self.of_log(values, index), CORRELATION_TIME: float(np.exp(noise.memory))})
        P0, places = self.P0 + more @ more.T, list(self.layout.noisy)
        P0[places, places] = np.exp(noise.power)
        return data, p, x0, P0, self.densities(noise), self.variances(noise, index)

    def filter_causally(
        self, data: Data, values: NamedValues, noise: Noise, index: int, rows: Sequence[int]
    ) -> Filtered:
        """Filter measurements with the inputs of a log; states in `rows` use only readings that have arrived.

        A late reading arrives after the row of its measurement.
        """
        filtered = self.run(values, noise, index, data=data)
        late = {k: n for k, by in self.in_rows(self.late, values, index).items() if (n := round(by)) > 0}
        states = filtered.states.copy()
        for row in rows if late else ():
            y = data.y.copy()
            for k, n in late.items():
                y[max(0, row - n + 1) : row + 1, k] = np.nan
            states[row] = self.run(values, noise, index, data=replace(data, y=y)).states[row]
        return replace(filtered, states=states)

    def innovations(self, values: NamedValues, noise: Noise, index: int) -> tuple[Array, Array]:
        """Return the innovations of a log and their variances, shape (rows, outputs)."""
        return self._aligned(self.run(values, noise, index, states=False), values, index)

    def _aligned(self, filtered: Filtered, values: NamedValues, index: int) -> tuple[Array, Array]:
        """Return innovations and variances at the rows in which readings arrive, not in which they are measured."""
        e, s = filtered.errors, filtered.variances  # changed in place; the last rows, which roll to the front, are NaN
        for k, late in self.in_rows(self.late, values, index).items():
            e[:, k], s[:, k] = np.roll(e[:, k], round(late)), np.roll(s[:, k], round(late))
        return e, s

    def begin_replay(self, filtered: Filtered, row: int) -> Array:
        """Return the filtered state at a row, without unknown inputs, to begin a replay.

        Start states of a free run are estimated from all rows of the log.
        """
        state, places = filtered.states[row].copy(), self.layout.start_places
        state[places] = filtered.states[-1][places]
        return self.drop_unknown_inputs(state)

    def simulate(
        self, values: NamedValues, index: int, state: Array | None = None, data: Data | None = None
    ) -> Simulated:
        """Return a simulation without noise, with the commands of a log.

        Args:
            state: First state, by default the start state of the log.
            data: Commands, by default those of the log.
        """
        state = self.start(values, index)[0] if state is None else state
        data = self.logs[index] if data is None else data
        return self.kernel.simulate(data, self.parameters(values, index), state, np.zeros(self.layout.memory))

    def simulate_from(
        self, values: NamedValues, index: int, points: tuple[Sequence[int], Any, Any], length: int = 1
    ) -> list[Simulated]:
        """Simulate `length` rows of a log from each of some rows; each result begins with the start row.

        Args:
            points: Rows, with the state and the memory at each.
            length: Number of rows after the first.
        """
        log, p = self.logs[index], self.parameters(values, index)
        at_once: Any = getattr(self.kernel, "simulate_from", None)  # kernels of other objects may lack this method
        if at_once:
            return list(at_once(log, p, points, length))
        runs = list[Simulated]()
        for row, state, memory in zip(*points, strict=True):
            run = self.kernel.simulate(log.rows(0, row + length + 1), p, state, memory, first=row)
            runs.append(Simulated(run.outputs[row:], run.states[row:], run.memory[row:]))
        return runs

    def score(self, values: NamedValues, noise: Noise, only: Sequence[int] | None = None) -> Scored:
        """Return the innovations and variances of some logs (default: all), log after log."""
        errors, variances, rows = [], [], []
        chosen = range(len(self.logs)) if only is None else only
        inputs = [self._inputs(values, noise, k) for k in chosen]
        runs = filter_all(self.kernel, inputs)
        for index, filtered in zip(chosen, runs, strict=True):
            (e, s), readings = self._aligned(filtered, values, index), self.readings[index]
            errors.append(e.take(readings.places))
            variances.append(s.take(readings.places))
            rows.append(readings.places // max(1, len(self.r)))
        return Scored(np.concatenate(errors), np.concatenate(variances), tuple(map(len, errors)), np.concatenate(rows))


# Random quantities of a filter: the unknown input of each forced equation, and sensor noise.
#
# The range of an unknown input is measured by its effect on the innovations, so no constant here has a model's unit. An
# input raises the innovation variance s. If the mean of ln s rises by less than SMALLEST_RISE, no log can show the
# input. At PLAIN_RISE the input is plainly detected, and sensors still contribute.
#


SMALLEST_RISE, PLAIN_RISE, LARGEST_RISE = 1e-3, 0.04, 3.0
GRID = np.arange(-60.0, 40.0, 4.0)


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise in natural logarithms, so that a step of a fit is a factor.

    Attributes:
        power: Variance of the unknown input of each forced equation [(unit of the state/s)²].
        memory: Correlation time of the unknown inputs [s].
        sensors: Variance of the noise of each output.
        timing: Variance of the time stamp error of each output [s²], which causes noise proportional to the rate of
            change; −∞ for none.
    """

    power: Array
    memory: float
    sensors: Array
    timing: Array

    @property
    def vector(self) -> Array:
        """Return all values as one vector."""
        return np.concatenate([self.power, [self.memory], self.sensors, self.timing])

    def like(self, vector: Array) -> Self:
        """Return a `Noise` of the same shapes from a vector."""
        n, m = len(self.power), len(self.sensors)
        power, memory, sensors, timing = np.split(vector, [n, n + 1, n + 1 + m])
        return type(self)(power, float(memory[0]), sensors, timing)

    @property
    def density(self) -> Array:
        """Return the low-frequency density 2·σ²·T of unknown inputs [unit of the state squared per second]."""
        return 2.0 * np.exp(self.power + self.memory)


@dataclass(frozen=True, eq=False)
class NoiseRange:
    """Log power of each unknown input at which ln s rises by SMALLEST_RISE to LARGEST_RISE; s: innovation variance."""

    smallest: Array
    quiet: Array
    plain: Array
    largest: Array


@dataclass(frozen=True, eq=False)
class NoiseLimits:
    """Limits and weak prior of a noise vector; a fixed value has equal limits."""

    low: Array
    high: Array
    mean: Array
    sigma: Array  # infinite without a prior

    @property
    def free(self) -> Rows:
        """Return the indices of noise values that a fit may change."""
        return np.flatnonzero(self.low < self.high)

    def penalty(self, vector: Array) -> float:
        """Return the penalty of the priors on a noise vector: ½ Σ ((v − mean)/sigma)²."""
        has_prior = np.isfinite(self.sigma)
        return float(0.5 * np.sum(((vector[has_prior] - self.mean[has_prior]) / self.sigma[has_prior]) ** 2))
