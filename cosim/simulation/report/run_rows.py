"""Rows of the page about any run: badges, connections, start values, where it came from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from cosim.base.text import amount, counted
from cosim.coupling.algorithms import algorithms
from cosim.report.html_tables import Badge, Row
from cosim.simulation.report.recorded import Run, mapping, mappings, number, texts
from cosim.simulation.report.verdicts import Criterion, failed
from cosim.storage.yaml_file import short

MOST_SPELLED, MOST_CHANGES = 200, 8  # signals, and changes of each, that a page spells out


@dataclass(frozen=True)
class Connection:
    """A connection, and the noise and the faults on it."""

    source: str
    target: str
    noise: str


def badges(run: Run, judged: Sequence[Criterion]) -> list[Badge]:
    """Status, criteria, algorithm, noise, seed, then what asks for attention."""
    found = [Badge("failed", "bad") if failed(run) else Badge("completed", "good")]
    if judged:
        met = sum(criterion.met for criterion in judged)
        found.append(
            Badge(f"{met} of {counted(len(judged), 'criterion')} met", "good" if met == len(judged) else "bad")
        )
    scenario, seed = run.scenario, run.manifest.get("seed")
    found += [Badge(_title(run.algorithm))] if run.algorithm else []
    measured = (mapping(c).get("signals") for c in mapping(scenario.get("components")).values())
    sources = (*mappings(scenario.get("connections")), *(s for found in measured for s in mapping(found).values()))
    noisy = any(mapping(mapping(source).get("noise")) for source in sources)
    found += [Badge("noise on" if noisy and scenario.get("noise", True) else "noise off")] if run.links else []
    found += [Badge(f"seed {seed}")] if seed is not None else []
    warnings = texts(run.manifest.get("warnings"))
    found += [Badge(counted(len(warnings), "warning"), "warn")] if warnings else []
    found += [Badge("uncommitted changes", "warn")] if mapping(run.manifest.get("git")).get("dirty") else []
    return found


def _title(algorithm: str) -> str:
    """Return the title of an algorithm, made from its name if it is not installed here."""
    known = algorithms().get(algorithm)
    return known.title if known else algorithm.replace("_", "-").title()


def items_of(run: Run) -> dict[str, dict[float, str]]:
    """Names of an enumeration's items by their numbers, of each column that has them."""
    found = mapping(run.manifest.get("items"))
    return {str(c): {number(v): str(name) for name, v in mapping(items).items()} for c, items in found.items()}


def spelled(run: Run) -> list[Row]:
    """What no curve shows, with the times of its changes: text, 64-bit integers, binary data, items by their names."""
    found = []
    for column, items in islice(mapping(run.manifest.get("items")).items(), MOST_SPELLED):
        if column in run.results and run.time.size:
            names = {value: name for name, value in mapping(items).items()}
            values = run.results[column]
            points = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist()]
            told = {k: str(names.get(values[k], f"{values[k]:g}")) for k in points[: MOST_CHANGES + 1]}
            found.append(Row(column, _over_time(run, told, len(points))))
    for column, kept in islice(run.results.exact.items(), MOST_SPELLED):
        points = [k for k in range(min(len(kept), run.time.size)) if not k or kept[k] != kept[k - 1]]
        told = {k: short(kept[k].hex() if isinstance(kept[k], bytes) else kept[k]) for k in points[: MOST_CHANGES + 1]}
        found.append(Row(column, _over_time(run, told, len(points))))
    return found


def _over_time(run: Run, values: Mapping[int, str], points: int) -> str:
    parts = [value if k == 0 else f"from {run.time[k]:g} s {value}" for k, value in values.items()]
    more = points - len(parts)
    return "; ".join([*parts, *([f"and {counted(more, 'more change')}"] if more > 0 else [])])


def connections(run: Run) -> list[Connection]:
    """The connections of the scenario."""
    return [
        Connection(str(link.get("from", "?")), str(link.get("to", "?")), "; ".join(_acting(run, link)))
        for link in mappings(run.scenario.get("connections"))
    ]


def _acting(run: Run, link: Mapping[str, Any]) -> list[str]:
    """What acts on a connection: its noise, then each injected fault."""
    noise, target = _noise(run, link), str(link.get("to"))
    return [*([noise] if noise else []), *(fault_text(fault) for fault in faults_on(run, [target]))]


def faults_on(run: Run, inputs: Sequence[str]) -> list[Mapping[str, Any]]:
    """Faults injected into the connections to these inputs."""
    faults = mappings(run.scenario.get("faults"))
    if not faults:
        return []
    arrays = {name.partition("[")[0] for name in inputs}
    return [fault for fault in faults if fault.get("on") in {*inputs, *arrays}]


def fault_text(fault: Mapping[str, Any]) -> str:
    """A fault as said in a line: `bias 0.1 from 2 s to 4 s`."""
    sizes = [str(fault["value"])] if "value" in fault else []
    sizes += [f"of {fault['delay']} s"] if "delay" in fault else []
    sizes += [f"with probability {fault['probability']}"] if "probability" in fault else []
    times = [f"{key} {fault[key]} s" for key in ("from", "to") if key in fault]
    return " ".join([f"fault: {fault.get('kind', '?')}", *sizes, *times])


def _noise(run: Run, link: Mapping[str, Any]) -> str:
    """Standard deviation and bias in the unit shown elsewhere; the manifest keeps the variance."""
    noise = mapping(link.get("noise"))
    if not noise:
        return ""
    unit = run.unit(str(link.get("to"))) or run.unit(str(link.get("from")))
    variance, bias = number(noise.get("variance"), 0.0), number(noise.get("bias"), 0.0)
    parts = [f"σ\u00a0=\u00a0{amount(math.sqrt(variance), unit)}"] if variance > 0 else []
    parts += [f"bias {amount(bias, unit)}"] if bias else []
    parts += [f"{key} {value}" for key, value in noise.items() if key not in ("variance", "bias")]
    return ", ".join(parts) or "none"


def starts(run: Run) -> list[Row]:
    """Start values and settings the scenario gave its components."""
    found = []
    for name, component in mapping(run.scenario.get("components")).items():
        kind = mapping(component)
        settings = {**kind, **mapping(kind.get("start"))}
        settings = {key: value for key, value in settings.items() if key not in ("start", "fmu", "block", "sha256")}
        source = str(kind.get("fmu") or kind.get("block") or "")
        found.append(Row(str(name), ", ".join(f"{key} = {_said(value)}" for key, value in settings.items()), source))
    return found


def _said(value: object) -> str:
    """A setting as one writes it in a scenario, on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_said(v)}" for key, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_said, value)) + "]"
    return str(value)


def provenance(run: Run) -> list[Row]:
    """What is needed to get the same numbers again."""
    manifest, scenario = run.manifest, run.scenario
    found = []
    for name, fmu in mapping(manifest.get("fmus")).items():
        fields = mapping(fmu)
        identity = [
            f"{key.replace('_', ' ')} {fields[key]}"
            for key in ("model_name", "version", "guid", "sha256", "generation_tool")
            if fields.get(key)
        ]
        found.append(Row(f"FMU {name}", "\n".join(identity), str(fields.get("path") or "")))
    if manifest.get("cosim_version"):
        found.append(Row("cosim", str(manifest["cosim_version"])))
    versions = mapping(manifest.get("versions"))
    found += [Row("Versions", ", ".join(f"{key} {value}" for key, value in versions.items()))] if versions else []
    git = mapping(manifest.get("git"))
    state = "with uncommitted changes" if git.get("dirty") else "clean"
    found += [Row("Git revision", str(git["revision"]), state)] if git.get("revision") else []
    facts = {"Duration": ("duration", "s"), "Step": ("step", "s")}
    found += [
        Row(label, f"{number(scenario[key]):g} {unit}") for label, (key, unit) in facts.items() if key in scenario
    ]
    found += [Row("Algorithm", run.algorithm)] if run.algorithm else []
    found += [Row("Seed", str(manifest["seed"]))] if manifest.get("seed") is not None else []
    design = mapping(manifest.get("design")) or mapping(scenario.get("design"))
    found += [Row("Design", ", ".join(f"{key} = {value}" for key, value in design.items()))] if design else []
    timings = mapping(manifest.get("timings"))
    wall = [f"{key} {amount(number(timings[key]), 's')}" for key in ("load", "simulate") if key in timings]
    found += [Row("Wall time", ", ".join(wall))] if wall else []
    return found
