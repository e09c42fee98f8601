"""`cosim info`: list variables and capabilities of FMUs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from cosim.core.text import some
from cosim.verbs.cli import say, say_json, table

if TYPE_CHECKING:
    from cosim.blocks.summary import Summary, Variable
    from cosim.probing.fmu_structure import Port
    from cosim.probing.places import Places

SECTIONS = {"inputs": ("input",), "outputs": ("output",), "parameters": ("parameter", "structuralParameter")}
UNITS = {"start": " s", "stop": " s", "step": " s", "tolerance": ""}  # of a default experiment
MAX_NAMES = 8  # states, and items of an enumeration
MAX_PARAMETERS = 60  # parameters in the table; --all shows every one


def command(
    fmus: list[Path],
    *,
    every: bool = False,
    places: bool = False,
    log: list[str] | None = None,
    compile: bool = False,
    limits: str = "",
    json: bool = False,
) -> None:
    """List variables, units, defaults and capabilities of FMUs.

    Args:
        fmus (FMU): FMU to describe.
        every (--all): List local variables and every parameter too.
        places: Execute each FMU to find the places where terms can act.
        log (LOG): Measured log that drives the inputs for --places.
        compile: Compile and execute the sources of FMUs that have no library for this machine.
        limits: Limits of each simulation for --places, for example 'step: 10 s'.

    Example: cosim info plant.fmu controller.fmu
    """
    from cosim.blocks.summary import summaries

    if not places and (log or limits or compile):
        raise typer.BadParameter("--log, --limits and --compile need --places")
    descriptions = summaries(fmus)
    probed: dict[Path, Places] = {}
    if places:
        from cosim.blocks.compiling import compiling
        from cosim.isolation.limits import read_limits
        from cosim.probing.places import probe_places
        from cosim.probing.prober import LIMITS
        from cosim.residuals.drive import log_of_fmu

        most, logs = read_limits(limits) if limits else LIMITS, log or []
        for fmu in fmus:
            read = [log_of_fmu(Path(name), fmu, alone=len(logs) == 1) for name in logs]
            with compiling(compile):
                probed[fmu] = probe_places(fmu, read, limits=most)
    contents, blank = [], [""]
    for fmu, summary in zip(fmus, descriptions, strict=True):
        contents.append(summary.as_json() | ({"places": probed[fmu].as_json()} if places else {}))
        say(*(blank if len(contents) > 1 else []), *_overview(summary))
        say(*(_places(probed[fmu]) if places else _variables(summary, every=every)))
    if json:
        say_json(contents if len(contents) > 1 else contents[0])


def _places(p: Places) -> list[str]:
    """Return the tables of places, and the findings."""

    def forces(*ports: Port | None) -> str:
        return ", ".join(f"{port.input} ({port.gain:.4g})" for port in ports if port)

    s = p.structure
    header = ("  output", "unit", "start", "input (gain)") if s.feeds else ("  state", "unit", "start", "")
    stored = [q for q in s.states or s.outputs if q.name in s.storages]
    storages = [(f"  {q.name}", q.unit, f"{q.start:.6g}", forces(s.feeds.get(q.name))) for q in stored]
    shows = {output: state for state, output in s.shown.items()}
    parameters = []
    for q in s.parameters:
        acts = "yes" if q.acts else "at the start only" if q.starts else "no"
        acts += ", and the FMU fails with a value near it" if q.failure else ""
        parameters.append((f"  {q.name}", q.quantity.unit, f"{q.quantity.start:.6g}", acts))
    pairs = [(f"  {r.position}", r.velocity, f"{r.gain:.6g}", forces(*r.ports) or "none") for r in s.pairs]
    joined = [
        (f"  {c.first.position}", c.second.position, f"{c.stiffness:.6g}", f"{c.damping:.6g}") for c in s.connections
    ]
    braked = [(f"  {d.parameter}", d.pair.velocity, f"{d.gain:.6g}", ", ".join(d.rates)) for d in s.dampings]
    sections: list[tuple[str, tuple[str, ...], Sequence[Sequence[str]]]] = [
        ("pairs", ("  position", "velocity", "gain", "forces (gain)"), pairs),
        *([("connections", ("  position", "and", "spring", "damper"), joined)] if joined else []),
        *([("dampings", ("  parameter", "velocity", "gain", "changes the rates of"), braked)] if braked else []),
        ("storages", header, storages),
        ("sensors", ("  output", "unit", "shows"), [(f"  {q.name}", q.unit, shows.get(q.name, "")) for q in s.outputs]),
        ("inputs", ("  input", "unit", "start"), [(f"  {q.name}", q.unit, f"{q.start:.6g}") for q in s.inputs]),
        ("parameters", ("  parameter", "unit", "start", "acts"), parameters),
    ]
    lines = [f"way: {s.way}: {p.reason}"]
    for title, heads, rows in sections:
        lines += [f"{title}: {len(rows)}", *table(heads, rows)] if rows else [f"{title}: none"]
    return [*lines, f"findings: {len(p.findings) or 'none'}", *(f"  {finding}" for finding in p.findings)]


def _overview(s: Summary) -> list[str]:
    """Return the lines about an FMU before its variables."""
    from cosim.fmi.description import C_CODE

    experiment = [f"{key} {s.experiment[key]:g}{unit}" for key, unit in UNITS.items() if key in s.experiment]
    without = " without --compile" if C_CODE in s.platforms else ""
    here = "" if s.runs_here else f", so it does not run on this machine{without}"
    capabilities = []
    for way, flags in s.capabilities.items():
        names = [name if value is True else f"{name} {value}" for name, value in flags.items()]
        capabilities.append(f"  {way}: {', '.join(names) or 'no capability declared'}")
    return [
        f"{s.file}: {s.name}, FMI {s.fmi_version} for {', '.join(s.ways)}" + (f", by {s.tool}" if s.tool else ""),
        *([f"  {s.description}"] if s.description else []),
        f"  default experiment: {', '.join(experiment) or 'none'}",
        f"  platforms: {', '.join(s.platforms) or 'none'}{here}",
        *capabilities,
        f"  states: {s.state_count}" + (f" ({some(s.states, MAX_NAMES)})" if s.states else ""),
        *(f"  warning: {slip}" for slip in s.slips[:5]),
    ]


def _variables(s: Summary, *, every: bool) -> list[str]:
    """Return the tables of variables; local variables are counted unless all are shown."""
    groups = {title: s.of(*causalities) for title, causalities in SECTIONS.items()}
    others = [v for v in s.variables if v.causality not in {"independent"}.union(*SECTIONS.values())]
    if every and others:
        groups["others"] = others
    lines = []
    for title, variables in groups.items():
        listed = variables if every or title != "parameters" else variables[:MAX_PARAMETERS]
        header = ("  name", "type", "unit", "start", "range", "description")
        lines += (
            [f"{title}: {len(variables)}", *table(header, [*map(_row, listed)])] if variables else [f"{title}: none"]
        )
        lines += [f"  … and {len(variables) - len(listed)} more (--all)"] if len(listed) < len(variables) else []
    if others and not every:
        lines.append(f"{len(others)} more: locals and calculated parameters (--all lists them)")
    return lines


def _row(v: Variable) -> tuple[str, ...]:
    """Return the cells of a variable: name, type, unit, start, range, description."""
    item = next((name for name, number in v.items.items() if str(number) == v.start), "")
    start = f"{v.start} ({item})" if item else (v.start or "")[:30]
    limits = "" if v.min is None and v.max is None else f"{v.min or '-∞'} … {v.max or '∞'}"
    if v.items:
        limits = some([f"{number} {name}" for name, number in v.items.items()], MAX_NAMES)
    name = f"  {v.name}{list(v.dimensions) if v.dimensions else ''}"
    return name, v.type, v.unit, start, limits, v.description[:80]
