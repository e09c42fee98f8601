"""Places in the Python file of a model: lines of classes, declarations and exceptions."""

from __future__ import annotations

import ast
import traceback
from pathlib import Path

from cosim.core.errors import Fault
from cosim.model.namespaces import Namespace

FUNCTIONS = ", ".join(f"m.{name}" for name in vars(Namespace) if not name.startswith("_"))
TRUTH_TEST = "truth value of"  # sympy's words for the truth test of a symbol
FOREIGN = ("Cannot convert expression to float", "must be real number", "ufunc", "Namespace' object has no attribute")


class ModelText:
    """The text of a model file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.classes: list[str] = []
        self._places: dict[tuple[str, str], tuple[int, int]] = {}
        try:
            tree = ast.parse(path.read_bytes())
        except (OSError, SyntaxError, ValueError):  # Loading the file reports this error.
            return
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                self.classes.append(node.name)
                self._places[node.name, ""] = _start(node)
                for statement in node.body:
                    targets: list[ast.expr] = getattr(statement, "targets", [getattr(statement, "target", None)])
                    names = [n.id for target in targets if target for n in ast.walk(target) if isinstance(n, ast.Name)]
                    names += [statement.name] if isinstance(statement, ast.FunctionDef) else []
                    self._places |= {(node.name, name): _start(statement) for name in names}

    def fault(self, owner: type, attribute: str, message: str) -> Fault:
        """Return a fault at a class's declaration, else at the class."""
        keys = [(c.__name__, attribute) for c in owner.__mro__ if c.__module__ == owner.__module__]
        place = next((key for key in keys if key in self._places), (owner.__name__, ""))
        return Fault(self.path, *self._places.get(place, (0, 0)), message)

    def convert_error(self, error: BaseException, doing: str) -> Fault:
        """Return the fault of an exception, with line and known remedy."""
        text = " ".join((error.msg if isinstance(error, SyntaxError) else str(error)).split())
        cure = ""
        if isinstance(error, TypeError) and TRUTH_TEST in text:
            where = "m.where(condition, then, otherwise) works on symbols too"
            cure = f"; no `if`, `max`, `min` or `and` on a number: {where}"
        elif isinstance(error, (TypeError, AttributeError)) and any(words in text for words in FOREIGN):
            cure = f"; functions come from m, which has {FUNCTIONS}"
        name = f"{doing}: {type(error).__name__}: {text}".removesuffix(": ")
        return Fault(self.path, *self._raised_at(error), f"{name}{cure}")

    def _raised_at(self, error: BaseException) -> tuple[int, int]:
        if isinstance(error, SyntaxError) and error.filename == str(self.path):
            return error.lineno or 0, max(1, error.offset or 1)
        for frame in reversed(traceback.extract_tb(error.__traceback__)):
            if frame.filename == str(self.path):
                return frame.lineno or 0, (frame.colno or 0) + 1
        return 0, 0


def _start(node: ast.stmt) -> tuple[int, int]:
    return node.lineno, node.col_offset + 1
