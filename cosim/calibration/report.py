"""Report page of a fit: improvement, main figure, parameters, identifiability, errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from cosim.blocks.compiling import permission
from cosim.calibration.estimate import Estimate
from cosim.calibration.fit_record import LogEntry, ParameterEntry, Record
from cosim.calibration.fit_study import Request
from cosim.calibration.outcome import Part
from cosim.core.text import MISSING, counted, displayed, join_names, plain, shown_unit, split_sentence
from cosim.logs.log import NORMAL_95
from cosim.report.charts import Charts, Plot
from cosim.report.panels import Panel, Trace, signal_panel
from cosim.report.template import Row, assignments, command, places, render
from cosim.residuals.compare import horizon_name

TEMPLATE = Path(__file__).with_name("templates") / "fit.html.j2"
MOST_OUTPUTS = 8  # with a chart
STRONG = 0.95  # correlation of two estimates that is reported


def page(record: Record, request: Request, estimate: Estimate, parts: Sequence[Part]) -> str:
    """Return the self-contained HTML page of a fit."""
    charts = Charts()
    options = {"--vary": request.vary, "--start": request.start, "--sealed": record.sealed}
    options |= {"--per-log": request.per_log, "--profile": request.profile, "--column": assignments(request.columns)}
    repeat = command("cosim", "fit", *record.logs, "--fmu", record.fmu, options=options)
    headline, details = split_sentence(record.sentence)
    verdict, tone = str(record.verdict), {"improved": "good", "worse": "bad"}.get(record.verdict, "plain")
    if verdict == "improved" and not estimate.settled:  # not counted as success yet
        verdict, tone = "improved, not converged", "warn"
    counts = {"log": len(record.logs), "sealed log": len(record.sealed), "simulation": record.simulations}
    warnings = [(counted(n, noun), "warn") for noun in ("warning", "note") if (n := len(getattr(record, f"{noun}s")))]
    names, matrix = [n for n, p in record.parameters.items() if p.status != "held"], record.correlation or []
    strong = [
        f"{names[i]} and {names[j]} ({plain(matrix[i][j], 2)})"
        for i, j in combinations(range(len(matrix)), 2)
        if abs(matrix[i][j]) > STRONG
    ]
    way = "free runs" if record.windows is None else f"windows of {record.windows:g} s: {record.windows_reason}"
    failed = f", {record.failed_simulations} failed" if record.failed_simulations else ""
    proof, panels = parts[-1] if parts else None, list[Panel]()
    if proof is not None:  # measured, before and after on the last log, the most improved output first
        log, channels = proof.log, proof.errors.channels.items()
        ratios = {n: 1.0 if c.after is None or not c.before else c.after / c.before for n, c in channels}
        for name in sorted((n for n in log.outputs if n in ratios), key=lambda n: ratios[n])[:MOST_OUTPUTS]:
            lines = ("measured", log.outputs[name], "estimate"), ("before", proof.before[name], "s1")
            panels.append(signal_panel(name, log.units[name], [*lines, ("after", proof.after[name], "true")]))
    values = {
        "name": f"Fit of {Path(record.fmu).name}",
        "headline": headline,
        "details": details,
        "tone": tone,
        "badges": [(verdict, tone), *(counted(count, noun) for noun, count in counts.items()), *warnings],
        "record": record,
        "plots": charts.over(proof.log.time).plots(panels) if proof else [],
        "profiles": [
            _profile_plot(n, p, charts) for n, p in record.parameters.items() if p.profile and p.profile.values[1:]
        ],
        "proof": proof,
        "parameters": [(n, p, _places(p)) for n, p in record.parameters.items()],
        "names": names,
        "correlation": [(n, [plain(v, 2) for v in row]) for n, row in zip(names, matrix, strict=False)],
        "strong": join_names(strong),
        "units": {n: u for d in estimate.logs.drives for n, u in d.log.units.items()},
        **{f.__name__: f for f in (displayed, horizon_name, interval, number, Path)},
        "repeat": f"{repeat} --compile" if permission.get() else repeat,
        "provenance": [
            Row("FMU", record.fmu),
            Row("Logs of the estimate", "\n".join(record.logs)),
            Row("Sealed logs", "\n".join(record.sealed) or "none"),
            Row("Method", f"output-error maximum likelihood, {way}"),
            Row(
                "Effort",
                f"{counted(record.simulations, 'simulation')} of a whole log{failed}, {plain(record.seconds)} s",
            ),
        ],
    }
    return render(TEMPLATE, values, charts)


def number(value: float | None) -> float:
    """Convert None to NaN."""
    return math.nan if value is None else value


def _places(p: ParameterEntry) -> dict[str, float]:
    low, high = p.ci95 or (math.nan, math.nan)
    return places(dot=p.value, neutral=p.start, low=low, high=high)


def _profile_plot(name: str, p: ParameterEntry, charts: Charts) -> Plot:
    """Draw the deviance over a parameter, with the 95 % limit."""
    assert p.profile is not None
    values, deviance = displayed(np.array(p.profile.values), p.unit), np.array(p.profile.deviance)
    ends = float(values[0]), float(values[-1])
    curve = Trace("deviance", deviance, "true", x=values)
    points = Trace("fits", deviance, "s0 dots", x=values)
    level = Trace("95 %", np.full(2, NORMAL_95**2), "reference", x=np.array(ends))
    return charts.alone(Panel(f"Profile of {name}", "1", [curve, points, level]), ends, (name, shown_unit(p.unit)))


def interval(entry: ParameterEntry | LogEntry) -> str:
    """Return a confidence interval as text; its width determines the number of digits."""
    if entry.ci95 is None:
        return MISSING
    low, high = (displayed(end, entry.unit) for end in entry.ci95)
    half, centre = 0.5 * (high - low), 0.5 * abs(high + low)
    digits = 2 + max(0, math.ceil(math.log10(centre / half))) if half > 0.0 and centre > half else 3
    ends = " … ".join(plain(end, min(digits, 8)) for end in (low, high))
    return f"{ends} {shown_unit(entry.unit)}".strip()
