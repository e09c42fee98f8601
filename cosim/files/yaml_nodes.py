"""YAML and JSON text as plain data with places; oversized, deep or unsupported content is rejected.

Nodes come from ruamel.yaml, whose messages are used, or for long texts from the faster libyaml if present.

Supported are mappings with text keys, lists, text, numbers, true, false and null, and anchors, aliases and merge keys
with limited expansion.
"""

from __future__ import annotations

import json
import re
from contextlib import suppress
from functools import cached_property, lru_cache
from importlib import import_module
from typing import Any, ClassVar

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import ScalarNode

DEEPEST = 60  # levels of nesting
LONG = 20_000  # text length from which loading another parser pays off
# Directives, tabs, byte order marks and Unicode line ends, on which the parsers disagree.
APART = re.compile("^%|[\\t\\x85\\u2028\\u2029\\ufeff]", re.MULTILINE)
MOST_YAML = 800_000  # text length [characters] readable within seconds
MOST_MARKS = 100_000  # commas, colons and lines of YAML, which determine the reading time
MOST_PARTS = 400_000  # keys and values after expanding aliases
MERGE, TAG = "<<", "tag:yaml.org,2002:"
TOO_DEEP = f"is nested too deep; at most {DEEPEST} levels are read"
SCALARS = {"null", "bool", "int", "float", "str", "timestamp", "merge", "value"}  # tags
Location = tuple[str | int, ...]
Place = tuple[int, int]
UNKNOWN: Place = (0, 0)
CONSTRUCTOR: Any = YAML(typ="safe", pure=True).constructor


class NotYaml(Exception):
    """Invalid or unsupported YAML text, with line and column from 1."""

    def __init__(self, message: str, mark: Any = None) -> None:
        super().__init__(message)
        self.line: int = 1 if mark is None else mark.line + 1
        self.column: int = 1 if mark is None else mark.column + 1


@lru_cache(maxsize=1)
def _libyaml() -> Any:
    """Return PyYAML's C parser with ruamel.yaml's scalar types, None if absent."""
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
            if self.depth > 2 * DEEPEST:
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
            self.data = json.loads(text, object_pairs_hook=with_unique_keys, parse_constant=int)  # NaN is no int
            if "\\u" in text:
                json.dumps(self.data, ensure_ascii=False).encode()  # rejects unpaired surrogates
            return
        except (ValueError, RecursionError):  # YAML, or a fault whose place only YAML reading finds
            self._is_json = False
        if self._is_large:
            raise NotYaml(
                f"has {len(text) / 1e6:.1f} MB of YAML, of which at most {MOST_YAML / 1e6:g} MB and about {MOST_MARKS} "
                "keys and values are read; write it as JSON, which may have 8 MB, or make it shorter"
            )
        self.data = None if self._root is None else self._value(self._root, 0)

    @cached_property
    def _root(self) -> Any:
        """Root node, None if empty: id (scalar, sequence, mapping), tag, value, start_mark; a scalar has a style."""
        text = self._text
        if len(text) >= LONG and not APART.search(text) and (parser := _libyaml()) is not None:
            with suppress(Exception):  # ruamel.yaml explains errors better than libyaml.
                return parser(text).get_single_node()
        try:
            return YAML(typ="safe", pure=True).compose(text)
        except RecursionError:
            raise NotYaml(TOO_DEEP) from None
        except (YAMLError, ValueError, IndexError, TypeError, AttributeError, AssertionError, OverflowError) as error:
            told = " ".join(filter(None, (getattr(error, "context", None), getattr(error, "problem", None))))
            if not told and isinstance(error, YAMLError):  # others come from mistakes of ruamel.yaml's scanner
                told = str(error).partition("\n")[0]
            mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
            raise NotYaml(f"is not YAML: {' '.join(told.split())[:200] or 'it cannot be understood'}", mark) from None

    def place(self, location: Location, key: bool = False) -> Place:
        """Return line and column of the nearest part at a location.

        The result is UNKNOWN for JSON that is too large to search or no YAML.

        Args:
            key: Whether to return the place of the key instead of the value.
        """
        if self._is_json and self._is_large:
            return UNKNOWN
        try:
            node, place = self._root, None
        except NotYaml:
            return UNKNOWN
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
        """Return the plain data of a YAML node; raise a fault if the file is too large or nested too deeply."""
        self._parts += 1
        if self._parts > MOST_PARTS:
            raise NotYaml(
                f"has more than {MOST_PARTS} values when its aliases are expanded; use fewer values or aliases",
                node.start_mark,
            )
        if depth > DEEPEST:
            raise NotYaml(TOO_DEEP, node.start_mark)
        kind = str(node.tag).removeprefix(TAG)
        if node.id == "mapping" and kind in {"map", "None"}:
            return {key: self._value(value, depth + 1) for key, (_, value) in _pairs(node).items()}
        if node.id == "sequence" and kind in {"seq", "None"}:
            return [self._value(value, depth + 1) for value in node.value]
        if node.id != "scalar" or kind not in SCALARS:
            tag = str(node.tag).replace(TAG, "!!")[:60]
            raise NotYaml(f'the tag "{tag}" means nothing here; leave it out', node.start_mark)
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
            raise NotYaml(f'"{text[:30]}" is no number', node.start_mark) from None


document_of = lru_cache(maxsize=2)(Document)  # A file is examined for its kind first, and then read.


def _pairs(node: Any) -> dict[str, tuple[Any, Any]]:
    """Return key → (key node, value node) of a mapping with its merged keys, which replace the node's value."""
    entries = node.value
    if isinstance(entries, dict):
        return entries
    node.value = None
    if entries is None:
        raise NotYaml("merges itself; take the merge out", node.start_mark)
    own: dict[str, tuple[Any, Any]] = {}
    merged: dict[str, tuple[Any, Any]] = {}
    for key, value in entries:
        if key.id != "scalar":
            raise NotYaml("a key is text, no list and no mapping", key.start_mark)
        if key.value == MERGE and not key.style:
            for other in value.value if value.id == "sequence" else [value]:
                if other.id != "mapping":
                    raise NotYaml("only a mapping, or a list of mappings, can be merged", value.start_mark)
                merged = {**_pairs(other), **merged}
        elif (name := _text_of(key)) in own:
            raise NotYaml(f'duplicate key "{name[:60]}"; keep one', key.start_mark)
        else:
            own[name] = key, value
    node.value = pairs = {**merged, **own}
    return pairs


def _text_of(node: Any) -> str:
    """Return a scalar's text with JSON surrogate pairs joined."""
    text: str = node.value
    try:
        return text.encode("utf-16", "surrogatepass").decode("utf-16")
    except UnicodeDecodeError:
        raise NotYaml(
            "contains half a character (one half of a surrogate pair); write the whole character", node.start_mark
        ) from None
