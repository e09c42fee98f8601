"""From logs to a fitting problem: the kernel for what they hold, where each starts, and how fine the steps must be."""

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

SAME, ALIKE = 0.5, 1e-5  # of NLL, and of what a wrong model makes of it, by which fewer substeps may change it
STARTING = 0.2  # [s] within which a measurement still counts as of the start
NO_SETTINGS = Settings()
USUAL_MEMORY = 0.15  # [s] for which an unknown input lasts, where nothing is known of it: longer than a few rows


def build_problem(
    subject: Subject,
    logs: Sequence[Log],
    unnamed: bool = False,
    noise: Mapping[str, float] = MappingProxyType({}),
    settings: Settings = NO_SETTINGS,
) -> Problem:
    """Return kernel and data; an output that only some logs hold is missing in the others.

    noise: standard deviations of outputs, as the study states them
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
    known, free = np.isin(measured, [*subject.sensor_variance]), ~np.isin(measured, [*noise])
    problem = Problem(
        kernel, data, readings, x0, P0, r, values, settle, settings, late, known, free, own=own, origins=begins
    )
    return replace(problem, P0=start_covariance(subject, problem))


def _variance(subject: Subject, output: str, noise: Mapping[str, float]) -> float:
    """Return the variance of a sensor: as the study states it, else as the subject does, else 1."""
    return noise[output] * noise[output] if output in noise else subject.sensor_variance.get(output, 1.0)


def _late(subject: Subject, measured: Sequence[str]) -> dict[str, list[int]]:
    """Return the places of the outputs that each latency delays."""
    return {name: [measured.index(n) for n in of if n in measured] for name, of in subject.late.items()}


def start_state(subject: Subject, data: Data, measured: Sequence[str], states: Sequence[str]) -> Array:
    """The subject's own start, with what is measured near the start of the log in its place."""
    start = {**subject.start(), **_first_measured(subject, data, measured)}
    return np.array([start.get(name, 0.0) for name in states])


def origins(
    subject: Subject, layout: Layout, logs: Sequence[Log], data: Sequence[Data], settings: Settings
) -> list[Origin]:
    """Return group and start of each log where there are parameters per log, else none."""
    if not settings.per_log:
        return []
    states, outputs = layout.states, layout.outputs
    found = []
    for log, d in zip(logs, data, strict=True):
        shown = {states.index(n): outputs.index(n) for n in _first_measured(subject, d, outputs) if n in states}
        found.append(Origin(settings.groups[log.path], shown))
    return found


def start_covariance(subject: Subject, problem: Problem) -> Array:
    """P0 of the stochastic states: 10·r of what every log measures at its start, else what the model says of it.

    Of a state of which it says nothing, the squared range of the model's own run on the commands, or 1 without.
    """
    layout = problem.layout
    measured = _measured_at_start(subject, problem)
    known = {n: 10 * v for n, v in zip(layout.outputs, problem.r.tolist(), strict=True) if n in measured}
    known = {**subject.start_variance, **known}
    later = {layout.states[k] for k in layout.carrying}  # known as long as the constant is
    names = [n for n in layout.uncertain if not n.startswith((DISTURBANCE, CONSTANT)) and n not in later]
    if not known.keys() >= set(names):
        ranges = dict(zip(layout.states, _range(problem).tolist(), strict=True))
        known = {name: ranges[name] ** 2 or 1.0 for name in names} | known
    return np.diag([known.get(name, 0.0) if name not in later else 0.0 for name in layout.uncertain])


def with_equations_trusted(subject: Subject, problem: Problem) -> Problem:
    """The problem without unknown inputs; one of free runs starts from what was read first, whatever is read later."""
    P0 = problem.P0.copy()
    if math.isinf(subject.horizon):
        for k, name in enumerate(problem.layout.uncertain):
            if name in _measured_at_start(subject, problem):
                P0[k, k] = 0.0
    return replace(problem, trusted=True, sensing=None, P0=P0)


def _measured_at_start(subject: Subject, problem: Problem) -> set[str]:
    """States that every log measures at its start."""
    outputs = problem.layout.outputs
    return set.intersection(*(set(_first_measured(subject, data, outputs)) for data in problem.logs))


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
    p, memory = problem.numbers(problem.of_log(problem.values, index)), np.zeros(problem.layout.memory)
    return problem.kernel.simulate(problem.logs[index], p, problem.start(problem.values, index)[0], memory)


def _first_measured(subject: Subject, data: Data, measured: Sequence[str]) -> dict[str, float]:
    """State → its first measurement, of the states that an output shows and that are measured near the start."""
    shown, first = subject.shown, {}
    early = data.y[: round(STARTING * slowness(data.step) / data.step) + 1]
    for j, name in enumerate(measured):
        column = early[:, j][~np.isnan(early[:, j])]
        if name in shown and len(column):
            first[name] = float(column[0])
    return first


def varied_inputs(subject: Subject, logs: Sequence[Log]) -> list[str]:
    """Inputs that are not constant in some log."""
    return [q.name for q in subject.inputs if any(np.ptp(log.inputs[q.name]) > 1e-9 for log in logs)]


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
    """One log as two; the second starts where a filter is then that follows what is measured."""
    (log,), (x0,) = problem.logs, problem.x0
    half = len(log.u) // 2
    halves = [log.rows(0, half), log.rows(half, len(log.u))]
    following = replace(problem, trusted=False, sensing=None)
    run = following.run(problem.values, following.plain, 0, states=True)
    reached = problem.undisturbed(run.states[half])
    readings = [readings_of(d.y, unscored(d)) for d in halves]
    begins = list(problem.origins) * 2
    for origin in problem.origins:
        # as it is read, or would be: what that says of the state depends on the group's value
        p, memory = problem.numbers(problem.of_log(problem.values, 0)), np.zeros(problem.layout.memory)
        read, y = problem.kernel.simulate(halves[1].rows(0, 1), p, reached, memory).outputs[0], halves[1].y[0]
        reached[list(origin.shown)] = np.where(np.isfinite(y), y, read)[list(origin.shown.values())]
    return replace(problem, logs=halves, readings=readings, x0=[x0, reached], origins=begins)
