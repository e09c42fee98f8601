"""Kinds of messages (error, warning, note), and their form on a terminal and in JSON."""

from __future__ import annotations

import re

# control characters except tab and line feed, marks that change the direction of text, and unpaired surrogates
UNPRINTABLE = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")

# the same characters as JSON escapes, or an escaped backslash
ESCAPED = re.compile(r"\\(\\|u(?:00[01][0-9a-f]|00[89][0-9a-f]|061c|200[ef]|202[89a-e]|206[6-9])|[bfr])")


def printable(text: str, *, one_line: bool = False) -> str:
    r"""Return a text in which escapes such as \u001b replace characters that could control a terminal.

    JSON keeps its meaning, because JSON strings use the same escapes.

    Args:
        one_line: Escape line feeds and tabs too.
    """
    shown = UNPRINTABLE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)
    return shown.replace("\n", "\\n").replace("\t", "\\t") if one_line else shown


def printable_json(text: str) -> str:
    r"""Return JSON in ASCII in which control characters are escaped twice: `\\u001b` in place of `\u001b`."""
    return ESCAPED.sub(lambda match: match[0] if match[1] == "\\" else f"\\{match[0]}", text)


class Note(str):
    """A message less severe than a warning; `-q` omits it."""


class CheckWarning(str):
    """A warning of `cosim check` on algebraic loops, processes or hidden code."""


class CheckNote(CheckWarning, Note):
    """A note of `cosim check`, less severe than its warnings."""


def with_severity(text: str) -> str:
    """Return a message with the prefix `warning: ` or `note: `."""
    return f"{'note' if isinstance(text, Note) else 'warning'}: {text}"


def with_prefix(prefix: str, text: str) -> str:
    """Return a message with a prefix, as an object of the same class, such as Note."""
    return type(text)(f"{prefix}{text}")
