"""Gain of one input, available to every model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from cosim.model.model import Effect, Number
from cosim.model.namespaces import Namespace
from cosim.model.quantities import parameter


@dataclass(frozen=True, kw_only=True)
class Gain(Effect):
    """Gain of one input: u → k·u.

    A model's subclass has a name, the input's name in `input`, and a place in the catalogue. Delays and shaping of the
    command act before.
    """

    equation = "k·u in place of u"
    input: ClassVar[str]

    gain: float = parameter(1.0, unit="1", bounds=(0.1, 10), neutral=1.0, typical=0.1, doc="gain k of the input")

    def transmit(self, m: Namespace, command: Mapping[str, Number]) -> Mapping[str, Number]:
        """Return the commands with the gain on one input."""
        return {**command, self.input: self.gain * command[self.input]}
