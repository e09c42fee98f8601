"""All messages with a code: `python -m tests.messages > docs/messages.md`; `… bare ROOM` lists those without a code."""

from __future__ import annotations

import ast
import importlib
import pkgutil
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import TypeGuard

from cosim.base.messages import Template

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("cosim", "plant", "controller", "fmus")
# Calls that take a message, and the number of the positional argument with it.
SINKS = {
    "Fault": 3, "fault": 1, "_fault": 1, "note": 1, "note_cell": 3, "at": 1, "FmuError": 0, "SimulationError": 2,
    "Crashed": 2, "DiskFull": 2, "TimedOut": 2, "warn": 0, "say_note": 0, "CosimError": 0,
    "CriterionMissed": 0, "SweepFailed": 0, "SweepStopped": 0, "failed_run": 1, "say_finding": 0, "_fail": 0,
}  # fmt: skip
KEEPING = {"around", "after", "with_prefix", "Message"}  # functions whose result has the code of a message
HEAD = """# Messages

Every error (E), warning (W) and note (N) has a code. `-v` prints the code behind the message, and `--json` has it as
`code`. Codes are stable; wording may change. Words in braces are values. A fault begins with its file, line and column.

The subject "it", or a missing subject, is the file, FMU or component named before the message. A message made of
several has the code of the first. Texts of modules that run inside FMUs have no code. Results have none either: values,
outcomes of criteria, and the sentence of a verdict or a report.
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
        for line, name in bare_calls(ast.parse(path.read_text(encoding="utf-8"))):
            yield f"{path.relative_to(ROOT)}:{line}: {name}"


def bare_calls(tree: ast.AST) -> list[tuple[int, str]]:
    """Return line and name of each call that takes a message and gets a text without a code.

    The text is in the call, or the argument is a name to which the same function assigns a text.
    """
    found = _sinks(tree)
    calls = {(line, name) for line, name, argument in found if _has_text(argument)}
    lines = [line for line, _, argument in found if isinstance(argument, ast.Name)]
    if lines:
        for scope in ast.walk(tree):
            if isinstance(scope, ast.FunctionDef) and any(scope.lineno <= n <= (scope.end_lineno or n) for n in lines):
                named = [(line, name, value.id) for line, name, value in _sinks(scope) if isinstance(value, ast.Name)]
                texts = set(_names_of_texts(ast.walk(scope))) if named else set()
                calls |= {(line, name) for line, name, value in named if value in texts}
    return sorted(calls)


def _sinks(scope: ast.AST) -> list[tuple[int, str, ast.expr]]:
    """Return line, name and message of each call that takes a message."""
    calls = [(node, _name_of(node)) for node in ast.walk(scope) if isinstance(node, ast.Call)]
    known = [(node, name, SINKS[name]) for node, name in calls if name in SINKS]
    return [(node.lineno, name, node.args[at]) for node, name, at in known if at < len(node.args)]


def _name_of(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def _names_of_texts(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Yield the names to which a text without a code is assigned."""
    for node in nodes:
        if isinstance(node, ast.Assign) and _has_text(node.value):
            yield from (target.id for target in node.targets if isinstance(target, ast.Name))


def _has_text(value: ast.AST) -> bool:
    """Return whether a value contains a sentence outside of templates and of functions that keep codes."""
    if isinstance(value, ast.Call) and (_name_of(value).isupper() or _name_of(value) in KEEPING):
        return False
    return _is_text(value) or any(map(_has_text, ast.iter_child_nodes(value)))


def _is_text(node: ast.AST) -> bool:
    """Return whether a node is a formatted string, a constant with a blank, or `str.join`, which drops codes."""
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Attribute) and node.func.attr == "join" and _is_string(node.func.value)
    return isinstance(node, ast.JoinedStr) or (_is_string(node) and " " in node.value.strip())


def _is_string(node: ast.AST) -> TypeGuard[ast.Constant]:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


if __name__ == "__main__":
    if sys.argv[1:2] == ["bare"]:
        print("\n".join(line for room in sys.argv[2:] or PACKAGES for line in bare(ROOT / room)))
    else:
        print(page(), end="")
