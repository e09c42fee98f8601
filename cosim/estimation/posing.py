"""Construction of a fitting problem from logs: kernel, start states and substeps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from cosim.base.arrays import Array
from cosim.estimation.data import as_data, folds, unscored
from cosim.estimation.per_log import Origin, own_parameters
from cosim.estimation.problem import Problem, Settings
from cosim.estimation.readings import readings_of, readings_of_table
from cosim.kernel.kernel import CONSTANT, DISTURBANCE, MEMORY, Data, Layout, Simulated
from cosim.logs.log import Log, slowness
from cosim.subject.interface import Subject

SAME, ALIKE = 0.5, 1e-5  # allowed NLL change by fewer substeps, absolute and relative to the NLL of a wrong model
STARTING = 0.2  # [s] within which a measurement counts as initial
NO_SETTINGS = Settings()
USUAL_MEMORY = 0.15  # [s] default correlation time of an unknown input: more than a few rows


def build_problem(
    subject: Subject,
    logs: Sequence[Log],
    unnamed: bool = False,
    noise: Mapping[str, float] = MappingProxyType({}),
    settings: Settings = NO_SETTINGS,
) -> Problem:
    """Return the fitting problem; outputs absent from a log are missing readings.

    Args:
        unnamed: Include unnamed terms in the kernel.
        noise: Standard deviations of outputs stated in the study.
    """
    logged = set().union(*(log.outputs for log in logs))
    measured = tuple(q.name for q in subject.outputs if q.name in logged)
    kernel = subject.kernel(measured, unnamed=unnamed, constant=settings.per_log)
    layout = kernel.layout
    settle = subject.settling([layout.states[k] for k in layout.driven])
    data = [as_data(subject, log, layout, settle, settings.interpolated) for log in logs]
    if subject.static:
        data = folds(data)
        readings = readings_of_table([d.y for d in data])
    else:
        readings = [readings_of(d.y, unscored(d)) for d in data]
    values = {**dict.fromkeys(layout.parameters, 0.0), **subject.values}
    values[MEMORY] = USUAL_MEMORY * max(slowness(d.step) for d in data)
    begins = origins(subject, layout, logs, data, settings)
    groups = [origin.group for origin in begins]
    own = tuple(own_parameters(subject, settings.per_log, groups, values, settings.tolerance))
    values |= {f.name: values[f.parameter] for f in own}
    x0, P0 = [start_state(subject, d, measured, layout.states) for d in data], np.empty((0, 0))
    r, late = np.array([_variance(subject, name, noise) for name in measured]), _late(subject, measured)
    stated, adjusted = np.isin(measured, [*subject.sensor_variance]), ~np.isin(measured, [*noise])
    problem = Problem(
        kernel, data, readings, x0, P0, r, values, settle, settings, late, stated, adjusted, own=own, origins=begins
    )
    return replace(problem, P0=start_covariance(subject, problem))


def _variance(subject: Subject, output: str, noise: Mapping[str, float]) -> float:
    """Return a sensor variance from the study, the subject, or the default 1."""
    return noise[output] * noise[output] if output in noise else subject.sensor_variance.get(output, 1.0)


def _late(subject: Subject, measured: Sequence[str]) -> dict[str, list[int]]:
    """Return the indices of the outputs that each latency delays."""
    return {name: [measured.index(n) for n in of if n in measured] for name, of in subject.late.items()}


def start_state(subject: Subject, data: Data, measured: Sequence[str], states: Sequence[str]) -> Array:
    """Return the subject's start state, with initial measurements inserted."""
    start = {**subject.start(), **_first_measured(subject, data, measured)}
    return np.array([start.get(name, 0.0) for name in states])


def origins(
    subject: Subject, layout: Layout, logs: Sequence[Log], data: Sequence[Data], settings: Settings
) -> list[Origin]:
    """Return group and start of each log; empty without parameters per log."""
    if not settings.per_log:
        return []
    states, outputs = layout.states, layout.outputs
    found = []
    for log, d in zip(logs, data, strict=True):
        shown = {states.index(n): outputs.index(n) for n in _first_measured(subject, d, outputs) if n in states}
        found.append(Origin(settings.groups[log.path], shown))
    return found


def start_covariance(subject: Subject, problem: Problem) -> Array:
    """Return P0 of the stochastic states.

    A state with initial measurements in every log has 10·r, another the subject's variance. Without either, the squared
    range of the model's own run on the commands counts, or 1.
    """
    layout = problem.layout
    measured = _measured_at_start(subject, problem)
    known = {n: 10 * v for n, v in zip(layout.outputs, problem.r.tolist(), strict=True) if n in measured}
    known = {**subject.start_variance, **known}
    later = {layout.states[k] for k in layout.carrying}  # derived from a constant, known to the same degree
    names = [n for n in layout.uncertain if not n.startswith((DISTURBANCE, CONSTANT)) and n not in later]
    if not known.keys() >= set(names):
        ranges = dict(zip(layout.states, _range(problem).tolist(), strict=True))
        known = {name: ranges[name] ** 2 or 1.0 for name in names} | known
    return np.diag([known.get(name, 0.0) if name not in later else 0.0 for name in layout.uncertain])


def with_equations_trusted(subject: Subject, problem: Problem) -> Problem:
    """Return the problem without unknown inputs; free runs start from the first readings."""
    P0 = problem.P0.copy()
    if math.isinf(subject.horizon):
        for k, name in enumerate(problem.layout.uncertain):
            if name in _measured_at_start(subject, problem):
                P0[k, k] = 0.0
    return replace(problem, trusted=True, sensing=None, P0=P0)


def _measured_at_start(subject: Subject, problem: Problem) -> set[str]:
    """Return states with an initial measurement in every log."""
    outputs = problem.layout.outputs
    return set.intersection(*(set(_first_measured(subject, data, outputs)) for data in problem.logs))


def _range(problem: Problem) -> Array:
    """Return the range of each state in the model's own run.

    The range is 0 at rest, and for a run that leaves the measurements by more than their span (unstable model).
    """
    runs = [own_run(problem, index) for index in range(len(problem.logs))]
    for log, run in zip(problem.logs, runs, strict=True):
        there = np.isfinite(log.y)
        apart = np.abs(np.where(there, run.outputs - np.where(there, log.y, 0.0), 0.0)).max(axis=0)
        span = np.where(there, log.y, -np.inf).max(axis=0) - np.where(there, log.y, np.inf).min(axis=0)
        if not np.all((apart <= span) | ~there.any(axis=0)):  # also true after overflow
            return np.zeros(len(problem.layout.states))
    low, high = np.percentile(np.vstack([run.states for run in runs]), (1, 99), axis=0)
    return np.asarray(high - low)


def own_run(problem: Problem, index: int) -> Simulated:
    """Return the noise-free response to a log's commands; NaN after divergence."""
    p, memory = problem.numbers(problem.of_log(problem.values, index)), np.zeros(problem.layout.memory)
    return problem.kernel.simulate(problem.logs[index], p, problem.start(problem.values, index)[0], memory)


def _first_measured(subject: Subject, data: Data, measured: Sequence[str]) -> dict[str, float]:
    """Return state → first measurement for states measured near the start."""
    shown, first = subject.shown, {}
    early = data.y[: round(STARTING * slowness(data.step) / data.step) + 1]
    for j, name in enumerate(measured):
        column = early[:, j][~np.isnan(early[:, j])]
        if name in shown and len(column):
            first[name] = float(column[0])
    return first


def varied_inputs(subject: Subject, logs: Sequence[Log]) -> list[str]:
    """Return inputs that vary in at least one log."""
    return [q.name for q in subject.inputs if any(np.ptp(log.inputs[q.name]) > 1e-9 for log in logs)]


def coarsened(problem: Problem, values: Mapping[str, float] | None = None) -> Problem:
    """Return the problem with the fewest substeps of equal likelihood.

    Args:
        values: Parameter values if not those of the base model; an active effect may need finer steps.
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
    """Return one log as two halves; the second starts from the filtered state."""
    (log,), (x0,) = problem.logs, problem.x0
    half = len(log.u) // 2
    halves = [log.rows(0, half), log.rows(half, len(log.u))]
    following = replace(problem, trusted=False, sensing=None)
    run = following.run(problem.values, following.plain, 0, states=True)
    reached = problem.undisturbed(run.states[half])
    readings = [readings_of(d.y, unscored(d)) for d in halves]
    begins = list(problem.origins) * 2
    for origin in problem.origins:
        # A start from a reading depends on the group's parameter value.
        p, memory = problem.numbers(problem.of_log(problem.values, 0)), np.zeros(problem.layout.memory)
        read, y = problem.kernel.simulate(halves[1].rows(0, 1), p, reached, memory).outputs[0], halves[1].y[0]
        reached[list(origin.shown)] = np.where(np.isfinite(y), y, read)[list(origin.shown.values())]
    return replace(problem, logs=halves, readings=readings, x0=[x0, reached], origins=begins)
