"""The fitting problem: logs, the kernel that filters them, and what is known beforehand."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array, Flags, Rows
from cosim.estimation.data import UNSCORED, unscored
from cosim.estimation.noise_model import Noise, NoiseLimits, NoiseRange, noise_range
from cosim.estimation.per_log import Origin, own, spread, started
from cosim.estimation.readings import Readings, readings_of
from cosim.kernel.kernel import MEMORY, Data, Filtered, Kernel, Layout
from cosim.logs.log import slowness
from cosim.subject.candidates import Free

RANGE_FROM, RANGE_ROWS = 10.0, 500  # [s] of the first log and rows at least, for the range of the process noise
TOO_QUIET, UNKNOWN = 0.1, 1e-4  # of a stated standard deviation, below which it is no sensor's; where none is stated
LONGEST_MEMORY = 0.1  # of a log
APART = 10  # times as long as readings are late, rows are apart whose states are asked of one run of the filter
WITHIN = 10.0  # times, by which a stated variance of a sensor is believed: a standard deviation of its logarithm


@dataclass(frozen=True)
class Settings:
    """What a study says of its logs.

    interpolated: inputs that run straight from row to row
    tolerance:    base parameter → how far it may be off, as a share of it: the half-width that holds 95 %
    per_log:      parameters of which each group of logs has its own value
    groups:       file of a log → its group
    """

    interpolated: frozenset[str] = frozenset()
    tolerance: Mapping[str, float] = field(default_factory=dict)
    per_log: tuple[str, ...] = ()
    groups: Mapping[Path, str] = field(default_factory=dict)


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
        sums = [float(part.sum()) for part in self.of_each_log(self.terms)]
        return tuple(v if np.isfinite(v) else np.inf for v in sums)

    def of_each_log(self, numbers: Any) -> list[Any]:
        """Return numbers of all measurements log by log."""
        return np.split(numbers, np.cumsum(self.counts)[:-1])


@dataclass
class Problem:
    """Logs, kernel and what is known beforehand: start states, measurement variances, values of all parameters.

    readings: what else there is to the measurements of each log
    r:      stated variance of each output; `stated` those that somebody did state, `adjusted` those that a fit may move
    settle: [s] until the lags of the model that was given have forgotten an unknown start
    late:   parameter that is a latency → places of the outputs that are late by it
    own:    what is free of each group of logs, where there are parameters per log; origins: of each log, then
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
    scatter: float = 1.0  # how many times what is left outweighs what white noise would: priors count so much more
    own: tuple[Free, ...] = ()
    origins: Sequence[Origin] = ()

    def with_noise(self, levels: Mapping[str, float]) -> Problem:
        """The problem with a first guess of the noise [standard deviation] of some outputs."""
        guess = [levels.get(name, 0.0) ** 2 for name in self.layout.outputs]
        return replace(self, r=np.where(np.array(guess) > 0.0, guess, self.r))

    @property
    def layout(self) -> Layout:
        """What stands where in the kernel's arrays."""
        return self.kernel.layout

    @property
    def table(self) -> bool:
        """Whether the logs are parts of tables, whose rows stand each for itself."""
        return self.logs[0].table

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
            origins=[self.origins[k] for k in taken if self.origins],
            sensing=None,  # limits do not move with what was fitted
        )
        lasting = float(np.log(self.longest_memory)) if self.layout.coloured else None

        def variances(power: Array, longest: bool) -> Array:
            noise = short.at(power)
            noise = replace(noise, memory=lasting) if longest and lasting is not None else noise
            return short.scored(self.values, noise).variances

        return noise_range(variances, len(self.layout.noisy))

    @property
    def longest_memory(self) -> float:
        """[s] that an unknown input lasts at most."""
        longest = max(len(d.u) * d.step for d in self.logs)
        return max(LONGEST_MEMORY * longest, 4.0 * min(d.step for d in self.logs))

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
        steps = [d.step for d in self.logs]
        finest = np.max([r.resolution for r in self.readings], axis=0)
        spread = np.max([r.spread for r in self.readings], axis=0)
        stated = np.log(self.r)
        least = np.where(self.stated, TOO_QUIET, UNKNOWN) ** 2 * np.exp(stated)
        low = np.log(np.maximum(least, finest**2 / 12.0))
        high = np.maximum(np.log(np.maximum(spread**2, 1e-300)), stated + np.log(100.0))
        low, high = (np.where(self.adjusted, limit, stated) for limit in (np.minimum(low, high), high))
        timed = np.isfinite(now.timing)
        shortest, longest = (
            np.where(timed, 2.0 * np.log(t), now.timing) for t in (1e-3 * min(steps), 4.0 * max(steps))
        )
        memory = np.log([2.0 * min(steps), self.longest_memory])
        if not self.layout.coloured or self.trusted:
            memory = np.full(2, now.memory)
        largest = self.noise.smallest if self.trusted else self.noise.largest
        power, nothing = len(self.layout.noisy), np.zeros(ny)
        within = np.where(self.stated & self.adjusted, np.log(WITHIN), np.inf)
        parts = (  # low, high, mean and standard deviation of each
            (self.noise.smallest, largest, np.zeros(power), np.full(power, np.inf)),
            (memory[:1], memory[1:], np.zeros(1), np.full(1, np.inf)),
            (low, high, stated, within),
            (shortest, longest, nothing, nothing + np.inf),
        )
        return NoiseLimits(*map(np.concatenate, zip(*parts, strict=True)))

    def undisturbed(self, state: Array) -> Array:
        """A state of the kernel without unknown inputs, of which no prediction is made; constants within bounds."""
        plain = state.copy()
        for f in self.own:
            place = self.layout.constants[f.parameter]
            plain[place] = min(max(plain[place], f.low), f.high)
        if self.layout.coloured:
            plain[self.layout.noise_places] = 0.0
        return plain

    def numbers(self, values: Mapping[str, float]) -> Array:
        """Values of the parameters in the kernel's order."""
        return np.array([values[name] if name in values else self.values[name] for name in self.layout.parameters])

    def of_log(self, values: Mapping[str, float], index: int) -> Mapping[str, float]:
        """The values that hold for a log: parameters per log as its group has them."""
        known = {name: value for name, (value, _) in self._own(values, index).items()}
        return {**values, **known} if known else values

    def start(self, values: Mapping[str, float], index: int) -> tuple[Array, Array]:
        """Start state of a log, and L, with which L·L' is its covariance beside P0."""
        known, x0 = self._own(values, index), self.x0[index]
        if not known:
            return x0, np.zeros((len(self.layout.stochastic), 0))
        p = self.numbers({**values, **{name: value for name, (value, _) in known.items()}})
        return started(self.kernel, self.logs[index], p, x0, known, self.origins[index].shown)

    def _own(self, values: Mapping[str, float], index: int) -> dict[str, tuple[float, float]]:
        """Parameter per log → its value for a log and the standard deviation of that; 0 where it is known."""
        known = {}
        for name in self.layout.constants:
            group = self.origins[index].group
            value = next(v[n] for n in (own(name, group), name) for v in (values, self.values) if n in v)
            known[name] = value, values.get(spread(name, group), 0.0)
        return known

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
        step, values = self.logs[index].step, self.of_log(values, index) if self.late else values
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
        x0, more = self.start(values, index)
        p, P0 = self.numbers({**self.of_log(values, index), **lasting}), self.P0 + more @ more.T
        if self.layout.coloured:
            places = list(self.layout.noisy)
            P0[places, places] = np.exp(noise.power)
        variances = self.variances(noise, index)
        return self.kernel.run(data, p, x0, P0, self.densities(noise), variances, states=states)

    def known(self, data: Data, values: Mapping[str, float], noise: Noise, index: int, rows: Sequence[int]) -> Filtered:
        """Filter what might have been measured in place of a log; its states in `rows` know what had arrived by then.

        A late reading stands in the row that it shows, and arrives after it: a state there must do without. It does
        without those that arrived while another one was asked for, too: a few, long ago.
        """
        filtered = self.filtered(data, values, noise, index, states=True)
        late = {k: n for k, by in self.lateness(values, index).items() if (n := round(by)) > 0}
        if not late or not rows:
            return filtered
        apart, states = min(np.diff(rows), default=len(data.u)), filtered.states.copy()
        runs = min(len(rows), math.ceil(APART * max(late.values()) / apart))
        for first in range(runs):
            asked, y = list(rows[first::runs]), data.y.copy()
            for row in asked:
                for k, n in late.items():
                    y[max(0, row - n + 1) : row + 1, k] = np.nan
            states[asked] = self.filtered(replace(data, y=y), values, noise, index, states=True).states[asked]
        return replace(filtered, states=states)

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
            (e, s), readings = self.innovations(values, noise, index), self.readings[index]
            errors.append(e.take(readings.places))
            variances.append(s.take(readings.places))
            rows.append(readings.rows)
        return Scored(np.concatenate(errors), np.concatenate(variances), tuple(map(len, errors)), np.concatenate(rows))
