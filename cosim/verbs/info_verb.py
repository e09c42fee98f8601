"""`cosim info`: list what FMUs have."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.blocks.description import C_CODE
from cosim.verbs.terminal import Json, say, say_json, table

if TYPE_CHECKING:
    from cosim.blocks.summary import Summary, Variable

SHOWN = {"input": "inputs", "output": "outputs", "parameter": "parameters"}
MOST = 60  # parameters in the table; --all shows every one


def command(
    fmus: Annotated[list[Path], typer.Argument(help="FMUs.")],
    every: Annotated[bool, typer.Option("--all", help="Locals and every parameter, too.")] = False,
    as_json: Json = False,
) -> None:
    """List what FMUs have: variables with types, units and defaults, capabilities, platforms, states."""
    from cosim.blocks.summary import summaries

    found = summaries(fmus)
    if as_json:
        say_json([s.as_json() for s in found] if len(found) > 1 else found[0].as_json())
        return
    for number, summary in enumerate(found):
        for line in ([""] if number else []) + _told(summary, every=every):
            say(line)


def _told(s: Summary, *, every: bool) -> list[str]:
    ways = ", ".join(s.ways)
    lines = [f"{s.file}: {s.name}, FMI {s.fmi_version} for {ways}" + (f", by {s.tool}" if s.tool else "")]
    lines += [f"  {s.description}"] if s.description else []
    e = s.experiment
    named = [
        f"{key} {e[key]:g}{'' if key == 'tolerance' else ' s'}"
        for key in ("start", "stop", "step", "tolerance")
        if key in e
    ]
    lines += [
        f"  default experiment: {', '.join(named) or 'none'}",
        f"  platforms: {', '.join(s.platforms) or 'none'}"
        + ("" if s.runs_here else ", so it does not run on this machine")
        + (" without --compile" if not s.runs_here and C_CODE in s.platforms else ""),
    ]
    lines += [
        f"  {way}: {', '.join(_flags(flags)) or 'no capability declared'}" for way, flags in s.capabilities.items()
    ]
    lines += [f"  states: {s.state_count}" + (f" ({_some(s.states)})" if s.states else "")]
    lines += [f"  warning: {slip}" for slip in s.slips[:5]]
    for causality, title in SHOWN.items():
        lines += _section(title, s.of(*(causality, "structuralParameter")[: 1 + (causality == "parameter")]), every)
    others = [
        v for v in s.variables if v.causality not in SHOWN and v.causality not in ("structuralParameter", "independent")
    ]
    if every:
        lines += _section("others", others, True)
    elif others:
        lines.append(f"{len(others)} more: locals and calculated parameters (--all lists them)")
    return lines


def _flags(flags: dict[str, object]) -> list[str]:
    return [name if value is True else f"{name} {value}" for name, value in flags.items()]


def _section(title: str, variables: list[Variable], every: bool) -> list[str]:
    if not variables:
        return [f"{title}: none"] if title != "others" else []
    shown = variables if every or title != "parameters" else variables[:MOST]
    rows = [
        (
            f"  {v.name}{list(v.dimensions) if v.dimensions else ''}",
            v.type,
            v.unit,
            _start(v),
            _range(v),
            v.description[:80],
        )
        for v in shown
    ]
    header = ("  name", "type", "unit", "start", "range", "description")
    more = [f"  … and {len(variables) - len(shown)} more (--all)"] if len(shown) < len(variables) else []
    return [f"{title}: {len(variables)}", *table(header, rows), *more]


def _start(v: Variable) -> str:
    item = next((name for name, number in v.items.items() if str(number) == v.start), "")
    return f"{v.start} ({item})" if item else (v.start or "")[:30]


def _range(v: Variable) -> str:
    if v.items:
        return _some([f"{number} {name}" for name, number in v.items.items()])
    return "" if v.min is None and v.max is None else f"{v.min or '-∞'} … {v.max or '∞'}"


def _some(names: list[str], most: int = 8) -> str:
    return ", ".join(names[:most]) + (", …" if len(names) > most else "")
