"""Elements of a page: labelled values, small tables and badges."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """A row of a table: a label, a value, and a note on how the value was measured."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Grid:
    """A small table: titles of the columns after the first, and rows that begin with a name."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Badge:
    """A short fact with a colour; `tone` is good, bad, warn or plain."""

    text: str
    tone: str = "plain"
