"""All messages with a code: `python -m tests.messages > docs/messages.md`; `… bare ROOM` lists those without a code."""

from __future__ import annotations

import ast
import importlib
import pkgutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from cosim.base.messages import Template

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("cosim", "plant", "controller", "fmus")
SEVERITY = {"E": "Errors", "W": "Warnings", "N": "Notes"}
# Calls that take a message, and the number of the positional argument with it.
SINKS = {
    "Fault": 3, "fault": 1, "_fault": 1, "note": 1, "note_cell": 3, "at": 1, "FmuError": 0, "SimulationError": 2,
    "Crashed": 2, "DiskFull": 2, "TimedOut": 2, "warn": 0, "say_note": 0, "CosimError": 0,
}  # fmt: skip
HEAD = """# Messages

Every error (E), warning (W) and note (N) has a code. `-v` prints the code behind the message, and `--json` has it as
`code`. Codes are stable; wording may change. Words in braces are values. A fault begins with its file, line and column.
The subject "it", or a missing subject, is the file, FMU or component named before the message. Texts of modules that
run inside FMUs have no code.
"""


def message_modules() -> Iterator[ModuleType]:
    """Yield the modules with templates, in the order of their names."""
    for package in PACKAGES:
        place = ROOT / package
        for found in sorted(info.name for info in pkgutil.walk_packages([str(place)], f"{package}.")):
            if found.rpartition(".")[2] == "messages":
                yield importlib.import_module(found)


def templates(module: ModuleType) -> dict[str, Template]:
    """Return the templates of a module by name."""
    return {name: value for name, value in vars(module).items() if isinstance(value, Template)}


def page() -> str:
    """Return docs/messages.md."""
    parts = [HEAD]
    for module in message_modules():
        title = (module.__doc__ or "").partition("\n")[0].rstrip(".").removeprefix("Messages of ")
        rows = sorted((t.code, t.text) for t in templates(module).values())
        cells = [f"| {code} | {text.replace('|', chr(92) + '|')} |" for code, text in rows]
        parts.append("\n".join([f"## {title[:1].upper()}{title[1:]}\n", "| code | message |", "|---|---|", *cells, ""]))
    return "\n".join(parts)


def bare(folder: Path) -> Iterator[str]:
    """Yield the places in a folder at which a text without a code becomes a message."""
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            at = SINKS.get(name)
            if at is None or len(node.args) <= at:
                continue
            if any(_is_text(part) for part in ast.walk(node.args[at])):
                yield f"{path.relative_to(ROOT)}:{node.lineno}: {name}"


def _is_text(node: ast.AST) -> bool:
    """Return whether a node is a sentence: a formatted string, or a constant with a blank."""
    return isinstance(node, ast.JoinedStr) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value.strip()
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["bare"]:
        print("\n".join(line for room in sys.argv[2:] or PACKAGES for line in bare(ROOT / room)))
    else:
        print(page(), end="")
