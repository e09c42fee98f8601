"""Replay errors of a model on logs, and the noise floor of these errors.

Each replay starts from the filtered state and effect memory of the replayed model, from past data only, at the time of
its first row, and lasts the model's horizon (2 s, or a free run). Errors are measured through the FMU. The noise floor
needs dozens of runs and is measured through the kernel, which gives the same results.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.estimation.data import as_data, unscored
from cosim.estimation.per_log import own, spread
from cosim.estimation.posing import origins, start_covariance, start_state
from cosim.estimation.problem import Problem
from cosim.estimation.readings import readings_of
from cosim.kernel.kernel import MEMORY as LASTS
from cosim.kernel.kernel import Data, Filtered
from cosim.logs.log import Log
from cosim.model.namespaces import arrays
from cosim.model.sensors import SensorError
from cosim.refinement.proof.refined_models import Variant
from cosim.residuals.drive import StoppedReplay
from cosim.residuals.residual_statistics import FREE_RUN, pooled
from cosim.residuals.windows import Replay, window_rows
from cosim.subject.interface import Replayer, Start, Subject

FLOOR_SEED = 20121

DRAWS = 20
CALMER, UNLIKE = 1.2, 3.0  # ratio of floor to error, and its log per scatter, from which a floor is too high


Evidence = list[tuple[Log, Replay]]


def filtering(problem: Problem, subject: Subject, logs: Sequence[Log]) -> Problem:
    """Return a variant's filter problem on other logs.

    The kernel of `problem` takes all parameters, including those of the variant.
    """
    layout = problem.layout
    data = [as_data(subject, log, layout, problem.settle, problem.settings.interpolated) for log in logs]
    x0 = [start_state(subject, d, layout.outputs, layout.states) for d in data]
    readings = [readings_of(d.y, unscored(d)) for d in data]
    begins = origins(subject, layout, logs, data, problem.settings)
    posed = replace(problem, logs=data, readings=readings, x0=x0, origins=begins)
    return replace(posed, P0=start_covariance(subject, posed))


def replays(
    variant: Variant, replayer: Replayer, problem: Problem, logs: Sequence[Log], horizons: Sequence[float] = ()
) -> dict[float, Evidence]:
    """Return horizon → corrected logs and their replays.

    The subject's own horizon comes first. An unstable subject may stop its FMU on another horizon; that log is skipped.
    """
    problem = filtering(problem, variant.subject, logs)
    judged = variant.subject.horizon
    played: dict[float, Evidence] = {judged: [], **{horizon: [] for horizon in horizons}}
    for index, log in enumerate(logs):
        values = problem.of_log(variant.values, index)
        starts, acting = {}, {}
        for horizon in played if not log.table else ():
            starts[horizon], acting[horizon] = _starts(variant, problem, log, index, horizon)
        made = replayer.replays(log, problem.logs[index], values, starts)
        for horizon in played:
            try:
                replay = next(made)
            except StoppedReplay:
                if horizon == judged:
                    raise
                break  # A stopped FMU must not be called again.
            played[horizon].append(
                (without_sensor_errors(log, variant, acting.get(horizon, {}), replay.outputs), replay)
            )
            if log.table:
                break
        made.close()
    return played


def _starts(
    variant: Variant, problem: Problem, log: Log, index: int, horizon: float
) -> tuple[dict[int, Start], dict[str, Array]]:
    """Return replay starts and parameters per log."""
    rows, layout = first_rows(log, horizon), problem.layout
    data = problem.data(variant.values, index)
    filtered = problem.filter_causally(data, variant.values, variant.noise, index, log.grid[rows].tolist())
    starts = {}
    for k in rows:
        row = int(log.grid[k])
        here = problem.undisturbed(filtered.states[row])
        per_log = {name: float(here[place]) for name, place in layout.constants.items()}
        states = dict(zip(layout.states, filtered.states[row].tolist(), strict=True))
        starts[k] = Start(states, filtered.memory[row], per_log)
    return starts, _acting(problem, filtered, log.grid[rows], log.grid)


def first_rows(log: Log, horizon: float) -> list[int]:
    """Return the first rows of the replays."""
    return [0] if horizon == FREE_RUN else window_rows(log, horizon)


def rmse(evidence: Evidence) -> dict[str, float]:
    """Return channel → RMSE pooled over the logs."""
    return pooled(replay.errors(log) for log, replay in evidence)


def without_sensor_errors(log: Log, variant: Variant, acting: Mapping[str, Array], said: Mapping[str, Array]) -> Log:
    """Return the log without the modelled sensor errors.

    Args:
        acting: Parameters per log, one value for each row.
        said: Output → simulated value, for sensors with latency or dependence on other outputs.
    """
    outputs = dict(log.outputs)
    for sensor in _sensors(variant, acting):
        if sensor.is_straight():
            at_zero, gain = _line(sensor)
            outputs |= {n: (outputs[n] - at_zero) / gain for n in sensor.affected() if n in outputs}
        elif not sensor.dormant:
            outputs |= {n: outputs[n] - by for n, by in _added(sensor, log.time, said).items() if n in outputs}
    return replace(log, outputs=outputs)


def _sensors(variant: Variant, acting: Mapping[str, Array]) -> Iterator[SensorError]:
    """Yield the sensor errors, last one first."""
    values = {**variant.values, **acting}
    for kind in reversed(variant.subject.sensors):
        yield kind(value=values[f"{kind.name}.value"])


def _line(sensor: SensorError) -> tuple[Any, Any]:
    """Return zero reading and gain of a sensor."""
    at_zero = sensor.measure(0.0)
    return at_zero, sensor.measure(1.0) - at_zero


def _added(sensor: Any, time: Array, said: Mapping[str, Array]) -> dict[str, Array]:
    """Return output → error of a nonlinear sensor."""
    own = {n: said[n] for n in sensor.affected()}
    if sensor.late:
        return {n: np.interp(time - sensor.value, time, there, left=np.nan) - there for n, there in own.items()}
    own = {n: np.nan_to_num(there) for n, there in own.items()}
    read = sensor.readings(arrays(), time, {**said, **own})
    return {n: np.asarray(read[n] - there) for n, there in own.items()}


def _acting(problem: Problem, filtered: Filtered, starts: Rows, rows: Rows) -> dict[str, Array]:
    """Return the parameters per log at each replay's start."""
    constants = problem.layout.constants
    if not constants:
        return {}
    begin = np.asarray(starts) if len(starts) else np.array([len(filtered.states) - 1])
    of_row = begin[np.maximum(0, np.searchsorted(begin, rows, side="left") - 1)]
    known = {k: problem.undisturbed(filtered.states[k]) for k in set(of_row.tolist())}
    return {name: np.array([known[k][place] for k in of_row.tolist()]) for name, place in constants.items()}


def predicted_errors(variant: Variant, problem: Problem, logs: Sequence[Log]) -> dict[str, float]:
    """Return the RMSE of each channel in kernel replays."""
    problem = filtering(problem, variant.subject, logs)
    missed = [
        _missed(variant, problem, log, index, problem.data(variant.values, index)) for index, log in enumerate(logs)
    ]
    return _root_mean_squares(problem, missed)


@dataclass(frozen=True)
class Floor:
    """Channel → noise floor of the replay error, and its scatter over draws.

    Attributes:
        level: Root mean square error of the model against itself.
        scatter: Standard deviation of the logarithm; no entry for a channel with a single draw.
    """

    level: Mapping[str, float]
    scatter: Mapping[str, float]

    def above(self, error: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """Return channel → floor and error if the floor is too high."""
        there = {n: (f, error[n]) for n, f in self.level.items() if error.get(n, 0.0) > 0.0}
        limits = {n: max(math.log(CALMER), UNLIKE * self.scatter.get(n, 0.0)) for n in there}
        return {n: (f, e) for n, (f, e) in there.items() if f > 0.0 and math.log(f / e) > limits[n]}


def noise_floor(variant: Variant, problem: Problem, logs: Sequence[Log], rng: np.random.Generator) -> Floor:
    """Return the noise floor from simulations with random noise."""
    problem = filtering(problem, variant.subject, logs)
    draws: list[list[Array]] = [[] for _ in range(-(-DRAWS // len(logs)))]
    for index, log in enumerate(logs):
        whole = {**variant.values, **_known_at_the_end(variant, problem, index)}
        first = problem.run(whole, variant.noise, index, states=True).states[0]
        for draw in draws:
            drawn = _drawn(problem, index, variant, first, rng)
            draw.append(_missed(variant, problem, log, index, drawn))
    level = _root_mean_squares(problem, [missed for draw in draws for missed in draw])
    each = [_root_mean_squares(problem, draw) for draw in draws]
    sizes = {name: [size for one in each if (size := one[name]) > 0.0] for name in level}
    return Floor(level, {n: float(np.std(np.log(s), ddof=1)) for n, s in sizes.items() if len(s) > 1})


def followed(variant: Variant, problem: Problem, logs: Sequence[Log]) -> dict[str, float]:
    """Return the last filtered values of parameters per log."""
    if not logs or not problem.layout.constants:
        return {}
    problem = filtering(problem, variant.subject, logs)
    ends = [_known_at_the_end(variant, problem, index) for index in range(len(logs))]
    return {name: value for end in ends for name, value in end.items()}


def _known_at_the_end(variant: Variant, problem: Problem, index: int) -> dict[str, float]:
    """Return filtered parameters at the end of a log."""
    if not (constants := problem.layout.constants):
        return {}
    last = problem.undisturbed(problem.run(variant.values, variant.noise, index, states=True).states[-1])
    group = problem.origins[index].group
    values = {own(name, group): float(last[place]) for name, place in constants.items()}
    return values | {spread(name, group): 0.0 for name in constants}


def _drawn(problem: Problem, index: int, variant: Variant, first: Array, rng: np.random.Generator) -> Data:
    """Return a simulated log with new noise.

    Late readings are shifted to the rows of their measurement, as in `Problem.data`.
    """
    layout, data = problem.layout, problem.data(variant.values, index)
    rows, noisy = len(data.u), layout.noise_places
    density = problem.densities(variant.noise)[list(layout.noisy)]
    kicks = np.zeros((rows, len(layout.states)))
    kicks[:, noisy] = rng.standard_normal((rows, len(noisy))) * np.sqrt(density * data.step)
    lasting = {**variant.values, LASTS: math.exp(variant.noise.memory)}
    p = problem.numbers(problem.of_log(lasting if layout.coloured else variant.values, index))
    truth = problem.kernel.simulate(data, p, first, np.zeros(layout.memory), kicks)
    sensed = rng.standard_normal(truth.outputs.shape) * np.sqrt(problem.variances(variant.noise, index))
    return replace(data, y=np.where(np.isnan(data.y), np.nan, _older(truth.outputs, data.late) + sensed))


def _older(outputs: Array, late: Array | None) -> Array:
    """Return outputs shifted by fractions of a row."""
    return outputs if late is None else outputs - np.nan_to_num(late) * np.diff(outputs, axis=0, prepend=outputs[:1])


def _missed(variant: Variant, problem: Problem, log: Log, index: int, data: Data) -> Array:
    """Return corrected measurement − model in replays over the model's horizon.

    Each replay starts from the state filtered from past data.
    """
    gains = dict.fromkeys(problem.layout.outputs, np.ones(len(data.u)))
    horizon = variant.subject.horizon
    rows = [] if data.table else log.grid[first_rows(log, horizon)].tolist()
    filtered = problem.filter_causally(data, variant.values, variant.noise, index, rows)
    acting = {} if data.table else _acting(problem, filtered, np.array(rows, np.intp), np.arange(len(data.u)))
    for sensor in _sensors(variant, acting):
        if sensor.is_straight():
            gains |= {n: gains[n] * _line(sensor)[1] for n in sensor.affected() if n in gains}
    readings = filtered.errors
    if not data.table:
        length = len(data.u) if horizon == FREE_RUN else round(horizon / data.step)
        p = problem.numbers(problem.of_log(variant.values, index))
        readings = data.y - _predicted(problem, data, p, filtered, rows, length)
    return np.asarray(readings / np.column_stack(list(gains.values())))


def _root_mean_squares(problem: Problem, missed: Sequence[Array]) -> dict[str, float]:
    whole = np.vstack(missed)
    sums, counts = np.nansum(whole**2, axis=0), np.isfinite(whole).sum(axis=0)
    return {
        name: float(np.sqrt(s / c)) if c else float("nan")
        for name, s, c in zip(problem.layout.outputs, sums, counts, strict=True)
    }


def _predicted(problem: Problem, data: Data, p: Array, filtered: Filtered, rows: Sequence[int], length: int) -> Array:
    """Return the outputs of kernel replays; NaN between replays."""
    predicted = np.full(data.y.shape, np.nan)
    for k in rows:
        end = min(k + length, len(data.u) - 1)
        part = data.rows(0, end + 1)
        run = problem.kernel.simulate(part, p, problem.undisturbed(filtered.states[k]), filtered.memory[k], first=k)
        predicted[k + 1 : end + 1] = _older(run.outputs[k:], None if part.late is None else part.late[k:])[1:]
    return predicted
