"""Conversion of arguments of `cosim` functions from Python values to the form that verbs use.

`check_arguments` is the only place where outside values are examined. It turns numbers of numpy into Python numbers
and text with a unit into seconds, and raises InputError naming every invalid argument. Annotations declare the
accepted values.
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
from typing import Any, NamedTuple, ParamSpec, TypeVar

from cosim.base.errors import Fault, InputError, refuse
from cosim.base.units import allowed_quantity, has_unit, read_quantity

Given = Mapping[str, Any] | Sequence[str]
# Annotations that say more than their type.
Seconds = float  # or text with a unit: 4 min
PositiveSeconds = float
Positive = float
NotNegative = float
ModelName = str  # or the name of a file or folder
Files = Sequence[str | os.PathLike[str]]
Runs = Sequence[Any]  # names of files or folders, numbers and results of functions
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
    raise InputError.at(Path(name), f"{_represent(values)}: give {SETTINGS}")


def texts(values: Given | None, name: str = "set") -> Sequence[str]:
    """Return settings as NAME=VALUE texts."""
    settings = normalize_settings(values, name)
    return [f"{n}={json.dumps(plain(v))}" for n, v in settings.items()] if isinstance(settings, Mapping) else settings


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
                raise ValueError(f"{_represent(wrong[0])} is a key; a key is text")
            return {_text(key): plain(each, depth + 1) for key, each in value.items()}
        case list() | tuple():
            return [plain(each, depth + 1) for each in value]
    raise ValueError(
        f"{_represent(value)} is of type {type(value).__name__}; it is a number, text, true or false, a list or "
        "a mapping"
    )


# -- accepted values of arguments ---------------------------------------------------------------------


def check_arguments(function: Callable[P, T]) -> Callable[P, T]:
    """Return the function with a check of its arguments. The check raises InputError with every invalid argument."""
    signature = inspect.signature(function)
    kinds = {name: list(_alternatives(str(p.annotation))) for name, p in signature.parameters.items()}

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        bound = signature.bind(*args, **kwargs)
        faults = []
        for name, value in bound.arguments.items():
            try:
                bound.arguments[name] = _argument(kinds[name], value)
            except ValueError as error:
                faults.append(Fault(Path(name), 0, 0, str(error)))
        refuse(faults)
        return function(*bound.args, **bound.kwargs)

    return call


def _alternatives(annotation: str) -> Iterator[str]:
    """Yield the types of an annotation without their parameters."""
    flat = re.sub(r"\[[^\[\]]*\]", "", re.sub(r"\[[^\[\]]*\[[^\[\]]*\][^\[\]]*\]", "", annotation))
    yield from (part.strip() for part in flat.split("|"))


def _argument(kinds: Sequence[str], value: Any) -> Any:
    """Return an argument converted by the first matching kind; raise ValueError if none matches."""
    value = _of_python(value)
    for kind in kinds:
        if kind not in KINDS:  # a type declared by a function of another package
            return value
        if KINDS[kind].accepts(value):
            return KINDS[kind].convert(value)
    wanted = " or ".join(dict.fromkeys(filter(None, (KINDS[kind].description for kind in kinds))))
    raise ValueError(f"is {_represent(value)}; give {wanted}")


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
        raise ValueError(f"{_represent(value)} is no finite number; give one below {LARGEST:g}")
    return value


def _finite(value: float, lowest: float = -math.inf, *, above: bool = False) -> float:
    number = float(_number(value))
    if number < lowest or (above and number == lowest):
        wanted = f"a number above {lowest:g}" if above else f"a number from {lowest:g} on"
        raise ValueError(f"is {_represent(value)}; give {wanted}")
    return number


def _seconds(value: Any, lowest: float = -math.inf) -> float:
    """Return a time [s] from a number, or from a text with a unit."""
    if isinstance(value, str):
        try:
            if not has_unit(value):
                raise ValueError(allowed_quantity("s"))
            value = read_quantity(value, "s")
        except ValueError as error:
            raise ValueError(f"is {_represent(value)}; {error}") from None
    return _finite(value, lowest, above=math.isfinite(lowest))


def _integer(value: int, lowest: int | None = None) -> int:
    if not -(2**63) <= value < 2**63 or (lowest is not None and value < lowest):
        wanted = "a whole number" if lowest is None else f"a whole number from {lowest} on"
        raise ValueError(f"is {_represent(value)}; give {f'{wanted} of at most 18 digits'}")
    return value


def _text(value: str) -> str:
    if "\0" in value:
        raise ValueError(f"{_represent(value)} holds a NUL character; leave it out")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise ValueError(
            f"{_represent(value)} contains half a character (one half of a surrogate pair), which UTF-8 cannot "
            "hold; write the whole character"
        ) from None
    if len(value) > MOST_TEXT:
        raise ValueError(f"is text of {len(value)} characters; give at most {MOST_TEXT}")
    return value


def _file(value: Any) -> Any:
    name = os.fspath(value)
    if not isinstance(name, str):
        wanted = "the name of a file or folder as text or a Path"
        raise ValueError(f"is {_represent(value)}; give {wanted}")
    if not _text(name).strip():
        raise ValueError("is blank; give the name of a file or folder")
    if len(name.encode()) > LONGEST_PATH or any(len(part.encode()) > LONGEST_NAME for part in re.split(r"[/\\]", name)):
        raise ValueError(f"is {_represent(name)}, longer than the name of a file can be ({LONGEST_NAME} bytes)")
    return name if isinstance(value, str) else Path(name)


def _settings(value: Any) -> Given:
    """Return settings as a mapping or texts."""
    settings: Given = plain(value) if isinstance(value, Mapping) else _names(value)
    return settings


def _names(value: Any) -> tuple[str, ...]:
    """Return a text or texts as a tuple."""
    return tuple(map(_text, (value,) if isinstance(value, str) else value))


def _files(value: Any) -> Any:
    return [_file(each) for each in value]


def _runs(value: Any) -> list[Any]:
    return [_file(v) if isinstance(v, (str, os.PathLike)) else v for v in map(_of_python, value)]


def _is(*types: Any) -> Callable[[Any], bool]:
    """Return a predicate for instances of some types; True and False are no numbers."""
    return lambda value: isinstance(value, types) and (types == (bool,) or not isinstance(value, bool))


def _are(predicate: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, (list, tuple, set, frozenset)) and all(map(predicate, value))


def _are_names(value: Any) -> bool:
    return isinstance(value, str) or _are(_is(str))(value)


def _is_a(module: str, name: str) -> Callable[[Any], bool]:
    """Return a predicate for instances of a named class.

    The class belongs to a module of a higher layer, which cannot be imported here.
    """
    return lambda value: any((kind.__module__, kind.__name__) == (module, name) for kind in type(value).__mro__)


def _are_runs(value: Any) -> bool:
    is_run = (KINDS["FilePath"].accepts, KINDS["Count"].accepts, KINDS["Signals"].accepts)
    return isinstance(value, (list, tuple)) and all(any(is_(v) for is_ in is_run) for v in map(_of_python, value))


def _has_names(value: Any) -> bool:
    return isinstance(value, Mapping) and all(isinstance(name, str) for name in value)


def _same(value: Any) -> Any:
    return value


class ArgumentKind(NamedTuple):
    """Accepted values of an annotation: a predicate, their conversion and their description."""

    accepts: Callable[[Any], bool]
    convert: Callable[[Any], Any]
    description: str


SETTINGS = 'a mapping, {"name": value}, or a list of "name=value"'
TIME = 'a number of seconds{}, or text with a unit such as "4 min"'
KINDS = {  # by annotation
    "None": ArgumentKind(_is(type(None)), _same, ""),
    "bool": ArgumentKind(_is(bool), _same, "True or False"),
    "int": ArgumentKind(_is(int), _integer, "a whole number"),
    "Seed": ArgumentKind(_is(int), lambda value: _integer(value, 0), "a whole number from 0 on"),
    "Count": ArgumentKind(_is(int), lambda value: _integer(value, 1), "a whole number from 1 on"),
    "float": ArgumentKind(_is(int, float), _finite, "a number"),
    "Positive": ArgumentKind(_is(int, float), lambda value: _finite(value, 0.0, above=True), "a number above 0"),
    "NotNegative": ArgumentKind(_is(int, float), lambda value: _finite(value, 0.0), "a number from 0 on"),
    "Seconds": ArgumentKind(_is(int, float, str), _seconds, TIME.format("")),
    "PositiveSeconds": ArgumentKind(_is(int, float, str), lambda value: _seconds(value, 0.0), TIME.format(" above 0")),
    "str": ArgumentKind(_is(str), _text, "text"),
    "FilePath": ArgumentKind(_is(str, os.PathLike), _file, "the name of a file or folder"),
    "ModelName": ArgumentKind(
        _is(str, os.PathLike), lambda value: str(_file(value)), "the name of a model, a file or a folder"
    ),
    "Sequence": ArgumentKind(_are_names, _names, "a list of names"),
    "tuple": ArgumentKind(_are_names, _names, "a list of texts"),
    "Files": ArgumentKind(_are(_is(str, os.PathLike)), _files, "a list of names of files"),
    "Mapping": ArgumentKind(_is(Mapping), plain, "a mapping of names to values"),
    "Given": ArgumentKind(lambda value: isinstance(value, Mapping) or _are_names(value), _settings, SETTINGS),
    "NamedFunctions": ArgumentKind(_has_names, dict, "a mapping of names to functions"),
    "Callable": ArgumentKind(callable, _same, "a function"),
    "Progress": ArgumentKind(callable, _same, "a function"),
    "Signals": ArgumentKind(_is_a("cosim.simulation.run_signals", "Signals"), _same, "a result of a function of cosim"),
    "Runs": ArgumentKind(_are_runs, _runs, "a list of runs: their folders, numbers, names or patterns"),
    "Subject": ArgumentKind(
        _is_a("cosim.subject.interface", "Subject"), _same, "an object of a subclass of cosim.subject.interface.Subject"
    ),
    "Observers": ArgumentKind(
        _are(_is_a("cosim.master.observer", "Observer")),
        _same,
        "a list of objects of subclasses of cosim.master.observer.Observer",
    ),
}


def _represent(value: Any) -> str:
    """Return a short printable form for a message."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a number of thousands of digits, or a mapping that contains itself
        return f"a {type(value).__name__} too large to show"
    text = text.encode("ascii", "backslashreplace").decode() if any("\ud800" <= c <= "\udfff" for c in text) else text
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 1]}…"
