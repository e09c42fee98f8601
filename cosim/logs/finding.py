"""Findings of the gate on a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Severity = Literal["note", "warning", "fault"]


@dataclass(frozen=True)
class Finding:
    """A finding on a log; a fault makes the log unusable.

    Attributes:
        kind: One word for programs.
        channel: "time", a column, or "" for the whole log.
        numbers: Values in the sentence.
    """

    severity: Severity
    kind: str
    channel: str
    sentence: str
    numbers: Mapping[str, float] = field(default_factory=dict)

    @property
    def whole(self) -> str:
        """Return the sentence with its subject."""
        return self.sentence if self.channel in ("", "time") else f"{self.channel} {self.sentence}"

    @property
    def line(self) -> str:
        """Return the line of the command line output."""
        return f"{self.severity}: {self.whole}"
