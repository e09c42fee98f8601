"""YAML nodes from ruamel.yaml, whose messages are used, or for long texts from the faster libyaml if present."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import ScalarNode

DEEPEST = 60  # levels of nesting
LONG = 20_000  # text length from which loading another parser pays off
# Directives, tabs, byte order marks and Unicode line ends, on which the parsers disagree.
APART = re.compile("^%|[\\t\\x85\\u2028\\u2029\\ufeff]", re.MULTILINE)
TEXT = "tag:yaml.org,2002:str"


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


def whole_number(node: Any) -> Any:
    """Return the number of an int node; raise ValueError or IndexError if invalid."""
    return _constructor().construct_yaml_int(ScalarNode(node.tag, node.value))


def number(node: Any) -> Any:
    """Return the number of a float node; raise ValueError or IndexError if invalid."""
    return _constructor().construct_yaml_float(ScalarNode(node.tag, node.value))


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
