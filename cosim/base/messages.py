"""Messages of arguments, units and installed packages, and the form of all messages.

Each room keeps the templates of its messages in its module `messages`. A code names the severity (E error, W warning,
N note), the room and a number, e.g. E-SCN-012. Codes never change their meaning; wording may change.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, SupportsIndex

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
    shown = UNPRINTABLE.sub(_escape, text) if UNPRINTABLE.search(text) else text
    return shown.replace("\n", "\\n").replace("\t", "\\t") if one_line else shown


def _escape(match: re.Match[str]) -> str:
    return f"\\u{ord(match[0]):04x}"


def printable_json(text: str) -> str:
    r"""Return JSON in ASCII whose texts are printable: `\\u001b` in place of `\u001b`."""
    return ESCAPED.sub(lambda match: match[0] if match[1] == "\\" else f"\\{match[0]}", text)


class Message(str):
    """A text for the user, with a code and field values.

    Attributes:
        code: Code of its template, "" without template.
        fields: Values in the text.
    """

    code: str
    fields: Mapping[str, Any]

    def __new__(cls, text: str, code: str = "", fields: Mapping[str, Any] = MappingProxyType({})) -> Message:
        """Return a text with a code."""
        message = super().__new__(cls, text)
        message.code, message.fields = code, fields
        return message

    def __str__(self) -> str:
        return self  # The text of an exception thus keeps its code.

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str.__str__(self), self.code, dict(self.fields))

    def replace(self, old: str, new: str, count: SupportsIndex = -1) -> Message:
        """Return the message with part of its text replaced."""
        return Message(super().replace(old, new, count), self.code, self.fields)

    def removeprefix(self, prefix: str) -> Message:
        """Return the message without text at its beginning, e.g. the name of a file."""
        return Message(super().removeprefix(prefix), self.code, self.fields)

    def after(self, prefix: str) -> Message:
        """Return the message with text in front, e.g. the name of a file."""
        return Message(f"{prefix}{self}", self.code, self.fields)


class Note(str):
    """A message that is no warning; -q omits it."""


class CheckWarning(str):
    """A warning about loops, processes or hidden code, which `cosim check` shows."""


class CheckNote(CheckWarning, Note):
    """A note of this kind."""


@dataclass(frozen=True)
class Template:
    """A message with fields in braces, as for `str.format`."""

    code: str
    text: str

    def __call__(self, **fields: Any) -> Message:
        """Return the message with these values."""
        return Message(self.text.format_map(fields), self.code, fields)

    def around(self, error: object, **fields: Any) -> Message:
        """Return the message with an error in its field `error`; a code of the error replaces the template's."""
        message = self(error=str(error), **fields)  # errors themselves need not survive a pickle
        return Message(message, code_of(error) or self.code, message.fields)


def code_of(text: object) -> str:
    """Return the code of a message or of an exception with a message, "" for other texts."""
    if isinstance(text, BaseException):
        text = text.args[0] if text.args else ""
    return getattr(text, "code", "")


def with_severity(text: str) -> str:
    """Return a warning or a note with its severity in front."""
    return f"{'note' if isinstance(text, Note) else 'warning'}: {text}"


def join(separator: str, texts: Iterable[str]) -> Message:
    """Return texts as one message, with code and fields of the first."""
    every = [*texts]
    first = next((text for text in every if isinstance(text, Message)), Message(""))
    return Message(separator.join(every), first.code, first.fields)


def with_prefix(prefix: str, text: str) -> str:
    """Return a text behind a prefix; a note or warning keeps its kind."""
    if isinstance(text, Message):
        return text.after(prefix)
    return type(text)(f"{prefix}{text}")


# -- messages of this room ------------------------------------------------------------------------
