"""Results for tables: errors on held-out rows, measured and model outputs over the inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.text import counted, display, finer
from cosim.base.units import factor
from cosim.logs.log import Log
from cosim.model.quantities import Quantity
from cosim.refinement.proof.measure import Evidence
from cosim.refinement.record import Part
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.error_tables import error_size, units
from cosim.report.charts import Abscissa, Charts, Plot
from cosim.report.html_tables import Grid
from cosim.report.panels import Panel, Trace
from cosim.residuals.residual_statistics import rmse

INPUTS = 4  # at most, as x axes of a residual
WORDS: Mapping[Part, str] = {"estimation": "used for the fits", "validation": "sealed"}
Axis = tuple[str, str, Array]  # input, displayed unit and values in it
COLUMNS = {"before": "Before", "recalibrated": "Recalibrated", "after": "Refined", "nearest": "Nearest"}


@dataclass(frozen=True)
class TablePlots:
    """Plots of a table: title, and outputs over the inputs."""

    title: str
    plots: tuple[Plot, ...]


def table_parts(r: Refinement, charts: Charts) -> Mapping[str, Any]:
    """Return the template's values for tables, empty for logs over time."""
    if not r.problem.table:
        return {"left_out": None, "tables_drawn": []}
    return {"left_out": held_out_table(r), "tables_drawn": draw_tables(r, charts)}


def held_out_table(r: Refinement) -> Grid:
    """Return the table of errors on held-out rows; without a claim, the refined model is omitted."""
    errors = r.record["error"]["left_out"]
    models = [k for k in COLUMNS if errors.get(k) and (k != "after" or r.verdict.claimed)]
    rows = []
    for name, unit in ((n, units(r)[n]) for n in errors["before"]):
        smallest = min(errors[k][name] for k in models)
        rows.append((name, *(error_size(errors[k][name], unit, smallest) for k in models)))
    return Grid("Rows left out", tuple(COLUMNS[k] for k in models), tuple(rows))


def draw_tables(r: Refinement, charts: Charts) -> list[TablePlots]:
    """Draw every table: estimation tables, then sealed tables."""
    tables = []
    for part, word in WORDS.items():
        for k, (log, _) in enumerate(r.evidence["before"].get(part, ())):
            of = {name: r.evidence[name][part][k : k + 1] for name in ("before", "after")}
            title = f"{log.path.name}, {word}: {counted(log.rows, 'row')}"
            plots = [p for name in log.outputs for p in _plots(r, charts, of, name)]
            tables.append(TablePlots(title, tuple(plots)))
    return tables


def _plots(r: Refinement, charts: Charts, of: Mapping[str, Evidence], name: str) -> list[Plot]:
    """Draw an output and its residual over the inputs.

    The output is drawn over the first varying input, the residual over each.
    """
    log = of["before"][0][0]
    models = [("before", "s1 solid", "before"), ("refined", "true", "after")]
    models = models if r.verdict.claimed else [("model", "true", "after")]
    errors = {label: (style, of[which][0][1].errors(of[which][0][0])[name]) for label, style, which in models}
    # readings are drawn, including the errors of sensors in the model
    reading = log.outputs[name]
    varied = [q for q in r.study.subject.inputs if np.ptp(log.inputs[q.name]) > 0.0][:INPUTS]
    unit, times = display(log.units[name])
    fine, scale = finer(log.units[name], max(rmse(e) for _, e in errors.values()))
    plots: list[Plot] = []
    for q in varied or r.study.subject.inputs[:1]:
        axis, alone = (q.name, *_unit_and_values(log, q)), len(varied) < 2
        if not plots:
            whole = [("measured", "estimate dots", reading)]
            whole += [(n, style, reading - e) for n, (style, e) in errors.items()]
            curves = [(n, s, v * times) for n, s, v in whole]
            plots.append(_draw_over_input(charts, name, unit, axis, curves, alone))
        residuals = [(n, f"{style} dots", e * scale) for n, (style, e) in errors.items()]
        plots.append(_draw_over_input(charts, f"{name}: measured − model", fine, axis, residuals, alone))
    return plots


def _unit_and_values(log: Log, q: Quantity) -> tuple[str, Array]:
    """Return the displayed unit of an input, and its values in this unit."""
    unit, scale = display(q.unit)
    written = log.written.get(q.name)
    if written and (ratio := factor(written, q.unit or log.units[q.name])):
        unit, scale = written, 1.0 / ratio
    return unit or "1", log.inputs[q.name] * scale


def _draw_over_input(
    charts: Charts, title: str, unit: str, axis: Axis, traces: Sequence[tuple[str, str, Array]], alone: bool
) -> Plot:
    """Draw rows over an input: dots, or lines for a single varying input."""
    name, axis_unit, values_over = axis
    order = np.argsort(values_over, kind="stable")
    places = values_over[order]
    panel = [
        Trace(label, values[order], style if alone or "dots" in style else f"{style} dots")
        for label, style, values in traces
    ]
    low, high = float(places.min()), float(places.max())
    room = 0.03 * (high - low) or 0.1 * abs(high) or 1.0
    drawing = charts.over(places, Abscissa((name, axis_unit), (low - room, high + room)))
    return drawing.plots([Panel(title, unit or "1", panel)])[0]
