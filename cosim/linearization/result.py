"""What comes of a linearisation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cosim.linearization.linear_model import Linear
from cosim.linearization.system_structure import Structure


@dataclass(frozen=True)
class Outcome:
    """Linear models, one a time, and what the first tells."""

    name: str
    title: str
    linear: tuple[Linear, ...]
    structure: Structure
    notes: tuple[str, ...]
    folder: Path | None

    @property
    def first(self) -> Linear:
        """The linear model, or the first of several."""
        return self.linear[0]
