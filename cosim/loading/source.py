"""Where in the file of a model something stands: a class, what it declares, the line that raised an error."""

from __future__ import annotations

import ast
import traceback
from pathlib import Path

from cosim.base.errors import Fault, InputError
from cosim.model.namespaces import Namespace

FUNCTIONS = ", ".join(f"m.{name}" for name in vars(Namespace) if not name.startswith("_"))
TRUTH = "truth value of"  # sympy's words where a symbol is asked whether it is true
NO_BRANCH = "no `if`, `max`, `min` or `and` on a number: m.where(condition, then, otherwise) works on symbols too"
FROM_NAMESPACE = f"functions come from m, which has {FUNCTIONS}"
LANGUAGE = "cosim.model"  # what a model file imports from
FORMER = {"delay", "design", "gain", "integrate", "model", "namespaces", "planar", "quantities", "sensors", "traits"}
NO_NUMBER = ("Cannot convert expression to float", "must be real number", "ufunc", "Namespace' object has no attribute")


class Source:
    """The text of a model file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.classes: list[str] = []
        self._places: dict[tuple[str, str], tuple[int, int]] = {}
        self._former: list[ast.ImportFrom] = []
        try:
            tree = ast.parse(path.read_bytes())
        except (OSError, SyntaxError, ValueError):  # reported where the file is loaded
            return
        self._former = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and _is_former(n.module or "")]
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                self.classes.append(node.name)
                self._places[node.name, ""] = _start(node)
                self._places |= {(node.name, name): place for name, place in _declared(node).items()}

    def check_imports(self) -> None:
        """Raise InputError where the file imports the modelling language from `plant`, where it was before."""
        if self._former:
            names = dict.fromkeys(alias.name for node in self._former for alias in node.names)
            cure = f"write `from {LANGUAGE} import {', '.join(names)}`"
            message = f"`plant` is not a part of the modelling language any more; {cure} in place of `from plant.…`"
            raise InputError([Fault(self.path, *_start(self._former[0]), message)])

    def fault(self, owner: type, attribute: str, message: str) -> Fault:
        """A fault of what a class declares, at the class itself where it inherits that or does not declare it."""
        own = [c.__name__ for c in owner.__mro__ if c.__module__ == owner.__module__]
        places = [self._places[key] for key in ((c, attribute) for c in own) if key in self._places]
        place = (*places, self._places.get((owner.__name__, ""), (0, 0)))[0]
        return Fault(self.path, *place, message)

    def raised(self, error: BaseException, doing: str) -> Fault:
        """A fault for an error, at the line of this file that raised it, with the cure where it is known."""
        line, column = self._raised_at(error)
        text = " ".join((error.msg if isinstance(error, SyntaxError) else str(error)).split())
        message = f"{doing}: {type(error).__name__}: {text}".removesuffix(": ")
        if isinstance(error, TypeError) and TRUTH in text:
            message += f"; {NO_BRANCH}"
        elif isinstance(error, (TypeError, AttributeError)) and any(words in text for words in NO_NUMBER):
            message += f"; {FROM_NAMESPACE}"
        return Fault(self.path, line, column, message)

    def _raised_at(self, error: BaseException) -> tuple[int, int]:
        if isinstance(error, SyntaxError) and error.filename == str(self.path):
            return error.lineno or 0, max(1, error.offset or 1)
        for frame in reversed(traceback.extract_tb(error.__traceback__)):
            if frame.filename == str(self.path):
                return frame.lineno or 0, (frame.colno or 0) + 1
        return 0, 0


def _is_former(module: str) -> bool:
    """Return whether the modelling language was imported from a module of this name in earlier releases."""
    package, _, name = module.partition(".")
    return package == "plant" and name in FORMER


def _start(node: ast.stmt) -> tuple[int, int]:
    return node.lineno, node.col_offset + 1


def _declared(node: ast.ClassDef) -> dict[str, tuple[int, int]]:
    """Attributes and methods in the body of a class, each with its line and column."""
    found: dict[str, tuple[int, int]] = {}
    for statement in node.body:
        if isinstance(statement, ast.FunctionDef):
            found[statement.name] = _start(statement)
        targets = statement.targets if isinstance(statement, ast.Assign) else []
        targets = [statement.target] if isinstance(statement, ast.AnnAssign) else targets
        names = [name for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
        found |= {name.id: _start(statement) for name in names}
    return found
