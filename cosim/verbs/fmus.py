"""`cosim info`, `init` and `simulate`: from FMUs, without a file of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.blocks.description import C_CODE
from cosim.storage.kinds import as_typed
from cosim.verbs.outcome import told
from cosim.verbs.terminal import (
    Compile,
    Force,
    Format,
    Json,
    Open,
    Report,
    progress_bar,
    say,
    say_json,
    seconds,
    table,
    warn,
)

if TYPE_CHECKING:
    from cosim.blocks.summary import Summary, Variable

SHOWN = {"input": "inputs", "output": "outputs", "parameter": "parameters"}
MOST = 60  # parameters in the table; --all shows every one


def register(app: typer.Typer) -> None:
    """Add these commands."""
    app.command()(info)
    app.command()(init)
    app.command()(simulate)


def info(
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


def init(
    fmus: Annotated[list[Path], typer.Argument(help="FMUs of one system.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The file to write; never over one.")] = Path(
        "scenario.yaml"
    ),
    as_json: Json = False,
) -> None:
    """Write a first scenario of FMUs, connected by name and unit: guesses are marked, and it runs as it is."""
    from cosim.authoring.draft import write_draft
    from cosim.authoring.matching import text
    from cosim.base.text import counted

    draft = write_draft(out, fmus)
    found = draft.matches.found
    if as_json:
        connections = [
            {"from": text(m.source), "to": text(m.target), "guess": m.guess, "others": m.others} for m in found
        ]
        left = [text(port) for port, _ in draft.matches.left]
        say_json({
            "scenario": str(out), "algorithm": draft.algorithm, "connections": connections, "not_connected": left,
            "choices": dict(draft.matches.choices),
        })  # fmt: skip
        return
    for m in found:
        say(f"  {text(m.source)} → {text(m.target)}" + (f"   guess: {m.guess}" if m.guess else ""))
        for other in m.others:
            say(f"      or {other}")
    for name, sources in draft.matches.choices.items():
        say(f"  {name} is left open, for several fit alike: {', '.join(sources)}")
    for warning in draft.warnings:
        warn(warning)
    guesses = sum(bool(m.guess) for m in found)
    say(
        f"wrote {out}: {counted(len(fmus), 'FMU')}, {counted(len(found), 'connection')}"
        + (f", {guesses} guessed (marked in the file)" if guesses else "")
        + (
            f", {counted(len(draft.matches.choices), 'input')} to choose for (in the file)"
            if draft.matches.choices
            else ""
        )
    )
    say(f"next: cosim run {as_typed(out)}")


def simulate(
    fmu: Annotated[Path, typer.Argument(help="An FMU.")],
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="NAME=VALUE of a parameter or input; repeatable. mass=2, angle=12deg."),
    ] = None,
    recorded: Annotated[
        Path | None, typer.Option("--input", help="A CSV with time and columns named as inputs, played to them.")
    ] = None,
    stop: Annotated[
        float | None,
        typer.Option(
            help="When it ends [s], or 4min; without, as the FMU says, or the input.", parser=seconds, metavar="TIME"
        ),
    ] = None,
    step: Annotated[
        float | None,
        typer.Option(help="Communication step [s], or 20ms; without, as the FMU says.", parser=seconds, metavar="TIME"),
    ] = None,
    record: Annotated[
        list[str] | None,
        typer.Option("--record", help="A local or parameter to record, too, or a pattern; repeatable."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for what it leaves; results/NAME of the FMU without.")
    ] = None,
    report: Report = True,
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
    in_process: Annotated[
        bool, typer.Option("--in-process", help="Load the FMU into this process, for a debugger.")
    ] = False,
    format_: Format = "csv",
    compile_: Compile = False,
) -> None:
    """Run one FMU, without a file: results.csv, report.html, and the scenario.yaml that repeats it."""
    from cosim.authoring.single import simulate as simulate_fmu
    from cosim.blocks.compiling import compiling

    with compiling(compile_), progress_bar() as progress:
        outcome, notes = simulate_fmu(
            fmu, out, start=set_ or (), recorded=recorded, stop=stop, step=step, record=record or (), report=report,
            force=force, in_process=in_process, format_=format_, progress=progress,
        )  # fmt: skip
    for note in notes:
        warn(note)
    if not as_json:
        say(f"scenario: {outcome.folder / 'scenario.yaml'} (change it, and `cosim run` it)")
    told(outcome, report=report, open_=open_, as_json=as_json, values=True)
