"""Comparison of the missing input with the claimed term of each effect."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.estimation.data import count_unscored
from cosim.estimation.fit import Fit
from cosim.estimation.past_readings import past_reading
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import Candidate
from cosim.estimation.subject.interface import Subject
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.dependence import BINS, Regressor, bins, choose, regressors, unnamed_term
from cosim.refinement.search.missing import (
    MOST_ROWS,
    Smoothed,
    Steps,
    contributions,
    loosen_noise,
    scale_to_missing,
    smooth_logs,
    smooth_unknown_inputs,
    smoothed_logs,
)

VARIES = 0.2  # least standard deviation of a term for a correlation, relative to its RMS


@dataclass(frozen=True, eq=False)
class EffectComparison:
    """A missing quantity, estimated from the logs, and the claimed term.

    where:            state or channel of the missing quantity; `unit`: its unit
    estimated, sigma: estimate without the claim and its standard deviation, row by row
    term:             claimed value, None without a claim
    first:            number of rows of the first log
    """

    effect: str
    kind: str
    where: str
    unit: str
    against: Regressor
    time: Array
    estimated: Array
    sigma: Array
    term: Array | None
    first: int
    step: float
    recorded: float | None = None  # the share in refine.json
    horizon: float = 0.0  # [s] of the replays; 0 for a whole run

    @property
    def quantity(self) -> str:
        """Return the missing quantity in words: `missing acceleration of speed`."""
        if self.kind == "sensor":
            return f"error of {self.where}"
        return f"missing {'acceleration' if self.unit in {'m/s2', 'rad/s2'} else 'rate'} of {self.where}"

    @property
    def correlation(self) -> float:
        """Return the correlation of estimate and term."""
        if self.term is None or not np.std(self.estimated):
            return float("nan")
        varies = np.std(self.term) > VARIES * np.sqrt(np.mean(self.term**2))
        return float(np.corrcoef(self.estimated, self.term)[0, 1]) if varies else float("nan")

    @property
    def share_of_means(self) -> float:
        """Return the mean square share explained by the term in means over intervals of the signal; 0 without them."""
        if self.term is None:
            return 0.0
        groups = bins(self.against.values, BINS)
        sizes = np.array([rows.size for rows in groups])
        mean, term = (np.array([v[rows].mean() for rows in groups]) for v in (self.estimated, self.term))
        power = float(sizes @ mean**2)
        return max(0.0, 1.0 - float(sizes @ (mean - term) ** 2) / power) if power else 0.0

    @property
    def share(self) -> float:
        """Return the mean square share explained by the term."""
        if self.recorded is not None:
            return self.recorded
        power = float(np.mean(self.estimated**2))
        if self.term is None or not power:
            return float("nan")
        return 1.0 - float(np.mean((self.estimated - self.term) ** 2)) / power


def compare_effects(r: Refinement) -> list[EffectComparison]:
    """Return a comparison for each claimed effect; without a claim, for an unexplained residual."""
    claim, base = r.verdict.claimed, r.attribution.base
    if claim is None:
        return [_draw_residual(r)] if r.verdict.name == "unexplained" else []
    pictures = []
    for candidate in claim.candidates:
        without = base.fit
        if len(claim.candidates) > 1:  # the other candidates stay, so that only this term is missing
            neutral = {n: r.problem.values[n] for n in candidate.parameters}
            without = replace(base.fit, values={**claim.fit.values, **neutral})
        picture = _reading if candidate.kind == "sensor" else _term
        compared = picture(r.study.subject, r.problem, candidate, without, claim.fit)
        pictures.append(replace(compared, horizon=_finite_horizon(r.study.subject)))
    return pictures


def _finite_horizon(subject: Subject) -> float:
    """Return the horizon of the replays [s], 0 for a whole run."""
    return subject.horizon if math.isfinite(subject.horizon) else 0.0


def _term(subject: Subject, problem: Problem, c: Candidate, without: Fit, with_it: Fit) -> EffectComparison:
    """Compare an effect's term in the equations with the acceleration that the model lacks.

    The comparison is for the equation whose term is largest relative to the uncertainty.
    """
    parts, _, sigma = smooth_logs(problem, without)
    terms = np.vstack([contributions(problem, without, with_it, k) for k, _ in parts])
    column = int(np.argmax(np.sqrt(np.mean(terms**2, axis=0)) / np.median(sigma, axis=0)))
    against = choose(regressors(subject, problem, parts), subject.drawn_against.get(c.name, ()), terms[:, column])
    picture = _picture(subject, parts, column, against)
    return replace(picture, effect=c.name, kind=c.kind, term=terms[:, column])


def _draw_residual(r: Refinement) -> EffectComparison:
    """Compare the missing acceleration beside the best hypothesis with the most promising unnamed term."""
    subject, problem, best = r.study.subject, r.problem, r.attribution.best.fit
    parts, value, sigma = smooth_unknown_inputs(problem, best)
    residual, equations = r.verdict.misfit, parts[0][1].equations
    column = int(np.argmax(value.std(axis=0) / np.median(sigma, axis=0)))
    if residual.get("equation") in equations:
        column = equations.index(residual["equation"])
    first = next(iter(residual.get("terms", ())), None)
    regression = unnamed_term(subject, problem, parts, first) if first else None
    if first is None or regression is None:
        return _picture(subject, parts, column, choose(regressors(subject, problem, parts), (), value[:, column]))
    term = scale_to_missing(problem, best, column, regression[1], value[:, column])
    picture = _picture(subject, parts, column, regression[0])
    return replace(picture, effect=first["signal"], term=term, recorded=residual.get("share"))


def _picture(subject: Subject, parts: Smoothed, column: int, against: Regressor) -> EffectComparison:
    """Return the comparison of an equation without a term."""
    where, logs = parts[0][1].equations[column], [m for _, m in parts]
    unit = _rate_unit(next((q.unit for q in subject.states if q.name == where), ""))
    first = len(logs[0].time)
    step = float(np.median(np.diff(logs[0].time))) if first > 1 else 1.0
    time = np.concatenate([m.time for m in logs])
    value, sigma = (np.concatenate([getattr(m, of)[:, column] for m in logs]) for of in ("value", "sigma"))
    return EffectComparison("", "nameless", where, unit, against, time, value, sigma, None, first, step)


def _rate_unit(unit: str) -> str:
    return {"m/s": "m/s2", "rad/s": "rad/s2"}.get(unit, f"{unit}/s")


def _reading(subject: Subject, problem: Problem, c: Candidate, without: Fit, with_it: Fit) -> EffectComparison:
    """Compare estimated and claimed error of a sensor.

    The comparison is for the output with the largest error. The horizontal axis is the output itself for a linear
    error, the rate of the output for late and lagging readings, otherwise the signal with the largest explained share.
    """
    kind = next(k for k in subject.sensors if k.name == c.name)
    parts = [_readings(problem, c, with_it, index, kind) for index in smoothed_logs(problem)]
    first = len(parts[0][0])
    time, clean, wrong, y, rate = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    names = problem.layout.outputs
    sizes = np.sqrt(np.nanmean((wrong - clean) ** 2, axis=0) / problem.r)
    channel = max((names.index(n) for n in kind.affected() if n in names), key=lambda k: sizes[k])
    rows = np.isfinite(y[:, channel]) & np.isfinite(wrong[:, channel])
    unit = {q.name: q.unit for q in subject.outputs}
    outputs = {
        n: Regressor(f"{n} as the refined model says it is", unit[n], clean[rows, k]) for k, n in enumerate(names)
    }
    name, missing, term = names[channel], (y - clean)[rows, channel], (wrong - clean)[rows, channel]
    if kind.depends_on_past():
        against = Regressor(f"rate of {name}, by the refined model", _rate_unit(unit[name]), rate[rows, channel])
    elif kind.is_straight():
        against = outputs[name]
    else:
        signals = {"time": Regressor("time", "s", time[rows]), **outputs}
        against = choose(signals, subject.drawn_against.get(c.name, ()), term)
    sigma = np.full(len(term), float(np.sqrt(problem.r[channel])))
    count, step = int(rows[:first].sum()), problem.logs[0].step
    return EffectComparison(c.name, "sensor", name, unit[name], against, time[rows], missing, sigma, term, count, step)


def _readings(problem: Problem, c: Candidate, with_it: Fit, index: int, kind: type[Any]) -> tuple[Array, ...]:
    """Return all measured outputs of a log, along the filtered states of the refined model.

    Returns:
        Time, outputs without and with the sensor error, readings, and rates of the outputs.
    """
    data = problem.logs[index]
    run = problem.run({**problem.values, **with_it.values}, loosen_noise(problem, with_it.noise), index, states=True)
    without = Steps(problem, index, {**with_it.values, **{n: problem.values[n] for n in c.parameters}})
    with_error = Steps(problem, index, with_it.values)
    count = min(len(data.u), MOST_ROWS) - 1
    clean, wrong = (s.outputs_along(run, count) for s in (without, with_error))
    times = data.times[:count]
    if kind.depends_on_past():
        sensor = kind(value=with_it.values[c.parameters[0]])
        wrong = np.column_stack([past_reading(sensor, times, column) for column in clean.T])
    rate = np.gradient(clean, data.step, axis=0)
    scored = slice(min(count_unscored(data), count - 1), count)
    return tuple(rows[scored] for rows in (times, clean, wrong, data.y[:count], rate))
