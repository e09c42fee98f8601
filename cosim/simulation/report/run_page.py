"""The page of any run: header, signals, figures of merit, wall time, provenance."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from html import escape
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from cosim.blocks.coupling import algorithms
from cosim.core import registry
from cosim.core.arrays import far_beyond
from cosim.core.text import amount, counted, displayed, is_difference, join_names, plain, showing
from cosim.credibility.validity import output_panels, validity_sentence
from cosim.files.files import write_text
from cosim.files.results import Results, is_rounded
from cosim.files.yaml_file import short
from cosim.report.cell.cell import MAX_CURVES, cell_of, rows_to_show
from cosim.report.charts import Charts
from cosim.report.html_tables import Badge, Row
from cosim.report.panels import Band, Panel, Trace, axis_unit, by_unit, extent
from cosim.report.template import render
from cosim.simulation.report.component_page import ComponentPage
from cosim.simulation.report.recorded import (
    MIN_READINGS,
    Run,
    disturbances,
    fault_text,
    faults_on,
    mapping,
    mappings,
    number,
    texts,
    time_sentence,
)
from cosim.simulation.report.system_diagram import graph_of_run

TEMPLATE = Path(__file__).with_name("templates") / "run.html.j2"
MAX_TILES = 4
LIMIT_LABEL = "allowed"
REFERENCE = re.compile(r"(?<=\.)ref(erence)?_|_(ref|reference|sp|set|setpoint|set_point|desired|target|wanted|cmd)$")
WIDTHS = {"settling_time": "band", "peak": "max", "final_error": "max"}  # criterion → its distance from the target
MAX_CONNECTIONS = 40  # with a separate chart; signals of further connections are among the others
MAX_WIRES = 200  # in the system diagram; `cosim graph` draws all
MAX_SIGNALS = 1000  # signals on a page
MAX_LISTED = 1000  # connections in the table
DRAWABLE = 1e100  # a diverged run has larger values, with squares that may overflow
MOST_NAMES = 5  # in a note
MAX_SPELLED, MAX_CHANGES = 200, 8  # signals on a page, and changes of each
STEP = "time between two exchanges of values among the components"
MIN_SHARE = 0.01  # of the wall time of a component with a row
NEGLIGIBLE = 1e-9  # share of its limit below which a value is shown as 0
NAMES = {"peak": "largest magnitude"}  # of kinds, others are shown as the scenario names them


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
        "when": str(run.manifest.get("date") or "").replace("T", " ")[:16],
        "settings": texts(run.manifest.get("set")),
        "outcome": outcome(run, goals),
        "tone": "bad" if run.has_failed or not all(c["met"] for c in goals) else "good" if goals else "plain",
        "badges": badges(run, goals),
        "tiles": page.tiles,
        "judged": drawing.plots(judged),
        "links": drawing.plots(list(links.values())),
        "others": drawing.plots(others),
        "spelled": spelled_values(run),
        "undrawn": undrawn,
        "trust": [*trust_rows(run)] if run.time.size else [],
        "bands": drawing.plots(trust_panels(run)) if run.time.size else [],
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
            low, high = extent([run.results[name]]) or (0.0, 0.0)
            is_one_sided = entry.get("kind") == "peak" and not number(target)  # of a signal that keeps its sign
            sides = (1.0,) if is_one_sided and low >= 0.0 else (-1.0,) if is_one_sided and high <= 0.0 else (-1.0, 1.0)
            ends = (displayed(number(target) + side * width, unit) for side in sides)
            limits = tuple(end for end in ends if math.isfinite(end))
        elif target in run.results:
            traces.append(run.trace(target, "reference"))
        band = _fault_band(run, [name], traces)
        panels[name] = Panel(name, axis_unit(unit), traces, band, limits, LIMIT_LABEL if limits else "")
    return list(panels.values())


def connection_panels(
    run: Run, connected: Sequence[Mapping[str, str]], shown: frozenset[str] = frozenset()
) -> dict[tuple[str, str], Panel]:
    """Return sent and received signal of each connection, if recorded in one unit.

    The reference of an input, such as `x_ref` of `x`, is in the chart of the input.
    """
    panels: dict[tuple[str, str], Panel] = {}
    fed = {link["target"]: link["source"] for link in connected if link["target"] in run.results}
    references = {name: other for name in fed if (other := REFERENCE.sub("", name)) != name and other in fed}
    references = {n: other for n, other in references.items() if run.unit(n) == run.unit(other) and n not in shown}
    for link in connected:
        ends = source, target = link["source"], link["target"]
        is_drawable = all(end in run.results and end not in shown for end in ends)
        if not is_drawable or run.unit(source) != run.unit(target) or len(panels) == MAX_CONNECTIONS:
            continue
        if references.get(target, target) != target and references[target] not in shown:
            continue  # drawn with its input
        traces = [run.trace(source, "true")]
        if not np.array_equal(run.results[source], run.results[target], equal_nan=True):
            traces.insert(0, run.trace(target, "estimate", ", ".join(filter(None, (target, link["noise"])))))
        traces += [run.trace(name, "reference") for name, other in references.items() if other == target]
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


# -- region and error bands ---------------------------------------------------------------------------------


def trust_rows(run: Run) -> Iterator[Row]:
    """Yield a row for each FMU with a record of credibility: the share of the time within its logs."""
    for name, entry in run.part("validity").items():
        if text := validity_sentence(name, mapping(entry)):
            yield Row(name, text.partition(": ")[2])


def trust_panels(run: Run) -> list[Panel]:
    """Return a panel for each output with an error band."""
    panels = []
    for name, entry in run.part("validity").items():
        outputs = {v: run.results[c] for c in run.results.columns for n, _, v in [c.partition(".")] if n == name}
        panels += output_panels(name, mapping(entry), run.time, outputs)
    return panels


# -- rows and sentences -----------------------------------------------------------------------------------


def badges(run: Run, judged: Sequence[Mapping[str, Any]]) -> list[Badge]:
    """Return badges: status, criteria, algorithm, noise, seed and warnings."""
    met = sum(criterion["met"] for criterion in judged)
    seed, warnings = run.manifest.get("seed"), texts(run.manifest.get("warnings"))
    sensors = [mapping(c.get("signals")).values() for c in run.components.values()]
    sources = [*run.connections, *(signal for signals in sensors for signal in signals)]
    has_noise = bool(run.scenario.get("noise", True)) and any(mapping(mapping(s).get("noise")) for s in sources)
    algorithm = algorithms().get(run.algorithm)
    title = algorithm.title if algorithm else run.algorithm.replace("_", "-").title()
    badges = (
        (True, Badge("failed", "bad") if run.has_failed else Badge("completed", "good" if judged else "plain")),
        (judged, Badge(f"{met} of {counted(len(judged), 'criterion')} met", "good" if met == len(judged) else "bad")),
        (run.algorithm and run.links, Badge(title)),
        (run.links, Badge("noise on" if has_noise else "noise off")),
        (seed is not None and has_noise, Badge(f"seed {seed}")),
        (warnings, Badge(counted(len(warnings), "warning"), "warn")),
        (run.part("git").get("dirty"), Badge("uncommitted changes", "warn")),
    )
    return [badge for applies, badge in badges if applies]


def event_rows(run: Run) -> list[dict[str, str]]:
    """Return the events of a run with event mode, by component and cause."""
    events = run.manifest.get("first_events")
    firsts: dict[tuple[str, str], str] = {}
    for event in events if isinstance(events, list) else []:
        time, *cause = event if isinstance(event, list) else [None]
        if isinstance(time, int | float) and len(cause) == 2:
            firsts.setdefault((str(cause[0]), str(cause[1])), f"{time:.6g} s")
    return [
        {"component": c, "cause": cause, "count": str(count), "first": firsts.get((c, cause), "–")}
        for c, counts in run.part("event_counts").items()
        for cause, count in mapping(counts).items()
    ]


def spelled_values(run: Run) -> list[Row]:
    """Return table rows of recorded values without curve, with the times of their changes.

    These are text, 64-bit integers, binary data and enumeration items.
    """
    columns: list[tuple[str, list[int], list[str]]] = []
    for column, names in islice(run.items.items(), MAX_SPELLED):
        if column in run.results and run.time.size:
            numbers = run.results[column]
            points = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist()]
            columns.append((column, points, [names.get(numbers[k], f"{numbers[k]:g}") for k in points]))
    for column, values in islice(run.results.exact.items(), MAX_SPELLED):
        points = [k for k in range(min(len(values), run.time.size)) if not k or values[k] != values[k - 1]]
        shown = (values[k] for k in points[: MAX_CHANGES + 1])
        columns.append((column, points, [short(v.hex() if isinstance(v, bytes) else v) for v in shown]))
    rows = []
    for column, points, words in columns:
        some = zip(points[: MAX_CHANGES + 1], words, strict=False)
        parts = [f"from {run.time[k]:g} s {text}" if k else text for k, text in some]
        more = len(points) - len(parts)
        rows.append(Row(column, "; ".join([*parts, *([f"and {counted(more, 'more change')}"] if more > 0 else [])])))
    return rows


def connections(run: Run) -> list[dict[str, str]]:
    """Return source, target and disturbances of the connections of the scenario."""
    return [
        {"source": str(c.get("from", "?")), "target": str(c.get("to", "?")), "noise": "; ".join(disturbances(run, c))}
        for c in run.connections
    ]


def fmi_kind(fmu: Mapping[str, Any]) -> str:
    """Return version and interface of an FMU of the manifest: `FMI 2.0, co-simulation`; "" if not recorded."""
    version, interface = fmu.get("fmi_version"), str(fmu.get("interface")).replace("-e", " e")
    return f"FMI {version}, {interface}" if version else ""


def component_rows(run: Run) -> list[dict[str, str]]:
    """Return name, FMU or block, kind and settings of the scenario's components."""

    def notation(value: object) -> str:
        """Return a setting in scenario notation on one line."""
        if isinstance(value, bool):
            return "true" if value else "false"
        if isinstance(value, Mapping):
            return "{" + ", ".join(f"{key}: {notation(v)}" for key, v in value.items()) + "}"
        return "[" + ", ".join(map(notation, value)) + "]" if isinstance(value, list | tuple) else str(value)

    rows, fmus = [], run.part("fmus")
    for name, component in run.components.items():
        kind = fmi_kind(mapping(fmus.get(name)))
        hidden = {"start", "fmu", "block", "sha256", *(("interface",) if kind else ())}
        chosen = {
            key: setting for key, setting in component.items() if setting not in ({}, []) and setting is not False
        }
        settings = []
        for key, value in {**chosen, **mapping(component.get("start"))}.items():
            if key not in hidden:
                own = " s (communication step of its own)" if key == "step" else ""
                settings.append(f"{key} = {notation(value)}{own}")
        kind = kind or ("block of cosim" if component.get("block") else "")
        source = str(component.get("fmu") or component.get("block") or "")
        rows.append({"label": name, "source": source, "kind": kind, "settings": ", ".join(settings)})
    return rows


# -- wall time -----------------------------------------------------------------------------------------------


def time_rows(run: Run) -> list[dict[str, str]]:
    """Return the measured wall times of components by calls, and of waiting."""
    timings = run.part("timings")
    if not number(timings.get("readings")) >= MIN_READINGS:
        return []
    rows, calls = [], ("step", "set", "get", "other")
    for name, entry in mapping(timings.get("components")).items():
        times = mapping(entry)
        if (share := number(times.get("share"))) >= MIN_SHARE:
            seconds = {call: f"{plain(number(times.get(call)), 2)} s" for call in calls}
            rows.append({"label": str(name), "share": f"{share:.0%}", **seconds})
    if (waiting := number(timings.get("waiting"), 0.0)) > 0.0:
        empty = dict.fromkeys(calls, "") | {"other": f"{plain(waiting, 2)} s"}
        rows.append({"label": "waiting for the pace, or in a pause", "share": "not counted", **empty})
    return rows


# -- provenance ----------------------------------------------------------------------------------------------


def provenance(run: Run) -> list[Row]:
    """Return known facts for reproducing the run."""
    manifest, rows = run.manifest, list[Row]()
    keys = ("model_name", "version", "guid", "sha256", "generation_tool")
    for name, entry in run.part("fmus").items():
        fmu = mapping(entry)
        lines = [
            *filter(None, [fmi_kind(fmu)]),
            *(f"{key.replace('_', ' ')} {fmu[key]}" for key in keys if fmu.get(key)),
        ]
        rows.append(Row(f"FMU {name}", "\n".join(lines), str(fmu.get("path") or "")))
    git, timings, seed = run.part("git"), run.part("timings"), manifest.get("seed")
    wall = [f"{key} {amount(number(timings[key]), 's')}" for key in ("load", "simulate") if key in timings]
    if math.isfinite(speed := number(timings.get("real_time_factor"))):
        wall.append(f"{plain(speed, 2)} times as fast as real time")
    versions = ", ".join(f"{key} {value}" for key, value in run.part("versions").items())
    duration = run.scenario.get("duration")
    facts = (
        Row("cosim", str(manifest.get("cosim_version") or "")),
        Row("Versions", versions),
        Row(
            "Git revision", str(git.get("revision") or ""), "with uncommitted changes" if git.get("dirty") else "clean"
        ),
        Row("Simulated time", "" if duration is None else f"{number(duration):g} s"),
        Row("Communication step", _step_text(run), STEP),
        Row("Coupling algorithm", run.algorithm),
        Row("Seed", "" if seed is None else str(seed)),
        Row("Wall time", ", ".join(wall)),
    )
    return [*rows, *(fact for fact in facts if fact.value), *_loop_rows(run), *_pace_rows(run)]


def _step_text(run: Run) -> str:
    """Return the communication step, or the sizes and errors of controlled steps, in lines."""
    step, control = run.scenario.get("step"), mapping(run.scenario.get("step"))
    if not control:
        return "" if step is None else f"{number(step):g} s"
    row = number(control.get("rows"), number(control.get("max")))
    limits = f"{amount(number(control.get('min')), 's')} to {amount(number(control.get('max')), 's')}"
    lines = [f"controlled, {limits}; a row every {amount(row, 's')}"]
    if steps := run.part("steps"):
        error, tolerance = number(steps.get("largest_error")), number(steps.get("tolerance"))
        if error > tolerance > 0.0:
            count = f"{steps.get('above_tolerance')} of {steps.get('accepted')} steps"
            excess = f"the largest error is {error / tolerance:.3g} times the tolerance"
            lines.append(f"TOLERANCE NOT MET in {count}: {excess}")
        sizes = ", ".join(f"{share} {amount(number(size), 's')}" for share, size in mapping(steps.get("sizes")).items())
        lines += [
            f"estimator {steps.get('estimator')}, tolerance {tolerance:g}, largest error {error:.2g}",
            f"{steps.get('accepted')} steps accepted, {steps.get('rejected')} taken back, "
            f"{steps.get('communication_points')} exchanges of values in all",
            f"sizes by share of steps that are shorter: {sizes}",
        ]
    return "\n".join(lines)


def _loop_rows(run: Run) -> Iterator[Row]:
    """Yield a row for each algebraic loop."""
    for loop in mappings(run.manifest.get("loops")):
        counts, names = mapping(loop.get("iterations")), texts(loop.get("components"))
        repeated, unsolved = ", ".join(texts(loop.get("repeated"))), mapping(loop.get("not_solved"))
        lines = [
            f"{str(loop.get('method', '')).title()}, relative tolerance {number(loop.get('tolerance')):g}, "
            f"unknowns {', '.join(texts(loop.get('unknowns')))}",
            f"iterations: {counts.get('start')} at the start, at most {counts.get('most')} at a communication point, "
            f"{counts.get('total')} at {loop.get('points')} points",
            *([f"repeated steps: {repeated}"] if repeated else []),
        ]
        if unsolved:
            lines = lines if number(counts.get("most")) > 1 else []
            if worst := mapping(unsolved.get("largest")):
                shares, last = mapping(unsolved.get("relative")), mapping(unsolved.get("last"))
                lines = [
                    f"residual at the end of a step: at most {number(worst.get('residual')):+.3g} of "
                    f"{worst.get('signal')} at t = {number(worst.get('time')):g} s, at last "
                    f"{number(last.get('residual')):+.3g}",
                    f"relative to the signal: {number(shares.get('median')):.2g} at half of the points, "
                    f"{number(shares.get('last')):.2g} at the last",
                    *lines,
                ]
            lines.insert(0, f"NOT SOLVED: {unsolved.get('reason')}")
        yield Row(f"Algebraic loop {' → '.join((*names, *names[:1]))}", "\n".join(lines))


def _pace_rows(run: Run) -> Iterator[Row]:
    """Yield a row on the pace of a run."""

    def milliseconds(seconds: object) -> str:
        value = 1e3 * number(seconds)
        return "below 0.001 ms" if 0.0 < value < 1e-3 else f"{value:.3g} ms"

    if not (pacing := run.part("pacing")):
        return
    overruns, jitter, points = mapping(pacing.get("overruns")), mapping(pacing.get("jitter")), pacing.get("points")
    lines = [f"{overruns.get('count')} of {points} communication points missed, as the steps took too long"]
    if "worst" in overruns:
        lines[0] += f", at worst {milliseconds(overruns['worst'])} at t = {number(overruns.get('at')):g} s"
    if jitter:
        names = {"p50": "median", "p99": "99 % of the points", "p999": "99.9 %", "max": "largest"}
        delays = ", ".join(f"{name} {milliseconds(jitter.get(k))}" for k, name in names.items())
        lines.append(f"delay of a point: {delays}")
    yield Row("Pace", "\n".join((f"{number(pacing.get('pace')):g} × real time", *lines)))


def criteria(run: Run) -> list[dict[str, Any]]:
    """Return title, value, allowed value, margin and outcome of the manifest's criteria as text."""
    rows = []
    for entry in mappings(run.manifest.get("criteria")):
        own_unit, unit = run.unit(str(entry.get("of"))), str(entry.get("unit") or "")
        value, bound = number(entry.get("value")), number(entry.get("max"))
        kind, target = str(entry.get("kind", "criterion")), entry.get("to")
        met = bool(entry["met"]) if "met" in entry else value <= bound
        parts = [f"{NAMES.get(kind, kind.replace('_', ' '))} of {entry.get('of', '?')}"]
        if target is not None:
            parts.append(f"to {target if isinstance(target, str) else amount(number(target), own_unit, None)}")
        if "band" in entry:
            parts.append(f"within ±{amount(number(entry['band']), own_unit, None, difference=True)}")
        parts += [f"{word} {amount(number(entry[word]), 's', None)}" for word in ("after", "until") if word in entry]
        if abs(value) < NEGLIGIBLE * bound:
            value = 0.0
        figure = partial(amount, unit=unit, difference=is_difference(entry))
        text = figure(value) if math.isfinite(value) else ("not settled" if kind == "settling_time" else "none")
        rest = bound - value
        margin = (
            f"{amount(abs(rest), unit, difference=True)} {'left' if rest >= 0 else 'over'}"
            if math.isfinite(rest)
            else ""
        )
        allowed = f"≤ {figure(bound, digits=None)}" if math.isfinite(bound) else ""
        rows.append({"title": " ".join(parts), "value": text, "allowed": allowed, "margin": margin, "met": met})
    return rows


def outcome(run: Run, judged: Sequence[Mapping[str, Any]]) -> str:
    """Return the run's outcome in one or two sentences."""
    if run.has_failed:
        reason = str(run.manifest["status"]).removeprefix("failed").lstrip(": ") or "no reason was recorded"
        return f"The simulation failed: {reason}. The rows before that are shown."
    missed = [c for c in judged if not c["met"]]
    if missed:
        first = missed[0]
        detail = f"{first['title']}: {first['value']}" + (f", allowed {first['allowed']}" if first["allowed"] else "")
        verb, which = ("was", detail) if len(missed) == 1 else ("were", f"first, {detail}")
        return f"{len(missed)} of {counted(len(judged), 'criterion')} {verb} missed ({which})."
    if judged:
        every = {1: "The criterion was met.", 2: "Both criteria were met."}
        return every.get(len(judged), f"All {counted(len(judged), 'criterion')} were met.")
    names = list(run.components) or list(run.variables)
    if not names or not run.time.size:
        return "Nothing was recorded."
    steps = counted(run.time.size - 1, "communication step")
    over = f"{amount(float(run.time[-1] - run.time[0]), 's', None)} in {steps}"
    return f"Simulated {join_names(names)} over {over}. No criteria are set, so nothing was judged."
