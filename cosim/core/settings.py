"""Types of the arguments of `cosim` functions, which pydantic checks.

Numbers of numpy become Python numbers, text with a unit becomes seconds. pydantic is imported at the first call.
"""

from __future__ import annotations

import functools
import inspect
import json
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ParamSpec, TypeVar

from annotated_types import Ge, Gt, Le

from cosim.core.errors import Fault, refuse
from cosim.core.registry import resolve
from cosim.core.units import read_quantity

P = ParamSpec("P")
T = TypeVar("T")
MAX_NESTING = 60  # levels of values of arguments and of files
LONGEST_NAME, LONGEST_PATH = 255, 4096  # limits of file systems [bytes]
MAX_ARGUMENT_CHARACTERS = 60  # characters of a value in a message


def of_python(value: Any) -> Any:
    """Convert a number, text or array of another library to the Python type; raise ValueError for other values."""
    if hasattr(value, "tolist") and hasattr(value, "dtype"):
        value = value.tolist()
    for kind in (bool, int, float):  # also subclasses, e.g. an item of an enumeration or numpy's float64
        if isinstance(value, kind):
            value = kind(value)
            break
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError("give a finite number")
    if type(value) is int and not -(2**63) <= value < 2**64:
        raise ValueError("give a whole number of 64 bits")
    if isinstance(value, (str, os.PathLike)) and isinstance(text := os.fspath(value), str):
        if re.search("[\0\ud800-\udfff]", text):
            raise ValueError("it contains a NUL character or an unpaired surrogate; use valid Unicode text")
        return str.__str__(value) if isinstance(value, str) else Path(text)
    return [*map(of_python, value)] if type(value) in (list, tuple) and len(value) < LONGEST_PATH else value


def plain(value: Any, depth: int = 0) -> Any:
    """Convert a value to JSON types; raise ValueError if impossible."""
    if depth > MAX_NESTING:
        raise ValueError(f"it is nested more than {MAX_NESTING} levels deep; use fewer levels")
    if not isinstance(value, (list, tuple)):
        value = of_python(value)
    if isinstance(value, (list, tuple)):
        return [plain(each, depth + 1) for each in value]
    if isinstance(value, Mapping):
        if wrong := [key for key in value if not isinstance(key, str)]:
            raise ValueError(f"the key {_represent(wrong[0])} is not text; use text keys")
        return {of_python(key): plain(each, depth + 1) for key, each in value.items()}
    if value is None or isinstance(value, (bool, int, float, str, Path)):
        return value
    kinds = "a number, text, true or false, a list or a mapping"
    raise ValueError(f"{_represent(value)} is of type {type(value).__name__}; allowed: {kinds}")


def _seconds(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        return read_quantity(value, "s")


def _file(value: Any) -> Any:
    if not isinstance(value, (str, os.PathLike)) or not isinstance(name := os.fspath(value), str):
        raise ValueError("give the name of a file or folder")
    if not name.strip():
        raise ValueError("it is empty; give the name of a file or folder")
    if len(name.encode()) > LONGEST_PATH or any(len(part.encode()) > LONGEST_NAME for part in re.split(r"[/\\]", name)):
        raise ValueError(f"it is longer than a file name can be ({LONGEST_NAME} bytes)")
    return value


def _listed(value: Any) -> Any:
    return sorted(value) if isinstance(value, (set, frozenset)) else (value,) if isinstance(value, str) else value


@dataclass(frozen=True)
class Converted:
    """Annotation with a function that converts an argument before pydantic checks it; may raise ValueError."""

    by: Callable[[Any], Any]

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], Any]) -> Any:
        """Return the schema for pydantic."""
        from pydantic_core import core_schema

        return core_schema.no_info_before_validator_function(self.by, handler(source))


FilePath = Annotated[str | os.PathLike[str], Converted(_file)]
ModelName = Annotated[str, Converted(lambda value: str(_file(value)))]  # or the name of a file or folder
Files = Annotated[Sequence[FilePath], Converted(_listed)]
Names = Annotated[Sequence[str], Converted(_listed)]
Values = Annotated[Mapping[str, Any], Converted(plain)]
Given = Values | Names  # settings: {"name": value}, or texts "name=value"
IN_SECONDS = Converted(_seconds)
Seconds = Annotated[float, IN_SECONDS]  # or text with a unit: 4 min
PositiveSeconds = Annotated[float, Gt(0), IN_SECONDS]
Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
Whole = Annotated[int, Ge(0)]
Seed = Whole
Port = Annotated[int, Ge(0), Le(65535)]
Count = Annotated[int, Ge(1)]
LATER = {  # types of higher rooms, which modules of verbs import for type checkers only
    "Signals": "cosim.simulation.run_signals:Signals",
    "Subject": "cosim.estimation.subject.interface:Subject",
}


def normalize_settings(values: Given | None) -> Given:
    """Return settings as a mapping name → value, or as a tuple of texts `name=value`."""
    return dict(values) if isinstance(values, Mapping) else tuple(_listed(values or ()))


def texts(values: Given | None) -> Sequence[str]:
    """Return settings as NAME=VALUE texts."""
    settings = normalize_settings(values)
    return [f"{n}={json.dumps(plain(v))}" for n, v in settings.items()] if isinstance(settings, Mapping) else settings


def check_arguments(function: Callable[P, T]) -> Callable[P, T]:
    """Return the function with a check of its arguments, which raises InputError with all invalid arguments."""
    signature = inspect.signature(function)
    adapters: dict[str, Any] = {}

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        bound = signature.bind(*args, **kwargs)
        for name in bound.arguments.keys() - adapters.keys():
            adapters[name] = adapter(signature.parameters[name].annotation, function)
        bound.arguments.update(check_values(adapters, bound.arguments))
        return function(*bound.args, **bound.kwargs)

    return call


def adapter(annotation: Any, function: Callable[..., Any], *, strict: bool = True) -> Any:
    """Return pydantic's check for values of a type; a type that pydantic does not know accepts any value.

    Args:
        strict: Reject text as a number. The command line accepts text.
    """
    from pydantic import ConfigDict, TypeAdapter

    names = dict(inspect.unwrap(function).__globals__)
    while isinstance(annotation, str):
        try:
            annotation = eval(annotation, names)
        except NameError as unknown:
            name = str(unknown.name)
            names[name] = resolve(LATER[name]) if name in LATER else Any
    return TypeAdapter(annotation, config=ConfigDict(strict=strict, allow_inf_nan=False, arbitrary_types_allowed=True))


def check_values(
    adapters: Mapping[str, Any], values: Mapping[str, Any], labels: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Return the values converted to their types; raise InputError that names every invalid value.

    Args:
        labels: Parameter → name in messages, where the two differ.
    """
    from pydantic import ValidationError

    checked, faults = dict[str, Any](), []
    for name, value in values.items():
        try:
            checked[name] = adapters[name].validate_python(of_python(value))
        except ValidationError as error:
            reasons = map(reason_of, error.errors(include_url=False))
            faults.append((name, f"is {_represent(value)}; {', '.join(dict.fromkeys(reasons))}"))
        except (ValueError, RecursionError) as error:
            faults.append((name, f"is {_represent(value)}; {error}"))
    refuse(Fault(Path((labels or {}).get(name, name)), 0, 0, reason) for name, reason in faults)
    return checked


def reason_of(error: Any) -> str:
    """Return pydantic's message in terms of files and options rather than of Python."""
    kind, context = error["type"], error.get("ctx") or {}
    if kind == "value_error":
        return str(context["error"])
    if kind == "is_instance_of":
        return "it should be a list" if context["class"] == "Sequence" else f"it should be of type {context['class']}"
    if kind == "string_pattern_mismatch":
        of = "component.variable, where component has" if "\\." in str(context.get("pattern")) else "a name with"
        return f"it should be {of} only letters, digits and _, and no digit at the beginning"
    if kind in {"too_short", "too_long"} and context.get("field_type") in {"List", "Tuple"}:
        bound = f"at least {context['min_length']}" if kind == "too_short" else f"at most {context['max_length']}"
        return f"it should have {bound} entries, not {context.get('actual_length')}"
    reason = str(error["msg"]).replace("Input should", "it should")
    return _WORDS.get(kind, reason[:1].lower() + reason[1:])


_WORDS = {
    **dict.fromkeys(("bool_type", "bool_parsing"), "it should be on or off"),
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type"), "it should be a mapping of keys to values"),
    **dict.fromkeys(("list_type", "tuple_type"), "it should be a list"),
    "string_type": "it should be text",
    **dict.fromkeys(("float_type", "float_parsing"), "it should be a valid number"),
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "it should be a whole number"),
    "int_parsing_size": "it should be a smaller number",
}


def _represent(value: Any) -> str:
    """Return a short printable form for a message."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a very long number, or a mapping that contains itself
        return f"a {type(value).__name__} too large to show"
    text = text.encode("utf-8", "backslashreplace").decode()
    return text if len(text) <= MAX_ARGUMENT_CHARACTERS else f"{text[: MAX_ARGUMENT_CHARACTERS - 1]}…"
