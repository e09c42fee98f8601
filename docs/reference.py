"""Markdown of the reference pages, generated from the code when the site is built."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator
from typing import Any

import typer.main

import cosim.model
from cosim.calibration.fitted import Fitted
from cosim.comparison.several import ComparedRuns
from cosim.core.registry import resolve
from cosim.refinement.refinement import Refined
from cosim.residuals.replay_signals import Replay
from cosim.simulation.run_signals import Run, Signals
from cosim.sweeps.reading import Swept
from cosim.sweeps.store import Runs
from cosim.verbs import verbs
from cosim.verbs.cli import command_line

RESULTS = (Run, Signals, Replay, Fitted, Refined, ComparedRuns, Swept, Runs)
ALIASES = {"Number", "Values"}  # of types: they have no docstring
SECTIONS = re.compile(r"^(Args|Attributes|Returns|Raises):$", re.MULTILINE)


def format_command_line() -> str:
    """Return the reference of all verbs, by group."""
    parts, group = [], ""
    for name, command in typer.main.get_command(command_line()).commands.items():  # type: ignore[attr-defined]
        if command.rich_help_panel != group:
            group = command.rich_help_panel
            parts.append(f"## {group}")
        text, _, example = inspect.cleandoc(command.help).partition("Example: ")
        parts += [f"### {name}", text.strip(), f"```sh\n{example}\n```"]
        with command.make_context(name, [], resilient_parsing=True) as context:
            records = [p.get_help_record(context) for p in command.params]
        rows = [(f"`{names}`", meaning) for names, meaning in filter(None, records)]
        parts.append(format_table(("argument or option", "meaning"), rows))
    return "\n\n".join(parts)


def format_python() -> str:
    """Return the reference of the functions, their results and the classes of a model file."""
    parts = ["## Functions"]
    for name, verb in verbs():
        if verb.function:
            function = resolve(verb.function)
            parts += [f"### cosim.{name.replace('-', '_')}", format_signature(name.replace("-", "_"), function)]
            parts += format_sections(inspect.getdoc(function) or "")
    parts.append("## Results")
    for kind in RESULTS:
        parts += [
            f"### {kind.__name__}",
            *format_sections(inspect.getdoc(kind) or ""),
            format_table(("member", "meaning"), list_members(kind)),
        ]
    parts += ["## Model files", "`from cosim.model import …`; [own_model.md](own_model.md) is the tutorial."]
    rows = [
        (f"`{name}`", read_first_line(getattr(cosim.model, name)))
        for name in sorted(cosim.model.__all__)
        if name not in ALIASES
    ]
    parts.append(format_table(("name", "meaning"), rows))
    return "\n\n".join(parts)


def format_signature(name: str, function: Any) -> str:
    """Return the call of a function with its default values, as a code block."""
    arguments = [p.replace(annotation=p.empty) for p in inspect.signature(function).parameters.values()]
    return f"```text\ncosim.{name}{inspect.Signature(arguments)}\n```"


def format_sections(docstring: str) -> Iterator[str]:
    """Yield the text of a docstring and a table or sentence for each of its sections."""
    text, *titled = SECTIONS.split(docstring)
    yield text.strip()
    for title, content in zip(titled[::2], titled[1::2], strict=True):
        if title == "Returns":
            yield f"Returns: {' '.join(content.split())}"
            continue
        items = re.findall(r"^    (\w+)(?: \(.*?\))?: (.*?)(?=^    \w|\Z)", content, re.MULTILINE | re.DOTALL)
        heading = {"Args": "argument", "Attributes": "attribute", "Raises": "error"}[title]
        yield format_table((heading, "meaning"), [(f"`{name}`", " ".join(meaning.split())) for name, meaning in items])


def list_members(kind: type) -> Iterator[tuple[str, str]]:
    """Yield the public properties and methods of a class with the first line of their docstrings."""
    fields = {field.name for field in dataclasses.fields(kind)} if dataclasses.is_dataclass(kind) else set()
    for name, member in inspect.getmembers(kind):
        if not name.startswith("_") and name not in fields and (callable(member) or isinstance(member, property)):
            yield f"`{name}()`" if callable(member) else f"`{name}`", read_first_line(member)


def read_first_line(thing: Any) -> str:
    """Return the first line of a docstring."""
    return (inspect.getdoc(thing) or "").split("\n", 1)[0]


def format_table(header: tuple[str, str], rows: Any) -> str:
    """Return a table of two columns."""
    lines = [header, ("---", "---"), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def format_known_answers() -> str:
    """Return the systems whose answers are known, which `tests/test_known.py` runs."""
    from tests.known.__main__ import format_cases  # with pytest

    return format_cases()


PAGES = {
    "<!-- generated: command line -->": format_command_line,
    "<!-- generated: Python -->": format_python,
    "<!-- generated: known answers -->": format_known_answers,
}
