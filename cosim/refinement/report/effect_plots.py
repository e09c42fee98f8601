"""Comparison of the missing input with the claimed term of each effect."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.core.text import counted, display, percent, plain
from cosim.estimation.data import count_unscored
from cosim.estimation.fit import Fit
from cosim.estimation.past_readings import past_reading
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import Candidate
from cosim.estimation.subject.interface import Subject
from cosim.logs.channel_noise import NORMAL_95
from cosim.logs.log import slowness
from cosim.refinement.refinement import Refinement
from cosim.refinement.search.missing import (
    MOST_ROWS,
    Smoothed,
    Steps,
    contributions,
    loosen_noise,
    smooth_logs,
    smooth_unknown_inputs,
    smoothed_logs,
)
from cosim.refinement.search.shapes import Shape, signals_of, values_of
from cosim.report.charts import Charts
from cosim.report.panels import Band, Panel, Trace, extent

VARIES = 0.2  # least standard deviation of a term for a correlation, relative to its RMS
BINS = 12
DOTS, FINE = 24, 80  # points with an error bar, and points of the claimed curve
LEAST = 0.6  # [s] least duration of the rows of an error bar
MEMORIES = 0.3  # [s] between independent rows of an error bar: twice the smoother's memory
CLOSE_UP = 12.0  # [s] duration of a close-up
MAX_FAST_SHARE = 0.5  # share of a missing quantity row by row; below it, means are compared
RATE_UNITS = {"m/s": "m/s2", "rad/s": "rad/s2"}


class Regressor(NamedTuple):
    """A signal as horizontal axis of a missing acceleration, with the rows of some logs in sequence."""

    name: str
    unit: str
    values: Array


@dataclass(frozen=True, eq=False)
class EffectComparison:
    """A missing quantity, estimated from the logs, and the claimed term.

    where:            state or channel of the missing quantity; `unit`: its unit
    estimated, sigma: estimate without the claim and its standard deviation, row by row
    term:             claimed value, None without a claim
    first:            number of rows of the first log
    recorded:         share in refine.json
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
    recorded: float | None = None

    @property
    def quantity(self) -> str:
        """Return the missing quantity in words: `missing acceleration of speed`."""
        if self.kind == "sensor":
            return f"error of {self.where}"
        return f"missing {'acceleration' if self.unit in RATE_UNITS.values() else 'rate'} of {self.where}"

    @property
    def correlation(self) -> float:
        """Return the correlation of estimate and term; NaN for a term that hardly varies."""
        if self.term is None or not np.std(self.estimated):
            return math.nan
        varies = np.std(self.term) > VARIES * np.sqrt(np.mean(self.term**2))
        return float(np.corrcoef(self.estimated, self.term)[0, 1]) if varies else math.nan

    @property
    def share(self) -> float:
        """Return the mean square share explained by the term."""
        if self.recorded is not None:
            return self.recorded
        power = float(np.mean(self.estimated**2))
        if self.term is None or not power:
            return math.nan
        return 1.0 - float(np.mean((self.estimated - self.term) ** 2)) / power


def compare_effects(r: Refinement) -> list[EffectComparison]:
    """Return a comparison for each claimed effect; without a claim, for an unexplained residual."""
    claim, base = r.verdict.claimed, r.verdict.base
    if claim is None:
        return [_compare_residual(r)] if r.verdict.name == "unexplained" else []
    compared = []
    for candidate in claim.candidates:
        without = base.fit
        if len(claim.candidates) > 1:  # the other candidates stay, so that only this term is missing
            neutral = {n: r.problem.values[n] for n in candidate.parameters}
            without = replace(base.fit, values={**claim.fit.values, **neutral})
        if candidate.kind == "sensor":
            compared.append(_compare_sensor(r.study.subject, r.problem, candidate, claim.fit))
        else:
            compared.append(_compare_term(r.study.subject, r.problem, candidate, without, claim.fit))
    return compared


def _compare_term(subject: Subject, problem: Problem, c: Candidate, without: Fit, with_it: Fit) -> EffectComparison:
    """Compare an effect's term in the equations with the acceleration that the model lacks.

    The comparison is for the equation whose term is largest relative to the uncertainty.
    """
    parts, _, sigma = smooth_logs(problem, without)
    terms = np.vstack([contributions(problem, without, with_it, k) for k, _ in parts])
    column = int(np.argmax(np.sqrt(np.mean(terms**2, axis=0)) / np.median(sigma, axis=0)))
    against = _choose(_regressors(subject, problem, parts), subject.drawn_against.get(c.name, ()), terms[:, column])
    return _of_equation(subject, parts, column, against, effect=c.name, kind=c.kind, term=terms[:, column])


def _compare_residual(r: Refinement) -> EffectComparison:
    """Compare the missing acceleration beside the best hypothesis with the most promising unnamed term."""
    subject, problem, best, residual = r.study.subject, r.problem, r.verdict.best.fit, r.verdict.residual
    parts, value, sigma = smooth_unknown_inputs(problem, best)
    equations, signals = parts[0][1].equations, signals_of(problem, parts)
    column = int(np.argmax(value.std(axis=0) / np.median(sigma, axis=0)))
    if residual.get("equation") in equations:
        column = equations.index(residual["equation"])
    for first in residual.get("terms", ())[:1]:
        if local := first.get("local"):
            shape = Shape.of_entry(first["equation"], local)
            term = shape.columns(signals) @ np.array(local["sizes"])
            against = Regressor(shape.signal, shape.unit, values_of(signals, shape.of))
        elif basis := subject.nameless(first["signal"]):
            evaluate, units = basis
            values = np.broadcast_to(evaluate(*(signals[name] for name in units)), signals["time"].shape)
            term, chosen = first["coefficient"] * values, next(iter(units), "time")
            against = Regressor(chosen, units.get(chosen, "s"), signals[chosen])
        else:
            break
        power = float(term @ term)
        term = term * max(0.0, float(value[:, column] @ term) / power if power else 0.0)
        share, effect = residual.get("share"), first["signal"]
        return _of_equation(subject, parts, column, against, effect=effect, term=term, recorded=share)
    return _of_equation(subject, parts, column, _choose(_regressors(subject, problem, parts), (), value[:, column]))


def _of_equation(subject: Subject, parts: Smoothed, column: int, against: Regressor, **more: Any) -> EffectComparison:
    """Return the comparison of an equation's missing input with a term."""
    where, logs = parts[0][1].equations[column], [m for _, m in parts]
    unit = next((q.unit for q in subject.states if q.name == where), "")
    first = len(logs[0].time)
    step = float(np.median(np.diff(logs[0].time))) if first > 1 else 1.0
    time = np.concatenate([m.time for m in logs])
    value, sigma = (np.concatenate([getattr(m, of)[:, column] for m in logs]) for of in ("value", "sigma"))
    rate_unit = RATE_UNITS.get(unit, f"{unit}/s")
    named = {"effect": "", "kind": "nameless", "term": None, **more}
    return EffectComparison(
        where=where,
        unit=rate_unit,
        against=against,
        time=time,
        estimated=value,
        sigma=sigma,
        first=first,
        step=step,
        **named,
    )


def _compare_sensor(subject: Subject, problem: Problem, c: Candidate, with_it: Fit) -> EffectComparison:
    """Compare estimated and claimed error of a sensor, along the filtered states of the refined model.

    The comparison is for the output with the largest error. The horizontal axis is the output itself for a linear
    error, the rate of the output for late and lagging readings, otherwise the signal with the largest explained share.
    """
    kind: Any = next(k for k in subject.sensors if k.name == c.name)
    names, parts = problem.layout.outputs, []
    for index in smoothed_logs(problem):
        data, noise = problem.logs[index], loosen_noise(problem, with_it.noise)
        run = problem.run({**problem.values, **with_it.values}, noise, index, states=True)
        count = min(len(data.u), MOST_ROWS) - 1
        neutral = {n: problem.values[n] for n in c.parameters}
        clean = Steps(problem, index, {**with_it.values, **neutral}).outputs_along(run, count)
        wrong, times = Steps(problem, index, with_it.values).outputs_along(run, count), data.times[:count]
        if kind.depends_on_past():
            sensor = kind(value=with_it.values[c.parameters[0]])
            wrong = np.column_stack([past_reading(sensor, times, column) for column in clean.T])
        rate = np.gradient(clean, data.step, axis=0)
        scored = slice(min(count_unscored(data), count - 1), count)
        parts.append([rows[scored] for rows in (times, clean, wrong, data.y[:count], rate)])
    time, clean, wrong, y, rate = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    sizes = np.sqrt(np.nanmean((wrong - clean) ** 2, axis=0) / problem.r)
    channel = max((names.index(n) for n in kind.affected() if n in names), key=lambda k: sizes[k])
    rows = np.isfinite(y[:, channel]) & np.isfinite(wrong[:, channel])
    unit = {q.name: q.unit for q in subject.outputs}
    name, missing, term = names[channel], (y - clean)[rows, channel], (wrong - clean)[rows, channel]
    outputs = {
        n: Regressor(f"{n} as the refined model says it is", unit[n], clean[rows, k]) for k, n in enumerate(names)
    }
    if kind.depends_on_past():
        rate_unit = RATE_UNITS.get(unit[name], f"{unit[name]}/s")
        against = Regressor(f"rate of {name}, by the refined model", rate_unit, rate[rows, channel])
    elif kind.is_straight():
        against = outputs[name]
    else:
        signals = {"time": Regressor("time", "s", time[rows]), **outputs}
        against = _choose(signals, subject.drawn_against.get(c.name, ()), term)
    sigma = np.full(len(term), float(np.sqrt(problem.r[channel])))
    count, step = int(rows[: len(parts[0][0])].sum()), problem.logs[0].step
    return EffectComparison(c.name, "sensor", name, unit[name], against, time[rows], missing, sigma, term, count, step)


# -- signals ----------------------------------------------------------------------------------


def _regressors(subject: Subject, problem: Problem, parts: Smoothed) -> dict[str, Regressor]:
    """Return name → signal as possible horizontal axis.

    Commands that vary include their rates, and the means and half differences of two with equal units.
    """
    signals, found = signals_of(problem, parts), []
    for q in subject.states:
        if q.name in problem.layout.uncertain and q.name.partition(".")[0] not in subject.present:
            values = signals[q.name]
            turns = q.unit == "rad" and np.ptp(values) > 2.0 * np.pi  # wrapped into one turn
            found.append(Regressor(q.name, q.unit, np.mod(values, 2.0 * np.pi) if turns else values))
    found.insert(0, Regressor("time", "s", signals["time"]))
    for a, b in combinations([s for s in found if s.unit in RATE_UNITS], 2):
        if a.unit != b.unit:
            found.append(Regressor(f"{b.name} · {a.name}", f"{b.unit} · {a.unit}", a.values * b.values))
    logs = [(problem.logs[index], m.rows(problem.logs[index])) for index, m in parts]
    u = np.vstack([data.u[rows] for data, rows in logs])
    du = np.vstack([np.gradient(data.u, data.step, axis=0)[rows] for data, rows in logs])
    varying = [(q, u[:, k], du[:, k]) for k, q in enumerate(subject.inputs) if np.ptp(u[:, k]) > 0]
    commands = [(f"command {q.name}", q.unit, v, dv) for q, v, dv in varying]
    for (one, v, dv), (other, w, dw) in combinations(varying, 2):
        for word, sign in (("mean", 0.5), ("half difference", -0.5)) if one.unit == other.unit else ():
            name = f"{word} of commands {one.name}, {other.name}"
            commands.append((name, one.unit, 0.5 * v + sign * w, 0.5 * dv + sign * dw))
    found += [Regressor(name, unit, v) for name, unit, v, _ in commands]
    found += [Regressor(f"rate of {name}", f"{unit}/s", dv) for name, unit, _, dv in commands]
    return {s.name: s for s in found}


def _bins(x: Array, count: int, least: int = 1) -> list[Rows]:
    """Return the rows in equal intervals of x.

    Intervals with fewer than `least` rows are joined with their neighbours.
    """
    low, high = float(x.min()), float(x.max())
    places = np.minimum((count * (x - low) / (high - low or 1.0)).astype(int), count - 1)
    joined: list[Rows] = []
    waiting = np.zeros(0, dtype=np.intp)
    for k in range(count):
        waiting = np.concatenate((waiting, np.flatnonzero(places == k)))
        if waiting.size >= least:
            joined.append(waiting)
            waiting = waiting[:0]
    if waiting.size:  # too few rows at the end for a separate bin
        joined[-1:] = [np.concatenate((*joined[-1:], waiting))]
    return joined


def _choose(signals: Mapping[str, Regressor], suggested: Sequence[str], values: Array) -> Regressor:
    """Return the signal whose bins explain most of the variance of `values`; suggested signals have precedence."""

    def explained(name: str) -> float:
        good = np.isfinite(values) & np.isfinite(signals[name].values)
        v, x = values[good], signals[name].values[good]
        total = float(v.var()) if v.size else 0.0
        if total == 0.0 or np.ptp(x) == 0.0:
            return 0.0
        within = sum(float(v[rows].var()) * rows.size for rows in _bins(x, BINS))
        return 1.0 - within / (total * v.size)

    names = [n for n in suggested if n in signals] or [n for n in signals if " · " not in n]
    return signals[max(names, key=explained)]


# -- page -------------------------------------------------------------------------------------


def shown_effects(r: Refinement, charts: Charts) -> list[dict[str, Any]]:
    """Return title, sentence and plots of each comparison."""
    horizon = r.study.subject.horizon
    average = horizon if r.verdict.claimed and math.isfinite(horizon) else 0.0
    return [
        {
            "title": s.effect or s.where,
            "sentence": f"{_sentence(s)} ({counted(s.estimated.size, 'row')} of the estimation logs).",
            "against": charts.alone(*_against_signal(s)),
            "time": _over_time(s, charts, average),
        }
        for s in compare_effects(r)
    ]


def _sentence(s: EffectComparison) -> str:
    """Return a sentence on a term's share and correlation."""
    quantity = s.quantity
    if s.term is None:
        return f"The {quantity} is drawn against {s.against.name}, which it follows most"
    if not np.any(s.term):  # the effect acts elsewhere, for example behind a sensor
        return f"{s.effect} adds nothing to the {quantity}: it acts on another equation"
    who = s.effect if s.kind != "nameless" else "a constant" if s.effect == "1" else f"the term in {s.effect}"
    share = min(1.0, max(0.0, s.share))
    if share < MAX_FAST_SHARE and s.kind != "sensor":
        groups = _bins(s.against.values, BINS)
        sizes = np.array([rows.size for rows in groups])
        mean, term = (np.array([v[rows].mean() for rows in groups]) for v in (s.estimated, s.term))
        power = float(sizes @ mean**2)
        of_means = max(0.0, 1.0 - float(sizes @ (mean - term) ** 2) / power) if power else 0.0
        if of_means > share:
            text = f"Averaged over intervals of {s.against.name}, the {quantity} is explained by {who} to "
            text += f"{percent(of_means)}; row by row to {percent(share)}, since most of it changes from row to row"
            return text
    text = f"Of the mean square {quantity}, {who} explains {percent(share)}"
    if s.kind == "sensor":
        return f"{text}; the rest is the noise of the sensor"
    if math.isfinite(correlation := s.correlation):
        text += f"; row by row the two correlate by {plain(correlation, 3)}"
    return text


def _against_signal(s: EffectComparison) -> tuple[Panel, tuple[float, float], tuple[str, str]]:
    """Draw the means of the missing quantity over a signal, and the claimed term."""
    unit, factor = display(s.unit)
    x, slow = s.against.values * display(s.against.unit)[1], slowness(s.step)
    least = max(1, min(round(LEAST * slow / s.step), x.size // DOTS))
    alike = 1.0 if s.kind == "sensor" else max(1.0, MEMORIES * slow / s.step)  # rows with correlated errors
    at, means, widths = [], [], []
    for rows in _bins(x, DOTS, least):
        signal, y = s.against.values[rows], s.estimated[rows]
        spread, scatter = float(signal.var()), float(y.var())
        if spread:  # A linear trend does not count as scatter.
            scatter -= float(np.mean((signal - signal.mean()) * (y - y.mean()))) ** 2 / spread
        variance = (np.mean(s.sigma[rows] ** 2) + max(0.0, scatter)) / max(1.0, rows.size / alike)
        at.append(x[rows].mean())
        means.append(y.mean())
        widths.append(NORMAL_95 * float(np.sqrt(variance)))
    places, mean, around = np.array(at), np.array(means), np.array(widths)
    traces = [
        Trace("data, with 95 %", (mean - around) * factor, "warm", x=places, upper=(mean + around) * factor),
        Trace("mean", mean * factor, "s1 dots", x=places),
    ]
    if s.term is not None:
        groups = _bins(x, FINE, max(1, least // 5))
        places, term = (np.array([v[g].mean() for g in groups]) for v in (x, s.term))
        traces.append(Trace(s.effect or "unnamed term", term * factor, "true", x=places))
    title = f"{s.quantity[0].upper()}{s.quantity[1:]} against {s.against.name}"
    over = s.against.name, " · ".join(display(u)[0] or u for u in s.against.unit.split(" · ")) or "1"
    return Panel(title, unit or "1", traces), extent([x]) or (0.0, 1.0), over


def _over_time(s: EffectComparison, charts: Charts, mean_over: float) -> Any:
    """Draw a part of the first log over time, at the largest variation.

    Args:
        mean_over: Duration [s] of the mean that is drawn where most changes from row to row; 0 for none.
    """
    unit, factor = display(s.unit)
    count = max(2, min(s.first, round(CLOSE_UP * slowness(s.step) / s.step)))
    signal = (s.estimated if s.term is None else s.term)[: s.first]
    power = np.convolve((signal - signal.mean()) ** 2, np.ones(count), "valid")
    first = int(np.argmax(power)) if power.size else 0
    rows = slice(first, first + count)
    estimated, width = s.estimated[rows] * factor, 2.0 * s.sigma[rows] * factor
    band: Band | None = Band("±2σ", estimated - width, estimated + width)
    label, average = "data", min(round(mean_over / s.step), count // 10)
    if s.share < MAX_FAST_SHARE and average > 1:
        estimated = np.convolve(s.estimated[: s.first], np.ones(average) / average, "same")[rows] * factor
        label, band = f"data, mean over {average * s.step:.3g}\u00a0s", None
    traces = [Trace(label, estimated, "estimate")]
    if s.term is not None:
        traces.append(Trace(s.effect or "unnamed term", s.term[rows] * factor, "true"))
    panel = Panel(f"{s.quantity[0].upper()}{s.quantity[1:]} over time", unit or "1", traces, band)
    return charts.over(s.time[rows]).plots([panel])[0]
