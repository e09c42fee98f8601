"""Tables of the page: badges, key figures, answers to steps, errors and effort, where the run came from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.report.judgement import Response, effort, error_rms, responses, saturation
from cosim.report.panels import QUANTITIES
from cosim.report.roles import SIDES, Craft, Run, mapping, mappings, number, texts
from cosim.report.sentences import SYMBOLS, Criterion, failed
from cosim.report.text import MISSING, amount, counted, length, percent, plain

SI = {"x": "m", "psi": "rad", "vx": "m/s", "psi_dot": "rad/s"}
MOST_RESPONSES = 16


@dataclass(frozen=True)
class Row:
    """A labelled value; `note` says how it was measured."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Grid:
    """A small table: its columns after the first, and rows whose first cell is their name."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Badge:
    """A fact at a glance; `tone` is good, bad, warn or plain."""

    text: str
    tone: str = "plain"


@dataclass(frozen=True)
class ResponseRow:
    """One reference step as text."""

    symbol: str
    time: str
    step: str
    settling: str
    believed: str
    overshoot: str
    rms: str
    final: str


@dataclass(frozen=True)
class Connection:
    """A connection and the noise on it."""

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
    found += [Badge(run.algorithm.replace("_", "-").title())] if run.algorithm else []
    noisy = any(mapping(link.get("noise")) for link in mappings(scenario.get("connections")))
    found += [Badge("noise on" if noisy and scenario.get("noise", True) else "noise off")] if run.links else []
    found += [Badge(f"seed {seed}")] if seed is not None else []
    warnings = texts(run.manifest.get("warnings"))
    found += [Badge(counted(len(warnings), "warning"), "warn")] if warnings else []
    found += [Badge("uncommitted changes", "warn")] if mapping(run.manifest.get("git")).get("dirty") else []
    return found


def tiles(run: Run, crafts: Sequence[Craft]) -> list[Row]:
    """The handful of numbers a reader looks for first; of the first craft."""
    found: list[Row] = []
    for variable in ("x", "psi"):
        answers = responses(crafts[0], variable) if crafts and not failed(run) else []
        if answers:
            band = "±0.02 m" if variable == "x" else "±0.02 rad"
            found.append(Row(f"Settling of {SYMBOLS[variable]}", _settling(answers[-1].settling), f"last step, {band}"))
    if found and crafts and (answers := responses(crafts[0], "x")):
        found.append(
            Row("Final error of x", length(answers[-1].final).replace("less than", "<"), "craft against reference")
        )
    shares = [saturation(craft, side) for craft in crafts[:1] for side in SIDES]
    if shares and all(map(math.isfinite, shares)):
        found.append(Row("Tilt at its limit", percent(max(shares)), "of the time, busier side"))
    factor = number(mapping(run.manifest.get("timings")).get("real_time_factor"))
    if math.isfinite(factor):
        found.append(
            Row("Simulation", f"{plain(factor, 2)}×", "faster than real time" if factor >= 1 else "of real time")
        )
    return found


def _settling(value: float) -> str:
    if math.isnan(value):
        return MISSING
    return amount(value, "s") if math.isfinite(value) else "not settled"


def response_rows(craft: Craft) -> list[ResponseRow]:
    """Answers of x and ψ to their references in order of time; the last ones where there are many."""
    answers = sorted((r for v in ("x", "psi") for r in responses(craft, v)), key=lambda r: (r.time, r.variable != "x"))
    return [_response_row(answer) for answer in answers[-MOST_RESPONSES:]]


def _response_row(answer: Response) -> ResponseRow:
    unit = SI[answer.variable]
    target = f"{amount(answer.start, unit)} → {amount(answer.target, unit)}"
    ramp = f", ramp of {amount(answer.ramp, 's', 2)}" if answer.ramp else ""
    sizes = (amount(value, unit, 2) for value in (answer.overshoot, answer.rms, answer.final))
    return ResponseRow(
        SYMBOLS[answer.variable], amount(answer.time, "s"), target + ramp, _settling(answer.settling),
        _settling(answer.believed), *sizes,
    )  # fmt: skip


def error_grid(craft: Craft) -> Grid | None:
    """RMS errors over the whole run: craft against reference, estimate against craft."""
    rows = []
    for quantity in QUANTITIES:
        true, unit = craft.signal(quantity.name), SI[quantity.name]
        tracking = error_rms(true, craft.reference(quantity.name))
        estimation = error_rms(craft.estimate(f"{quantity.name}_hat"), true)
        if math.isfinite(tracking) or math.isfinite(estimation):
            rows.append((quantity.symbol, amount(tracking, unit), amount(estimation, unit)))
    return Grid("RMS errors", ("craft − reference", "estimate − craft"), tuple(rows)) if rows else None


def tilt_grid(craft: Craft) -> Grid | None:
    """Effort and saturation over the whole run."""
    rows = []
    for side in SIDES:
        command = craft.command(f"tilt_{side}")
        good = np.abs(command[np.isfinite(command)]) if command is not None else np.zeros(0)
        if good.size:
            used = amount(effort(craft, side), "rad.s")
            rows.append((side, used, amount(float(good.max()), "rad"), percent(saturation(craft, side))))
    return Grid("Tilt commands", ("effort ∫|α| dt", "largest", "at its limit"), tuple(rows)) if rows else None


def connections(run: Run) -> list[Connection]:
    """The connections of the scenario."""
    return [
        Connection(str(link.get("from", "?")), str(link.get("to", "?")), _noise(run, link))
        for link in mappings(run.scenario.get("connections"))
    ]


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
        found.append(Row(str(name), ", ".join(f"{key} = {value}" for key, value in settings.items()), source))
    return found


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
