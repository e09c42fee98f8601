"""Plots on the page of a refinement: logs, innovations, and the missing input with the claimed term of each effect."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.core.text import MISSING, counted, display, displayed, finer, percent, plain, shown_unit
from cosim.core.units import unit_of_rate
from cosim.estimation.data import count_unscored, past_reading
from cosim.estimation.fit import Fit
from cosim.estimation.kernel.generate import READING
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import Candidate
from cosim.estimation.subject.interface import Subject
from cosim.logs.log import NORMAL_95
from cosim.refinement.proof.measure import Part, ReplayedLogs
from cosim.refinement.refinement import Refinement
from cosim.refinement.search.missing import (
    MOST_ROWS,
    MissingInput,
    contributions,
    loosen_noise,
    outputs_along,
    smooth_logs,
    smoothed_logs,
)
from cosim.refinement.search.unnamed import Shape, Signals, signal_units, signals_of, values_of
from cosim.report.charts import Abscissa, Charts, Drawing, Plot
from cosim.report.panels import Band, Panel, Trace, extent
from cosim.residuals.report import neighbours
from cosim.residuals.residual_statistics import lags_of, rmse, whiteness

TIMES = " · "  # between the signals of a product


def runs(r: Refinement, charts: Charts, leading: str) -> list[dict[str, Any]]:
    """Return title, channels and plots of the first sealed and estimation log, the leading channel first."""
    pages = []
    words: dict[Part, str] = {"validation": "sealed", "estimation": "used for the fits"}
    for part, word in words.items():
        before, after = (r.evidence[v].get(part) for v in ("before", "after"))
        if not before or not after:
            continue
        log, old = before[0]
        curves = [("model", "true", after)]
        if r.verdict.claimed:
            curves = [("before", "s1", before), ("refined", "true", after)]
        elif r.verdict.nearest and (near := r.evidence.get("nearest", {}).get(part)):
            curves = [("model", "s1", before), ("nearest", "true", near)]
        drawing = charts.over(log.time, Abscissa(breaks=sorted(old.starts)))
        names = sorted(log.outputs, key=lambda name: name != leading)
        plots = [plot for name in names for plot in _channel(drawing, curves, name)]
        pages.append({"title": f"{log.path.name}, {word}", "channels": ", ".join(names), "plots": plots})
    return pages


def _channel(drawing: Drawing, curves: Sequence[tuple[str, str, ReplayedLogs]], name: str) -> list[Plot]:
    """Draw a channel of a log: measurement with model, and residual.

    The model's output is the reading minus its error, and includes sensor errors in the model.

    Args:
        curves: Label, style and replays of each model.
    """
    log, old = curves[0][2][0]
    errors = [(label, style, e[0][1].errors(e[0][0])[name]) for label, style, e in curves]
    unit, reading = log.units.get(name, ""), log.outputs[name]
    fine, scale = finer(unit, max(rmse(e) for _, _, e in errors))
    whole = [Trace("measured", displayed(reading, unit), "estimate")]
    whole += [Trace(label, displayed(reading - e, unit), style, anew=True) for label, style, e in errors]
    residuals = [Trace(label, e * scale, style, anew=True) for label, style, e in errors]
    panels = [Panel(name, shown_unit(unit) or "1", whole), Panel(f"{name}: measured − model", fine or "1", residuals)]
    starts, inside, shaded = sorted(old.starts), np.zeros(log.time.size, dtype=bool), []
    for k in starts[::2]:
        inside |= (log.time >= log.time[k]) & (log.time <= log.time[k] + old.horizon)
    for panel in panels:
        span = extent([trace.values for trace in panel.traces])
        if span is not None and len(starts) > 1:
            panel = replace(panel, band=Band("every other replay", *(np.where(inside, end, np.nan) for end in span)))
        shaded.append(panel)
    return drawing.plots(shaded)


def innovations(r: Refinement, charts: Charts) -> list[dict[str, Any]]:
    """Return statistics and plots of the normalised innovations of each channel.

    Without a claim, the filter of the fit is compared with a filter that trusts its equations.
    """
    after, problem = r.variants["after"], r.problem
    pairs = [(after, replace(after.noise, power=problem.noise.smallest)), (after, after.noise)]
    if r.verdict.claimed:
        pairs[0] = (r.variants["before"], after.noise)
    both = []
    for variant, noise in pairs:
        parts = []
        for k, data in enumerate(problem.logs):
            run = problem.run(variant.values, noise, k, states=False)
            first = min(count_unscored(data), max(0, len(run.errors) - 2))
            scaled = (run.errors / np.sqrt(run.variances))[first:]
            parts.append(np.where(np.isfinite(scaled), scaled, np.nan))
        both.append(parts)
    names, styles, step = modes(r), ("s1", "true"), problem.logs[0].step
    drawing = charts.over(problem.logs[0].times[-len(both[0][0]) :])
    lags = lags_of(min(len(part) for part in both[0]), step)
    over_lags = charts.over(step * np.arange(1.0, lags + 1.0), Abscissa(("lag", "s")))
    gap = np.full(lags + 1, np.nan)  # beyond any lag, between logs
    found = []
    for channel in dict.fromkeys(n for log in r.study.logs for n in log.outputs if n in problem.layout.outputs):
        column = problem.layout.outputs.index(channel)
        series = [[part[:, column] for part in parts] for parts in both]
        tests = [whiteness(np.concatenate([piece for part in s for piece in (part, gap)]), lags) for s in series]
        traces = [Trace(n, s[0], style) for n, s, style in zip(names, series, styles, strict=True)]
        edge = np.full(series[0][0].size, NORMAL_95)
        panel = Panel(f"Innovation of {channel}", "σ", traces, Band("95 % of what is expected", -edge, edge))
        rho = [Trace(name, test.rho[1:], style) for name, test, style in zip(names, tests, styles, strict=True)]
        width = np.full(lags, np.nan_to_num(tests[1].band))
        beside = Panel(f"Autocorrelation of {channel}", "1", rho, Band("95 % band if white", -width, width))
        row = {
            "channel": channel,
            "size": [plain(rmse(np.concatenate(s)), 2) for s in series],
            "neighbours": [neighbours(t) for t in tests],
            "white": [MISSING if np.isnan(t.p_value) else "yes" if t.white else "no" for t in tests],
            "plots": [drawing.plots([panel])[0], over_lags.plots([beside])[0]],
        }
        found.append(row)
    return found


def modes(r: Refinement) -> tuple[str, str]:
    """Return the labels of the compared models, or of the compared filters without a claim."""
    return ("before", "refined") if r.verdict.claimed else ("equations trusted", "disturbance estimated")


class Regressor(NamedTuple):
    """A signal as horizontal axis of a missing derivative, with the rows of some logs in sequence."""

    name: str
    unit: str
    values: Array


@dataclass(frozen=True, eq=False)
class EffectComparison:
    """A missing quantity, estimated from the logs, and the claimed term.

    Attributes:
        where: State or channel of the missing quantity.
        unit: Unit of the missing quantity.
        estimated: Estimate without the claim, row by row; `sigma`: its standard deviation.
        term: Claimed value; None without a claim.
        first: Number of rows of the first log.
        fitted_share: Mean square share explained by the term in a fit; None for that of the estimate.
    """

    effect: str
    kind: str
    where: str
    unit: str
    against: Regressor
    time: Array
    estimated: Array
    sigma: Array
    first: int
    term: Array | None = None
    fitted_share: float | None = None

    @property
    def quantity(self) -> str:
        """Return the missing quantity in words."""
        return f"error of {self.where}" if self.kind == "sensor" else f"missing derivative of {self.where}"

    @property
    def share(self) -> float:
        """Return the mean square share explained by the term."""
        return _explained(self.estimated, self.term) if self.fitted_share is None else self.fitted_share


def _explained(values: Array, term: Array | None) -> float:
    """Return the share of a mean square that a term explains, at least 0; NaN without a term."""
    power = float(np.mean(values**2))
    return max(0.0, 1.0 - float(np.mean((values - term) ** 2)) / power) if term is not None and power else math.nan


def _like(values: Array, term: Array) -> Array:
    """Return a term scaled to the least mean square distance from values, or 0 for one of the other sign."""
    power = float(term @ term)
    return np.asarray(term * max(0.0, float(values @ term) / power if power else 0.0))


def compare_effects(r: Refinement) -> list[EffectComparison]:
    """Return a comparison for each claimed effect; without a claim, for an unexplained residual."""
    claim, problem = r.verdict.claimed, r.problem
    if claim is None:
        return [_compare_residual(r)] if r.verdict.name == "unexplained" else []
    compared = []
    for c in claim.candidates:
        if c.kind == "sensor":
            compared.append(_compare_sensor(r.study.subject, problem, c, claim.fit))
            continue
        without = r.verdict.base.fit
        if len(claim.candidates) > 1:  # the other candidates stay, so that only this term is missing
            neutral = {n: problem.values[n] for n in c.parameters}
            without = replace(without, values={**claim.fit.values, **neutral})
        compared.append(_compare_term(r.study.subject, problem, c, without, claim.fit))
    return compared


def _compare_term(subject: Subject, problem: Problem, c: Candidate, without: Fit, with_it: Fit) -> EffectComparison:
    """Compare an effect's term with the derivative that the model lacks.

    The comparison is for the equation whose term is largest relative to the uncertainty.
    """
    missing = smooth_logs(problem, without, deviations=problem.layout.is_free_run)
    terms = np.vstack([contributions(problem, without, with_it, k) for k in range(len(missing.rows))])
    column = int(np.argmax(np.sqrt(np.mean(terms**2, axis=0)) / np.median(missing.sigma, axis=0)))
    signals, drawn = signals_of(problem, missing), subject.drawn_against.get(c.name, ())
    against, term = _choose(subject, signals, drawn, terms[:, column]), terms[:, column]
    return _of_equation(subject, missing, column, effect=c.name, kind=c.kind, against=against, term=term)


def _compare_residual(r: Refinement) -> EffectComparison:
    """Compare the missing derivative beside the best hypothesis with the most promising unnamed term."""
    subject, problem, best, residual = r.study.subject, r.problem, r.verdict.best.fit, r.verdict.residual
    missing, first = smooth_logs(problem, best), next(iter(residual["terms"]), None)
    value, equations, signals = missing.value, missing.equations, signals_of(problem, missing)
    if first and first["equation"].startswith(READING):
        return _compare_reading(subject, problem, best, missing, signals, first)
    column = int(np.argmax(value.std(axis=0) / np.median(missing.sigma, axis=0)))
    if residual["equation"] in equations:
        column = equations.index(residual["equation"])
    first = next((term for term in residual["terms"] if term["equation"] == equations[column]), None)
    basis = subject.nameless(first["signal"]) if first else None
    if first and first.get("local"):
        against, term = _local(first, signals)
    elif first and basis:
        evaluate, units = basis
        own = evaluate(*(signals[name] for name in units))
        term = first["coefficient"] * np.broadcast_to(own, signals["time"].shape)
        chosen = next(iter(units), "time")
        against = Regressor(chosen, units.get(chosen, "s"), signals[chosen])
    else:
        against = _choose(subject, signals, (), value[:, column])
        return _of_equation(subject, missing, column, effect="", kind="nameless", against=against)
    about = {"effect": first["signal"], "kind": "nameless", "fitted_share": residual["share"]}
    return _of_equation(subject, missing, column, against=against, term=_like(value[:, column], term), **about)


def _local(entry: Mapping[str, Any], signals: Signals) -> tuple[Regressor, Array]:
    """Return the signal of a local shape, and its values."""
    shape = Shape.of_entry(entry["equation"], entry["local"])
    values = shape.columns(signals) @ np.array(entry["local"]["sizes"])
    return Regressor(shape.signal, shape.unit, values_of(signals, shape.of)), values


def _compare_reading(
    subject: Subject, problem: Problem, best: Fit, missing: MissingInput, signals: Signals, entry: Mapping[str, Any]
) -> EffectComparison:
    """Compare the innovations of an output with an unnamed term of its reading."""
    name = entry["equation"].removeprefix(READING)
    runs = [problem.innovations(best.values, best.noise, k) for k in range(len(missing.rows))]
    errors, variances = (
        missing.of_logs(tables)[:, problem.layout.outputs.index(name)] for tables in zip(*runs, strict=True)
    )
    read, (against, term) = np.isfinite(errors), _local(entry, signals)
    return EffectComparison(
        f"{entry['local']['kind']} over {against.name}",
        "sensor",
        name,
        _unit_of(subject, name),
        against._replace(values=against.values[read]),
        signals["time"][read],
        errors[read],
        np.sqrt(variances[read]),
        int(missing.by_log(read)[0].sum()),
        _like(errors[read], term[read]),
    )


def _of_equation(subject: Subject, missing: MissingInput, column: int, **about: Any) -> EffectComparison:
    """Return the comparison of an equation's missing input with a term."""
    return EffectComparison(
        where=missing.equations[column],
        unit=next((unit_of_rate(q.unit) for q in subject.states if q.name == missing.equations[column]), ""),
        time=missing.time,
        estimated=missing.value[:, column],
        sigma=missing.sigma[:, column],
        first=missing.rows[0].stop - missing.rows[0].start,
        **about,
    )


def _unit_of(subject: Subject, output: str) -> str:
    return next(q.unit for q in subject.outputs if q.name == output)


def _compare_sensor(subject: Subject, problem: Problem, c: Candidate, claim: Fit) -> EffectComparison:
    """Compare estimated and claimed error of a sensor, along the filtered states of the refined model.

    The comparison is for the output with the largest error.
    """
    kind: Any = next(k for k in subject.sensors if k.name == c.name)
    names, parts, noise = problem.layout.outputs, [], loosen_noise(problem, claim.noise)
    neutral = {**claim.values, **{n: problem.values[n] for n in c.parameters}}
    for index in smoothed_logs(problem):
        data, run = problem.logs[index], problem.run(claim.values, noise, index)
        count = min(len(data.u), MOST_ROWS) - 1
        clean = outputs_along(problem, index, neutral, run, count)
        wrong, times = outputs_along(problem, index, claim.values, run, count), data.times[:count]
        if kind.depends_on_past():
            sensor = kind(value=claim.values[c.parameters[0]])
            wrong = np.column_stack([past_reading(sensor, times, column) for column in clean.T])
        rate = np.gradient(clean, data.step, axis=0)
        scored = slice(min(count_unscored(data), count - 1), count)
        parts.append([rows[scored] for rows in (times, clean, wrong, data.y[:count], rate)])
    time, clean, wrong, y, rate = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    sizes = np.sqrt(np.nanmean((wrong - clean) ** 2, axis=0) / problem.r)
    channel = max((names.index(n) for n in kind.affected() if n in names), key=lambda k: sizes[k])
    rows = np.isfinite(y[:, channel]) & np.isfinite(wrong[:, channel])
    name, term = names[channel], (wrong - clean)[rows, channel]
    signals = {"time": time[rows], **dict(zip(names, clean[rows].T, strict=True))}
    signals[f"rate of {name}"] = rate[rows, channel]
    return EffectComparison(
        c.name,
        "sensor",
        name,
        _unit_of(subject, name),
        _choose(subject, signals, subject.drawn_against.get(c.name, ()), term),
        time[rows],
        (y - clean)[rows, channel],
        np.full(len(term), float(np.sqrt(problem.r[channel]))),
        int(rows[: len(parts[0][0])].sum()),
        term,
    )


def _choose(subject: Subject, signals: Mapping[str, Array], suggested: Sequence[str], values: Array) -> Regressor:
    """Return the signal whose bins explain most of the variance of `values`; suggested signals have precedence."""
    units = signal_units(subject)
    names = [n for n in suggested if all(one in signals for one in n.split(TIMES))]
    found = []
    for name in names or [n for n in signals if n in units and n.partition(".")[0] not in subject.present]:
        parts = name.split(TIMES)
        x = np.prod([signals[one] for one in parts], axis=0)
        if units.get(name) == "rad" and np.ptp(x) > 2.0 * np.pi:  # a turning angle, wrapped into one turn
            x = np.mod(x, 2.0 * np.pi)
        found.append(Regressor(name, TIMES.join(units[one] for one in parts), x))
    return min(found, key=lambda s: sum(float(np.var(values[rows])) * rows.size for rows in _bins(s.values)))


def _bins(x: Array) -> list[Rows]:
    """Return the rows in intervals of x with √n rows each."""
    return np.array_split(np.argsort(x, kind="stable"), max(1, round(math.sqrt(x.size))))


# -- page -------------------------------------------------------------------------------------


def shown_effects(r: Refinement, charts: Charts) -> list[dict[str, Any]]:
    """Return title, sentence and plots of each comparison."""
    return [
        {
            "title": s.effect or s.where,
            "brief": s.quantity if s.term is None else f"{s.effect} explains {percent(s.share)} of the {s.quantity}",
            "sentence": f"{_sentence(s)} ({counted(s.estimated.size, 'row')} of the estimation logs).",
            "plots": _plots(s, charts),
        }
        for s in compare_effects(r)
    ]


def _sentence(s: EffectComparison) -> str:
    """Return a sentence on a term's share."""
    if s.term is None:
        return f"The {s.quantity} is drawn against {s.against.name}, which it follows most"
    if not np.any(s.term):  # the effect acts elsewhere, for example behind a sensor
        return f"{s.effect} adds nothing to the {s.quantity}: it acts on another equation"
    who = s.effect if s.kind != "nameless" else "a constant" if s.effect == "1" else f"the term in {s.effect}"
    text = f"Of the mean square {s.quantity}, {who} explains {percent(s.share)}"
    if s.kind == "sensor":
        return f"{text}; the rest is the noise of the sensor"
    estimated, term = (np.array([v[rows].mean() for rows in _bins(s.against.values)]) for v in (s.estimated, s.term))
    return f"{text} row by row, and {percent(_explained(estimated, term))} of means over {s.against.name}"


def _plots(s: EffectComparison, charts: Charts) -> list[Any]:
    """Draw the missing quantity and the claimed term: means over a signal, and the first log over time.

    Estimates of neighbouring rows are correlated, so that each pass of the signal through an interval counts once.
    """
    (unit, factor), x = display(s.unit), displayed(s.against.values, s.against.unit)
    label, title = s.effect or "unnamed term", f"{s.quantity[0].upper()}{s.quantity[1:]}"
    bins = _bins(x)
    passes = np.array([1 + np.count_nonzero(np.diff(np.sort(rows)) > 1) for rows in bins])
    places, mean = (np.array([v[rows].mean() for rows in bins]) for v in (x, s.estimated))
    variance = np.array([s.estimated[rows].var() + np.mean(s.sigma[rows] ** 2) for rows in bins])
    around = NORMAL_95 * np.sqrt(variance / passes)
    means = [
        Trace("data, with 95 %", (mean - around) * factor, "warm", x=places, upper=(mean + around) * factor),
        Trace("mean", mean * factor, "s1 dots", x=places),
    ]
    estimated, width = (factor * of[: s.first] for of in (s.estimated, 2.0 * s.sigma))
    course = [Trace("data", estimated, "estimate")]
    if s.term is not None:
        term = factor * s.term
        means.append(Trace(label, np.array([term[rows].mean() for rows in bins]), "true", x=places))
        course.append(Trace(label, term[: s.first], "true"))
    over = s.against.name, TIMES.join(display(u)[0] or u for u in s.against.unit.split(TIMES)) or "1"
    against = Panel(f"{title} against {s.against.name}", unit or "1", means)
    band = Band("±2σ", estimated - width, estimated + width)
    time = Panel(f"{title} over time", unit or "1", course, band)
    return [
        charts.alone(against, extent([x]) or (0.0, 1.0), over),
        *charts.over(s.time[: s.first]).plots([time]),
    ]
