"""A first scenario of FMUs: times from their default experiments, connections by name and unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from cosim.authoring.draft_text import scenario_text, write_sound
from cosim.authoring.matching import Match, Matches, Port, match_ports, text
from cosim.authoring.parts import DraftPart, parts_of, times_of
from cosim.blocks.coupling import DEFAULT, WITHOUT_ORDER, AlgebraicLoop, Algorithm
from cosim.blocks.summary import platforms_of
from cosim.core.drafts import draft_of
from cosim.core.errors import InputError
from cosim.fmi.description import no_library, platform_of

MAX_PORTS = 6  # inputs and outputs in a message


def write_draft(path: Path, fmus: Sequence[Path]) -> tuple[Matches, str, list[str]]:
    """Write a commented scenario of FMUs, with guesses marked; return connections, coupling algorithm and warnings.

    Connections are by name and unit. An existing file is never overwritten.

    Raises:
        InputError: An FMU is faulty, no output fits an input, or `path` exists.
    """
    if path.is_dir():
        raise InputError.at(path, "is a folder; name the file to write as --out")
    if path.exists():
        raise InputError.at(
            path, "is there already; it is never written over; give another name as --out, or move it away"
        )
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise InputError.at(path, "a scenario is YAML; name a .yaml or .yml file as --out")
    if not path.parent.is_dir():
        raise InputError.at(path.parent, "no such folder; make it first")
    parts = parts_of(fmus)
    inputs, outputs = [p for part in parts for p in part.inputs], [p for part in parts for p in part.outputs]
    sizes = {name: size for part in parts for name, size in part.sizes.items()}
    matches = match_ports(outputs, inputs, sizes)
    every = matches.connections
    kept = [m for m in every if not m.guess]
    if _algorithm(parts, kept) is DEFAULT:  # leave out guesses that close an algebraic loop
        for guess in (m for m in every if m.guess):
            kept += [guess] if _algorithm(parts, [*kept, guess]) is DEFAULT else []
        dropped = tuple((m.target, (text(m.source), *m.others)) for m in every if m not in kept)
        matches = Matches(tuple(m for m in every if m in kept), (*matches.unconnected, *dropped), matches.choices)
    if len(parts) > 1 and not matches.any_candidate:
        raise InputError.at(fmus[0], _no_fit(fmus, inputs, outputs, sizes))
    times = times_of(parts)
    algorithm = _algorithm(parts, matches.connections)
    with draft_of(path) as draft:
        system = write_sound(draft, scenario_text(path.parent, parts, matches, times, algorithm), parts[0].path)
    warnings = []
    for part in parts:
        here, there = platform_of(part.description), platforms_of(part.path)
        if here not in there:
            warnings.append(f"{part.name} does not run on this machine: {no_library(here, there)}")
    return matches, algorithm.name, [*warnings, *times.notes, *system.warnings]


def _algorithm(parts: Sequence[DraftPart], matches: Sequence[Match]) -> Algorithm:
    """Return the default coupling algorithm; with an algebraic loop, the algorithm without stepping order."""
    blocks = {part.name: part.block for part in parts}
    edges = [(m.source[0], m.target[0], m.target[1].name, m.source[1].name) for m in matches]
    try:
        DEFAULT.plan(blocks, edges, None)
    except AlgebraicLoop:
        return WITHOUT_ORDER
    return DEFAULT


def _no_fit(fmus: Sequence[Path], inputs: Sequence[Port], outputs: Sequence[Port], sizes: Mapping[str, int]) -> str:
    """Return why no output fits any input."""
    text_ = f"{' and '.join(p.name for p in fmus)} cannot be connected"
    if not outputs or not inputs:
        return f"{text_}: they have no {'inputs' if outputs else 'outputs'}; run each alone by `cosim simulate`"
    lists = []
    for ports in (outputs, inputs):
        names = []
        for port in ports[:MAX_PORTS]:
            size = sizes.get(text(port))
            names.append(f"{text(port)} [{port[1].unit or port[1].kind}{f', {size} elements' if size else ''}]")
        lists.append(", ".join(names))
    text_ += f": no output ({lists[0]}) fits an input of another ({lists[1]}) by type"
    element = next((f"{port[0]}.{port[1].name}" for port in (*inputs, *outputs) if text(port) in sizes), None)
    if element is None:
        return f"{text_} and unit"
    cure = f"a scenario may connect elements of an array one by one, as {element}"
    return f"{text_}, unit and number of elements; {cure}"
