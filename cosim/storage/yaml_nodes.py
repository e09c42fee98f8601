"""YAML and JSON text as plain data with places; oversized, deep or unsupported content is rejected.

Nodes come from ruamel.yaml, whose messages are used, or for long texts from the faster libyaml if present.

Supported are mappings with text keys, lists, text, numbers, true, false and null, and anchors, aliases and merge keys
with limited expansion.
"""

from __future__ import annotations

import importlib
import json
import re
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property, lru_cache
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import ScalarNode

DEEPEST = 60  # levels of nesting
LONG = 20_000  # text length from which loading another parser pays off
# Directives, tabs, byte order marks and Unicode line ends, on which the parsers disagree.
APART = re.compile("^%|[\\t\\x85\\u2028\\u2029\\ufeff]", re.MULTILINE)
TEXT = "tag:yaml.org,2002:str"
MOST_YAML, MOST_JSON = 800_000, 8_000_000  # text lengths [characters] readable within seconds
MOST_MARKS = 100_000  # commas, colons and lines of YAML, which determine the reading time
MOST_PARTS = 400_000  # keys and values after expanding aliases
MERGE = "<<"
SCALARS = {"null", "bool", "int", "float", "str", "timestamp", "merge", "value"}  # tags
Location = tuple[str | int, ...]
Place = tuple[int, int]
UNKNOWN: Place = (0, 0)


class NotYaml(Exception):
    """Invalid or unsupported YAML text, with line and column from 1."""

    def __init__(self, line: int, column: int, message: str) -> None:
        super().__init__(message)
        self.line, self.column = line, column


def nodes(text: str) -> Any:
    """Return the root node of a YAML text, None if empty.

    A node has id (scalar, sequence, mapping), tag, value and start_mark; a scalar has a style, empty if plain.

    Raises:
        NotYaml: The text is invalid.
    """
    if len(text) >= LONG and not APART.search(text) and (parser := _libyaml()) is not None:
        with suppress(Exception):  # ruamel.yaml explains errors better than libyaml.
            return parser(text).get_single_node()
    return _by_ruamel(text)


@lru_cache(maxsize=1)
def _constructor() -> Any:
    return YAML(typ="safe", pure=True).constructor


def _by_ruamel(text: str) -> Any:
    try:
        return YAML(typ="safe", pure=True).compose(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        context = error.context if str(error.problem).startswith("but ") or not error.problem else ""
        problem = " ".join(f"{context or ''} {error.problem or ''}".split()) or "cannot be understood"
        raise NotYaml(line, column, f"is not YAML: {problem[:200]}") from None
    except RecursionError:
        raise NotYaml(1, 1, f"is nested too deep; at most {DEEPEST} levels are read") from None
    except YAMLError as error:
        problem = (str(error).splitlines() or ["unreadable"])[0]
        raise NotYaml(1, 1, f"is not YAML: {problem[:200]}") from None
    except (ValueError, IndexError, TypeError, AttributeError, AssertionError, OverflowError):
        # errors of ruamel.yaml's scanner
        raise NotYaml(1, 1, "is not YAML: it cannot be understood") from None


@lru_cache(maxsize=1)
def _libyaml() -> Callable[[str], Any] | None:
    """Return PyYAML's C parser with ruamel.yaml's scalar types, if present."""
    try:
        parser: Any = importlib.import_module("yaml.cyaml").CParser
    except ImportError:
        return None
    resolver = YAML(typ="safe", pure=True).resolver.versioned_resolver
    tags = {first: [(str(tag), pattern.match) for tag, pattern in kinds] for first, kinds in resolver.items()}

    class Parser(parser):  # type: ignore[misc]
        """Methods called by PyYAML's composer."""

        def __init__(self, text: str) -> None:
            super().__init__(text)
            self.depth = 0

        def descend_resolver(self, _: Any, __: Any) -> None:
            """Enter a nested node."""
            self.depth += 1
            if self.depth > 2 * DEEPEST:  # Deeper nesting would overflow the stack in libyaml.
                raise RecursionError

        def ascend_resolver(self) -> None:
            """Leave a nested node."""
            self.depth -= 1

        def resolve(self, kind: Any, value: Any, implicit: Any) -> str | None:
            """Return the tag of an untagged node."""
            if kind.id != "scalar":
                return f"tag:yaml.org,2002:{'map' if kind.id == 'mapping' else 'seq'}"
            if implicit[0]:
                for tag, match in tags.get(value[:1], ()):
                    if match(value):
                        return tag
            return TEXT

    return Parser


@lru_cache(maxsize=2)  # A file is examined for its kind first, and then read.
def document_of(text: str) -> Document:
    """Return the document of a text; its shared data are read-only."""
    return Document(text)


class Document:
    """Plain data with the place of each part."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._pairs: dict[int, dict[str, tuple[Any, Any]]] = {}
        self._parts, self._is_json = 0, False
        self.data = self._read()

    def _read(self) -> Any:
        if self._text.lstrip("\ufeff \t\r\n")[:1] in {"{", "["} and len(self._text) <= MOST_JSON:
            try:
                data = json.loads(self._text, object_pairs_hook=_unique_keys, parse_constant=_no_constant)
                if "\\u" in self._text:
                    json.dumps(data, ensure_ascii=False).encode()  # rejects unpaired surrogates
            except (ValueError, RecursionError):
                pass  # YAML in braces, or a fault whose place only YAML reading finds
            else:
                self._is_json = True
                return data
        if _is_large(self._text):
            size, limit, json_limit = len(self._text) / 1e6, MOST_YAML / 1e6, MOST_JSON / 1e6
            raise NotYaml(
                1,
                1,
                (
                    f"has {size:.1f} MB of YAML, of which at most {limit:g} MB and about {MOST_MARKS} keys and "
                    f"values are read; write it as JSON, which may have {json_limit:g} MB, or make it shorter"
                ),
            )
        return None if self._root is None else self._value(self._root, 0)

    @cached_property
    def _root(self) -> Any:
        """Return the text's root node, None if empty."""
        return nodes(self._text)

    def pairs(self, node: Any) -> dict[str, tuple[Any, Any]]:
        """Return key → (key node, value node), with merged keys."""
        if id(node) not in self._pairs:
            self._pairs[id(node)] = self._pairs_of(node, 0)
        return self._pairs[id(node)]

    def _pairs_of(self, node: Any, depth: int) -> dict[str, tuple[Any, Any]]:
        own: dict[str, tuple[Any, Any]] = {}
        merged: dict[str, tuple[Any, Any]] = {}
        if depth > DEEPEST:
            raise _fault(node, "merges itself; take the merge out")
        for key, value in node.value:
            if key.id != "scalar":
                raise _fault(key, "a key is text, no list and no mapping")
            if key.value == MERGE and not key.style:
                for other in value.value if value.id == "sequence" else [value]:
                    if other.id != "mapping":
                        raise _fault(value, "only a mapping, or a list of mappings, can be merged")
                    merged = {**self._pairs_of(other, depth + 1), **merged}
            elif (name := _text_of(key)) in own:
                raise _fault(key, f'duplicate key "{name[:60]}"; keep one')
            else:
                own[name] = key, value
        return {**merged, **own} if merged else own

    def place(self, location: Location, key: bool = False) -> Place:
        """Return line and column of the nearest part at a location.

        The result is UNKNOWN for invalid text and for JSON too large to search.

        Args:
            key: Whether to return the place of the key instead of the value.
        """
        if self._is_json and _is_large(self._text):
            return UNKNOWN
        try:
            node, place = self._root, (1, 1)
        except NotYaml:
            return UNKNOWN
        for depth, step in enumerate(location):
            is_last = depth == len(location) - 1
            if node.id == "mapping" and step in (pairs := self.pairs(node)):
                at, node = pairs[str(step)]
                # A missing key is reported at the key of its parent.
                place = _place_of(at if (key and is_last) or (not is_last and node.id != "scalar") else node)
            elif node.id == "sequence" and isinstance(step, int) and step < len(node.value):
                node = node.value[step]
                place = _place_of(node)
            else:
                break
        return place

    def _value(self, node: Any, depth: int) -> Any:
        """Return the plain data of a YAML node; raise a fault if the file is too large or nested too deeply."""
        self._parts += 1
        if self._parts > MOST_PARTS:
            raise _fault(
                node, f"has more than {MOST_PARTS} values when its aliases are expanded; use fewer values or aliases"
            )
        if depth > DEEPEST:
            raise _fault(node, f"is nested too deep; at most {DEEPEST} levels are read")
        kind = str(node.tag).removeprefix("tag:yaml.org,2002:")
        if node.id == "mapping" and kind in {"map", "None"}:
            return {key: self._value(value, depth + 1) for key, (_, value) in self.pairs(node).items()}
        if node.id == "sequence" and kind in {"seq", "None"}:
            return [self._value(value, depth + 1) for value in node.value]
        if node.id == "scalar" and kind in SCALARS:
            return _scalar(node, kind)
        raise _fault(
            node, f'the tag "{str(node.tag).replace("tag:yaml.org,2002:", "!!")[:60]}" means nothing here; leave it out'
        )


def _scalar(node: Any, kind: str) -> Any:
    """Return the value of a scalar node."""
    text = _text_of(node)
    match kind:
        case "null":
            return None
        case "bool":
            return text.lower() == "true"
        case "int" | "float":
            try:
                construct = getattr(_constructor(), f"construct_yaml_{kind}")
                return construct(ScalarNode(node.tag, node.value))
            except (ValueError, IndexError):
                raise _fault(node, f'"{text[:30]}" is no number') from None
    return text


def _is_large(text: str) -> bool:
    return len(text) > MOST_YAML or sum(map(text.count, ",:\n")) > MOST_MARKS


def _place_of(node: Any) -> Place:
    return node.start_mark.line + 1, node.start_mark.column + 1


def _text_of(node: Any) -> str:
    """Return a scalar's text with JSON surrogate pairs joined."""
    text: str = node.value
    try:
        return text.encode("utf-16", "surrogatepass").decode("utf-16")
    except UnicodeDecodeError:
        raise _fault(
            node, "contains half a character (one half of a surrogate pair); write the whole character"
        ) from None


def _fault(node: Any, message: str) -> NotYaml:
    return NotYaml(*_place_of(node), message)


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; raise ValueError for duplicate keys."""
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        raise ValueError("duplicate key")
    return mapping


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is no JSON")
