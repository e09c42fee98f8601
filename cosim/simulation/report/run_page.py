"""The page of any run: header, signals, figures of merit, provenance."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import far_beyond
from cosim.base.text import display
from cosim.report.charts import Charts, Drawing
from cosim.report.html_tables import Row
from cosim.report.panels import NO_UNIT_TEXT, Band, Panel, Trace, by_unit, extent
from cosim.report.template import render
from cosim.simulation.report.component_page import ComponentPage, component_page
from cosim.simulation.report.fmi_kinds import fmi_kinds
from cosim.simulation.report.recorded import Run, mapping, mappings, number, texts
from cosim.simulation.report.run_rows import (
    ConnectionRow,
    badges,
    component_rows,
    connections,
    event_rows,
    fault_text,
    faults_on,
    items_of,
    provenance,
    spelled_values,
)
from cosim.simulation.report.system_diagram import graph_of_run
from cosim.simulation.report.time_rows import time_rows, time_sentence
from cosim.simulation.report.verdicts import CriterionText, criteria, has_failed, outcome
from cosim.storage.files import write_text
from cosim.storage.results import Results

TEMPLATE = Path(__file__).with_name("templates") / "run.html.j2"
MAX_TILES = 4
LIMIT_LABEL = "allowed"
WIDTHS = {"settling_time": "band", "peak": "max", "final_error": "max"}  # criterion → its distance from the target
MAX_CONNECTIONS = 40  # with a separate chart; signals of further connections are among the others
MAX_WIRES = 200  # in the system diagram; `cosim graph` draws all
MAX_SIGNALS = 1000  # signals on a page
MAX_LISTED = 1000  # connections in the table
DRAWABLE = 1e100  # a diverged run has larger values, with squares that may overflow


@far_beyond
def write_report(path: Path, results: Results, manifest: Mapping[str, Any]) -> None:
    """Write one self-contained HTML page about a run; `manifest` may lack any of its keys."""
    run = drawable_run(results, manifest)
    drawing = Charts().over(run.time)
    page = component_page(run, drawing) or ComponentPage(TEMPLATE, tiles=_goals(criteria(run)))
    write_text(path, render(page.template, context(run, drawing, page), [TEMPLATE.parent]))


def drawable_run(results: Results, manifest: Mapping[str, Any]) -> Run:
    """Return a run's rows with finite time, and NaN for all values not drawable."""
    timed = np.isfinite(results.time)
    values = results.values[timed]
    drawable = np.where(np.abs(values) < DRAWABLE, values, np.nan)
    return Run(replace(results, time=results.time[timed], values=drawable), manifest)


def context(run: Run, drawing: Drawing, page: ComponentPage) -> Mapping[str, Any]:
    """Return the values of the template."""
    goals, connected, kinds = criteria(run), connections(run), fmi_kinds(run)
    judged = judged_panels(run) if run.time.size and not page.shown else []
    links = connection_panels(run, connected, page.shown) if run.time.size else {}
    others = signal_panels(run, page.shown.union(*links, {p.title for p in judged})) if run.time.size else []
    return {
        "name": str(run.scenario.get("name") or "Run"),
        "description": str(run.scenario.get("description") or ""),
        "outcome": outcome(run, goals),
        "tone": "bad" if has_failed(run) or not all(c.met for c in goals) else "good" if goals else "plain",
        "badges": badges(run, goals),
        "tiles": page.tiles,
        "judged": drawing.plots(judged),
        "links": drawing.plots(list(links.values())),
        "others": drawing.plots(others),
        "spelled": spelled_values(run),
        "undrawn": _undrawn(len(_find_undisplayed(run, page.shown))),
        "criteria": goals,
        "rows": run.time.size,
        "end": run.time[-1] if run.time.size else 0.0,
        "data": drawing.charts.data(page.data),  # after all drawings
        "diagram": _diagram(run),
        "provenance": provenance(run, kinds),
        "connections": connected[:MAX_LISTED],
        "unlisted": max(0, len(connected) - MAX_LISTED),
        "components": component_rows(run, kinds),
        "events": event_rows(run),
        "times": time_rows(run),
        "time_sentence": time_sentence(mapping(run.manifest.get("timings"))),
        "warnings": texts(run.manifest.get("warnings")),
        "repeat": shlex.join(["cosim", "run", "manifest.json"]),
        "version": str(run.manifest.get("cosim_version") or ""),
        "own": bool(page.shown),
        **page.values,
    }


def _diagram(run: Run) -> str:
    """Return the system diagram, "" without connections or with too many."""
    if len(mappings(run.scenario.get("connections"))) > MAX_WIRES:
        return ""
    graph = graph_of_run(run)
    return graph.svg(alone=False) if graph is not None and graph.links else ""


def _goals(judged: Sequence[CriterionText]) -> list[Row]:
    """Return table rows of the scenario's criteria, missed criteria first."""
    first = sorted(judged, key=lambda c: c.met)[:MAX_TILES]
    allowed = {c: f", allowed {c.allowed}" if c.allowed else "" for c in first}
    return [Row(c.title, c.value, f"{'met' if c.met else 'missed'}{allowed[c]}") for c in first]


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
        unit, factor = display(run.unit(name))
        traces = [Trace(name, run.results[name] * factor, "true", held=name in run.results.whole)]
        limits: tuple[float, ...] = ()
        if not isinstance(target, str):
            width = number(entry.get(WIDTHS.get(str(entry.get("kind")), "")))  # NaN without limits
            ends = (factor * (number(target) + side * width) for side in (-1.0, 1.0))
            limits = tuple(end for end in ends if math.isfinite(end))
        elif target in run.results:
            traces.append(Trace(target, run.results[target] * factor, "reference"))
        label = unit or run.unit(name) or NO_UNIT_TEXT
        band = _fault_band(run, [name], traces)
        panels[name] = Panel(name, label, traces, band, limits, LIMIT_LABEL if limits else "")
    return list(panels.values())


def connection_panels(
    run: Run, connected: Sequence[ConnectionRow], shown: frozenset[str] = frozenset()
) -> dict[tuple[str, str], Panel]:
    """Return sent and received signal of each connection, if recorded in one unit."""
    panels: dict[tuple[str, str], Panel] = {}
    items = items_of(run)
    for link in connected:
        ends = (link.source, link.target)
        is_drawable = all(end in run.results and end not in shown for end in ends)
        if not is_drawable or run.unit(ends[0]) != run.unit(ends[1]) or len(panels) == MAX_CONNECTIONS:
            continue
        unit, factor = display(run.unit(link.target))
        sent, arrived = (run.results[end] * factor for end in ends)
        label, whole = f"{link.target}, {link.noise}" if link.noise else link.target, run.results.whole
        traces = [Trace(link.source, sent, "true", held=ends[0] in whole, items=items.get(ends[0], {}))]
        if not np.array_equal(sent, arrived, equal_nan=True):
            received = Trace(label, arrived, "estimate", held=ends[1] in whole, items=items.get(ends[1], {}))
            traces.insert(0, received)
        title = f"{link.source} → {link.target}"
        panels[ends] = Panel(
            title, unit or run.unit(link.target) or NO_UNIT_TEXT, traces, _fault_band(run, ends, traces)
        )
    return panels


def _find_undisplayed(run: Run, shown: frozenset[str]) -> list[str]:
    return [column for column in run.results.columns if column not in shown]


def _undrawn(signals: int) -> str:
    return f"The first {MAX_SIGNALS} of {signals} signals; the file of rows has all." if signals > MAX_SIGNALS else ""


def signal_panels(run: Run, shown: frozenset[str] = frozenset()) -> list[Panel]:
    """Return the columns not in `shown`, grouped by unit, MAX_SIGNALS at most."""
    panels, items, whole = [], items_of(run), run.results.whole
    for unit, columns in by_unit(_find_undisplayed(run, shown)[:MAX_SIGNALS], run.unit, run.results.__getitem__):
        shown_unit, factor = display(unit)
        traces = [
            Trace(column, run.results[column] * factor, f"s{i}", held=column in whole, items=items.get(column, {}))
            for i, column in enumerate(columns)
        ]
        title = ", ".join(dict.fromkeys(column.partition(".")[0] for column in columns))
        panels.append(Panel(title, shown_unit or unit or NO_UNIT_TEXT, traces, _fault_band(run, columns, traces)))
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
