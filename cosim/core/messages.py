"""Kinds of messages, and their form on a terminal and in JSON."""

from __future__ import annotations

import re

# control characters but tab and line feed, marks that change the direction of text, and halves of surrogate pairs
UNPRINTABLE = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")

# the same as escapes of JSON, or an escaped backslash
ESCAPED = re.compile(r"\\(\\|u(?:00[01][0-9a-f]|00[89][0-9a-f]|061c|200[ef]|202[89a-e]|206[6-9])|[bfr])")


def printable(text: str, *, one_line: bool = False) -> str:
    r"""Return a text with an escape such as \u001b for each character that could steer a terminal.

    JSON keeps its meaning, because its strings have the same escapes.

    Args:
        one_line: Whether line feeds and tabs are escaped too.
    """
    shown = UNPRINTABLE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)
    return shown.replace("\n", "\\n").replace("\t", "\\t") if one_line else shown


def printable_json(text: str) -> str:
    r"""Return JSON in ASCII whose texts are printable: `\\u001b` in place of `\u001b`."""
    return ESCAPED.sub(lambda match: match[0] if match[1] == "\\" else f"\\{match[0]}", text)


class Note(str):
    """A message that is no warning; -q omits it."""


class CheckWarning(str):
    """A warning about loops, processes or hidden code, which `cosim check` shows."""


class CheckNote(CheckWarning, Note):
    """A note of this kind."""


def with_severity(text: str) -> str:
    """Return a warning or a note with its severity in front."""
    return f"{'note' if isinstance(text, Note) else 'warning'}: {text}"


def with_prefix(prefix: str, text: str) -> str:
    """Return a text behind a prefix; a note or warning keeps its kind."""
    return type(text)(f"{prefix}{text}")
