"""Rows of the page of any run: badges, connections, start values and provenance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from cosim.base.text import amount, counted, plain
from cosim.blocks.coupling import algorithms
from cosim.report.html_tables import Badge, Row
from cosim.simulation.report.recorded import Run, mapping, mappings, number, texts
from cosim.simulation.report.step_rows import loop_rows, pace_rows, step_rows
from cosim.simulation.report.verdicts import CriterionText, has_failed
from cosim.storage.yaml_file import short

MAX_SPELLED, MAX_CHANGES = 200, 8  # signals on a page, and changes of each


@dataclass(frozen=True)
class EventRow:
    """Events of a component with one cause: their number, and the time of the first."""

    component: str
    cause: str
    count: str
    first: str


def event_rows(run: Run) -> list[EventRow]:
    """Return the events of a run with event mode, by component and cause."""
    events = run.manifest.get("first_events")
    firsts: dict[tuple[str, str], float] = {}
    for event in events if isinstance(events, list) else []:
        time, *cause = event if isinstance(event, list) else [None]
        if isinstance(time, int | float) and len(cause) == 2:
            firsts.setdefault((str(cause[0]), str(cause[1])), float(time))
    return [
        EventRow(
            component, cause, str(count), f"{firsts[component, cause]:.6g} s" if (component, cause) in firsts else "–"
        )
        for component, counts in mapping(run.manifest.get("event_counts")).items()
        for cause, count in mapping(counts).items()
    ]


@dataclass(frozen=True)
class ConnectionRow:
    """A connection with its noise and faults."""

    source: str
    target: str
    noise: str


def badges(run: Run, judged: Sequence[CriterionText]) -> list[Badge]:
    """Return badges: status, criteria, algorithm, noise, seed and warnings."""
    met = sum(criterion.met for criterion in judged)
    seed, warnings = run.manifest.get("seed"), texts(run.manifest.get("warnings"))
    badges = (
        (True, Badge("failed", "bad") if has_failed(run) else Badge("completed", "good" if judged else "plain")),
        (judged, Badge(f"{met} of {counted(len(judged), 'criterion')} met", "good" if met == len(judged) else "bad")),
        (run.algorithm and run.links, Badge(_title(run.algorithm))),
        (run.links, Badge("noise on" if _has_noise(run.scenario) else "noise off")),
        (seed is not None and _has_noise(run.scenario), Badge(f"seed {seed}")),
        (warnings, Badge(counted(len(warnings), "warning"), "warn")),
        (mapping(run.manifest.get("git")).get("dirty"), Badge("uncommitted changes", "warn")),
    )
    return [badge for applies, badge in badges if applies]


def _has_noise(scenario: Mapping[str, Any]) -> bool:
    """Return whether any connection or fix sensor adds noise."""
    sensors = (mapping(mapping(c).get("signals")) for c in mapping(scenario.get("components")).values())
    sources = (*mappings(scenario.get("connections")), *(signal for signals in sensors for signal in signals.values()))
    return bool(scenario.get("noise", True)) and any(mapping(mapping(source).get("noise")) for source in sources)


def _title(algorithm: str) -> str:
    """Return an algorithm's title, derived from its name if not installed."""
    entry = algorithms().get(algorithm)
    return entry.title if entry else algorithm.replace("_", "-").title()


def items_of(run: Run) -> dict[str, dict[float, str]]:
    """Return column → enumeration items by number."""
    columns = mapping(run.manifest.get("items"))
    return {str(c): {number(v): str(name) for name, v in mapping(items).items()} for c, items in columns.items()}


def spelled_values(run: Run) -> list[Row]:
    """Return table rows of recorded values without curve, with the times of their changes.

    These are text, 64-bit integers, binary data and enumeration items.
    """
    rows = []
    for column, items in islice(mapping(run.manifest.get("items")).items(), MAX_SPELLED):
        if column in run.results and run.time.size:
            names, numbers = {value: name for name, value in mapping(items).items()}, run.results[column]
            points = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist()]
            texts = [str(names.get(numbers[k], f"{numbers[k]:g}")) for k in points[: MAX_CHANGES + 1]]
            rows.append(Row(column, _over_time(run, points, texts)))
    for column, values in islice(run.results.exact.items(), MAX_SPELLED):
        points = [k for k in range(min(len(values), run.time.size)) if not k or values[k] != values[k - 1]]
        first = (values[k] for k in points[: MAX_CHANGES + 1])
        texts = [short(value.hex() if isinstance(value, bytes) else value) for value in first]
        rows.append(Row(column, _over_time(run, points, texts)))
    return rows


def _over_time(run: Run, points: Sequence[int], texts: Sequence[str]) -> str:
    """Return a value's first changes with their times."""
    parts = [f"from {run.time[k]:g} s {text}" if k else text for k, text in zip(points, texts, strict=False)]
    more = len(points) - len(parts)
    return "; ".join([*parts, *([f"and {counted(more, 'more change')}"] if more > 0 else [])])


def connections(run: Run) -> list[ConnectionRow]:
    """Return the connections of the scenario."""
    return [
        ConnectionRow(str(link.get("from", "?")), str(link.get("to", "?")), "; ".join(disturbances(run, link)))
        for link in mappings(run.scenario.get("connections"))
    ]


def disturbances(run: Run, link: Mapping[str, Any]) -> list[str]:
    """Return a connection's noise and injected faults as text."""
    faults = (fault_text(fault) for fault in faults_on(run, [str(link.get("to"))]))
    return [*filter(None, [_noise(run, link)]), *faults]


def faults_on(run: Run, inputs: Sequence[str]) -> list[Mapping[str, Any]]:
    """Return faults injected into connections to given inputs."""
    names = {*inputs, *(name.partition("[")[0] for name in inputs)}
    return [fault for fault in mappings(run.scenario.get("faults")) if fault.get("on") in names]


def fault_text(fault: Mapping[str, Any]) -> str:
    """Return a fault as text: `bias 0.1 from 2 s to 4 s`."""
    sizes = [str(fault["value"])] if "value" in fault else []
    sizes += [f"of {fault['delay']} s"] if "delay" in fault else []
    sizes += [f"with probability {fault['probability']}"] if "probability" in fault else []
    times = [f"{key} {fault[key]} s" for key in ("from", "to") if key in fault]
    return " ".join([f"fault: {fault.get('kind', '?')}", *sizes, *times])


def _noise(run: Run, link: Mapping[str, Any]) -> str:
    """Return a connection's noise with its standard deviation. The manifest holds the variance."""
    noise = mapping(link.get("noise"))
    if not noise:
        return ""
    unit = run.unit(str(link.get("to"))) or run.unit(str(link.get("from")))
    variance, bias = number(noise.get("variance"), 0.0), number(noise.get("bias"), 0.0)
    parts = [f"σ\u00a0=\u00a0{amount(math.sqrt(variance), unit)}"] if variance > 0 else []
    parts += [f"bias {amount(bias, unit)}"] if bias else []
    parts += [f"{key} {value}" for key, value in noise.items() if key not in ("variance", "bias")]
    return ", ".join(parts) or "none"


@dataclass(frozen=True)
class ComponentRow:
    """A component of the scenario.

    Attributes:
        source: Its FMU or block.
        kind: FMI version and interface, "built-in block", or "".
        settings: Start values and settings.
    """

    label: str
    source: str
    kind: str
    settings: str


def component_rows(run: Run, kinds: Mapping[str, str]) -> list[ComponentRow]:
    """Return the scenario's components.

    Args:
        kinds: Component → FMI version and interface, as far as known.
    """
    rows = []
    for name, value in mapping(run.scenario.get("components")).items():
        component = mapping(value)
        chosen = {key: setting for key, setting in component.items() if setting != {} and setting is not False}
        settings = {**chosen, **mapping(component.get("start"))}.items()
        hidden = {"start", "fmu", "block", "sha256", *(("interface",) if name in kinds else ())}
        texts = [_setting_text(k, v) for k, v in settings if k not in hidden]
        kind = kinds.get(str(name), "block of cosim" if component.get("block") else "")
        source = str(component.get("fmu") or component.get("block") or "")
        rows.append(ComponentRow(str(name), source, kind, ", ".join(texts)))
    return rows


def _setting_text(key: str, value: object) -> str:
    """Return a setting as text; a step of its own is named in full."""
    text = f"{key} = {_format_setting(value)}"
    return f"{text} s (communication step of its own)" if key == "step" else text


def _format_setting(value: object) -> str:
    """Return a setting in scenario notation on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_format_setting(v)}" for key, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_format_setting, value)) + "]"
    return str(value)


def provenance(run: Run, kinds: Mapping[str, str]) -> list[Row]:
    """Return known facts for reproducing the run.

    Args:
        kinds: Component → FMI version and interface, as far as known.
    """
    manifest, scenario = run.manifest, run.scenario
    git, timings, seed = mapping(manifest.get("git")), mapping(manifest.get("timings")), manifest.get("seed")
    dirty = git.get("dirty")
    wall = [f"{key} {amount(number(timings[key]), 's')}" for key in ("load", "simulate") if key in timings]
    if math.isfinite(speed := number(timings.get("real_time_factor"))):
        wall.append(f"{plain(speed, 2)} times as fast as real time")
    facts = (
        Row("cosim", str(manifest.get("cosim_version") or "")),
        Row("Versions", _pairs(mapping(manifest.get("versions")), " ")),
        Row("Git revision", str(git.get("revision") or ""), "with uncommitted changes" if dirty else "clean"),
        Row("Simulated time", f"{number(scenario['duration']):g} s" if "duration" in scenario else ""),
        *step_rows(run),
        Row("Coupling algorithm", run.algorithm),
        Row("Seed", "" if seed is None else str(seed)),
        Row("Wall time", ", ".join(wall)),
    )
    entries = mapping(manifest.get("fmus")).items()
    fmus = (_fmu_row(name, mapping(fmu), kinds.get(str(name), "")) for name, fmu in entries)
    return [*fmus, *(fact for fact in facts if fact.value), *loop_rows(run), *pace_rows(run)]


def _pairs(facts: Mapping[str, Any], between: str) -> str:
    return ", ".join(f"{key}{between}{value}" for key, value in facts.items())


def _fmu_row(name: str, fmu: Mapping[str, Any], kind: str) -> Row:
    """Return an FMU's identity, a line per fact."""
    keys = ("model_name", "version", "guid", "sha256", "generation_tool")
    lines = [*filter(None, [kind]), *(f"{key.replace('_', ' ')} {fmu[key]}" for key in keys if fmu.get(key))]
    return Row(f"FMU {name}", "\n".join(lines), str(fmu.get("path") or ""))
