"""`cosim info`: list variables and capabilities of FMUs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.verbs.options import Compile, Json, Texts
from cosim.verbs.terminal import say, say_json, some, table

if TYPE_CHECKING:
    from cosim.blocks.summary import Summary, Variable
    from cosim.probing.fmu_structure import Pair, Port, ProbedParameter, Structure
    from cosim.probing.places import Places

SECTIONS = {"inputs": ("input",), "outputs": ("output",), "parameters": ("parameter", "structuralParameter")}
UNITS = {"start": " s", "stop": " s", "step": " s", "tolerance": ""}  # of a default experiment
MAX_NAMES = 8  # states, and items of an enumeration
MAX_PARAMETERS = 60  # parameters in the table; --all shows every one


def command(
    fmus: Annotated[list[Path], typer.Argument(metavar="FMU", help="FMU to describe.")],
    *,
    every: Annotated[bool, typer.Option("--all", help="List local variables and every parameter too.")] = False,
    places: Annotated[
        bool,
        typer.Option("--places", help="Execute each FMU to find the places where terms can act."),
    ] = False,
    log: Annotated[
        Texts, typer.Option("--log", metavar="LOG", help="Measured log that drives the inputs for --places.")
    ] = None,
    compile_: Compile = False,
    limits: Annotated[
        str, typer.Option("--limits", help="Limits of each simulation for --places, for example 'step: 10 s'.")
    ] = "",
    as_json: Json = False,
) -> None:
    """List variables, units, defaults and capabilities of FMUs.

    Example: cosim info plant.fmu controller.fmu
    """
    from cosim.blocks.summary import summaries

    if not places and (log or limits or compile_):
        raise typer.BadParameter("--log, --limits and --compile need --places")
    descriptions = summaries(fmus)
    probed = [_probe(fmu, log or [], limits, compiles=compile_) if places else None for fmu in fmus]
    if as_json:
        contents = [_content(s, p) for s, p in zip(descriptions, probed, strict=True)]
        say_json(contents if len(contents) > 1 else contents[0])
        return
    for number, (summary, found) in enumerate(zip(descriptions, probed, strict=True)):
        say(*([""] if number else []), *_overview(summary))
        say(*(_variables(summary, every=every) if found is None else _places(found)))


def _content(summary: Summary, places: Places | None) -> dict[str, Any]:
    """Return the content of an FMU for JSON."""
    return summary.as_json() | ({} if places is None else {"places": places.as_json()})


def _probe(fmu: Path, logs: Sequence[str], limits: str, *, compiles: bool) -> Places:
    from cosim.blocks.compiling import compiling
    from cosim.isolation.limits import read_limits
    from cosim.probing.places import probe_places
    from cosim.probing.prober import LIMITS
    from cosim.residuals.drive import log_of_fmu

    read = [log_of_fmu(Path(log), fmu, alone=len(logs) == 1) for log in logs]
    with compiling(compiles):
        return probe_places(fmu, read, limits=read_limits(limits) if limits else LIMITS)


def _places(p: Places) -> list[str]:
    """Return the tables of places, and the findings."""
    s, lines = p.structure, [f"way: {p.way}: {p.reason}"]
    pairs = [(f"  {pair.position}", pair.velocity, f"{pair.gain:.6g}", _ports(pair)) for pair in s.pairs]
    lines += _titled("pairs", ("  position", "velocity", "gain", "forces (gain)"), pairs)
    joined = [
        (f"  {c.first.position}", c.second.position, f"{c.stiffness:.6g}", f"{c.damping:.6g}") for c in s.connections
    ]
    lines += _titled("connections", ("  position", "and", "spring", "damper"), joined) if joined else []
    braked = [(f"  {d.parameter}", d.pair.velocity, f"{d.gain:.6g}", ", ".join(d.rates)) for d in s.dampings]
    lines += _titled("dampings", ("  parameter", "velocity", "gain", "changes the rates of"), braked) if braked else []
    lines += _storages(s)
    shows = {output: state for state, output in s.shown.items()}
    sensors = [(f"  {q.name}", q.unit, shows.get(q.name, "")) for q in s.outputs]
    lines += _titled("sensors", ("  output", "unit", "shows the state"), sensors)
    lines += _titled(
        "inputs", ("  input", "unit", "start"), [(f"  {q.name}", q.unit, f"{q.start:.6g}") for q in s.inputs]
    )
    parameters = [(f"  {q.name}", q.quantity.unit, f"{q.quantity.start:.6g}", _acting(q)) for q in s.parameters]
    lines += _titled("parameters", ("  parameter", "unit", "start", "acts"), parameters)
    return [*lines, f"findings: {len(p.findings) or 'none'}", *(f"  {finding}" for finding in p.findings)]


def _storages(s: Structure) -> list[str]:
    header = ("  output", "unit", "start", "input (gain)") if s.feeds else ("  state", "unit", "start")
    stored = [q for q in s.states or s.outputs if q.name in s.storages]
    rows = [(f"  {q.name}", q.unit, f"{q.start:.6g}", *_feed(s.feeds.get(q.name))) for q in stored]
    return _titled("storages", header, rows)


def _titled(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"{title}: {len(rows)}", *table(header, rows)] if rows else [f"{title}: none"]


def _ports(pair: Pair) -> str:
    return ", ".join(name for port in pair.ports for name in _feed(port)) or "none"


def _feed(port: Port | None) -> tuple[str, ...]:
    return (f"{port.input} ({port.gain:.4g})",) if port else ()


def _acting(parameter: ProbedParameter) -> str:
    acts = "yes" if parameter.acts else "at the start only" if parameter.starts else "no"
    return f"{acts}, and the FMU fails with a value near it" if parameter.failure else acts


def _overview(s: Summary) -> list[str]:
    """Return the lines about an FMU before its variables."""
    from cosim.blocks.description import C_CODE

    experiment = [f"{key} {s.experiment[key]:g}{unit}" for key, unit in UNITS.items() if key in s.experiment]
    without = " without --compile" if C_CODE in s.platforms else ""
    here = "" if s.runs_here else f", so it does not run on this machine{without}"
    return [
        f"{s.file}: {s.name}, FMI {s.fmi_version} for {', '.join(s.ways)}" + (f", by {s.tool}" if s.tool else ""),
        *([f"  {s.description}"] if s.description else []),
        f"  default experiment: {', '.join(experiment) or 'none'}",
        f"  platforms: {', '.join(s.platforms) or 'none'}{here}",
        *(f"  {way}: {', '.join(_flags(flags)) or 'no capability declared'}" for way, flags in s.capabilities.items()),
        f"  states: {s.state_count}" + (f" ({some(s.states, MAX_NAMES)})" if s.states else ""),
        *(f"  warning: {slip}" for slip in s.slips[:5]),
    ]


def _variables(s: Summary, *, every: bool) -> list[str]:
    """Return the tables of variables; local variables are counted unless all are shown."""
    lines = [line for title, causalities in SECTIONS.items() for line in _section(title, s.of(*causalities), every)]
    listed = {"independent"}.union(*SECTIONS.values())
    others = [v for v in s.variables if v.causality not in listed]
    if every:
        return lines + _section("others", others, True)
    more = f"{len(others)} more: locals and calculated parameters (--all lists them)"
    return [*lines, more] if others else lines


def _flags(flags: dict[str, object]) -> list[str]:
    return [name if value is True else f"{name} {value}" for name, value in flags.items()]


def _section(title: str, variables: list[Variable], every: bool) -> list[str]:
    if not variables:
        return [f"{title}: none"] if title != "others" else []
    listed = variables if every or title != "parameters" else variables[:MAX_PARAMETERS]
    rows = []
    for v in listed:
        name = f"  {v.name}{list(v.dimensions) if v.dimensions else ''}"
        rows.append((name, v.type, v.unit, _start(v), _range(v), v.description[:80]))
    header = ("  name", "type", "unit", "start", "range", "description")
    more = [f"  … and {len(variables) - len(listed)} more (--all)"] if len(listed) < len(variables) else []
    return [f"{title}: {len(variables)}", *table(header, rows), *more]


def _start(v: Variable) -> str:
    item = next((name for name, number in v.items.items() if str(number) == v.start), "")
    return f"{v.start} ({item})" if item else (v.start or "")[:30]


def _range(v: Variable) -> str:
    if v.items:
        return some([f"{number} {name}" for name, number in v.items.items()], MAX_NAMES)
    return "" if v.min is None and v.max is None else f"{v.min or '-∞'} … {v.max or '∞'}"
