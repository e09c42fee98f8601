"""The page of a fit: what it improved, the figure that shows it, parameters, identifiability, errors."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import Any

from cosim.blocks.compiling import permission
from cosim.calibration.fit_record import Outcome, ParameterEntry, Record, StartEntry
from cosim.calibration.replay_proof import Part
from cosim.core.text import MISSING, amount, counted, display, join_names, percent, plain, size, split_sentence
from cosim.core.version import __version__
from cosim.report.charts import Charts, Plot
from cosim.report.html_tables import Badge, Row
from cosim.report.panels import Panel, Trace
from cosim.report.template import render
from cosim.residuals.replay_sentences import horizon_name
from cosim.residuals.residual_statistics import FREE_RUN

TEMPLATE = Path(__file__).with_name("templates") / "fit.html.j2"
TONES = {"improved": "good", "worse": "bad"}
MOST_OUTPUTS = 8  # with a chart
STRONG = 0.95  # correlation of two estimates that is worth a word


def page(outcome: Outcome, record: Record) -> str:
    """Return a self-contained page."""
    charts = Charts()
    headline, details = split_sentence(record.sentence)
    part, estimate = outcome.decisive, outcome.estimate
    verdict, tone = str(record.verdict), TONES.get(record.verdict, "plain")
    if verdict == "improved" and not estimate.settled:  # no success yet
        verdict, tone = "improved, not settled", "warn"
    badges = [
        Badge(verdict, tone),
        Badge(counted(len(record.logs), "log")),
        Badge(counted(len(record.sealed), "sealed log")),
        Badge(counted(record.simulations, "simulation")),
    ]
    if record.warnings:
        badges.append(Badge(counted(len(record.warnings), "warning"), "warn"))
    starts = [
        {"name": s.name, "log": Path(s.log).name, "value": amount(s.value, s.unit, 4), "interval": _range(s)}
        for s in record.starts
    ]
    names, matrix = [n for n, p in record.parameters.items() if p.status != "held"], record.correlation or []
    rows = [(n, [plain(v, 2) for v in row]) for n, row in zip(names, matrix, strict=False)]
    strong = [
        f"{names[i]} and {names[j]} ({plain(matrix[i][j], 2)})"
        for i in range(len(matrix))
        for j in range(i)
        if abs(matrix[i][j]) > STRONG
    ]
    screening = [
        {
            "name": c.name,
            "effect": MISSING if c.effect is None else f"{plain(c.effect, 2)} σ",
            "verdict": "estimated" if c.estimated else "left",
            "why": c.reason,
        }
        for c in record.screening
    ]
    units = {n: u for d in estimate.logs.drives for n, u in d.log.units.items()}
    noise = [
        {
            "name": n,
            "sigma": size(entry.sigma, units[n]),
            "colour": MISSING if entry.colour is None else plain(entry.colour, 2),
        }
        for n, entry in record.noise.items()
    ]
    way = "free runs" if record.windows is None else f"windows of {record.windows:g} s: {record.windows_reason}"
    failed = f", {record.failed_simulations} failed" if record.failed_simulations else ""
    provenance = [
        Row("FMU", record.fmu),
        Row("Logs of the estimate", "\n".join(record.logs)),
        Row("Sealed logs", "\n".join(record.sealed) or "none"),
        Row("Method", f"output-error maximum likelihood, {way}"),
        Row("Effort", f"{counted(record.simulations, 'simulation')} of a whole log{failed}, {plain(record.seconds)} s"),
        Row("cosim", __version__),
    ]
    return render(
        TEMPLATE,
        {
            "name": f"Fit of {outcome.fmu.name}",
            "headline": headline,
            "details": details,
            "tone": tone,
            "badges": badges,
            "warnings": [*record.warnings, *record.notes],
            "plots": [] if part is None else _plots(part, charts),
            "log": "" if part is None else part.after[-1].log.path.name,
            "is_sealed": part is not None and part.sealed,
            "horizon": "" if part is None else horizon_name(part.horizon),
            "parameters": [_parameter(n, p) for n, p in record.parameters.items()],
            "starts": starts,
            "correlation": {"columns": names, "rows": rows} if len(matrix) > 1 else None,
            "strong": join_names(strong),
            "singular": [plain(v) for v in record.singular_values],
            "combinations": [c.sentence for c in estimate.combinations],
            "errors": _errors(record),
            "screening": screening,
            "noise": noise,
            "repeat": shlex.join(_repeat(outcome, record)),
            "provenance": provenance,
            "data": charts.data(),  # after all drawings
            "version": __version__,
        },
    )


def _plots(part: Part, charts: Charts) -> list[Plot]:
    """Draw measured, before and after on the last log, the most improved output first."""
    old, new = part.before[-1], part.after[-1]
    log, errors = new.log, part.errors(part.horizon)
    ratios = {n: b / a if a > 0.0 and math.isfinite(b / a) else 1.0 for n, (a, b) in errors.items()}
    names = sorted((n for n in log.outputs if n in ratios), key=lambda n: ratios[n])[:MOST_OUTPUTS]
    drawing = charts.over(log.time)
    panels = []
    for name in names:
        unit, factor = display(log.units[name])
        curves = (
            ("measured", log.outputs[name], "estimate"),
            ("before", old.replays[part.horizon].outputs[name], "s1"),
            ("after", new.replays[part.horizon].outputs[name], "true"),
        )
        panels.append(Panel(name, unit or "1", [Trace(label, v * factor, style) for label, v, style in curves]))
    return drawing.plots(panels)


def _parameter(name: str, p: ParameterEntry) -> dict[str, Any]:
    """Return a table row: values, and their places on a ruler about value, start and interval."""
    points = [p.start, p.value, *(p.ci95 or ())]
    low, high = min(points), max(points)
    margin = 0.1 * (high - low) or 0.1 * abs(p.value) or 1.0

    def place(value: float) -> float:
        return float(round(100.0 * (value - low + margin) / (high - low + 2.0 * margin), 2))

    notes = {"estimated": "", "at_bound": "at its bound", "held": "held at its start"}
    bounds = MISSING
    if p.tolerance is not None:
        bounds = f"± {amount(p.tolerance, p.unit, 2)}, prior"
    elif p.low is not None or p.high is not None:
        ends = ["" if end is None else plain(display(p.unit)[1] * end) for end in (p.low, p.high)]
        bounds = f"{ends[0] or '−∞'} … {ends[1] or '∞'}"
    return {
        "name": name,
        "start": amount(p.start, p.unit, 4),
        "value": amount(p.value, p.unit, 5),
        "interval": _range(p),
        "bounds": bounds,
        "note": notes[p.status] or ("not identifiable alone" if p.ci95 is None else ""),
        "at": place(p.value),
        "old": place(p.start),
        "span": p.ci95 and (place(p.ci95[0]), round(place(p.ci95[1]) - place(p.ci95[0]), 2)),
    }


def _range(entry: ParameterEntry | StartEntry) -> str:
    """Return a confidence interval with as many digits as its width deserves."""
    if entry.ci95 is None:
        return MISSING
    low, high = entry.ci95
    symbol, factor = display(entry.unit)
    half, centre = 0.5 * (high - low), 0.5 * abs(high + low)
    digits = 2 + max(0, math.ceil(math.log10(centre / half))) if half > 0.0 and centre > half else 3
    ends = " … ".join(plain(end * factor, min(digits, 8)) for end in (low, high))
    return f"{ends} {symbol}".strip()


def _errors(record: Record) -> list[dict[str, Any]]:
    """Return an error table for each set of logs."""
    titles, tables = {"estimation": "Logs of the estimate", "sealed": "Sealed logs"}, []
    for part, errors in record.errors.items():
        horizon = horizon_name(FREE_RUN if errors.horizon is None else errors.horizon)
        rows = []
        for name, c in errors.channels.items():
            sizes = [MISSING if v is None else size(v, c.unit) for v in (c.before, c.after, c.noise_floor)]
            left = MISSING if c.excess_left is None else percent(max(0.0, c.excess_left))
            rows.append({"name": name, "before": sizes[0], "after": sizes[1], "floor": sizes[2], "left": left})
        tables.append({"title": f"{titles[part]}, {horizon}", "rows": rows})
    return tables


def _repeat(outcome: Outcome, record: Record) -> list[str]:
    """Return the command that repeats the fit."""
    words = ["cosim", "fit", *record.logs, "--fmu", record.fmu]
    for name, p in record.parameters.items():
        value = name
        if p.tolerance is not None:
            value = f"{name}={100.0 * p.tolerance / abs(p.start):g}%"
        elif p.low is not None and p.high is not None:
            value = f"{name}={p.low!r}..{p.high!r}"
        words += ["--vary", value]
    for name, given in outcome.given.items():
        words += ["--start", f"{name}={str(given).lower() if isinstance(given, bool) else given}"]
    for path in record.sealed:
        words += ["--sealed", path]
    called = {c: n for d in outcome.estimate.logs.drives for c, n in d.log.called.items()}
    words += [word for c, n in called.items() for word in ("--column", f"{c}={n}")]
    return [*words, *(["--compile"] if permission.get() else [])]
