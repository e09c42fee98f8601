"""The page of a run: header, signals, figures of merit, wall time, provenance."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core import registry
from cosim.core.arrays import far_beyond
from cosim.core.text import amount, counted, displayed, is_difference, join_names, plain, showing
from cosim.credibility.validity import output_panels, validity_sentence
from cosim.files.files import write_text
from cosim.files.results import Results
from cosim.files.yaml_file import short
from cosim.report.cell.cell import MAX_CELL_CURVES, cell_of, rows_to_show
from cosim.report.charts import Charts, Drawing
from cosim.report.panels import Band, Panel, Trace, axis_unit, by_unit, extent
from cosim.report.template import Row, command, render
from cosim.simulation.report.recorded import (
    MIN_READINGS,
    ComponentPage,
    Run,
    disturbances,
    fault_text,
    faults_on,
    number,
    time_sentence,
)
from cosim.simulation.report.system_diagram import graph_of_run

TEMPLATE = Path(__file__).with_name("templates") / "run.html.j2"
MAX_TILES = 4
LIMIT_LABEL = "allowed"
REFERENCE_PART = re.compile(
    r"(?<=\.)ref(erence)?_|_(ref|reference|sp|set|setpoint|set_point|desired|target|wanted|cmd)$"
)
WIDTH_KEYS = {"settling_time": "band", "peak": "max", "final_error": "max"}  # criterion → its distance from the target
MAX_CONNECTION_CHARTS = 40  # with a separate chart; signals of further connections are among the others
MAX_WIRES = 200  # in the system diagram; `cosim graph` draws all
MAX_PAGE_SIGNALS = 1000  # signals on a page
MAX_LISTED_CONNECTIONS = 1000  # connections in the table
DRAWABLE = 1e100  # a diverged run has larger values, with squares that may overflow
MAX_SPELLED, MAX_CHANGES = 200, 8  # signals on a page, and changes of each
STEP_MEANING = "time between two exchanges of values among the components"
MIN_SHARE = 0.01  # of the wall time of a component with a row
CRITERION_NAMES = {"peak": "largest magnitude"}  # of kinds, others are shown as the scenario names them


@far_beyond
def write_report(path: Path, results: Results, manifest: Mapping[str, Any]) -> None:
    """Write one self-contained HTML page about a run; `manifest` may lack any top-level key."""
    with showing(manifest):
        write_text(path, _page(drawable_run(results, manifest)))


def _page(run: Run) -> str:
    drawing, goals, has_rows = Charts().over(run.time), criteria(run), bool(run.time.size)
    worst = sorted(goals, key=lambda goal: bool(goal["met"]))[:MAX_TILES]
    verdicts = [f"{'met' if goal['met'] else 'missed'}, allowed {goal['allowed']}" for goal in worst]
    tiles = [Row(goal["title"], goal["value"], verdict) for goal, verdict in zip(worst, verdicts, strict=True)]
    entry = registry.page_for(run.variables.values())
    page: ComponentPage | None = registry.resolve(entry.subject)(run, drawing) if entry else None
    page = page or ComponentPage(TEMPLATE)
    connected, shown = connections(run), page.shown
    judged = judged_panels(run) if has_rows and not shown else []
    links = connection_panels(run, connected, shown) if has_rows else {}
    others = signal_panels(run, shown.union(*links, {p.title for p in judged})) if has_rows else []
    graph = graph_of_run(run) if len(run.connections) <= MAX_WIRES else None
    count = len([column for column in run.results.columns if column not in shown])
    values = {
        "name": run.scenario.get("name", "Run"),
        "description": run.scenario.get("description", ""),
        "when": run.manifest.get("date", "").replace("T", " ")[:16],
        "settings": run.manifest.get("set", ()),
        "outcome": outcome(run, goals),
        "tone": "bad" if run.has_failed or not all(c["met"] for c in goals) else "good" if goals else "plain",
        "badges": badges(run, goals),
        "tiles": page.tiles or tiles,
        "judged": drawing.plots(judged),
        "links": drawing.plots(list(links.values())),
        "others": drawing.plots(others),
        "spelled": spelled_values(run),
        "undrawn": f"The first {MAX_PAGE_SIGNALS} of {count} signals; the file of rows has all."
        * (count > MAX_PAGE_SIGNALS),
        **trust(run, drawing),
        "criteria": goals,
        "rows": run.time.size,
        "end": run.time[-1] if has_rows else 0.0,
        "data": drawing.charts.data(page.data),  # after all drawings, which add data
        "diagram": graph.svg(alone=False) if graph is not None and graph.links else "",
        "provenance": provenance(run),
        "connections": connected[:MAX_LISTED_CONNECTIONS],
        "unlisted": len(connected[MAX_LISTED_CONNECTIONS:]),
        "components": component_rows(run),
        "events": event_rows(run),
        "times": time_rows(run),
        "time_sentence": time_sentence(run.part("timings")),
        "warnings": run.manifest.get("warnings", ()),
        "repeat": command("cosim", "run", "manifest.json"),
        "version": run.manifest.get("cosim_version", ""),
        "own": bool(shown),
        **page.values,
    }
    return render(page.template, values, folders=[TEMPLATE.parent])


def drawable_run(results: Results, manifest: Mapping[str, Any]) -> Run:
    """Return the run with finite times only, and with NaN for values that cannot be drawn."""
    timed = np.isfinite(results.time)
    values = results.values[timed]
    drawable = np.where(np.abs(values) < DRAWABLE, values, np.nan)
    return Run(replace(results, time=results.time[timed], values=drawable), manifest)


def judged_panels(run: Run) -> list[Panel]:
    """Return a panel for each signal with a criterion, missed criteria first.

    Each panel shows the target and the limits.
    """
    entries = sorted(run.manifest.get("criteria", ()), key=lambda entry: bool(entry["met"]))
    panels: dict[str, Panel] = {}
    for entry in entries:
        name, target, kind = entry["of"], entry.get("to", 0.0), entry["kind"]
        if name not in run.results or name in panels or len(panels) == MAX_TILES:
            continue
        names, limits = [(name, "true")], tuple[float, ...]()
        if not isinstance(target, str):
            width = number(entry.get(WIDTH_KEYS.get(kind, "")))  # NaN without limits
            low, high = extent([run.results[name]]) or (0.0, 0.0)
            is_one_sided = kind == "peak" and not target  # true for the peak of a signal that keeps its sign
            sides = (1.0,) if is_one_sided and low >= 0.0 else (-1.0,) if is_one_sided and high <= 0.0 else (-1.0, 1.0)
            ends = (displayed(target + side * width, run.unit(name)) for side in sides)
            limits = tuple(end for end in ends if math.isfinite(end))
        elif target in run.results:
            names.append((target, "reference"))
        traces = [run.trace(*each) for each in names]
        panels[name] = _panel(run, name, traces, [name], limits=limits, limit_label=LIMIT_LABEL if limits else "")
    return list(panels.values())


def connection_panels(
    run: Run, connected: Sequence[Mapping[str, str]], shown: frozenset[str] = frozenset()
) -> dict[tuple[str, str], Panel]:
    """Return a panel with the source and target signal of each connection, if both are recorded in one unit.

    The panel of an input also shows its reference, such as `x_ref` for `x`.
    """
    panels: dict[tuple[str, str], Panel] = {}
    fed = {link["target"]: link for link in connected if link["target"] in run.results and link["target"] not in shown}
    references = {name: other for name in fed if (other := REFERENCE_PART.sub("", name)) != name and other in fed}
    references = {name: other for name, other in references.items() if run.unit(name) == run.unit(other)}
    for target, link in fed.items():
        source = link["source"]
        is_drawable = source in run.results and source not in shown and run.unit(source) == run.unit(target)
        if not is_drawable or target in references or len(panels) == MAX_CONNECTION_CHARTS:
            continue
        traces = [run.trace(source, "true")]
        if not np.array_equal(run.results[source], run.results[target], equal_nan=True):
            traces.insert(0, run.trace(target, "estimate", ", ".join(filter(None, (target, link["noise"])))))
        traces += [run.trace(name, "reference") for name, other in references.items() if other == target]
        panels[source, target] = _panel(run, f"{source} → {target}", traces, [source, target])
    return panels


def signal_panels(run: Run, shown: frozenset[str] = frozenset()) -> list[Panel]:
    """Return the columns not in `shown`, grouped by unit, MAX_PAGE_SIGNALS at most."""
    panels = []
    names = [column for column in run.results.columns if column not in shown][:MAX_PAGE_SIGNALS]
    for _, columns in by_unit(names, run.unit, run.results.__getitem__):
        title = ", ".join(dict.fromkeys(column.partition(".")[0] for column in columns))
        traces = [run.trace(column, f"s{i}") for i, column in enumerate(columns)]
        panels.append(_panel(run, title, traces, columns))
    return panels


def _panel(run: Run, title: str, traces: Sequence[Trace], columns: Sequence[str], **more: Any) -> Panel:
    """Return a panel of columns of one unit, with shaded times at which faults are injected into them."""
    band, faults, around = None, faults_on(run, columns), extent([trace.values for trace in traces])
    if faults and around is not None:
        acting = np.zeros(run.time.size, bool)
        for fault in faults:
            begin, end = number(fault.get("from"), -math.inf), number(fault.get("to"), math.inf)
            acting |= (run.time >= begin) & (run.time <= end)
        edges = (np.where(acting, edge, np.nan) for edge in around)
        band = Band("; ".join(fault_text(fault) for fault in faults), *edges)
    return Panel(title, axis_unit(run.unit(columns[-1])), traces, band, **more)


def results_cell(results: Results, names: Sequence[str], title: str) -> str:
    """Return HTML with an interactive chart of the first of the named signals, one panel per unit."""
    shown = tuple(names[:MAX_CELL_CURVES])
    rows = rows_to_show([results[name] for name in shown])  # first of all: a long run is not copied
    values = np.column_stack([results[name][rows] for name in shown]) if shown else np.empty((rows.size, 0))
    run = drawable_run(replace(results, time=results.time[rows], columns=shown, values=values, exact={}), {})
    omitted = len(names) - len(shown)
    return cell_of(run.time, signal_panels(run), title, rows=results.time.size, omitted=omitted)


def trust(run: Run, drawing: Drawing) -> dict[str, Any]:
    """Return, for FMUs with a record of credibility, the share of the time within their logs, and error bands."""
    rows, panels = list[Row](), list[Panel]()
    for name, entry in run.part("validity").items() if run.time.size else ():
        outputs = {v: run.results[c] for c in run.results.columns for n, _, v in [c.partition(".")] if n == name}
        panels += output_panels(name, entry, run.time, outputs)
        if text := validity_sentence(name, entry):
            rows.append(Row(name, text.partition(": ")[2]))
    return {"trust": rows, "bands": drawing.plots(panels)}


# -- rows and sentences -----------------------------------------------------------------------------------


def badges(run: Run, judged: Sequence[Mapping[str, Any]]) -> list[str | tuple[str, str]]:
    """Return the badges in the page's header: status, criteria, noise and warnings."""
    met, warnings = sum(criterion["met"] for criterion in judged), run.manifest.get("warnings", ())
    badges = (
        (True, ("failed", "bad") if run.has_failed else ("completed", "good" if judged else "plain")),
        (judged, (f"{met} of {counted(len(judged), 'criterion')} met", "good" if met == len(judged) else "bad")),
        (run.scenario.get("noise") is False, "noise off"),
        (warnings, (counted(len(warnings), "warning"), "warn")),
        (run.part("git").get("dirty"), ("uncommitted changes", "warn")),
    )
    return [badge for applies, badge in badges if applies]


def event_rows(run: Run) -> list[dict[str, str]]:
    """Return table rows with the number of events by component and cause, for a run with event mode."""
    events = reversed(run.manifest.get("first_events", ()))
    firsts = {(name, cause): f"{time:.6g} s" for time, name, cause in events}
    return [
        {"component": c, "cause": cause, "count": str(count), "first": firsts.get((c, cause), "–")}
        for c, counts in run.part("event_counts").items()
        for cause, count in counts.items()
    ]


def spelled_values(run: Run) -> list[Row]:
    """Return table rows for recorded values that cannot be drawn, with the times of their changes.

    These are text, 64-bit integers, binary data and enumeration items.
    """
    columns: dict[str, Sequence[Any]] = {}
    for name, items in run.items.items():
        if name in run.results:
            columns[name] = [items.get(value, f"{value:g}") for value in run.results[name].tolist()]
    rows = []
    for name, values in islice({**columns, **run.results.exact}.items(), MAX_SPELLED):
        changes = [k for k in range(min(len(values), run.time.size)) if not k or values[k] != values[k - 1]]
        parts = []
        for k in changes[: MAX_CHANGES + 1]:
            text = short(values[k].hex() if isinstance(values[k], bytes) else values[k])
            parts.append(f"from {run.time[k]:g} s {text}" if k else text)
        if more := len(changes[MAX_CHANGES + 1 :]):
            parts.append(f"and {counted(more, 'more change')}")
        rows.append(Row(name, "; ".join(parts)))
    return rows


def connections(run: Run) -> list[dict[str, str]]:
    """Return table rows of connections: source, target, noise and faults."""
    return [{"source": c["from"], "target": c["to"], "noise": "; ".join(disturbances(run, c))} for c in run.connections]


def fmi_kind(fmu: Mapping[str, Any]) -> str:
    """Return version and interface of an FMU in the manifest: `FMI 2.0, co-simulation`; "" if not recorded."""
    version, interface = fmu.get("fmi_version"), str(fmu.get("interface")).replace("-e", " e")
    return f"FMI {version}, {interface}" if version else ""


def component_rows(run: Run) -> list[dict[str, str]]:
    """Return table rows of components: name, FMU or block, kind and settings."""
    rows, fmus = [], run.part("fmus")
    for name, component in run.components.items():
        kind = fmi_kind(fmus[name]) if name in fmus else "block of cosim" * ("block" in component)
        hidden = {"start", "fmu", "block", "sha256", *(("interface",) if kind else ())}
        chosen = {key: value for key, value in component.items() if value not in ({}, []) and value is not False}
        settings = []
        for key, value in {**chosen, **component.get("start", {})}.items():
            if key not in hidden:
                settings.append(f"{key} = {fact_text(value)}")
        source = component.get("fmu") or component.get("block") or ""
        rows.append({"label": name, "source": source, "kind": kind, "settings": ", ".join(settings)})
    return rows


# -- wall time -----------------------------------------------------------------------------------------------


def time_rows(run: Run) -> list[dict[str, str]]:
    """Return table rows with the wall time of each component by kind of call, and of waiting."""
    timings = run.part("timings")
    if timings.get("readings", 0) < MIN_READINGS:
        return []
    rows, calls = [], ("step", "set", "get", "other")
    for name, times in timings["components"].items():
        if times["share"] >= MIN_SHARE:
            seconds = {call: f"{plain(times[call], 2)} s" for call in calls}
            rows.append({"label": name, "share": f"{times['share']:.0%}", **seconds})
    if waiting := timings.get("waiting"):
        empty = dict.fromkeys(calls, "") | {"other": f"{plain(waiting, 2)} s"}
        rows.append({"label": "waiting for the pace, or in a pause", "share": "not counted", **empty})
    return rows


# -- provenance ----------------------------------------------------------------------------------------------


def provenance(run: Run) -> list[Row]:
    """Return table rows with facts for repeating the run, from the manifest."""
    manifest, rows = run.manifest, list[Row]()
    keys = ("model_name", "version", "guid", "sha256", "generation_tool")
    for name, fmu in run.part("fmus").items():
        lines = [fmi_kind(fmu), *(f"{key.replace('_', ' ')} {fmu[key]}" for key in keys if fmu.get(key))]
        rows.append(Row(f"FMU {name}", "\n".join(filter(None, lines)), fmu.get("path", "")))
    git, timings, pacing = run.part("git"), run.part("timings"), run.part("pacing")
    wall = [f"{key} {amount(timings[key], 's')}" for key in ("load", "simulate") if key in timings]
    if "real_time_factor" in timings:
        wall.append(f"{plain(timings['real_time_factor'], 2)} times as fast as real time")
    step = run.scenario.get("step")
    steps = fact_lines({**step, **run.part("steps")}) if isinstance(step, Mapping) else _seconds(step)
    facts = [
        Row("cosim", manifest.get("cosim_version", "")),
        Row("Versions", ", ".join(f"{key} {value}" for key, value in run.part("versions").items())),
        Row("Git revision", git.get("revision", ""), "with uncommitted changes" if git.get("dirty") else "clean"),
        Row("Simulated time", _seconds(run.scenario.get("duration"))),
        Row("Communication step", steps, STEP_MEANING),
        Row("Coupling algorithm", run.algorithm),
        Row("Seed", "" if manifest.get("seed") is None else str(manifest["seed"])),
        Row("Wall time", ", ".join(wall)),
    ]
    for loop in manifest.get("loops", ()):
        names, state = loop["components"], "NOT SOLVED\n" if "not_solved" in loop else ""
        facts.append(Row(f"Algebraic loop {' → '.join((*names, *names[:1]))}", state + fact_lines(loop)))
    if pacing:
        facts.append(Row("Pace", f"{pacing['pace']:g} × real time\n{fact_lines(pacing)}"))
    return [*rows, *(fact for fact in facts if fact.value)]


def _seconds(value: Any) -> str:
    return "" if value is None else f"{value:g} s"


def fact_lines(facts: Mapping[str, Any]) -> str:
    """Return facts of the manifest as text, one line `key: value` per fact."""
    return "\n".join(f"{str(key).replace('_', ' ')}: {fact_text(value)}" for key, value in facts.items())


def fact_text(value: Any) -> str:
    """Return a value of the manifest as text on one line."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {fact_text(v)}" for key, v in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(fact_text, value))
    text = plain(value, None) if isinstance(value, float) else str(value)
    return text.lower() if isinstance(value, bool) else text


def criteria(run: Run) -> list[dict[str, Any]]:
    """Return title, value, allowed value, margin and outcome of each criterion in the manifest, as text."""
    rows = []
    for entry in run.manifest.get("criteria", ()):
        kind, target, own_unit, unit = entry["kind"], entry.get("to"), run.unit(entry["of"]), entry["unit"]
        title = f"{CRITERION_NAMES.get(kind, kind.replace('_', ' '))} of {entry['of']}"
        if target is not None:
            title += f" to {target if isinstance(target, str) else amount(target, own_unit, None)}"
        if "band" in entry:
            title += f" within ±{amount(entry['band'], own_unit, None, difference=True)}"
        title += "".join(f" {w} {amount(entry[w], 's', None)}" for w in ("after", "until") if w in entry)
        figure, value = partial(amount, unit=unit, difference=is_difference(entry)), entry["value"]
        row = {"title": title, "met": entry["met"], "margin": "", "allowed": f"≤ {figure(entry['max'], digits=None)}"}
        if value is None:
            row["value"] = "not settled" if kind == "settling_time" else "none"
        else:
            row["value"], rest = figure(value), entry["max"] - value
            row["margin"] = f"{amount(abs(rest), unit, difference=True)} {'left' if rest >= 0 else 'over'}"
        rows.append(row)
    return rows


def outcome(run: Run, judged: Sequence[Mapping[str, Any]]) -> str:
    """Return one or two sentences on the outcome of the run."""
    if run.has_failed:
        reason = run.manifest["status"].removeprefix("failed").lstrip(": ") or "no reason was recorded"
        return f"The simulation failed: {reason}. The rows before that are shown."
    missed = [c for c in judged if not c["met"]]
    if missed:
        first = missed[0]
        detail = f"{first['title']}: {first['value']}, allowed {first['allowed']}"
        return f"{len(missed)} of {counted(len(judged), 'criterion')} missed; first {detail}."
    if judged:
        return f"{len(judged)} of {counted(len(judged), 'criterion')} met."
    names = list(run.components) or list(run.variables)
    if not names or not run.time.size:
        return "Nothing was recorded."
    steps = counted(run.time.size - 1, "communication step")
    over = f"{amount(float(run.time[-1] - run.time[0]), 's', None)} in {steps}"
    return f"Simulated {join_names(names)} over {over}. No criteria are set, so nothing was judged."
