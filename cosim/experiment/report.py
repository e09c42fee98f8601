"""The page of an excitation: its input, the expected separation of the rivals, and its limits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.text import counted, displayed, join_names, plain
from cosim.experiment.excite import MAX_RIVALS, Excitation
from cosim.experiment.question import MIN_SEPARATION
from cosim.report.charts import Charts
from cosim.report.panels import held_panels, signal_panel
from cosim.report.template import command, render

TEMPLATE = Path(__file__).with_name("templates") / "excite.html.j2"
MAX_RIVAL_PAIRS = 30  # pairs in the table, the least separated first
MAX_OUTPUTS = 12  # with a chart


def page(excitation: Excitation, scenario: Path) -> str:
    """Return the self-contained page of an experiment; `scenario` is the file that plays the input."""
    question, trial, charts = excitation.question, excitation.trial, Charts()
    model = question.loaded.model
    units = {q.name: q.unit for q in (*model.inputs, *model.outputs)}
    drawing, panels = charts.over(trial.time), []
    names = dict.fromkeys((*(name for name in trial.outputs if name in question.limits), *question.measured))
    for name in [*names][:MAX_OUTPUTS]:  # limited outputs come first
        lines = [("model", trial.outputs[name], "true")]
        for k, (rival, other) in enumerate([*excitation.rivals.items()][:MAX_RIVALS]):
            lines.append((f"if {rival} is true", other.outputs[name], f"s{k}"))
        limit = question.limits.get(name)
        ends = () if limit is None else trial.outputs[name][0] + np.array([-limit, limit])
        edges = tuple(float(displayed(end, units[name])) for end in ends)
        panels.append(signal_panel(name, units[name], lines, limits=edges, limit_label="limit" if edges else ""))
    separates = min(excitation.apart.values()) >= MIN_SEPARATION
    values = {
        "excitation": excitation,
        "tone": "warn" if excitation.excess > 1.0 else "good" if separates else "bad",
        "badges": [
            f"{plain(float(trial.time[-1] - trial.time[0]))} s",
            counted(len(question.rivals), "rival"),
            f"measured: {join_names(question.measured)}",
        ],
        "inputs": drawing.plots(held_panels(trial.inputs, units)),
        "needed": MIN_SEPARATION,
        "longest": max(MIN_SEPARATION, *excitation.apart.values(), *excitation.usual.values()),
        "most": MAX_RIVAL_PAIRS,
        "limits": _limits(excitation, units),
        "outputs": drawing.plots(panels),
        "play": command("cosim", "run", str(scenario)),
    }
    return render(TEMPLATE, values, charts)


def _limits(excitation: Excitation, units: Mapping[str, str]) -> list[Mapping[str, Any]]:
    """Return a table row for each limited signal: allowed excursion, the model's, and the largest of any rival."""
    model, trials = excitation.question.loaded.model, {"": excitation.trial, **excitation.rivals}
    starts = dict(zip((q.name for q in model.inputs), model.start_command(), strict=True))
    rows: list[Mapping[str, Any]] = []
    for name, limit in excitation.question.limits.items():
        signals = {rival: {**trial.inputs, **trial.outputs}.get(name) for rival, trial in trials.items()}
        excursions = {k: float(np.abs(v - starts.get(name, v[0])).max()) for k, v in signals.items() if v is not None}
        if excursions:
            rival = max(excursions, key=lambda k: math.inf if math.isnan(excursions[k]) else excursions[k])
            sizes = {"limit": limit, "model": excursions.get("", math.nan), "largest": excursions[rival]}
            is_within = excursions[rival] <= limit * (1.0 + 1e-9)
            rows.append({"name": name, "unit": units[name], **sizes, "rival": rival, "within": is_within})
    return rows
