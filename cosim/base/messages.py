"""Messages with stable codes.

Each room keeps the templates of its messages in its module `messages`. A code names the severity (E error, W warning,
N note), the room and a number, e.g. E-SCN-012. Codes never change their meaning; wording may change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any


class Message(str):
    """A text for the user.

    Attributes:
        code: Code of its template, "" for a text without one.
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

    def after(self, prefix: str) -> Message:
        """Return the message behind a prefix, e.g. the name of a file."""
        return Message(f"{prefix}{self}", self.code, self.fields)


@dataclass(frozen=True)
class Template:
    """A message with fields in braces, as for `str.format`."""

    code: str
    text: str

    def __call__(self, **fields: Any) -> Message:
        """Return the message with these values."""
        return Message(self.text.format_map(fields), self.code, fields)


def code_of(text: object) -> str:
    """Return the code of a message or of an exception with a message, "" for other texts."""
    if isinstance(text, BaseException):
        text = text.args[0] if text.args else ""
    return getattr(text, "code", "")


def with_prefix(prefix: str, text: str) -> str:
    """Return a text behind a prefix; a message keeps its code."""
    return text.after(prefix) if isinstance(text, Message) else f"{prefix}{text}"
