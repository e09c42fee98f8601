"""Tables of the page: badges, key figures, answers to steps, errors and effort, where the run came from."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """A labelled value; `note` says how it was measured."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Grid:
    """A small table: its columns after the first, and rows whose first cell is their name."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Badge:
    """A fact at a glance; `tone` is good, bad, warn or plain."""

    text: str
    tone: str = "plain"
