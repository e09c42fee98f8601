"""Nodes of a YAML text: by ruamel.yaml, whose faults are told; of a long one by libyaml, where there is one, faster."""

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

DEEPEST = 60  # parts within parts
LONG = 20_000  # characters from which it is worth while to load another parser
# directives, tabs, marks and line ends of Unicode: the parsers differ in what they make of them
APART = re.compile("^%|[\\t\\x85\\u2028\\u2029\\ufeff]", re.MULTILINE)
TEXT = "tag:yaml.org,2002:str"


class NotYaml(Exception):
    """Text that is no YAML, or none that is read here: line and column from 1, and why."""

    def __init__(self, line: int, column: int, problem: str) -> None:
        super().__init__(problem)
        self.line, self.column = line, column


def nodes(text: str) -> Any:
    """The node at the root of a YAML text, None of an empty one; NotYaml.

    A node has id (scalar, sequence, mapping), tag, value and start_mark; a scalar has a style, empty where it is plain.
    """
    if len(text) >= LONG and not APART.search(text) and (parser := _libyaml()) is not None:
        with suppress(Exception):  # what libyaml does not take, ruamel.yaml says why
            return parser(text).get_single_node()
    return _by_ruamel(text)


def whole_number(node: Any) -> Any:
    """The number of a node that is tagged as an int; ValueError or IndexError where it is none."""
    return _constructor().construct_yaml_int(ScalarNode(node.tag, node.value))


def number(node: Any) -> Any:
    """The number of a node that is tagged as a float; ValueError or IndexError where it is none."""
    return _constructor().construct_yaml_float(ScalarNode(node.tag, node.value))


@lru_cache(maxsize=1)
def _constructor() -> Any:
    return YAML(typ="safe", pure=True).constructor


def _by_ruamel(text: str) -> Any:
    try:
        return YAML(typ="safe", pure=True).compose(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        said = (
            [error.context, error.problem]
            if str(error.problem).startswith("but ")
            else [error.problem or error.context]
        )
        problem = " ".join(" ".join(filter(None, said)).split()) or "cannot be understood"
        raise NotYaml(
            mark.line + 1 if mark else 1, mark.column + 1 if mark else 1, f"not YAML: {problem[:200]}"
        ) from None
    except RecursionError:
        raise NotYaml(1, 1, "is nested too deep") from None
    except YAMLError as error:
        raise NotYaml(1, 1, f"is not YAML: {(str(error).splitlines() or ['unreadable'])[0][:200]}") from None
    except (ValueError, IndexError, TypeError, AttributeError, AssertionError, OverflowError):  # of its scanner
        raise NotYaml(1, 1, "is not YAML: it cannot be understood") from None


@lru_cache(maxsize=1)
def _libyaml() -> Callable[[str], Any] | None:
    """PyYAML's parser in C, which takes scalars for what ruamel.yaml does; None where there is none."""
    try:
        parser: Any = importlib.import_module("yaml.cyaml").CParser
    except ImportError:
        return None
    meanings = YAML(typ="safe", pure=True).resolver.versioned_resolver
    tags = {first: [(str(tag), pattern.match) for tag, pattern in kinds] for first, kinds in meanings.items()}

    class Parser(parser):  # type: ignore[misc]
        """Calls of PyYAML's composer."""

        def __init__(self, text: str) -> None:
            super().__init__(text)
            self.depth = 0

        def descend_resolver(self, _: Any, __: Any) -> None:
            """A node begins within another."""
            self.depth += 1
            if self.depth > 2 * DEEPEST:  # libyaml's own calls would fill the stack
                raise RecursionError

        def ascend_resolver(self) -> None:
            """It ends."""
            self.depth -= 1

        def resolve(self, kind: Any, value: Any, implicit: Any) -> str | None:
            """The tag of a node that states none."""
            if kind.id != "scalar":
                return f"tag:yaml.org,2002:{'map' if kind.id == 'mapping' else 'seq'}"
            if implicit[0]:
                for tag, match in tags.get(value[:1], ()):
                    if match(value):
                        return tag
            return TEXT

    return Parser
