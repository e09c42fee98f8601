"""Places in a model's file: of classes, declarations and exceptions."""

from __future__ import annotations

import ast
import traceback
from pathlib import Path

from cosim.base.errors import Fault, InputError
from cosim.model.namespaces import Namespace

FUNCTIONS = ", ".join(f"m.{name}" for name in vars(Namespace) if not name.startswith("_"))
TRUTH = "truth value of"  # sympy's words for the truth test of a symbol
NO_BRANCH = "no `if`, `max`, `min` or `and` on a number: m.where(condition, then, otherwise) works on symbols too"
FROM_NAMESPACE = f"functions come from m, which has {FUNCTIONS}"
LANGUAGE = "cosim.model"  # package imported by model files
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
        except (OSError, SyntaxError, ValueError):  # Loading the file reports this error.
            return
        self._former = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and _is_former(n.module or "")]
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                self.classes.append(node.name)
                self._places[node.name, ""] = _start(node)
                self._places |= {(node.name, name): place for name, place in _declared(node).items()}

    def check_imports(self) -> None:
        """Raise InputError for imports from `plant`, the former package."""
        if self._former:
            names = dict.fromkeys(alias.name for node in self._former for alias in node.names)
            cure = f"write `from {LANGUAGE} import {', '.join(names)}`"
            message = f"`plant` is not a part of the modelling language any more; {cure} in place of `from plant.…`"
            raise InputError([Fault(self.path, *_start(self._former[0]), message)])

    def fault(self, owner: type, attribute: str, message: str) -> Fault:
        """Return a fault at a class's declaration, else at the class."""
        own = [c.__name__ for c in owner.__mro__ if c.__module__ == owner.__module__]
        places = [self._places[key] for key in ((c, attribute) for c in own) if key in self._places]
        place = (*places, self._places.get((owner.__name__, ""), (0, 0)))[0]
        return Fault(self.path, *place, message)

    def raised(self, error: BaseException, doing: str) -> Fault:
        """Return the fault of an exception, with line and known remedy."""
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
    """Return whether a module is a former part of the modelling language."""
    package, _, name = module.partition(".")
    return package == "plant" and name in FORMER


def _start(node: ast.stmt) -> tuple[int, int]:
    return node.lineno, node.col_offset + 1


def _declared(node: ast.ClassDef) -> dict[str, tuple[int, int]]:
    """Return attributes and methods of a class with their places."""
    found: dict[str, tuple[int, int]] = {}
    for statement in node.body:
        if isinstance(statement, ast.FunctionDef):
            found[statement.name] = _start(statement)
        targets = statement.targets if isinstance(statement, ast.Assign) else []
        targets = [statement.target] if isinstance(statement, ast.AnnAssign) else targets
        names = [name for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
        found |= {name.id: _start(statement) for name in names}
    return found
