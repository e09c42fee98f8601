"""Places in the Python file of a model: lines of classes, declarations and exceptions."""

from __future__ import annotations

import ast
import traceback
from pathlib import Path

from cosim.base.errors import Fault, InputError
from cosim.model.namespaces import Namespace

FUNCTIONS = ", ".join(f"m.{name}" for name in vars(Namespace) if not name.startswith("_"))
TRUTH_TEST = "truth value of"  # sympy's words for the truth test of a symbol
FORMER = {"delay", "design", "gain", "integrate", "model", "namespaces", "planar", "quantities", "sensors", "traits"}
FOREIGN = ("Cannot convert expression to float", "must be real number", "ufunc", "Namespace' object has no attribute")


class ModelText:
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
                self._places |= {(node.name, name): place for name, place in _find_declarations(node).items()}

    def check_imports(self) -> None:
        """Raise InputError for imports from `plant`, a former name."""
        if self._former:
            names = dict.fromkeys(alias.name for node in self._former for alias in node.names)
            message = (
                "`plant` is not a part of the modelling language any more; write `from cosim.model import "
                f"{', '.join(names)}` in place of `from plant.…`"
            )
            raise InputError([Fault(self.path, *_start(self._former[0]), message)])

    def fault(self, owner: type, attribute: str, message: str) -> Fault:
        """Return a fault at a class's declaration, else at the class."""
        keys = [(c.__name__, attribute) for c in owner.__mro__ if c.__module__ == owner.__module__]
        place = next((key for key in keys if key in self._places), (owner.__name__, ""))
        return Fault(self.path, *self._places.get(place, (0, 0)), message)

    def convert_error(self, error: BaseException, doing: str) -> Fault:
        """Return the fault of an exception, with line and known remedy."""
        line, column = self._raised_at(error)
        text = " ".join((error.msg if isinstance(error, SyntaxError) else str(error)).split())
        fields = {"doing": doing, "error": f"{type(error).__name__}: {text}".removesuffix(": ")}
        if isinstance(error, TypeError) and TRUTH_TEST in text:
            return Fault(
                self.path,
                line,
                column,
                (
                    "{doing}: {error}; no `if`, `max`, `min` or `and` on a number: m.where(condition, then, "
                    "otherwise) works on symbols too"
                ).format(**fields),
            )
        if isinstance(error, (TypeError, AttributeError)) and any(words in text for words in FOREIGN):
            return Fault(
                self.path,
                line,
                column,
                "{doing}: {error}; functions come from m, which has {functions}".format(functions=FUNCTIONS, **fields),
            )
        return Fault(self.path, line, column, "{doing}: {error}".format(**fields))

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


def _find_declarations(node: ast.ClassDef) -> dict[str, tuple[int, int]]:
    """Return the place of each attribute and method of a class: name → (line, column)."""
    places: dict[str, tuple[int, int]] = {}
    for statement in node.body:
        if isinstance(statement, ast.FunctionDef):
            places[statement.name] = _start(statement)
        targets = statement.targets if isinstance(statement, ast.Assign) else []
        targets = [statement.target] if isinstance(statement, ast.AnnAssign) else targets
        names = [name for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
        places |= {name.id: _start(statement) for name in names}
    return places
