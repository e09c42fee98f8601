"""Conversion of arguments of `cosim` functions from Python values to the form that verbs use.

`checked` is the only place where outside values are examined. It turns numbers of numpy into Python numbers and text
with a unit into seconds, and raises InputError naming every invalid argument. Annotations declare the accepted values.
"""

from __future__ import annotations

import functools
import inspect
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from cosim.base.errors import Fault, InputError
from cosim.base.units import allowed_quantity, has_unit, read_quantity

Given = Mapping[str, Any] | Sequence[str]
# Annotations that say more than their type.
Seconds = float  # or text with a unit: 4 min
PositiveSeconds = float
Positive = float
NotNegative = float
ModelName = str  # or the name of a file or folder
Files = Sequence[str | os.PathLike[str]]
Seed = int  # at least 0
Count = int  # at least 1

P = ParamSpec("P")
T = TypeVar("T")
DEEPEST = 60  # levels of nesting, more than any file read here has
LARGEST = 1e308  # close to the largest double
LONGEST_NAME, LONGEST_PATH = 255, 4096  # limits of file systems [bytes]
MOST_TEXT = 8_000_000  # characters
SHOWN = 60  # characters of a value in a message


def normalize_settings(values: Given | None, name: str = "set") -> Given:
    """Return settings as a mapping or a tuple of texts; raise InputError for other types."""
    if values is None:
        return ()
    if isinstance(values, str):
        return (values,)
    if isinstance(values, Mapping):
        return dict(values)
    if isinstance(values, Sequence) and all(isinstance(v, str) for v in values):
        return tuple(values)
    raise InputError([Fault(Path(name), 0, 0, f"{_shown(values)}: {GIVEN}")])


def texts(values: Given | None, name: str = "set") -> Sequence[str]:
    """Return settings as NAME=VALUE texts."""
    found = normalize_settings(values, name)
    return [f"{n}={as_yaml(v)}" for n, v in found.items()] if isinstance(found, Mapping) else found


def as_yaml(value: Any) -> str:
    """Return a Python value as text for --set."""
    return json.dumps(plain(value))


def plain(value: Any, depth: int = 0) -> Any:
    """Return a value as JSON types; raise ValueError if impossible."""
    if depth > DEEPEST:
        raise ValueError(f"it is nested more than {DEEPEST} levels deep; write it flatter")
    value = _of_python(value)
    match value:
        case None | bool():
            return value
        case str():
            return _text(value)
        case int() | float():
            return _number(value)
        case os.PathLike():
            return _file(value)
        case Mapping():
            if wrong := [key for key in value if not isinstance(key, str)]:
                raise ValueError(f"{_shown(wrong[0])} is a key; a key is text")
            return {_text(key): plain(each, depth + 1) for key, each in value.items()}
        case list() | tuple():
            return [plain(each, depth + 1) for each in value]
    raise ValueError(
        f"{_shown(value)} is of type {type(value).__name__}; it is a number, text, true or false, a list or a mapping"
    )


# -- accepted values of arguments ---------------------------------------------------------------------


def checked(function: Callable[P, T]) -> Callable[P, T]:
    """Return the function with a check of its arguments. The check raises InputError with every invalid argument."""
    signature = inspect.signature(function)
    takes = {name: list(_alternatives(str(p.annotation))) for name, p in signature.parameters.items()}

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        bound = signature.bind(*args, **kwargs)
        faults = []
        for name, value in bound.arguments.items():
            try:
                bound.arguments[name] = _argument(takes[name], value)
            except ValueError as error:
                faults.append(Fault(Path(name), 0, 0, str(error)))
        if faults:
            raise InputError(faults)
        return function(*bound.args, **bound.kwargs)

    return call


def _alternatives(annotation: str) -> Iterator[str]:
    """Yield the types of an annotation without their parameters."""
    flat = re.sub(r"\[[^\[\]]*\]", "", re.sub(r"\[[^\[\]]*\[[^\[\]]*\][^\[\]]*\]", "", annotation))
    yield from (part.strip() for part in flat.split("|"))


def _argument(kinds: Sequence[str], value: Any) -> Any:
    """Return an argument converted by the first matching kind; raise ValueError if none matches."""
    value = _of_python(value)
    errors = []
    for kind in kinds:
        if kind not in KINDS:  # a type declared by a function of another package
            return value
        accepts, convert = KINDS[kind]
        if accepts(value):
            return convert(value)
        errors.append(WANTED[kind])
    wanted = " or ".join(dict.fromkeys(filter(None, errors)))
    raise ValueError(f"is {_shown(value)}; give {wanted}")


def _of_python(value: Any) -> Any:
    """Return a numpy-like value as a Python value. Further types are returned unchanged."""
    if isinstance(value, (str, int, float)) and type(value).__module__ == "builtins":
        return value
    if hasattr(value, "tolist") and hasattr(value, "dtype"):
        return value.tolist()
    for kind in (bool, int, float, str):  # a subclass, e.g. an item of an enumeration or numpy's float64
        if isinstance(value, kind):
            return kind(value) if kind is not str else str.__str__(value)
    return value


def _number(value: float) -> float:
    if not abs(value) < LARGEST:
        raise ValueError(f"{_shown(value)} is no finite number; give one below {LARGEST:g}")
    return value


def _finite(value: float, lowest: float = -math.inf, *, above: bool = False) -> float:
    number = float(_number(value))
    if number < lowest or (above and number == lowest):
        raise ValueError(
            f"is {_shown(value)}; give a number {'above' if above else 'from'} {lowest:g}{'' if above else ' on'}"
        )
    return number


def _seconds(value: Any, lowest: float = -math.inf) -> float:
    """Return a time [s] from a number or text."""
    if isinstance(value, str):
        if not has_unit(value):
            raise ValueError(f"is {_shown(value)}; {allowed_quantity('s')}")
        value = read_quantity(value, "s")
    return _finite(value, lowest, above=math.isfinite(lowest))


def _whole(value: int, lowest: int | None = None) -> int:
    if not -(2**63) <= value < 2**63 or (lowest is not None and value < lowest):
        allowed = "a whole number" if lowest is None else f"a whole number from {lowest} on"
        raise ValueError(f"is {_shown(value)}; give {allowed} of at most 18 digits")
    return value


def _text(value: str) -> str:
    if "\0" in value:
        raise ValueError(f"{_shown(value)} holds a NUL character; leave it out")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise ValueError(
            f"{_shown(value)} holds half a character (a surrogate); give text that UTF-8 can hold"
        ) from None
    if len(value) > MOST_TEXT:
        raise ValueError(f"is text of {len(value)} characters; give at most {MOST_TEXT}")
    return value


def _file(value: Any) -> Any:
    name = os.fspath(value)
    if not isinstance(name, str):
        raise ValueError(f"is {_shown(value)}; give the name of a file or folder as text or a Path")
    if not _text(name).strip():
        raise ValueError("is blank; give the name of a file or folder")
    if len(name.encode()) > LONGEST_PATH or any(len(part.encode()) > LONGEST_NAME for part in re.split(r"[/\\]", name)):
        raise ValueError(f"is {_shown(name)}, longer than the name of a file can be ({LONGEST_NAME} bytes)")
    return name if isinstance(value, str) else Path(name)


def _settings(value: Any) -> Given:
    """Return settings as a mapping or texts."""
    found: Given = plain(value) if isinstance(value, Mapping) else _names(value)
    return found


def _names(value: Any) -> tuple[str, ...]:
    """Return a text or texts as a tuple."""
    return tuple(map(_text, (value,) if isinstance(value, str) else value))


def _files(value: Any) -> Any:
    return [_file(each) for each in value]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_file(value: Any) -> bool:
    return isinstance(value, (str, os.PathLike))


def _are(kind: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, (list, tuple, set, frozenset)) and all(map(kind, value))


def _are_names(value: Any) -> bool:
    return isinstance(value, str) or _are(lambda each: isinstance(each, str))(value)


def _is_a(module: str, name: str) -> Callable[[Any], bool]:
    """Return a predicate for instances of a named class.

    The class belongs to a module of a higher layer, which cannot be imported here.
    """
    return lambda value: any((kind.__module__, kind.__name__) == (module, name) for kind in type(value).__mro__)


def _same(value: Any) -> Any:
    return value


GIVEN = 'give a mapping, {"name": value}, or a list of "name=value"'
# Annotation → a predicate of accepted values and their conversion. WANTED describes the accepted values.
KINDS: dict[str, tuple[Callable[[Any], bool], Callable[[Any], Any]]] = {
    "None": (lambda value: value is None, _same),
    "bool": (lambda value: isinstance(value, bool), _same),
    "int": (_is_whole, _whole),
    "Seed": (_is_whole, lambda value: _whole(value, 0)),
    "Count": (_is_whole, lambda value: _whole(value, 1)),
    "float": (_is_number, _finite),
    "Positive": (_is_number, lambda value: _finite(value, 0.0, above=True)),
    "NotNegative": (_is_number, lambda value: _finite(value, 0.0)),
    "Seconds": (lambda value: _is_number(value) or isinstance(value, str), _seconds),
    "PositiveSeconds": (lambda value: _is_number(value) or isinstance(value, str), lambda value: _seconds(value, 0.0)),
    "str": (lambda value: isinstance(value, str), _text),
    "FilePath": (_is_file, _file),
    "ModelName": (_is_file, lambda value: str(_file(value))),
    "Sequence": (_are_names, _names),
    "tuple": (_are_names, _names),
    "Files": (_are(_is_file), _files),
    "Mapping": (lambda value: isinstance(value, Mapping), plain),
    "Given": (lambda value: isinstance(value, Mapping) or _are_names(value), _settings),
    "Callable": (callable, _same),
    "Progress": (callable, _same),
    "Signals": (_is_a("cosim.simulation.run_signals", "Signals"), _same),
    "Subject": (_is_a("cosim.subject.interface", "Subject"), _same),
    "Observers": (_are(_is_a("cosim.master.observer", "Observer")), _same),
}
WANTED = {
    "None": "",
    "bool": "True or False",
    "int": "a whole number",
    "Seed": "a whole number from 0 on",
    "Count": "a whole number from 1 on",
    "float": "a number",
    "Positive": "a number above 0",
    "NotNegative": "a number from 0 on",
    "Seconds": 'a number of seconds, or text with a unit such as "4 min"',
    "PositiveSeconds": 'a number of seconds above 0, or text with a unit such as "4 min"',
    "str": "text",
    "FilePath": "the name of a file or folder",
    "ModelName": "the name of a model, a file or a folder",
    "Sequence": "a list of names",
    "tuple": "a list of texts",
    "Files": "a list of names of files",
    "Mapping": "a mapping of names to values",
    "Given": GIVEN.removeprefix("give "),
    "Callable": "a function",
    "Progress": "a function",
    "Signals": "what a function of cosim returned",
    "Subject": "an object of a subclass of cosim.subject.interface.Subject",
    "Observers": "a list of objects of subclasses of cosim.master.observer.Observer",
}


def _shown(value: Any) -> str:
    """Return a short printable form for a message."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a number of thousands of digits, or a mapping that contains itself
        return f"a {type(value).__name__} too large to show"
    text = text.encode("ascii", "backslashreplace").decode() if any("\ud800" <= c <= "\udfff" for c in text) else text
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 1]}…"
