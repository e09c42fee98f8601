"""The page of any run: header, signals, figures of merit, provenance."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core import registry
from cosim.core.arrays import far_beyond
from cosim.core.text import displayed, showing
from cosim.files.files import write_text
from cosim.files.results import Results, is_rounded
from cosim.report.cell.cell import MAX_CURVES, cell_of, rows_to_show
from cosim.report.charts import Charts
from cosim.report.html_tables import Row
from cosim.report.panels import Band, Panel, Trace, axis_unit, by_unit, extent
from cosim.report.template import render
from cosim.simulation.report.component_page import ComponentPage
from cosim.simulation.report.recorded import Run, mappings, number, texts
from cosim.simulation.report.run_rows import (
    badges,
    component_rows,
    connections,
    criteria,
    event_rows,
    fault_text,
    faults_on,
    outcome,
    provenance,
    spelled_values,
    time_rows,
    time_sentence,
)
from cosim.simulation.report.system_diagram import graph_of_run

TEMPLATE = Path(__file__).with_name("templates") / "run.html.j2"
MAX_TILES = 4
LIMIT_LABEL = "allowed"
WIDTHS = {"settling_time": "band", "peak": "max", "final_error": "max"}  # criterion → its distance from the target
MAX_CONNECTIONS = 40  # with a separate chart; signals of further connections are among the others
MAX_WIRES = 200  # in the system diagram; `cosim graph` draws all
MAX_SIGNALS = 1000  # signals on a page
MAX_LISTED = 1000  # connections in the table
DRAWABLE = 1e100  # a diverged run has larger values, with squares that may overflow
MOST_NAMES = 5  # in a note


@far_beyond
def write_report(path: Path, results: Results, manifest: Mapping[str, Any]) -> None:
    """Write one self-contained HTML page about a run; `manifest` may lack any of its keys."""
    with showing(manifest):
        write_text(path, _page(drawable_run(results, manifest)))


def _page(run: Run) -> str:
    drawing, goals = Charts().over(run.time), criteria(run)
    tiles = []
    for c in sorted(goals, key=lambda c: bool(c["met"]))[:MAX_TILES]:
        allowed = f", allowed {c['allowed']}" if c["allowed"] else ""
        tiles.append(Row(c["title"], c["value"], f"{'met' if c['met'] else 'missed'}{allowed}"))
    page: ComponentPage | None = None  # of the run's components
    if entry := registry.page_for(run.variables.values()):
        page = registry.resolve(entry.subject)(run, drawing)
    page = page or ComponentPage(TEMPLATE, tiles=tiles)
    connected, shown = connections(run), page.shown
    judged = judged_panels(run) if run.time.size and not shown else []
    links = connection_panels(run, connected, shown) if run.time.size else {}
    others = signal_panels(run, shown.union(*links, {p.title for p in judged})) if run.time.size else []
    graph = graph_of_run(run) if len(run.connections) <= MAX_WIRES else None
    count = len([column for column in run.results.columns if column not in shown])
    undrawn = f"The first {MAX_SIGNALS} of {count} signals; the file of rows has all." if count > MAX_SIGNALS else ""
    values = {
        "name": str(run.scenario.get("name") or "Run"),
        "description": str(run.scenario.get("description") or ""),
        "outcome": outcome(run, goals),
        "tone": "bad" if run.has_failed or not all(c["met"] for c in goals) else "good" if goals else "plain",
        "badges": badges(run, goals),
        "tiles": page.tiles,
        "judged": drawing.plots(judged),
        "links": drawing.plots(list(links.values())),
        "others": drawing.plots(others),
        "spelled": spelled_values(run),
        "undrawn": undrawn,
        "criteria": goals,
        "rows": run.time.size,
        "end": run.time[-1] if run.time.size else 0.0,
        "data": drawing.charts.data(page.data),  # after all drawings
        "diagram": graph.svg(alone=False) if graph is not None and graph.links else "",
        "provenance": provenance(run),
        "connections": connected[:MAX_LISTED],
        "unlisted": max(0, len(connected) - MAX_LISTED),
        "components": component_rows(run),
        "events": event_rows(run),
        "times": time_rows(run),
        "time_sentence": time_sentence(run.part("timings")),
        "warnings": texts(run.manifest.get("warnings")),
        "repeat": shlex.join(["cosim", "run", "manifest.json"]),
        "version": str(run.manifest.get("cosim_version") or ""),
        "own": bool(shown),
        **page.values,
    }
    return render(page.template, values, [TEMPLATE.parent])


def drawable_run(results: Results, manifest: Mapping[str, Any]) -> Run:
    """Return a run's rows with finite time, and NaN for all values not drawable."""
    timed = np.isfinite(results.time)
    values = results.values[timed]
    drawable = np.where(np.abs(values) < DRAWABLE, values, np.nan)
    return Run(replace(results, time=results.time[timed], values=drawable), manifest)


def judged_panels(run: Run) -> list[Panel]:
    """Return a panel for each signal with a criterion, missed criteria first.

    Each panel shows target and limits.
    """
    entries = sorted(mappings(run.manifest.get("criteria")), key=lambda entry: bool(entry.get("met")))
    panels: dict[str, Panel] = {}
    for entry in entries:
        name, target = str(entry.get("of")), entry.get("to", 0.0)
        if name not in run.results or name in panels or len(panels) == MAX_TILES:
            continue
        unit = run.unit(name)
        traces = [run.trace(name, "true")]
        limits: tuple[float, ...] = ()
        if not isinstance(target, str):
            width = number(entry.get(WIDTHS.get(str(entry.get("kind")), "")))  # NaN without limits
            ends = (displayed(number(target) + side * width, unit) for side in (-1.0, 1.0))
            limits = tuple(end for end in ends if math.isfinite(end))
        elif target in run.results:
            traces.append(run.trace(target, "reference"))
        band = _fault_band(run, [name], traces)
        panels[name] = Panel(name, axis_unit(unit), traces, band, limits, LIMIT_LABEL if limits else "")
    return list(panels.values())


def connection_panels(
    run: Run, connected: Sequence[Mapping[str, str]], shown: frozenset[str] = frozenset()
) -> dict[tuple[str, str], Panel]:
    """Return sent and received signal of each connection, if recorded in one unit."""
    panels: dict[tuple[str, str], Panel] = {}
    for link in connected:
        ends = source, target = link["source"], link["target"]
        is_drawable = all(end in run.results and end not in shown for end in ends)
        if not is_drawable or run.unit(source) != run.unit(target) or len(panels) == MAX_CONNECTIONS:
            continue
        traces = [run.trace(source, "true")]
        if not np.array_equal(run.results[source], run.results[target], equal_nan=True):
            traces.insert(0, run.trace(target, "estimate", ", ".join(filter(None, (target, link["noise"])))))
        unit = axis_unit(run.unit(target))
        panels[ends] = Panel(f"{source} → {target}", unit, traces, _fault_band(run, ends, traces))
    return panels


def signal_panels(run: Run, shown: frozenset[str] = frozenset()) -> list[Panel]:
    """Return the columns not in `shown`, grouped by unit, MAX_SIGNALS at most."""
    panels = []
    names = [column for column in run.results.columns if column not in shown][:MAX_SIGNALS]
    for unit, columns in by_unit(names, run.unit, run.results.__getitem__):
        traces = [run.trace(column, f"s{i}") for i, column in enumerate(columns)]
        title = ", ".join(dict.fromkeys(column.partition(".")[0] for column in columns))
        panels.append(Panel(title, axis_unit(unit), traces, _fault_band(run, columns, traces)))
    return panels


def _fault_band(run: Run, columns: Sequence[str], traces: Sequence[Trace]) -> Band | None:
    """Return a band over the times of faults in these signals."""
    faults, around = faults_on(run, columns), extent([trace.values for trace in traces])
    if not faults or around is None:
        return None
    acting = np.zeros(run.time.size, bool)
    for fault in faults:
        begin, end = number(fault.get("from"), -math.inf), number(fault.get("to"), math.inf)
        acting |= (run.time >= begin) & (run.time <= end)
    lower, upper = (np.where(acting, edge, np.nan) for edge in around)
    return Band("; ".join(fault_text(fault) for fault in faults), lower, upper)


def results_cell(results: Results, names: Sequence[str], title: str) -> str:
    """Return HTML with an interactive chart of the first of the named signals; those of one unit share a panel.

    A note names signals of texts, which are not drawn, and integers that doubles round.
    """
    shown = tuple(names[:MAX_CURVES])
    rows = rows_to_show([results[name] for name in shown])  # first of all: a long run is not copied
    values = np.column_stack([results[name][rows] for name in shown]) if shown else np.empty((rows.size, 0))
    run = drawable_run(replace(results, time=results.time[rows], columns=shown, values=values, exact={}), {})
    omitted = len(names) - len(shown)
    page = cell_of(run.time, signal_panels(run), title, rows=results.time.size, omitted=omitted)
    texts = [name for name in results.exact if name not in results]
    rounded = [name for name in shown if name in results.exact and is_rounded(results[name])]
    parts = [f"{_names(texts)} not drawn: texts"] if texts else []
    parts += [f"{_names(rounded)} above 2⁵³ drawn as the nearest doubles"] if rounded else []
    note = f"<p><small>{escape('; '.join(parts))}.</small></p>" if parts else ""
    return page + note


def _names(names: Sequence[str]) -> str:
    return ", ".join(names[:MOST_NAMES]) + (f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else "")
