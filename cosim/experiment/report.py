"""The page of an excitation: its input, the expected separation of the rivals, and its limits."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.text import counted, display, joined, plain
from cosim.base.version import __version__
from cosim.experiment.chosen_input import SEPARATED, Excitation
from cosim.experiment.separation import Pair
from cosim.report.drawing import Charts, Drawing
from cosim.report.html_tables import Badge
from cosim.report.panels import Panel, Trace, by_unit
from cosim.report.svg import Plot
from cosim.report.template import render

TEMPLATE = Path(__file__).with_name("templates") / "excite.html.j2"
MOST_PAIRS = 30  # in the table, the least separated first
MOST_OUTPUTS = 12  # with a chart
MOST_RIVALS = 4  # drawn beside the model
NAMED = 8  # rivals in a badge


def page(found: Excitation, scenario: Path) -> str:
    """Return a self-contained page; scenario: file with the input."""
    question, charts = found.question, Charts()
    seconds = float(found.trial.time[-1] - found.trial.time[0])
    outputs = _outputs(found)
    drawing = charts.over(found.trial.time, len(found.trial.inputs) + len(outputs) * (1 + MOST_RIVALS))
    pairs = found.hardest_first
    largest = max([SEPARATED, *(d for of in (found.apart, found.usual) for d in of.values() if math.isfinite(d))])
    return render(
        TEMPLATE,
        {
            "name": f"Excitation of {question.loaded.model.title}",
            "outcome": found.headline,
            "tone": "good" if min(found.apart.values()) >= SEPARATED else "bad",
            "badges": [
                Badge(f"{plain(seconds)} s"),
                Badge(counted(len(question.rivals), "rival")),
                Badge(f"measured: {', '.join(question.measured[:NAMED])}{', …' if question.measured[NAMED:] else ''}"),
            ],
            "warning": found.warning,
            "inputs": drawing.plots(_input_panels(found)),
            "needed": plain(SEPARATED, None),
            "mark": round(100.0 * SEPARATED / largest, 2),
            "usual": found.rig.usual,
            "pairs": [_pair(found, pair, largest) for pair in pairs[:MOST_PAIRS]],
            "more_pairs": max(0, len(pairs) - MOST_PAIRS),
            "limits": _limits(found),
            "outputs": _output_plots(found, outputs, drawing),
            "play": shlex.join(["cosim", "run", str(scenario)]),
            "data": charts.data(),  # after all drawings
            "version": __version__,
        },
    )


def _units(found: Excitation) -> Mapping[str, str]:
    model = found.question.loaded.model
    return {q.name: q.unit for q in (*model.inputs, *model.outputs)}


def _input_panels(found: Excitation) -> list[Panel]:
    """Return the inputs, grouped by unit."""
    inputs, units = found.trial.inputs, _units(found)
    panels = []
    for unit, names in by_unit(inputs, units.__getitem__, inputs.__getitem__):
        shown, factor = display(unit)
        traces = [Trace(n, inputs[n] * factor, f"s{k}", held=True) for k, n in enumerate(names)]
        panels.append(Panel(", ".join(names), shown or "1", traces))
    return panels


def _outputs(found: Excitation) -> list[str]:
    """Return the outputs with a chart: first limited, then measured outputs."""
    question, outputs = found.question, found.trial.outputs
    limited = [name for name in outputs if name in question.limits]
    return list(dict.fromkeys((*limited, *question.measured)))[:MOST_OUTPUTS]


def _output_plots(found: Excitation, names: list[str], drawing: Drawing) -> list[Plot]:
    """Draw the outputs of model and rivals, with limits."""
    rivals, units = list(found.rivals.items())[:MOST_RIVALS], _units(found)
    panels = []
    for name in names:
        shown, factor = display(units[name])
        values = found.trial.outputs[name] * factor
        traces = [Trace("model", values, "true")]
        for k, (rival, trial) in enumerate(rivals):
            other = trial.outputs[name] * factor
            traces.append(Trace(f"if {rival} is true", np.where(np.isfinite(other), other, np.nan), f"s{k}"))
        limit = found.question.limits.get(name)
        edges = () if limit is None else (float(values[0] - limit * factor), float(values[0] + limit * factor))
        panels.append(Panel(name, shown or "1", traces, None, edges, "limit" if edges else ""))
    return drawing.plots(panels)


def _pair(found: Excitation, pair: Pair, largest: float) -> Mapping[str, Any]:
    apart, usual = found.apart[pair], found.usual[pair]
    width, old = (round(100.0 * min(1.0, d / largest), 2) if math.isfinite(d) else 100.0 for d in (apart, usual))
    return {
        "pair": f"{pair[0]} and {pair[1]}",
        "apart": plain(apart, 2),
        "usual": plain(usual, 2),
        "width": width,
        "old": old,
        "separated": apart >= SEPARATED,
    }


def _limits(found: Excitation) -> list[Mapping[str, Any]]:
    """Return allowed, model's and largest excursion of each limited signal."""
    model, units, trials = found.question.loaded.model, _units(found), {"": found.trial, **found.rivals}
    starts = dict(zip((q.name for q in model.inputs), model.start_command(), strict=True))
    rows: list[Mapping[str, Any]] = []
    for name, limit in found.question.limits.items():
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
                "limit": joined(f"±{plain(limit * factor, 3)}", unit),
                "model": joined(plain(excursions.get("", math.nan) * factor, 3), unit),
                "largest": joined(plain(excursions[rival] * factor, 3), unit) + (f" ({rival})" if rival else ""),
                "kept": excursions[rival] <= limit * (1.0 + 1e-9),
            }
        )
    return rows
