"""The page of an excitation: its input, the expected separation of the rivals, and its limits."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.text import append_unit, counted, display, displayed, join_names, plain, shown_unit
from cosim.core.version import __version__
from cosim.experiment.excite import MAX_RIVALS, Excitation
from cosim.experiment.separation import MIN_SEPARATION
from cosim.report.charts import Charts
from cosim.report.html_tables import Badge
from cosim.report.panels import Panel, Trace, held_panels
from cosim.report.template import render

TEMPLATE = Path(__file__).with_name("templates") / "excite.html.j2"
MAX_PAIRS = 30  # in the table, the least separated first
MAX_OUTPUTS = 12  # with a chart


def page(excitation: Excitation, scenario: Path) -> str:
    """Return the self-contained page of an experiment; `scenario` is the file that plays the input."""
    question, charts = excitation.question, Charts()
    seconds = float(excitation.trial.time[-1] - excitation.trial.time[0])
    model = question.loaded.model
    units = {q.name: q.unit for q in (*model.inputs, *model.outputs)}
    drawing = charts.over(excitation.trial.time)
    pairs, names = excitation.hardest_first, question.measured
    largest = max(
        [MIN_SEPARATION, *(d for of in (excitation.apart, excitation.usual) for d in of.values() if math.isfinite(d))]
    )
    panels = []  # each output of the model and of its rivals with its limits: limited outputs first
    limited = [name for name in excitation.trial.outputs if name in question.limits]
    for name in list(dict.fromkeys((*limited, *names)))[:MAX_OUTPUTS]:
        unit, values = units[name], excitation.trial.outputs[name]
        traces = [Trace("model", displayed(values, unit), "true")]
        for k, (rival, trial) in enumerate(list(excitation.rivals.items())[:MAX_RIVALS]):
            other = displayed(trial.outputs[name], unit)
            traces.append(Trace(f"if {rival} is true", np.where(np.isfinite(other), other, np.nan), f"s{k}"))
        limit = question.limits.get(name)
        edges = () if limit is None else tuple(float(displayed(values[0] + x, unit)) for x in (-limit, limit))
        panels.append(Panel(name, shown_unit(unit) or "1", traces, None, edges, "limit" if edges else ""))
    separates, rows = min(excitation.apart.values()) >= MIN_SEPARATION, []
    for pair in pairs[:MAX_PAIRS]:
        distances = excitation.apart[pair], excitation.usual[pair]
        widths = [round(100.0 * min(1.0, d / largest), 2) if math.isfinite(d) else 100.0 for d in distances]
        row = {"pair": f"{pair[0]} and {pair[1]}", "apart": plain(distances[0], 2), "usual": plain(distances[1], 2)}
        rows.append({**row, "width": widths[0], "old": widths[1], "separated": distances[0] >= MIN_SEPARATION})
    return render(
        TEMPLATE,
        {
            "name": f"Excitation of {question.loaded.model.title}",
            "outcome": excitation.headline,
            "tone": "warn" if excitation.excess > 1.0 else "good" if separates else "bad",
            "badges": [
                Badge(f"{plain(seconds)} s"),
                Badge(counted(len(question.rivals), "rival")),
                Badge(f"measured: {join_names(names)}"),
            ],
            "cautions": excitation.warnings,
            "inputs": drawing.plots(held_panels(excitation.trial.inputs, units)),
            "needed": plain(MIN_SEPARATION, None),
            "mark": round(100.0 * MIN_SEPARATION / largest, 2),
            "usual": excitation.rig.usual,
            "pairs": rows,
            "more_pairs": max(0, len(pairs) - MAX_PAIRS),
            "limits": _limits(excitation, units),
            "outputs": drawing.plots(panels),
            "play": shlex.join(["cosim", "run", str(scenario)]),
            "data": charts.data(),  # after all drawings
            "version": __version__,
        },
    )


def _limits(excitation: Excitation, units: Mapping[str, str]) -> list[Mapping[str, Any]]:
    """Return a table row for each limited signal: allowed excursion, the model's, and the largest of any rival."""
    model, trials = excitation.question.loaded.model, {"": excitation.trial, **excitation.rivals}
    starts = dict(zip((q.name for q in model.inputs), model.start_command(), strict=True))
    rows: list[Mapping[str, Any]] = []
    for name, limit in excitation.question.limits.items():
        excursions = {}
        for rival, trial in trials.items():
            values = {**trial.inputs, **trial.outputs}.get(name)
            if values is not None:
                excursions[rival] = float(np.abs(values - starts.get(name, values[0])).max())
        if not excursions:
            continue
        unit, factor = display(units[name])
        rival = max(excursions, key=lambda k: math.inf if math.isnan(excursions[k]) else excursions[k])
        rows.append(
            {
                "name": name,
                "limit": append_unit(f"±{plain(limit * factor, 3)}", unit),
                "model": append_unit(plain(excursions.get("", math.nan) * factor, 3), unit),
                "largest": append_unit(plain(excursions[rival] * factor, 3), unit) + (f" ({rival})" if rival else ""),
                "within": excursions[rival] <= limit * (1.0 + 1e-9),
            }
        )
    return rows
