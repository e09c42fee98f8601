"""What the gate has to say about a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Severity = Literal["note", "warning", "fault"]


@dataclass(frozen=True)
class Finding:
    """Something to know about a log; a fault makes it unusable.

    kind: one word for programs; channel: "time", a column, or "" for the whole; numbers: what the sentence says
    """

    severity: Severity
    kind: str
    channel: str
    sentence: str
    numbers: Mapping[str, float] = field(default_factory=dict)

    @property
    def whole(self) -> str:
        """The sentence with its subject; what is said of the time names its own."""
        return self.sentence if self.channel in ("", "time") else f"{self.channel} {self.sentence}"

    @property
    def line(self) -> str:
        """As the command line prints it."""
        return f"{self.severity}: {self.whole}"
