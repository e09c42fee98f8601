"""Construction of a fitting problem from logs: kernel, start states, substeps, horizon and sensor noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from cosim.core.arrays import Array, Flags, NamedValues
from cosim.core.text import join_names, plain, written
from cosim.estimation.data import count_unscored, data_of, first_measured, readings_of, start_state
from cosim.estimation.fit import Fit, fit, initial_fit
from cosim.estimation.kernel.kernel import (
    CONSTANT_PREFIX,
    CORRELATION_TIME,
    DEVIATION,
    DISTURBANCE,
    EARLIER,
)
from cosim.estimation.problem import WITHIN, Noise, Origin, Problem, Settings
from cosim.estimation.subject.candidates import Free, own, spread_of_base, usual_size
from cosim.estimation.subject.interface import Subject
from cosim.logs.log import Log, slowness, surprise, white_noise

MOST_DOUBLINGS = 8  # of the substeps of a fit
MAX_SEARCH_SUBSTEPS = 2  # steps of co-simulation between rows while a search ranks candidates
# allowed NLL change by fewer substeps, absolute and relative to the NLL of a wrong model
SUBSTEP_NLL_TOLERANCE, SUBSTEP_NLL_SHARE = 0.5, 1e-5
NO_SETTINGS = Settings()
USUAL_MEMORY = 0.15  # [s] default correlation time of an unknown input, longer than a few rows


def build_problem(
    subject: Subject,
    logs: Sequence[Log],
    unnamed: bool = False,
    noise: NamedValues = MappingProxyType({}),
    settings: Settings = NO_SETTINGS,
) -> Problem:
    """Return the fitting problem; outputs absent from a log are missing readings.

    Args:
        unnamed: Include unmodelled dynamics (terms outside the catalogue) in the kernel.
        noise: Output → standard deviation of its noise, as stated in the study.
    """
    logged = set().union(*(log.outputs for log in logs))
    measured = tuple(q.name for q in subject.outputs if q.name in logged)
    kernel = subject.kernel(measured, unnamed=unnamed, constant=settings.per_log)
    values = {**dict.fromkeys(kernel.layout.parameters, 0.0), **subject.values}
    values[CORRELATION_TIME] = USUAL_MEMORY * max(slowness(log.step) for log in logs)
    free = list[Free]()  # each parameter per log once per group of logs, with a prior around its value
    for name in settings.per_log:
        p, value = subject.declared[name], values[name]
        share = settings.tolerance.get(name, p.tolerance)
        sigma = usual_size(p) if share is None or p.neutral is not None else spread_of_base(p, value, share)
        for group in dict.fromkeys(settings.groups[log.path] for log in logs):
            size, prior = min(usual_size(p), sigma), (value, sigma)
            free.append(Free(own(name, group), *p.bounds, size, prior, parameter=name, group=group))
    values |= {f.name: values[f.parameter] for f in free}
    variances = {**subject.sensor_variance, **{n: s * s for n, s in noise.items()}}
    late, lagging = (
        {
            f"{kind.name}.value": [measured.index(n) for n in kind.affected() if n in measured]
            for kind in subject.sensors
            if getattr(kind, way)
        }
        for way in ("late", "lagging")
    )
    r, stated = np.array([variances.get(name, 1.0) for name in measured]), np.isin(measured, [*variances])
    adjusted = np.ones(len(measured), bool)
    problem = Problem(kernel, [], r, values, settings, late, lagging, stated, adjusted, own=tuple(free))
    return with_logs(subject, problem, logs)


def with_logs(subject: Subject, problem: Problem, logs: Sequence[Log]) -> Problem:
    """Return the fitting problem of a subject with other logs."""
    states, outputs, settings = problem.layout.states, problem.layout.outputs, problem.settings
    data = [data_of(subject, log, problem.layout, settings.interpolated) for log in logs]
    begins = []
    for log, d in zip(logs, data, strict=True) if settings.per_log else ():
        initial = {states.index(n): outputs.index(n) for n in first_measured(subject, d, outputs) if n in states}
        begins.append(Origin(settings.groups[log.path], initial))
    x0, readings = [start_state(subject, d, outputs, states) for d in data], list(map(readings_of, data))
    posed = replace(problem, logs=data, readings=readings, x0=x0, origins=begins)
    return replace(posed, P0=start_covariance(subject, posed))


def start_covariance(subject: Subject, problem: Problem) -> Array:
    """Return the start covariance P0 of the stochastic states.

    If a state has an initial measurement in every log, its variance is ten times the noise variance of the output;
    otherwise it is the subject's start variance. Without a start variance, it is the squared range of the state in a
    simulation with the commands of the logs, or 1.
    """
    layout = problem.layout
    measured = _measured_at_start(subject, problem)
    variances = {n: WITHIN * v for n, v in zip(layout.outputs, problem.r.tolist(), strict=True) if n in measured}
    variances = {**subject.start_variance, **variances}
    derived = {layout.states[k] for k in layout.carrying}  # from a constant, with the uncertainty of the constant
    of_noise = DISTURBANCE, DEVIATION, EARLIER, CONSTANT_PREFIX  # states whose variance the noise or a constant sets
    names = [n for n in layout.uncertain if not n.startswith(of_noise) and n not in derived]
    if set(names) - variances.keys():
        ranges = dict(zip(layout.states, _range(problem).tolist(), strict=True))
        variances = {name: ranges[name] ** 2 or 1.0 for name in names} | variances
    return np.diag([variances.get(name, 0.0) if name not in derived else 0.0 for name in layout.uncertain])


def with_equations_trusted(subject: Subject, problem: Problem) -> Problem:
    """Return the problem without unknown inputs, as if equations were exact; free runs start from first readings."""
    P0 = problem.P0.copy()
    if math.isinf(subject.horizon):
        fixed = np.isin(problem.layout.uncertain, [*_measured_at_start(subject, problem)])
        P0[fixed, fixed] = 0.0
    return replace(problem, trusted=True, sensing=None, P0=P0)


def _measured_at_start(subject: Subject, problem: Problem) -> set[str]:
    """Return states with an initial measurement in every log."""
    outputs = problem.layout.outputs
    return set.intersection(*(set(first_measured(subject, data, outputs)) for data in problem.logs))


def _range(problem: Problem) -> Array:
    """Return the range of each state in a simulation of the logs, 0 for a state that does not change.

    All ranges are 0 if the simulation deviates from the measurements by more than their range, as for an unstable
    model.
    """
    runs = [problem.simulate(problem.values, index) for index in range(len(problem.logs))]
    for log, run in zip(problem.logs, runs, strict=True):
        measured = np.isfinite(log.y)
        error = np.abs(np.where(measured, run.outputs - np.where(measured, log.y, 0.0), 0.0)).max(axis=0)
        span = np.where(measured, log.y, -np.inf).max(axis=0) - np.where(measured, log.y, np.inf).min(axis=0)
        if not np.all((error <= span) | ~measured.any(axis=0)):  # also true after overflow
            return np.zeros(len(problem.layout.states))
    return np.asarray(np.ptp(np.vstack([run.states for run in runs]), axis=0))


def coarsen(problem: Problem, values: NamedValues | None = None) -> Problem:
    """Return the problem with the fewest substeps that leave the likelihood unchanged.

    Args:
        values: Parameter values for the test, by default those of the base model. An active effect may need more
            substeps.
    """
    if problem.layout.is_free_run:  # substeps matter to forces that follow the outputs, and to no model without them
        few = [replace(log, substeps=min(log.substeps, MAX_SEARCH_SUBSTEPS)) for log in problem.logs]
        return replace(problem, logs=few) if values is None else problem
    noise, values = problem.plain, {**problem.values, **(values or {})}
    exact = problem.score(values, noise).nll
    most = max(log.substeps for log in problem.logs)
    for n in (2**k for k in range((most - 1).bit_length())):
        coarse = replace(problem, logs=[replace(log, substeps=min(n, log.substeps)) for log in problem.logs])
        if abs(coarse.score(values, noise).nll - exact) < max(SUBSTEP_NLL_TOLERANCE, SUBSTEP_NLL_SHARE * abs(exact)):
            return coarse
    return problem


def with_finer_steps(problem: Problem, values: NamedValues, noise: Noise) -> Problem:
    """Return the problem with enough substeps for the likelihood at fitted values; unchanged if they suffice.

    At fitted values, the substeps that suffice for the given model may be too long.
    """
    if problem.layout.is_free_run:
        return problem
    now = problem.score(values, noise).nll
    for _ in range(MOST_DOUBLINGS):
        finer = replace(problem, logs=[replace(log, substeps=2 * log.substeps) for log in problem.logs])
        before, now = now, finer.score(values, noise).nll
        if abs(now - before) < max(SUBSTEP_NLL_TOLERANCE, SUBSTEP_NLL_SHARE * abs(now)):
            break
        problem = finer
    return problem


def halve_log(problem: Problem) -> Problem:
    """Return the problem with its single log in two halves; the second half starts from the filtered state.

    Free runs always cover the whole log; each half then has only its own readings.
    """
    (log,), (x0,) = problem.logs, problem.x0
    half, reached = len(log.u) // 2, x0
    if problem.layout.is_free_run:
        early = np.arange(len(log.u))[:, None] < half
        halves = [replace(log, y=np.where(rows, log.y, np.nan)) for rows in (early, ~early)]
    else:
        halves = [log.rows(0, half), log.rows(half, len(log.u))]
        following = replace(problem, trusted=False, sensing=None)
        run = following.run(problem.values, following.plain, 0)
        reached = problem.drop_unknown_inputs(run.states[half])
        for origin in problem.origins:
            # A start from a reading depends on the parameter value of the group.
            first = halves[1].rows(0, 1)
            read, y = problem.simulate(problem.values, 0, reached, first).outputs[0], first.y[0]
            reached[list(origin.initial)] = np.where(np.isfinite(y), y, read)[list(origin.initial.values())]
    readings = list(map(readings_of, halves))
    return replace(problem, logs=halves, readings=readings, x0=[x0, reached], origins=[*problem.origins] * 2)


# Free runs: start states, of which the first readings show only a part, and fits to more and more rows.
#
# A free run that has departed from the motion in a log does not show which parameters would avoid this: large unknown
# inputs explain the rest of the log, and a fit ends in a local optimum. In the first rows, the free run is still near
# the log.


ENOUGH = 0.5  # estimates end when the NLL of a log decreases by less than this


def with_likely_starts(problem: Problem, values: NamedValues | None = None, noise: Noise | None = None) -> Problem:
    """Return the problem with maximum-likelihood start states of free runs; other problems are unchanged.

    Method: Gauss-Newton iterations, in which the filter is linear in the start states.

    Args:
        values: Parameter values; None for those of the problem.
        noise: Noise levels; None for the most likely ones.
    """
    given = {**problem.values, **(values or {})}
    for _ in problem.layout.states if problem.layout.start_places else ():  # more iterations than needed
        level = noise or initial_fit(problem).noise
        x0 = [_next(problem, given, level, k) for k in range(len(problem.logs))]
        if all(after is before for after, before in zip(x0, problem.x0, strict=True)):
            break
        problem = replace(problem, x0=x0)
    return problem


def _next(problem: Problem, values: NamedValues, noise: Noise, index: int) -> Array:
    """Return a more likely start state of a log; the same array if there is none."""
    places, x0 = problem.layout.start_places, problem.x0[index]

    def objective(x: Array) -> float:
        starts = [*problem.x0[:index], x, *problem.x0[index + 1 :]]
        e, s = replace(problem, x0=starts).innovations(values, noise, index)  # of all rows
        with np.errstate(over="ignore", invalid="ignore"):
            nll = 0.5 * float(np.nansum(np.log(s) + e**2 / s))
        return nll if np.isfinite(nll) else np.inf

    moved, before = x0.copy(), objective(x0)
    moved[places] = problem.run(values, noise, index).states[-1][places]
    for each in (moved, 0.5 * (x0 + moved)):
        if np.isfinite(each).all() and objective(each) < before - ENOUGH:
            return each
    return x0


def fit_growing(problem: Problem, free: Sequence[Free], start: NamedValues) -> Fit:
    """Return a fit to all rows.

    The fit starts from values of fits to fewer rows, with unknown inputs at a detectable level.

    Args:
        start: Start values of the parameters.
    """
    values, rows = start, 2 * max(1, *(count_unscored(data) for data in problem.logs))
    while rows < max(len(data.u) for data in problem.logs):
        first = problem.first_rows(rows)
        values = fit(first, free, values, first.plain).values
        rows *= 2
    return fit(problem, free, values, problem.plain)


# -- sensor noise in the logs, which may differ from the noise stated by the model -------------------


OFF = 1.5  # ratio from which a level differs from the noise; accuracy is about 10 %
STAMPS_ERR, MAX_SQUARED_INNOVATION = 5.0, 9.0  # standard deviations of the test; limit on squared innovations
MAX_MOTION_SHARE = 0.3  # share of a channel's level that may come from motion between rows


def noise_levels(problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
    """Return output → noise standard deviation, if it can be estimated; and output → first guess.

    The level is the deviation of readings from four neighbours, which also contains fast motion. A simulation of the
    model estimates the share of motion. If this share is large, as for sensors slower than the motion, the level is
    only a first guess.
    """
    noise, both = {}, {}
    runs = [problem.simulate(problem.values, index).outputs for index in range(len(problem.logs))]
    for j, name in enumerate(problem.layout.outputs):
        columns = [log.y[:, j] for log in problem.logs]
        simulated = [np.where(np.isfinite(y), run[:, j], np.nan) for y, run in zip(columns, runs, strict=True)]
        read, motion = (white_noise(np.concatenate([surprise(y) for y in each])) for each in (columns, simulated))
        both[name] = read
        if motion < MAX_MOTION_SHARE * read:
            noise[name] = math.sqrt(read**2 - motion**2)
    return noise, both | noise


def erring_stamps(problem: Problem, at: Fit) -> Flags:
    """Return True for each output whose time stamps seem to have errors.

    Errors of time stamps cause innovations that grow with the rate of change ẏ. The statistic is Rao's score test of a
    variance τ²·ẏ² at τ = 0: Σ ½ ẏ²/s·(e²/s − 1) over √(Σ ½ (ẏ²/s)²). Errors of time stamps are independent from row to
    row, but innovations of a wrong model are not. Therefore ẏ·e/s of neighbouring rows must be uncorrelated.
    """

    def statistics(index: int) -> Array:
        """Return score, information, sum of products of neighbours and of their squares, for each output of a log."""
        readings = problem.readings[index]
        e, s = problem.innovations(at.values, at.noise, index)
        speed = readings.slopes / problem.logs[index].step
        with np.errstate(invalid="ignore"):
            share = np.where(readings.scored, speed**2 / s, 0.0)
            share = share - share.sum(axis=0) / np.maximum(1, readings.scored.sum(axis=0)) * readings.scored
            squares = np.minimum(e**2 / s, MAX_SQUARED_INNOVATION)  # a few outliers are no clock error
            spread = np.where(readings.scored, squares - 1.0, 0.0)
            moved = np.where(readings.scored, np.copysign(np.sqrt(squares * speed**2 / s), speed * e), 0.0)
        neighbours = moved[1:] * moved[:-1]
        sums = 0.5 * share * spread, 0.5 * share**2, neighbours, neighbours**2
        return np.array([each.sum(axis=0) for each in sums])

    scores, information, products, squares = np.sum([*map(statistics, range(len(problem.logs)))], axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        is_significant = scores / np.sqrt(information) > STAMPS_ERR
        is_white = ~(products / np.sqrt(squares) > STAMPS_ERR)
    return np.asarray(is_significant & is_white & ~np.isfinite(at.noise.timing) & problem.adjusted)


def noise_warnings(problem: Problem, noise: Noise, subject: Subject) -> tuple[str, ...]:
    """Return warnings about estimated noise that differs from the stated noise, or for which none is stated."""
    names, units = problem.layout.outputs, {q.name: written(q.unit) for q in subject.outputs}
    levels = dict(zip(names, np.exp(0.5 * noise.sensors).tolist(), strict=True))
    stated = {n: s for n, s, known in zip(names, np.sqrt(problem.r).tolist(), problem.stated, strict=True) if known}
    unstated = {n: level for n, level in levels.items() if n not in stated}
    different = {n: levels[n] for n, s in stated.items() if not s / OFF <= levels[n] <= OFF * s}
    warnings = []
    if different:
        both = (f"{n} {plain(s, 2)}, not {plain(stated[n], 2)} {units[n]}".rstrip() for n, s in different.items())
        warnings.append(
            f"the noise in the logs differs from the stated noise ({'; '.join(both)}); the noise of the "
            f"logs is used. To accept this, write {_line(different)} into the study"
        )
    if unstated:
        warnings.append(
            f"the model does not state the noise of {join_names([*unstated])} (sensor_variance); the logs show "
            f"{_line(unstated)}, which is used. To change it, write this key with other values into the study"
        )
    stamps = zip(names, np.exp(0.5 * noise.timing).tolist(), strict=True)
    if erring := [f"{name} by {plain(t, 2)} s" for name, t in stamps if t > 0.0]:
        warnings.append(
            f"the time stamps seem to jitter, with a standard deviation of {join_names(erring)}. Readings that change "
            "fast therefore have less weight; record with a better clock to avoid this"
        )
    return tuple(warnings)


def _line(levels: NamedValues) -> str:
    return f"`noise: {{{', '.join(f'{name}: {level:.2g}' for name, level in levels.items())}}}`"
