"""Missing input and claimed term of each effect, as evidence for or against a verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cosim.base.arrays import Array
from cosim.estimation.data import unscored
from cosim.estimation.problem import Problem
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.dependence import Regressor, choose, nameless, regressors
from cosim.refinement.search.hypotheses import Hypothesis
from cosim.refinement.search.missing import (
    MOST_ROWS,
    Filter,
    Smoothed,
    Steps,
    at_best,
    claimed,
    loosened,
    smoothed,
    smoothed_logs,
)
from cosim.subject.candidates import Candidate
from cosim.subject.interface import Subject

VARIES = 0.2  # least standard deviation of a term for a correlation, relative to its RMS


@dataclass(frozen=True, eq=False)
class Shown:
    """A missing quantity and the claimed term.

    what, unit: missing quantity; where: its state or channel
    estimated, sigma: estimate from the data without the claim, row by row
    term:       claimed value, None without a claim
    first:      number of rows of the first log
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

    @property
    def what(self) -> str:
        """Return the missing quantity in words: `acceleration missing from speed`."""
        if self.kind == "sensor":
            return f"error of {self.where}"
        return f"{'acceleration' if self.unit in {'m/s2', 'rad/s2'} else 'rate'} missing from {self.where}"

    @property
    def correlation(self) -> float:
        """Return the correlation of estimate and term."""
        if self.term is None or not np.std(self.estimated):
            return float("nan")
        varies = np.std(self.term) > VARIES * np.sqrt(np.mean(self.term**2))
        return float(np.corrcoef(self.estimated, self.term)[0, 1]) if varies else float("nan")

    @property
    def share(self) -> float:
        """Return the share of mean square explained."""
        if self.recorded is not None:
            return self.recorded
        power = float(np.mean(self.estimated**2))
        if self.term is None or not power:
            return float("nan")
        return 1.0 - float(np.mean((self.estimated - self.term) ** 2)) / power


def shown(r: Refinement) -> list[Shown]:
    """Compare each claimed term, or the remainder, with data."""
    claim, base = r.verdict.claimed, r.attribution.base
    if claim is None:
        return [_draw_residual(r)] if r.verdict.name == "unexplained" else []
    pictures = []
    for candidate in claim.candidates:
        with_it = Filter(claim.fit.values, claim.fit.noise)
        without = Filter(base.fit.values, base.fit.noise)
        if len(claim.candidates) > 1:  # the other candidates stay, so that only this term is missing
            without = Filter(_without(claim, candidate, r.problem.values), base.fit.noise)
        picture = _reading if candidate.kind == "sensor" else _term
        pictures.append(picture(r.study.subject, r.problem, candidate, without, with_it))
    return pictures


def _without(claim: Hypothesis, candidate: Candidate, neutral: Mapping[str, float]) -> dict[str, float]:
    """Return the claim's values with one candidate at neutral."""
    return {**claim.fit.values, **{n: neutral[n] for n in candidate.parameters}}


def _term(subject: Subject, problem: Problem, c: Candidate, without: Filter, with_it: Filter) -> Shown:
    """Compare a term with the missing acceleration.

    The comparison is in the equation with the largest term, relative to its uncertainty.
    """
    parts, _, sigma = smoothed(problem, without)
    terms = np.vstack([claimed(problem, without, with_it, k) for k, _ in parts])
    column = int(np.argmax(np.sqrt(np.mean(terms**2, axis=0)) / np.median(sigma, axis=0)))
    against = choose(regressors(subject, problem, parts), subject.drawn_against.get(c.name, ()), terms[:, column])
    picture = _picture(subject, parts, column, against)
    return replace(picture, effect=c.name, kind=c.kind, term=terms[:, column])


def _draw_residual(r: Refinement) -> Shown:
    """Compare the best hypothesis' remainder with the most promising unnamed term."""
    subject, problem, best = r.study.subject, r.problem, r.attribution.best.fit
    parts, value, sigma = smoothed(problem, Filter(best.values, best.noise))
    residual, equations = r.verdict.residual, parts[0][1].equations
    column = int(np.argmax(value.std(axis=0) / np.median(sigma, axis=0)))
    if residual.get("equation") in equations:
        column = equations.index(residual["equation"])
    first = next(iter(residual.get("terms", ())), None)
    drawn = nameless(subject, problem, parts, first) if first else None
    if first is None or drawn is None:
        return _picture(subject, parts, column, choose(regressors(subject, problem, parts), (), value[:, column]))
    term = at_best(problem, best, column, drawn[1], value[:, column])
    picture = _picture(subject, parts, column, drawn[0])
    return replace(picture, effect=first["signal"], term=term, recorded=residual.get("share"))


def _picture(subject: Subject, parts: Smoothed, column: int, against: Regressor) -> Shown:
    """Return the missing input of one equation."""
    where, logs = parts[0][1].equations[column], [m for _, m in parts]
    unit = _per_second(next((q.unit for q in subject.states if q.name == where), ""))
    first = len(logs[0].time)
    step = float(np.median(np.diff(logs[0].time))) if first > 1 else 1.0
    time = np.concatenate([m.time for m in logs])
    value, sigma = (np.concatenate([getattr(m, of)[:, column] for m in logs]) for of in ("value", "sigma"))
    return Shown("", "nameless", where, unit, against, time, value, sigma, None, first, step)


def _per_second(unit: str) -> str:
    return {"m/s": "m/s2", "rad/s": "rad/s2"}.get(unit, f"{unit}/s")


def _reading(subject: Subject, problem: Problem, c: Candidate, without: Filter, with_it: Filter) -> Shown:
    """Compare estimated and claimed error of a sensor.

    The error is shown for the output with the largest error: against the output itself if a straight line describes the
    error, against the output's rate for late readings, otherwise against the signal with the largest explained share.
    """
    kind = next(k for k in subject.sensors if k.name == c.name)
    parts = [_sensed(problem, c, with_it, index, late=kind.late) for index in smoothed_logs(problem)]
    first = len(parts[0].time)
    time = np.concatenate([p.time for p in parts])
    there, read, y, rate = (np.vstack([getattr(p, n) for p in parts]) for n in ("there", "read", "y", "rate"))
    names = problem.layout.outputs
    sizes = np.sqrt(np.nanmean((read - there) ** 2, axis=0) / problem.r)
    channel = max((names.index(n) for n in kind.affected() if n in names), key=lambda k: sizes[k])
    rows = np.isfinite(y[:, channel]) & np.isfinite(read[:, channel])
    unit = {q.name: q.unit for q in subject.outputs}
    said = {n: Regressor(f"{n} as the refined model says it is", unit[n], there[rows, k]) for k, n in enumerate(names)}
    name, missed, term = names[channel], (y - there)[rows, channel], (read - there)[rows, channel]
    if kind.late:
        against = Regressor(f"rate of {name}, by the refined model", _per_second(unit[name]), rate[rows, channel])
    elif kind.is_straight():
        against = said[name]
    else:
        known = {"time": Regressor("time", "s", time[rows]), **said}
        against = choose(known, subject.drawn_against.get(c.name, ()), term)
    sigma = np.full(len(term), float(np.sqrt(problem.r[channel])))
    count, step = int(rows[:first].sum()), problem.logs[0].step
    return Shown(c.name, "sensor", name, unit[name], against, time[rows], missed, sigma, term, count, step)


@dataclass(frozen=True, eq=False)
class _Sensed:
    """Rows of one log: outputs without and with a sensor error, readings, output rates."""

    time: Array
    there: Array
    read: Array
    y: Array
    rate: Array


def _sensed(problem: Problem, c: Candidate, with_it: Filter, index: int, *, late: bool) -> _Sensed:
    """Return every measured output along a log's refined estimate."""
    data = problem.logs[index]
    run = problem.run({**problem.values, **with_it.values}, loosened(problem, with_it.noise), index, states=True)
    clean = Steps(problem, index, {**with_it.values, **{n: problem.values[n] for n in c.parameters}})
    wrong = Steps(problem, index, with_it.values)
    count = min(len(data.u), MOST_ROWS) - 1
    there, read = (np.array([s.step(k, run.states[k], run.memory[k])[1] for k in range(count)]) for s in (clean, wrong))
    k = np.arange(count, dtype=np.float64)
    if late:  # the sensor's delay: outputs of an earlier time
        rows = with_it.values[c.parameters[0]] / data.step
        read = np.column_stack([np.interp(k - rows, k, column, left=np.nan) for column in there.T])
    rate = np.gradient(there, data.step, axis=0)
    kept = slice(min(unscored(data), count - 1), count)
    time = data.start + data.step * k
    return _Sensed(time[kept], there[kept], read[kept], data.y[:count][kept], rate[kept])
