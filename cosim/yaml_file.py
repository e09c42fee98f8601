"""YAML read with the place of every key and value, and validated so that every fault is reported at once."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from cosim.errors import Fault, InputError

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]

Location = tuple[str | int, ...]
M = TypeVar("M", bound=BaseModel)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`; did you mean "…"?` where a known word is close, else an empty string."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f'; did you mean "{close[0]}"?' if close else ""


class YamlFile:
    """A YAML document and where each of its parts stands."""

    def __init__(self, path: Path) -> None:
        self.path = path
        yaml = YAML(typ="rt", pure=True)
        yaml.allow_duplicate_keys = False
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            raise InputError([Fault(path, 0, 0, "no such file")]) from None
        except (OSError, UnicodeDecodeError) as error:
            raise InputError([Fault(path, 0, 0, f"cannot be read as text: {error}")]) from None
        try:
            self.root: Any = yaml.load(text)
        except MarkedYAMLError as error:
            raise InputError([self._yaml_fault(error)]) from None
        except RecursionError:
            raise InputError([Fault(path, 1, 1, "is nested too deep")]) from None
        except (YAMLError, ValueError) as error:
            raise InputError([Fault(path, 1, 1, f"is not YAML: {str(error).splitlines()[0]}")]) from None
        if not isinstance(self.root, CommentedMap):
            raise InputError([Fault(path, 1, 1, "is not a mapping of keys to values")])

    def _yaml_fault(self, error: MarkedYAMLError) -> Fault:
        mark = error.problem_mark or error.context_mark
        problem = " ".join(str(error.problem or error.context or "is not YAML").split())
        if "duplicate key" in problem:
            problem = problem.split(" with value")[0].replace("found duplicate key", "duplicate key") + "; keep one"
        else:
            problem = f"not YAML: {problem}"
        return Fault(self.path, mark.line + 1 if mark else 1, mark.column + 1 if mark else 1, problem)

    def place(self, location: Location, key: bool = False) -> tuple[int, int]:
        """Line and column of the value at `location`, of its key if asked, or of the nearest part that exists."""
        node, found = self.root, (1, 1)
        for depth, step in enumerate(location):
            if isinstance(node, CommentedMap) and step in node:
                last = depth == len(location) - 1
                line, column = (node.lc.key if key and last else node.lc.value)(step)
                value = node[step]
                if isinstance(value, (CommentedMap, CommentedSeq)) and not (key and last):
                    line, column = node.lc.key(step) if not last else (line, column)
            elif isinstance(node, CommentedSeq) and isinstance(step, int) and step < len(node):
                line, column = node.lc.item(step)
            else:
                break
            found, node = (line + 1, column + 1), node[step]
        return found

    def fault(self, location: Location, message: str, *, key: bool = False, exit_code: int = 2) -> Fault:
        """A fault at a place of this file."""
        return Fault(self.path, *self.place(location, key), message, exit_code)

    def validate(self, model: type[M], data: Any = None, at: Location = ()) -> M:
        """The document, or what stands `at` a place of it, as a pydantic model; InputError with every fault."""
        try:
            return model.model_validate(plain(self.root) if data is None else data)
        except ValidationError as error:
            raise InputError([self._pydantic_fault(model, e, at) for e in error.errors()]) from None

    def partly(self, model: type[M]) -> tuple[M | None, list[Fault]]:
        """The document without its faulty parts, so that the rest can be checked too, and their faults.

        None where it cannot do without them, or where a key at its top is at fault, on which the rest depends.
        """
        data = plain(self.root)
        try:
            return model.model_validate(data), []
        except ValidationError as error:
            errors = error.errors()
        faults = [self._pydantic_fault(model, e) for e in errors]
        if any(len(e["loc"]) < 2 for e in errors):
            return None, faults
        for e in errors:
            _leave_out(data, tuple(p for p in e["loc"] if not _is_tag(p)))
        try:
            return model.model_validate(data), faults
        except ValidationError:
            return None, faults

    def _pydantic_fault(self, model: type[BaseModel], error: Any, at: Location = ()) -> Fault:
        within: Location = tuple(p for p in error["loc"] if not _is_tag(p))
        location = (*at, *within)
        name = ".".join(map(str, location))
        kind, given = error["type"], error.get("input")
        if kind == "extra_forbidden":
            known = _known_keys(model, within[:-1])
            message = f'unknown key "{location[-1]}"{did_you_mean(str(location[-1]), known)}'
            return self.fault(location, f"{message} (known here: {', '.join(known)})", key=True)
        if kind == "missing":
            return self.fault(location[:-1], f'"{name}" is missing; add it')
        detail = str(error["msg"]).removeprefix("Value error, ").replace("Input should be", "it should be")
        if kind.startswith("bool"):
            detail = "it is on or off"
        shown = repr(given) if isinstance(given, (str, int, float, bool)) or given is None else type(given).__name__
        return self.fault(location, f"{name} is {shown}: {detail[:1].lower() + detail[1:]}")


def _leave_out(data: Any, location: Location) -> None:
    """Take a part out of plain data; a list goes as a whole, or those behind would move up."""
    for step in location[:-1]:
        if not isinstance(data.get(step), dict):
            data.pop(step, None)
            return
        data = data[step]
    data.pop(location[-1], None)


def plain(node: Any) -> Any:
    """A YAML document as plain dictionaries, lists, strings and numbers."""
    if isinstance(node, dict):
        return {str(k): plain(v) for k, v in node.items()}
    if isinstance(node, (list, tuple)):
        return [plain(v) for v in node]
    if isinstance(node, bool) or node is None:
        return node
    for kind in (int, float, str):
        if isinstance(node, kind):
            return kind(node)
    return node


def _is_tag(part: str | int) -> bool:
    """Pydantic puts the name of a union's branch into the location; it is no part of the file."""
    return isinstance(part, str) and (part.endswith(("]", "»")) or part in {"float", "str", "bool"})


def _known_keys(model: type[BaseModel], location: Sequence[str | int]) -> list[str]:
    """Keys allowed at a place, as far as the model's annotations say."""
    current: Any = model
    for step in location:
        annotation = current.model_fields[step].annotation if _has_field(current, step) else current
        current = _inner_model(annotation) or current
    return [f.alias or name for name, f in current.model_fields.items()]


def _has_field(model: Any, step: str | int) -> bool:
    return isinstance(step, str) and step in getattr(model, "model_fields", {})


def _inner_model(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        if found := _inner_model(inner):
            return found
    return None


class Part(BaseModel):
    """A part of a scenario: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)
