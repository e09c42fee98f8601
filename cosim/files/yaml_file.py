"""YAML and JSON with line and column of every key and value, and validation that reports all faults at once.

Oversized, deep or unsupported content is rejected. ruamel.yaml parses the text and supplies the messages; long texts
use the faster libyaml, if installed. Supported are mappings with text keys, lists, text, numbers, true, false and null,
and anchors and aliases with limited expansion.
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, get_args, get_origin

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationError,
    ValidatorFunctionWrapHandler,
)
from pydantic_core.core_schema import CoreSchema, no_info_wrap_validator_function
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import ScalarNode

from cosim.core.errors import Fault, InputError
from cosim.core.settings import MAX_NESTING, reason_of
from cosim.core.text import closest, did_you_mean
from cosim.core.units import has_unit, number_in, read_quantity
from cosim.files.files import open_bytes

LONG = 20_000  # text length from which loading another parser pays off
# Directives, tabs, byte order marks and Unicode line ends, on which the parsers disagree.
PARSERS_DISAGREE = re.compile("^%|[\\t\\x85\\u2028\\u2029\\ufeff]", re.MULTILINE)
MOST_YAML = 800_000  # text length [characters] readable within seconds
MOST_MARKS = 100_000  # commas, colons and lines of YAML, which determine the time to read a file
MOST_PARTS = 400_000  # keys and values after expanding aliases
TAG_PREFIX = "tag:yaml.org,2002:"
TOO_DEEP = f"is nested more than {MAX_NESTING} levels deep; use fewer levels"
SCALARS = {"null", "bool", "int", "float", "str", "timestamp", "merge", "value"}  # tags
Location = tuple[str | int, ...]
Place = tuple[int, int]
UNKNOWN_PLACE: Place = (0, 0)
CONSTRUCTOR: Any = YAML(typ="safe", pure=True).constructor
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]


@dataclass(frozen=True)
class InUnit:
    """Type of a value in a unit: a number, or text such as `4 min`, which is converted.

    If the unit is not known yet (None), text stays until `YamlFile.in_units` converts it.
    """

    unit: str | None
    difference: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        def number(value: Any, inner: ValidatorFunctionWrapHandler) -> Any:
            if self.unit is not None:
                return inner(number_in(value, self.unit, difference=self.difference))
            return value if isinstance(value, str) and has_unit(value) else inner(value)

        return no_info_wrap_validator_function(number, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        number = handler(schema)
        if "anyOf" in number:
            return {**number, "anyOf": [*number["anyOf"], {"type": "string"}]}
        return {**number, "type": ["number", "string"]}


Seconds = Annotated[Number, InUnit("s")]
PositiveSeconds = Annotated[Positive, InUnit("s")]
NotNegativeSeconds = Annotated[NotNegative, InUnit("s")]
Share = InUnit("1")  # a number, or text such as `5 %`
UNIT_OF_KEY = InUnit(None)  # a number, or text whose unit depends on other parts of the file
Amount = Annotated[Number, UNIT_OF_KEY]
PositiveAmount = Annotated[Positive, UNIT_OF_KEY]
NotNegativeAmount = Annotated[NotNegative, UNIT_OF_KEY]

MAX_YAML_BYTES = 8_000_000  # size of a file [bytes]
MOST_FAULTS = 200  # reported faults per file
MAX_SHOWN_CHARACTERS = 80  # shown characters of a name or value
M = TypeVar("M", bound=BaseModel)
Origin = Callable[[Location, str, int], Fault]
Remove = Callable[[dict[Any, Any], Sequence[tuple[Location, str]]], None]  # from data, by place and kind of fault
ROUNDS = 5  # attempts to remove faulty parts; each attempt may reveal further faults


class YamlFile:
    """A YAML document with line and column of each part; `root` is the data, which must not be changed.

    Args:
        origin: Function that maps a fault of a generated document to its source file.
    """

    def __init__(self, path: Path, origin: Origin | None = None) -> None:
        self.path, self.origin = path, origin
        self.overrides: dict[Location, str] = {}  # parts set by options, e.g. `--set "step=0"`
        try:
            self._document = document_of(_text(path))
        except NotYaml as error:
            raise InputError([Fault(path, error.line, error.column, str(error))]) from None
        self.root: Any = self._document.data
        self._within: Location = ()
        if not isinstance(self.root, dict):
            raise InputError([Fault(path, 1, 1, "is not a mapping of keys to values")])

    def enter(self, key: str) -> None:
        """Restrict the document to the part under a key."""
        self.root, self._within = self.root[key], (*self._within, key)

    def place(self, location: Location, key: bool = False) -> tuple[int, int]:
        """Return line and column of the part at a location, or of the nearest enclosing part.

        Args:
            key: Return the place of the key instead of the value.
        """
        return self._document.place((*self._within, *location), key)

    def fault(self, location: Location, message: str, *, key: bool = False, exit_code: int = 2) -> Fault:
        """Return a fault where a value was set: in the file, in the source of a generated file, or by an option."""
        is_missing = location_in(self.root, location, "") != location
        for at, option in reversed(self.overrides.items()):
            # For a missing part, options that set a value inside it count, too.
            if location[: len(at)] == at or (is_missing and at[: len(location)] == location):
                return Fault(self.path, 0, 0, f"{option}: {message}" if option else message, exit_code)
        if self.origin is not None:
            return self.origin((*self._within, *location), message, exit_code)
        return Fault(self.path, *self.place(location, key), message, exit_code)

    def in_units(
        self, content: M, section: str, units: Mapping[str, str], *, difference: bool = False
    ) -> tuple[M, list[Fault]]:
        """Return the content with text such as `400 kg` in a section converted to numbers, and faults.

        A faulty value is omitted. Text under an unknown name is converted without a check, because the unknown name is
        reported elsewhere.

        Args:
            units: Name → unit of its number.
        """
        values: dict[str, Any] = getattr(content, section)
        if not any(isinstance(value, str) for value in values.values()):
            return content, []
        numbers, faults = dict[str, Any](), list[Fault]()
        for name, value in values.items():
            is_text = isinstance(value, str)
            try:
                number = read_quantity(value, units[name], difference=difference) if is_text and name in units else 1.0
                numbers[name] = number if is_text else value
            except ValueError as error:
                faults.append(self.wrong((section, name), value, error))
        content = content.model_copy(update={section: numbers})
        try:
            return self.validate(type(content), dict(content)), faults
        except InputError as error:  # an out-of-range value
            return content, [*faults, *error.faults]

    def wrong(self, at: Location, value: Any, reason: object, *, key: bool = False) -> Fault:
        """Return the fault of an invalid value."""
        name, text = ".".join(map(short, at)) or "it", str(reason).replace(", or it should be ", " or ")
        return self.fault(at, f"{name} is {format_value(value)}: {text}", key=key)

    def validate(self, model: type[M], data: Any = None) -> M:
        """Return data (default: the whole file) as an object of a pydantic model; raise InputError with all faults."""
        data = self.root if data is None else data
        try:
            return model.model_validate(data)
        except ValidationError as error:
            raise InputError(self._faults(model, error, data)) from None

    def partly(
        self, model: type[M], first: str = "", *, data: Any = None, remove: Remove | None = None
    ) -> tuple[M, list[Fault]]:
        """Return data (default: all) as an object of a pydantic model without its faulty parts, and the faults.

        An unknown top-level key does not affect the other parts, unless it resembles `first`, a key on which the other
        parts depend.

        Args:
            remove: Function that removes the faulty parts. By default no known top-level key can be removed.

        Raises:
            InputError: A faulty part cannot be removed, or a faulty top-level key may affect the others.
        """

        def remove_inner(data: dict[Any, Any], places: Sequence[tuple[Location, str]]) -> None:
            for place, kind in places:
                is_alien = kind == "extra_forbidden" and closest(str(place[0]), model.model_fields) != first
                if len(place) < 2 and not is_alien:
                    raise InputError(faults)
                remove_part(data, place)

        data, faults = self.root if data is None else data, list[Fault]()
        for _ in range(ROUNDS):
            try:
                return model.model_validate(data), faults
            except ValidationError as error:
                if not faults:
                    data, faults = copy.deepcopy(data), self._faults(model, error, data)
                kinds = [(location_in(data, e["loc"], e["type"]), e["type"]) for e in error.errors(include_url=False)]
                (remove or remove_inner)(data, [(place, kind) for place, kind in kinds if place])
        raise InputError(faults)

    def _faults(self, model: type[BaseModel], error: ValidationError, data: Any) -> list[Fault]:
        # Of a union's branches, the one with errors inside the value is the intended one. If there is none, the first
        # error counts.
        every: list[Any] = error.errors(include_url=False)
        places = [location_in(data, e["loc"], e["type"]) for e in every]
        parents = {place[:k] for place in places for k in range(len(place))}
        misfits: dict[Location, Any] = {}
        errors: list[Any] = []
        for each, place in zip(every, places, strict=True):
            if each["type"] not in _FORMS:
                errors.append(each)
            elif place in misfits:
                misfits[place]["else"].append(each)
            elif place not in parents:
                misfits[place] = {**each, "else": []}
                errors.append(misfits[place])
        faults = []
        for each in errors[:MOST_FAULTS]:
            location = location_in(data, each["loc"], each["type"])
            if each["type"] == "missing":
                name = ".".join(map(short, location))
                faults.append(self.fault(location[:-1], f'"{name}" is missing; add it'))
            elif each["type"] == "extra_forbidden":
                key, keys = str(location[-1]), _allowed_keys(model, each["loc"][:-1])
                message = f'unknown key "{short(key)}"{did_you_mean(key, keys)} (allowed: {", ".join(keys)})'
                if cure := REMOVED_KEYS.get(key):
                    message = f'"{short(key)}" is no longer supported. {cure}'
                faults.append(self.fault(location, message, key=True))
            else:
                reasons = dict.fromkeys(map(reason_of, (each, *each.get("else", ()))))
                is_key = "[key]" in each["loc"][len(location) :]
                faults.append(self.wrong(location, each.get("input"), ", or ".join(reasons), key=is_key))
        if len(errors) > MOST_FAULTS:
            faults.append(Fault(self.path, 0, 0, f"{len(errors)} faults in all; the first {MOST_FAULTS} are shown"))
        return faults


def _text(path: Path) -> str:
    """Return a file's text; raise InputError if unreadable."""
    try:
        with open_bytes(path) as stream:
            content = stream.read(MAX_YAML_BYTES + 1)
        if len(content) > MAX_YAML_BYTES:
            limit = f"the limit of {MAX_YAML_BYTES / 1e6:g} MB (YAML: {MOST_YAML / 1e6:g} MB); make it shorter"
            raise InputError.at(path, f"has {path.stat().st_size / 1e6:.1f} MB, more than {limit}")
        return content.decode()
    except UnicodeDecodeError:
        raise InputError.at(path, "is not UTF-8 text; save it as UTF-8") from None
    except FileNotFoundError:
        raise InputError.at(path, "no such file") from None
    except OSError as error:
        raise InputError.at(path, f"cannot be read: {error.strerror}") from None
    except ValueError:  # an invalid file name
        raise InputError.at(Path(format_value(str(path))), "no such file") from None


def format_value(value: Any) -> str:
    """Return a value as written in a YAML file, shortened if long."""
    if isinstance(value, (str, float)):
        return repr(short(value) if isinstance(value, str) else value)
    if isinstance(value, int) and abs(value) >= 10**MAX_SHOWN_CHARACTERS:
        return "a very large number"
    if value is None or isinstance(value, int):
        return "empty" if value is None else str(value).lower()
    if isinstance(value, dict):
        return "a mapping"
    return "a list" if isinstance(value, (list, tuple)) else "of another kind"


def short(text: object) -> str:
    """Return a text shortened for a message."""
    whole = str(text)
    return whole if len(whole) <= MAX_SHOWN_CHARACTERS else f"{whole[: MAX_SHOWN_CHARACTERS - 1]}…"


REMOVED_KEYS: dict[str, str] = {  # key of earlier versions → what to use instead
    "at": "Run FMUs on this machine; `cosim sweep --dask` spreads runs over many machines.",
    "live": "Exchange values with a function of Python: cosim.run(..., inputs={...}); examples/live shows one.",
    "carry_logs": "Remove it, and give the validation logs together with the FMU.",
    "delivery": "A refined FMU contains the original and the terms: omit the key.",
    "design": "Design the controller first: cosim build --model MODEL --design FILE.",
}
_FORMS = {"dict_type", "model_type", "list_type", "tuple_type", "string_type", "float_type", "string_pattern_mismatch"}


def remove_part(data: dict[Any, Any], location: Location) -> tuple[dict[Any, Any], str | int]:
    """Remove the smallest part at a location and return its parent and key.

    For a missing key, the part without the key is removed. A faulty list is removed entirely, so that the indices of
    its elements stay valid.
    """
    key, *rest = location
    for step in rest:
        if not isinstance(data.get(key), dict) or step not in data[key]:
            break
        data, key = data[key], step
    data.pop(key, None)
    return data, key


def location_in(data: Any, places: Sequence[str | int], kind: str) -> Location:
    """Return the location of a fault in the data.

    Locations of pydantic include names of union branches, which are not part of the data.

    Args:
        kind: Type of the fault in pydantic; the location of a `missing` key is not in the data.
    """
    location: list[str | int] = []
    for k, part in enumerate(places):
        indices = data if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ()
        if part in indices:
            data = data[part]
            location.append(part)
        elif kind in {"missing", "extra_forbidden"} and k == len(places) - 1:
            location.append(part)
    return tuple(location)


def _allowed_keys(annotation: Any, places: Sequence[str | int]) -> list[str]:
    """Return the allowed keys of the part at a location, which may include tags of a union's branches."""
    for step in places:
        while get_origin(annotation) is Annotated:
            annotation = get_args(annotation)[0]
        branches = {getattr(mark, "tag", None): b for b in get_args(annotation) for mark in get_args(b)[1:]}
        field = getattr(annotation, "model_fields", {}).get(step)
        otherwise = field.annotation if field is not None else (get_args(annotation) or (annotation,))[-1]
        annotation = branches.get(step, otherwise)
    return _keys(annotation)


def _keys(annotation: Any) -> list[str]:
    """Return the keys of the first pydantic model in an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [f.alias or name for name, f in annotation.model_fields.items()]
    return next(filter(None, map(_keys, get_args(annotation))), [])


class Part(BaseModel):
    """A part of a file; unknown keys are rejected."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True, defer_build=True)


# -- text as plain data with places ---------------------------------------------------------------


class NotYaml(Exception):
    """Invalid or unsupported YAML text, with line and column from 1."""

    def __init__(self, message: str, mark: Any = None) -> None:
        super().__init__(message)
        self.line: int = 1 if mark is None else mark.line + 1
        self.column: int = 1 if mark is None else mark.column + 1


@lru_cache(maxsize=1)
def _libyaml() -> Any:
    """Return PyYAML's C parser with ruamel.yaml's scalar types, or None if PyYAML is not installed."""
    try:
        loader: Any = import_module("yaml").CLoader
    except (ImportError, AttributeError):
        return None

    class Parser(loader):  # type: ignore[misc]
        """Parser that counts the nesting, which would overflow the stack in libyaml."""

        yaml_implicit_resolvers: ClassVar[Any] = {
            first: [(str(tag), pattern) for tag, pattern in kinds]
            for first, kinds in YAML(typ="safe", pure=True).resolver.versioned_resolver.items()
        }
        depth = 0

        def descend_resolver(self, *_: Any) -> None:
            self.depth += 1
            if self.depth > 2 * MAX_NESTING:
                raise RecursionError

        def ascend_resolver(self) -> None:
            self.depth -= 1

    return Parser


class Document:
    """Plain data with the place of each part."""

    def __init__(self, text: str) -> None:
        def with_unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
            mapping = dict(pairs)
            if len(mapping) < len(pairs):
                raise ValueError("duplicate key")
            return mapping

        self._text, self._parts = text, 0
        self._is_large = len(text) > MOST_YAML or sum(map(text.count, ",:\n")) > MOST_MARKS
        self._is_json = True
        try:
            self.data = json.loads(text, object_pairs_hook=with_unique_keys, parse_constant=int)  # an int cannot be NaN
            if "\\u" in text:
                json.dumps(self.data, ensure_ascii=False).encode()  # this rejects unpaired surrogates
            return
        except (ValueError, RecursionError):  # YAML, or a fault whose place only YAML reading finds
            self._is_json = False
        if self._is_large:
            raise NotYaml(
                f"has {len(text) / 1e6:.1f} MB of YAML; the limits are {MOST_YAML / 1e6:g} MB and about {MOST_MARKS} "
                "keys and values; write it as JSON, with a limit of 8 MB, or make it shorter"
            )
        self.data = None if self._root is None else self._value(self._root, 0)

    @cached_property
    def _root(self) -> Any:
        """Return the root node.

        A node has id (scalar, sequence, mapping), tag, value and start_mark; a scalar also has a style.

        The node of an empty document is None.
        """
        text = self._text
        if len(text) >= LONG and not PARSERS_DISAGREE.search(text) and (parser := _libyaml()) is not None:
            with suppress(Exception):  # ruamel.yaml explains errors better than libyaml.
                return parser(text).get_single_node()
        try:
            return YAML(typ="safe", pure=True).compose(text)
        except RecursionError:
            raise NotYaml(TOO_DEEP) from None
        except (YAMLError, ValueError, IndexError, TypeError, AttributeError, AssertionError, OverflowError) as error:
            told = " ".join(filter(None, (getattr(error, "context", None), getattr(error, "problem", None))))
            if not told and isinstance(error, YAMLError):  # other errors are bugs of ruamel.yaml
                told = str(error).partition("\n")[0]
            mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
            raise NotYaml(f"is not YAML: {' '.join(told.split())[:200] or 'it cannot be parsed'}", mark) from None

    def place(self, location: Location, key: bool = False) -> Place:
        """Return line and column of the part at a location, or of the nearest enclosing part.

        The result is UNKNOWN_PLACE for JSON that is too large to search or no YAML.

        Args:
            key: Return the place of the key instead of the value.
        """
        if self._is_json and self._is_large:
            return UNKNOWN_PLACE
        try:
            node, place = self._root, None
        except NotYaml:
            return UNKNOWN_PLACE
        for depth, step in enumerate(location, 1):
            is_last = depth == len(location)
            if node.id == "mapping" and step in (pairs := _pairs(node)):
                at, node = pairs[str(step)]
                # A missing key is reported at the key of its parent.
                place = (at if (key and is_last) or (not is_last and node.id != "scalar") else node).start_mark
            elif node.id == "sequence" and isinstance(step, int) and step < len(node.value):
                node = node.value[step]
                place = node.start_mark
            else:
                break
        return (1, 1) if place is None else (place.line + 1, place.column + 1)

    def _value(self, node: Any, depth: int) -> Any:
        """Return the plain data of a YAML node; raise NotYaml if the file is too large or nested too deeply."""
        self._parts += 1
        if self._parts > MOST_PARTS:
            raise NotYaml(
                f"has more than {MOST_PARTS} values when its aliases are expanded; use fewer values or aliases",
                node.start_mark,
            )
        if depth > MAX_NESTING:
            raise NotYaml(TOO_DEEP, node.start_mark)
        kind = str(node.tag).removeprefix(TAG_PREFIX)
        if node.id == "mapping" and kind in {"map", "None"}:
            return {key: self._value(value, depth + 1) for key, (_, value) in _pairs(node).items()}
        if node.id == "sequence" and kind in {"seq", "None"}:
            return [self._value(value, depth + 1) for value in node.value]
        if node.id != "scalar" or kind not in SCALARS:
            tag = str(node.tag).replace(TAG_PREFIX, "!!")[:60]
            raise NotYaml(f'the tag "{tag}" is not supported; remove it', node.start_mark)
        text = _text_of(node)
        if kind == "null":
            return None
        if kind == "bool":
            return text.lower() == "true"
        if kind not in {"int", "float"}:
            return text
        try:
            return getattr(CONSTRUCTOR, f"construct_yaml_{kind}")(ScalarNode(node.tag, node.value))
        except (ValueError, IndexError):
            raise NotYaml(f'"{text[:30]}" is not a number', node.start_mark) from None


document_of = lru_cache(maxsize=2)(Document)  # cached, because a file is parsed for its kind and again for its content


def _pairs(node: Any) -> dict[str, tuple[Any, Any]]:
    """Return key → (key node, value node) of a mapping; store these pairs as the node's value."""
    if not isinstance(node.value, dict):
        pairs: dict[str, tuple[Any, Any]] = {}
        for key, value in node.value:
            if key.id != "scalar":
                raise NotYaml("a list or mapping is used as a key; use text", key.start_mark)
            if (name := _text_of(key)) in pairs:
                raise NotYaml(f'duplicate key "{name[:60]}"; keep one', key.start_mark)
            pairs[name] = key, value
        node.value = pairs
    found: dict[str, tuple[Any, Any]] = node.value
    return found


def _text_of(node: Any) -> str:
    """Return a scalar's text with JSON surrogate pairs joined."""
    text: str = node.value
    try:
        return text.encode("utf-16", "surrogatepass").decode("utf-16")
    except UnicodeDecodeError:
        raise NotYaml(
            "contains an unpaired surrogate (half a character); write the whole character", node.start_mark
        ) from None
