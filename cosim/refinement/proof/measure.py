"""Replay errors of a model on logs, and the noise floor of these errors.

Each replay starts from the filtered state and effect memory of the replayed model, from past data only, at the time of
its first row, and lasts the model's horizon (2 s, or a free run). Errors are measured through the FMU. The noise floor
needs dozens of runs and is measured through the kernel, which gives the same results.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.core.errors import SimulationError
from cosim.core.linear_algebra import square_roots
from cosim.estimation.data import data_of, readings_of, start_state
from cosim.estimation.free_runs import with_likely_starts
from cosim.estimation.kernel.kernel import MEMORY as LASTS
from cosim.estimation.kernel.kernel import Begin, Filtered, simulate_all
from cosim.estimation.past_readings import past_reading, replayed
from cosim.estimation.per_log import own, spread
from cosim.estimation.posing import origins, start_covariance
from cosim.estimation.problem import Problem
from cosim.estimation.subject.interface import Replayer, Start, Subject
from cosim.logs.log import Log
from cosim.model.namespaces import arrays
from cosim.refinement.proof.refined_models import Variant
from cosim.residuals.residual_statistics import FREE_RUN, pool_errors
from cosim.residuals.windows import Replay, window_rows

FLOOR_SEED = 20121

DRAWS = 20
PARTS = 8  # parts of a free run, each counted as one replay


ReplayedLogs = list[tuple[Log, Replay]]


def _posed(problem: Problem, subject: Subject, logs: Sequence[Log]) -> Problem:
    """Return a subject's fitting problem on other logs.

    The kernel of `problem` takes all parameters, including those of the variant.
    """
    layout = problem.layout
    data = [data_of(subject, log, layout, problem.settings.interpolated) for log in logs]
    x0 = [start_state(subject, d, layout.outputs, layout.states) for d in data]
    readings = list(map(readings_of, data))
    begins = origins(subject, layout, logs, data, problem.settings)
    posed = replace(problem, logs=data, readings=readings, x0=x0, origins=begins)
    return replace(posed, P0=start_covariance(subject, posed))


def _begun(variant: Variant, problem: Problem, logs: Sequence[Log]) -> Problem:
    """Return a variant's fitting problem on other logs, of free runs with the variant's likely start states."""
    return with_likely_starts(_posed(problem, variant.subject, logs), variant.values, variant.noise)


def replay_logs(
    variant: Variant, replayer: Replayer, problem: Problem, logs: Sequence[Log], horizons: Sequence[float] = ()
) -> dict[float, ReplayedLogs]:
    """Return horizon → corrected logs and their replays.

    The subject's own horizon comes first. On further horizons, a log on which an unstable FMU stops is skipped.
    """
    problem = _begun(variant, problem, logs)
    judged = variant.subject.horizon
    played: dict[float, ReplayedLogs] = {judged: [], **{horizon: [] for horizon in horizons}}
    for index, log in enumerate(logs):
        values = problem.of_log(variant.values, index)
        starts, per_log = {}, {}
        for horizon in played:
            starts[horizon], per_log[horizon] = _starts(variant, problem, log, index, horizon)
        results = replayer.replays(log, problem.logs[index], values, starts)
        for horizon in played:
            try:
                replay = next(results)
            except SimulationError:
                if horizon == judged:
                    raise
                break  # A stopped FMU must not be called again.
            corrected = _remove_sensor_errors(log, variant, per_log[horizon], replay.outputs)
            played[horizon].append((corrected, replay))
        results.close()
    return played


def _starts(
    variant: Variant, problem: Problem, log: Log, index: int, horizon: float
) -> tuple[dict[int, Start], dict[str, Array]]:
    """Return row → start of replay, and parameters per log."""
    rows, layout = first_rows(log, horizon), problem.layout
    data, noise = problem.data(variant.values, index), variant.noise_of_starts(horizon)
    filtered = problem.filter_causally(data, variant.values, noise, index, log.grid[rows].tolist())
    starts = {}
    for k in rows:
        row = int(log.grid[k])
        here = problem.begin_replay(filtered, row)
        per_log = {name: float(here[place]) for name, place in layout.constants.items()}
        states = dict(zip(layout.states, filtered.states[row].tolist(), strict=True))
        states |= {layout.states[k]: float(here[k]) for k in layout.start_places}
        starts[k] = Start(states, filtered.memory[row], per_log)
    return starts, _parameters_at_starts(problem, filtered, log.grid[rows], log.grid)


def first_rows(log: Log, horizon: float) -> list[int]:
    """Return the first rows of the replays."""
    return [0] if horizon == FREE_RUN else window_rows(log, horizon)


def rmse(evidence: ReplayedLogs) -> dict[str, float]:
    """Return channel → RMSE pooled over the logs."""
    return pool_errors(replay.errors(log) for log, replay in evidence)


def _remove_sensor_errors(
    log: Log, variant: Variant, per_log: Mapping[str, Array], simulated: Mapping[str, Array]
) -> Log:
    """Return the log without the modelled sensor errors.

    Args:
        per_log: Parameters per log, one value for each row.
        simulated: Output → simulated value, for sensors that depend on the past or on other outputs.
    """
    outputs = dict(log.outputs)
    for sensor in _sensors(variant, per_log):
        read = [n for n in sensor.affected() if n in outputs]
        if sensor.is_straight():
            at_zero, gain = _line(sensor)
            outputs |= {n: (outputs[n] - at_zero) / gain for n in read}
        elif sensor.dormant:
            continue
        elif sensor.depends_on_past():
            late = {n: past_reading(sensor, log.time, simulated[n], outputs[n]) - simulated[n] for n in read}
            outputs |= {n: outputs[n] - error for n, error in late.items()}
        else:
            clean = {n: np.nan_to_num(simulated[n]) for n in sensor.affected()}
            readings = sensor.readings(arrays(), log.time, {**simulated, **clean})
            outputs |= {n: outputs[n] - np.asarray(readings[n] - clean[n]) for n in read}
    return replace(log, outputs=outputs)


def _sensors(variant: Variant, per_log: Mapping[str, Array]) -> Iterator[Any]:
    """Yield the sensor errors in reverse order."""
    values = {**variant.values, **per_log}
    for kind in reversed(variant.subject.sensors):
        yield kind(value=values[f"{kind.name}.value"])


def _line(sensor: Any) -> tuple[Any, Any]:
    """Return the reading at zero and the gain of a sensor with a linear error."""
    at_zero = sensor.measure(0.0)
    return at_zero, sensor.measure(1.0) - at_zero


def _parameters_at_starts(problem: Problem, filtered: Filtered, starts: Rows, rows: Rows) -> dict[str, Array]:
    """Return the parameters per log at each replay's start."""
    constants = problem.layout.constants
    if not constants:
        return {}
    begin = np.asarray(starts) if len(starts) else np.array([len(filtered.states) - 1])
    of_row = begin[np.maximum(0, np.searchsorted(begin, rows, side="left") - 1)]
    states = {k: problem.drop_unknown_inputs(filtered.states[k]) for k in set(of_row.tolist())}
    return {name: np.array([states[k][place] for k in of_row.tolist()]) for name, place in constants.items()}


def predicted_errors(variant: Variant, problem: Problem, logs: Sequence[Log]) -> dict[str, float]:
    """Return the RMSE of each channel in kernel replays."""
    problem = _begun(variant, problem, logs)
    return _root_mean_squares(
        problem, [_KernelReplays(variant, problem, log, k).errors() for k, log in enumerate(logs)]
    )


@dataclass(frozen=True)
class Floor:
    """Noise floor of the replay error by channel, and its scatter over draws.

    Attributes:
        level: Channel → root mean square error of the model against itself.
        scatter: Channel → standard deviation of the logarithm; channels with a single draw are omitted.
    """

    level: Mapping[str, float]
    scatter: Mapping[str, float]


def noise_floor(variant: Variant, problem: Problem, logs: Sequence[Log], rng: np.random.Generator) -> Floor:
    """Return the noise floor: errors of the model against itself, simulated with random noise.

    Each simulation starts near the filtered state of a replay's first row, at a random deviation with the filter's
    covariance, and so stays near the motion of the log. A floor above the standard deviation of its channel is omitted.
    """
    problem = _begun(variant, problem, logs)
    draws: list[list[Array]] = [[] for _ in range(-(-DRAWS // len(logs)))]
    for index, log in enumerate(logs):
        replays = _KernelReplays(variant, problem, log, index)
        for draw in draws:
            draw.append(replays.random_errors(rng))
    each = [_root_mean_squares(problem, draw) for draw in draws]
    level, scatter = {}, {}
    for name, size in _root_mean_squares(problem, [errors for draw in draws for errors in draw]).items():
        readings = np.concatenate([np.zeros(0), *(log.outputs[name] for log in logs if name in log.outputs)])
        readings = readings[np.isfinite(readings)]
        if readings.size > 1 and size > float(np.std(readings)):
            continue
        level[name] = size
        sizes = [draw[name] for draw in each if draw[name] > 0.0]
        if len(sizes) > 1:
            scatter[name] = float(np.std(np.log(sizes), ddof=1))
    return Floor(level, scatter)


def final_log_parameters(variant: Variant, problem: Problem, logs: Sequence[Log]) -> dict[str, float]:
    """Return the last filtered values of parameters per log."""
    if not logs or not problem.layout.constants:
        return {}
    problem, ends = _posed(problem, variant.subject, logs), dict[str, float]()
    for index, origin in enumerate(problem.origins):
        last = problem.drop_unknown_inputs(problem.run(variant.values, variant.noise, index, states=True).states[-1])
        for name, place in problem.layout.constants.items():
            ends |= {own(name, origin.group): float(last[place]), spread(name, origin.group): 0.0}
    return ends


class _KernelReplays:
    """Kernel replays of a log over the model's horizon, each from the state filtered from past data."""

    def __init__(self, variant: Variant, problem: Problem, log: Log, index: int) -> None:
        data, horizon = problem.data(variant.values, index), variant.subject.horizon
        self.variant, self.problem, self.index, self.data = variant, problem, index, data
        self.rows: list[int] = log.grid[first_rows(log, horizon)].tolist()  # of the replays
        noise = variant.noise_of_starts(horizon)
        self.filtered = problem.filter_causally(data, variant.values, noise, index, self.rows)
        starts, every_row = np.array(self.rows, np.intp), np.arange(len(data.u))
        per_log = _parameters_at_starts(problem, self.filtered, starts, every_row)
        gains = dict.fromkeys(problem.layout.outputs, np.ones(len(data.u)))
        for sensor in _sensors(variant, per_log):
            if sensor.is_straight():
                gains |= {n: gains[n] * _line(sensor)[1] for n in sensor.affected() if n in gains}
        self.gains = np.column_stack(list(gains.values()))

    @cached_property
    def predicted(self) -> Array:
        """Return the outputs of the replays, NaN elsewhere."""
        starts = {k: self.problem.begin_replay(self.filtered, k) for k in self.rows}
        return self._simulate(self.variant.values, starts)

    def errors(self) -> Array:
        """Return corrected measurement − model, shape (rows, outputs)."""
        return np.asarray((self.data.y - self.predicted) / self.gains)

    def random_errors(self, rng: np.random.Generator) -> Array:
        """Return the errors against a simulation with random noise and random deviations of the starts."""
        problem, noise, data, rows = self.problem, self.variant.noise, self.data, self.rows
        errors = rng.standard_normal(data.y.shape) * np.sqrt(problem.variances(noise, self.index))
        if problem.layout.is_free_run:
            errors += self._random_deviations(rng)
        else:
            layout, starts = problem.layout, self.filtered.states.copy()
            if self.filtered.covariances is not None:
                roots = square_roots(self.filtered.covariances[rows])
                random = rng.standard_normal((len(rows), len(layout.stochastic), 1))
                starts[np.ix_(rows, list(layout.stochastic))] += (roots @ random)[..., 0]
            noisy = len(layout.noise_places)
            deviation = np.exp(0.5 * noise.power)  # Replays know nothing of the unknown inputs.
            starts[np.ix_(rows, layout.noise_places)] = rng.standard_normal((len(rows), noisy)) * deviation
            density = problem.densities(noise)[list(layout.noisy)]
            kicks = np.zeros((len(data.u), len(layout.states)))
            kicks[:, layout.noise_places] = rng.standard_normal((len(data.u), noisy)) * np.sqrt(density * data.step)
            memory = {LASTS: math.exp(noise.memory)}
            errors += self._simulate({**self.variant.values, **memory}, starts, kicks) - self.predicted
        return np.asarray(np.where(np.isnan(data.y), np.nan, errors) / self.gains)

    def _random_deviations(self, rng: np.random.Generator) -> Array:
        """Return random deviations of the outputs of a free run, driven by the fitted unknown inputs."""
        noise, data, kernel = self.variant.noise, self.data, self.problem.kernel
        propagation = kernel.responses(data, self.problem.x0[self.index])[1]  # type: ignore[attr-defined]
        fades = math.exp(-data.step / math.exp(noise.memory))
        inputs = rng.standard_normal(data.y.shape) * np.exp(0.5 * noise.power)
        deviations = np.zeros((len(inputs) + 1, inputs.shape[1]))  # after the row before the first
        for k in range(1, len(inputs)):
            both = np.concatenate([deviations[k], deviations[k - 1]])
            deviations[k + 1] = propagation @ both + data.step * inputs[k - 1]
            inputs[k] = fades * inputs[k - 1] + math.sqrt(1.0 - fades**2) * inputs[k]
        return deviations[1:]

    def _simulate(
        self, values: Mapping[str, float], starts: Mapping[int, Array] | Array, kicks: Array | None = None
    ) -> Array:
        """Return outputs of simulations from given states, NaN elsewhere."""
        problem, data, horizon = self.problem, self.data, self.variant.subject.horizon
        length = len(data.u) if horizon == FREE_RUN else round(horizon / data.step)
        p, outputs = problem.numbers(problem.of_log(values, self.index)), np.full(data.y.shape, np.nan)
        parts = {k: data.rows(0, min(k + length, len(data.u) - 1) + 1) for k in self.rows}
        begins: list[Begin] = [(part, p, starts[k], self.filtered.memory[k], kicks, k) for k, part in parts.items()]
        for (k, part), run in zip(parts.items(), simulate_all(problem.kernel, begins), strict=True):
            end = len(part.u) - 1
            read = run.outputs[k:]
            if part.late is not None:  # by the age of each reading in rows
                read = read - np.nan_to_num(part.late[k:]) * np.diff(read, axis=0, prepend=read[:1])
            outputs[k + 1 : end + 1] = read[1:]
        rows = np.arange(len(outputs), dtype=np.float64)
        for j, lag in enumerate(data.lags if data.lags is not None else ()):
            if lag:
                outputs[:, j] = replayed(rows, outputs[:, j], float(lag), data.y[:, j])
        return outputs


def _root_mean_squares(problem: Problem, errors: Sequence[Array]) -> dict[str, float]:
    whole = np.vstack(errors)
    sums, counts = np.nansum(whole**2, axis=0), np.isfinite(whole).sum(axis=0)
    return {
        name: float(np.sqrt(s / c)) if c else float("nan")
        for name, s, c in zip(problem.layout.outputs, sums, counts, strict=True)
    }
