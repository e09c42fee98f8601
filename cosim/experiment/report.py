"""The page of an excitation: its input, the expected separation of the rivals, and its limits."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.text import counted, displayed, join_names, plain, shown_unit
from cosim.core.version import __version__
from cosim.experiment.excite import MAX_RIVALS, Excitation
from cosim.experiment.question import MIN_SEPARATION
from cosim.report.charts import Charts
from cosim.report.html_tables import Badge
from cosim.report.panels import Panel, Trace, held_panels
from cosim.report.template import render

TEMPLATE = Path(__file__).with_name("templates") / "excite.html.j2"
MAX_PAIRS = 30  # pairs in the table, the least separated first
MAX_OUTPUTS = 12  # with a chart


def page(excitation: Excitation, scenario: Path) -> str:
    """Return the self-contained page of an experiment; `scenario` is the file that plays the input."""
    question, charts = excitation.question, Charts()
    seconds = float(excitation.trial.time[-1] - excitation.trial.time[0])
    model = question.loaded.model
    units = {q.name: q.unit for q in (*model.inputs, *model.outputs)}
    drawing = charts.over(excitation.trial.time)
    panels = []  # each output of the model and of its rivals with its limits; limited outputs come first
    limited = [name for name in excitation.trial.outputs if name in question.limits]
    for name in list(dict.fromkeys((*limited, *question.measured)))[:MAX_OUTPUTS]:
        unit, values = units[name], excitation.trial.outputs[name]
        traces = [Trace("model", displayed(values, unit), "true")]
        for k, (rival, trial) in enumerate(list(excitation.rivals.items())[:MAX_RIVALS]):
            other = displayed(trial.outputs[name], unit)
            traces.append(Trace(f"if {rival} is true", np.where(np.isfinite(other), other, np.nan), f"s{k}"))
        limit = question.limits.get(name)
        edges = () if limit is None else tuple(float(displayed(values[0] + x, unit)) for x in (-limit, limit))
        panels.append(Panel(name, shown_unit(unit) or "1", traces, None, edges, "limit" if edges else ""))
    separates = min(excitation.apart.values()) >= MIN_SEPARATION
    return render(
        TEMPLATE,
        {
            "excitation": excitation,
            "tone": "warn" if excitation.excess > 1.0 else "good" if separates else "bad",
            "badges": [
                Badge(f"{plain(seconds)} s"),
                Badge(counted(len(question.rivals), "rival")),
                Badge(f"measured: {join_names(question.measured)}"),
            ],
            "inputs": drawing.plots(held_panels(excitation.trial.inputs, units)),
            "needed": MIN_SEPARATION,
            "longest": max(MIN_SEPARATION, *excitation.apart.values(), *excitation.usual.values()),
            "most": MAX_PAIRS,
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
        signals = {rival: {**trial.inputs, **trial.outputs}.get(name) for rival, trial in trials.items()}
        excursions = {k: float(np.abs(v - starts.get(name, v[0])).max()) for k, v in signals.items() if v is not None}
        if excursions:
            rival = max(excursions, key=lambda k: math.inf if math.isnan(excursions[k]) else excursions[k])
            sizes = {"limit": limit, "model": excursions.get("", math.nan), "largest": excursions[rival]}
            is_within = excursions[rival] <= limit * (1.0 + 1e-9)
            rows.append({"name": name, "unit": units[name], **sizes, "rival": rival, "within": is_within})
    return rows
