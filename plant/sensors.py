"""Errors of the sensors: on the measurement, not in the plant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from plant.model import Effect, Number


@dataclass(frozen=True, kw_only=True)
class SensorError(Effect):
    """One output reads wrong. `measure` gives what the sensor says for what is there."""

    output: ClassVar[str]

    def measure(self, value: Number) -> Number:
        """Reading for a true value."""
        raise NotImplementedError
