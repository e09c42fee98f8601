"""YAML and JSON text as plain data with places; oversized, deep or unsupported content is rejected.

Supported are mappings with text keys, lists, text, numbers, true, false and null, and anchors, aliases and merge keys
with limited expansion.
"""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any

from cosim.storage.yaml_parsers import DEEPEST, NotYaml, nodes, number, whole_number

__all__ = ["Document", "Location", "NotYaml", "Place", "document_of"]

MOST_YAML, MOST_JSON = 800_000, 8_000_000  # text lengths [characters] readable within seconds
MOST_MARKS = 100_000  # commas, colons and lines of YAML, which determine the reading time
MOST_PARTS = 400_000  # keys and values after expanding aliases
MERGE = "<<"
Location = tuple[str | int, ...]
Place = tuple[int, int]
UNKNOWN: Place = (0, 0)


@lru_cache(maxsize=2)  # A file is examined for its kind first, and then read.
def document_of(text: str) -> Document:
    """Return the document of a text; its shared data are read-only."""
    return Document(text)


class Document:
    """Plain data with the place of each part."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._node: Any = None
        self._pairs: dict[int, dict[str, tuple[Any, Any]]] = {}
        self._composed = self._is_json = False
        self.data = self._read()

    def _read(self) -> Any:
        if self._text.lstrip("\ufeff \t\r\n")[:1] in {"{", "["} and len(self._text) <= MOST_JSON:
            try:
                data = json.loads(self._text, object_pairs_hook=_once, parse_constant=_no_constant)
                if "\\u" in self._text:
                    json.dumps(data, ensure_ascii=False).encode()  # rejects unpaired surrogates
            except (ValueError, RecursionError):
                pass  # YAML in braces, or a fault whose place only YAML reading finds
            else:
                self._is_json = True
                return data
        if _is_large(self._text):
            most = f"{MOST_YAML / 1e6:g} MB and about {MOST_MARKS} keys and values"
            size = f"has {len(self._text) / 1e6:.1f} MB of YAML, of which at most {most} are read"
            raise NotYaml(1, 1, f"{size}; write it as JSON, which may have {MOST_JSON / 1e6:g} MB, or make it shorter")
        return _Plain(self._compose(), self).data

    def _compose(self) -> Any:
        """Return the nodes of the text."""
        if not self._composed:
            self._node, self._composed = nodes(self._text), True
        return self._node

    def pairs(self, node: Any) -> dict[str, tuple[Any, Any]]:
        """Return key → (key node, value node), with merged keys."""
        if id(node) not in self._pairs:
            self._pairs[id(node)] = self._pairs_of(node, 0)
        return self._pairs[id(node)]

    def _pairs_of(self, node: Any, depth: int) -> dict[str, tuple[Any, Any]]:
        own: dict[str, tuple[Any, Any]] = {}
        merged: dict[str, tuple[Any, Any]] = {}
        if depth > DEEPEST:
            raise _fault(node, "merges itself")
        for key, value in node.value:
            if key.id != "scalar":
                raise _fault(key, "a key is text, no list and no mapping")
            if key.value == MERGE and not key.style:
                for other in value.value if value.id == "sequence" else [value]:
                    if other.id != "mapping":
                        raise _fault(value, "what is merged is a mapping, or a list of such")
                    merged = {**self._pairs_of(other, depth + 1), **merged}
            elif (name := _whole(key)) in own:
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
            node, found = self._compose(), (1, 1)
        except NotYaml:
            return UNKNOWN
        for depth, step in enumerate(location):
            last = depth == len(location) - 1
            if node.id == "mapping" and step in (pairs := self.pairs(node)):
                at, value = pairs[str(step)]
                # A missing key is reported at the key of its parent.
                mark = (at if (key and last) or (not last and value.id != "scalar") else value).start_mark
            elif node.id == "sequence" and isinstance(step, int) and step < len(node.value):
                value = node.value[step]
                mark = value.start_mark
            else:
                break
            node, found = value, (mark.line + 1, mark.column + 1)
        return found


class _Plain:
    """Conversion of nodes to plain data."""

    def __init__(self, root: Any, document: Document) -> None:
        self.document, self.parts = document, 0
        self.data = None if root is None else self._of(root, 0)

    def _of(self, node: Any, depth: int) -> Any:
        self.parts += 1
        if self.parts > MOST_PARTS:
            raise _fault(node, f"has more than {MOST_PARTS} parts, aliases followed; write less")
        if depth > DEEPEST:
            raise _fault(node, "is nested too deep")
        if node.id == "mapping":
            self._check_tag(node, "map")
            pairs = self.document.pairs(node)
            return {key: self._of(value, depth + 1) for key, (_, value) in pairs.items()}
        if node.id == "sequence":
            self._check_tag(node, "seq")
            return [self._of(value, depth + 1) for value in node.value]
        return self._scalar(node)

    def _scalar(self, node: Any) -> Any:
        kind = str(node.tag).removeprefix("tag:yaml.org,2002:")
        text = _whole(node)
        match kind:
            case "null":
                return None
            case "bool":
                return text.lower() == "true"
            case "int" | "float":
                try:
                    return whole_number(node) if kind == "int" else number(node)
                except (ValueError, IndexError):
                    raise _fault(node, f'"{text[:30]}" is no number') from None
            case "str" | "timestamp" | "merge" | "value":
                return text
        raise _fault(node, f'the tag "{_tag(node)}" means nothing here; leave it out')

    def _check_tag(self, node: Any, kind: str) -> None:
        if node.tag is not None and str(node.tag) != f"tag:yaml.org,2002:{kind}":
            raise _fault(node, f'the tag "{_tag(node)}" means nothing here; leave it out')


def _is_large(text: str) -> bool:
    return len(text) > MOST_YAML or sum(map(text.count, ",:\n")) > MOST_MARKS


def _whole(node: Any) -> str:
    """Return a scalar's text with JSON surrogate pairs joined."""
    text: str = node.value
    try:
        return text.encode("utf-16", "surrogatepass").decode("utf-16")
    except UnicodeDecodeError:
        raise _fault(node, "holds half a character") from None


def _tag(node: Any) -> str:
    return str(node.tag).replace("tag:yaml.org,2002:", "!!")[:60]


def _fault(node: Any, problem: str) -> NotYaml:
    return NotYaml(node.start_mark.line + 1, node.start_mark.column + 1, problem)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; raise ValueError for duplicate keys."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("duplicate key")
    return found


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is no JSON")
