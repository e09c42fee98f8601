"""Result of a linearization: linear models, their structure and notes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cosim.linearization.linear_model import Linear
from cosim.linearization.system_structure import Structure


@dataclass(frozen=True)
class Outcome:
    """Linear models for one or more times, and the structure of the first."""

    name: str
    title: str
    linear: tuple[Linear, ...]
    structure: Structure
    notes: tuple[str, ...]
    folder: Path | None

    @property
    def first(self) -> Linear:
        """Return the first linear model."""
        return self.linear[0]
