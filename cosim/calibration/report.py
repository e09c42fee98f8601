"""The page of a fit: what it improved, the figure that shows it, parameters, identifiability, errors."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cosim.base.text import MISSING, amount, counted, display, join_names, percent, plain, size, split_sentence
from cosim.base.version import __version__
from cosim.blocks.compiling import permission
from cosim.calibration.fit_record import Outcome, ParameterEntry, Record, StartEntry
from cosim.calibration.replay_proof import Part
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
    part = outcome.decisive
    return render(
        TEMPLATE,
        {
            "name": f"Fit of {outcome.fmu.name}",
            "headline": headline,
            "details": details,
            "tone": _verdict(outcome, record)[1],
            "badges": _badges(outcome, record),
            "warnings": [*record.warnings, *record.notes],
            "plots": [] if part is None else _plots(part, charts),
            "log": "" if part is None else part.after[-1].log.path.name,
            "is_sealed": part is not None and part.sealed,
            "horizon": "" if part is None else horizon_name(part.horizon),
            "parameters": [_parameter(n, p) for n, p in record.parameters.items()],
            "starts": [_start(s) for s in record.starts],
            "correlation": _correlation(record),
            "strong": _strong_pairs(record),
            "singular": [plain(v) for v in record.singular_values],
            "combinations": [c.sentence for c in outcome.estimate.combinations],
            "errors": list(_errors(record)),
            "screening": [_choice(c) for c in record.screening],
            "noise": [_noise(n, record, outcome) for n in record.noise],
            "repeat": shlex.join(_repeat(outcome, record)),
            "provenance": _provenance(record),
            "data": charts.data(),  # after all drawings
            "version": __version__,
        },
    )


def _verdict(outcome: Outcome, record: Record) -> tuple[str, str]:
    """Return the verdict as a short text, and its tone; an improvement by an unsettled estimate is no success yet."""
    if record.verdict == "improved" and not outcome.estimate.settled:
        return "improved, not settled", "warn"
    return record.verdict, TONES.get(record.verdict, "plain")


def _badges(outcome: Outcome, record: Record) -> list[Badge]:
    badges = [
        Badge(*_verdict(outcome, record)),
        Badge(counted(len(record.logs), "log")),
        Badge(counted(len(record.sealed), "sealed log")),
        Badge(counted(record.simulations, "simulation")),
    ]
    return badges + ([Badge(counted(len(record.warnings), "warning"), "warn")] if record.warnings else [])


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
    span = None if p.ci95 is None else (place(p.ci95[0]), round(place(p.ci95[1]) - place(p.ci95[0]), 2))
    return {
        "name": name,
        "start": amount(p.start, p.unit, 4),
        "value": amount(p.value, p.unit, 5),
        "interval": MISSING if p.ci95 is None else _range(p.ci95, p.unit),
        "bounds": _bounds(p),
        "note": notes[p.status] or ("not identifiable alone" if p.ci95 is None else ""),
        "at": place(p.value),
        "old": place(p.start),
        "span": span,
    }


def _bounds(p: ParameterEntry) -> str:
    if p.tolerance is not None:
        return f"± {amount(p.tolerance, p.unit, 2)}, prior"
    if p.low is None and p.high is None:
        return MISSING
    ends = ["" if end is None else plain(display(p.unit)[1] * end) for end in (p.low, p.high)]
    return f"{ends[0] or '−∞'} … {ends[1] or '∞'}"


def _range(interval: tuple[float, float], unit: str) -> str:
    symbol, factor = display(unit)
    half = 0.5 * (interval[1] - interval[0])
    centre = 0.5 * abs(interval[1] + interval[0])
    digits = 2 + max(0, math.ceil(math.log10(centre / half))) if half > 0.0 and centre > half else 3
    ends = " … ".join(plain(end * factor, min(digits, 8)) for end in interval)
    return f"{ends} {symbol}".strip()


def _start(s: StartEntry) -> dict[str, str]:
    interval = MISSING if s.ci95 is None else _range(s.ci95, s.unit)
    return {"name": s.name, "log": Path(s.log).name, "value": amount(s.value, s.unit, 4), "interval": interval}


def _estimated(record: Record) -> list[str]:
    return [n for n, p in record.parameters.items() if p.status != "held"]


def _correlation(record: Record) -> dict[str, Any] | None:
    if record.correlation is None or len(record.correlation) < 2:
        return None
    names = _estimated(record)
    rows = [(n, [plain(v, 2) for v in row]) for n, row in zip(names, record.correlation, strict=True)]
    return {"columns": names, "rows": rows}


def _strong_pairs(record: Record) -> str:
    names, matrix = _estimated(record), record.correlation or []
    pairs = [
        f"{names[i]} and {names[j]} ({plain(matrix[i][j], 2)})"
        for i in range(len(matrix))
        for j in range(i)
        if abs(matrix[i][j]) > STRONG
    ]
    return join_names(pairs)


def _errors(record: Record) -> Iterator[dict[str, Any]]:
    """Yield an error table for each set of logs."""
    titles = {"estimation": "Logs of the estimate", "sealed": "Sealed logs"}
    for part, errors in record.errors.items():
        horizon = horizon_name(FREE_RUN if errors.horizon is None else errors.horizon)
        rows = []
        for name, c in errors.channels.items():
            sizes = [MISSING if v is None else size(v, c.unit) for v in (c.before, c.after, c.noise_floor)]
            left = MISSING if c.excess_left is None else percent(max(0.0, c.excess_left))
            rows.append({"name": name, "before": sizes[0], "after": sizes[1], "floor": sizes[2], "left": left})
        yield {"title": f"{titles[part]}, {horizon}", "rows": rows}


def _choice(choice: Any) -> dict[str, str]:
    effect = MISSING if choice.effect is None else f"{plain(choice.effect, 2)} σ"
    return {
        "name": choice.name,
        "effect": effect,
        "verdict": "estimated" if choice.estimated else "left",
        "why": choice.reason,
    }


def _noise(name: str, record: Record, outcome: Outcome) -> dict[str, str]:
    units: Mapping[str, str] = {n: u for d in outcome.estimate.logs.drives for n, u in d.log.units.items()}
    noise = record.noise[name]
    colour = MISSING if noise.colour is None else plain(noise.colour, 2)
    return {"name": name, "sigma": size(noise.sigma, units[name]), "colour": colour}


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


def _provenance(record: Record) -> list[Row]:
    way = "free runs" if record.windows is None else f"windows of {record.windows:g} s: {record.windows_reason}"
    failed = f", {record.failed_simulations} failed" if record.failed_simulations else ""
    return [
        Row("FMU", record.fmu),
        Row("Logs of the estimate", "\n".join(record.logs)),
        Row("Sealed logs", "\n".join(record.sealed) or "none"),
        Row("Method", f"output-error maximum likelihood, {way}"),
        Row("Effort", f"{counted(record.simulations, 'simulation')} of a whole log{failed}, {plain(record.seconds)} s"),
        Row("cosim", __version__),
    ]
