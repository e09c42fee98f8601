"""Findings of the gate on a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Severity = Literal["note", "warning", "fault"]
SENSORS = "sensors"  # kind of a finding on claimed errors of sensors


@dataclass(frozen=True)
class Finding:
    """A finding on a log.

    Attributes:
        severity: A fault makes the log unusable; a warning or a note does not.
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
        """Return the sentence, preceded by the channel if the finding is on a column."""
        return self.sentence if self.channel in ("", "time") else f"{self.channel} {self.sentence}"

    @property
    def line(self) -> str:
        """Return the sentence with channel and severity, a line of the command line output."""
        return f"{self.severity}: {self.whole}"
