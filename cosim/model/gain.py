"""A gain of one input, which every model may lack."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from cosim.model.model import Effect, Number
from cosim.model.namespaces import Namespace
from cosim.model.quantities import parameter


@dataclass(frozen=True, kw_only=True)
class Gain(Effect):
    """One input does k times what it is told: u → k·u.

    A model names it, and the input in `input`, and has it in its catalogue; nothing else. Whatever delays or shapes the
    command comes before it.
    """

    equation = "k·u in place of u"
    input: ClassVar[str]

    gain: float = parameter(1.0, unit="1", bounds=(0.1, 10), neutral=1.0, typical=0.1, doc="gain k of the input")

    def transmit(self, m: Namespace, command: Mapping[str, Number]) -> Mapping[str, Number]:
        """k·u of the one, the other commands as they are."""
        return {**command, self.input: self.gain * command[self.input]}
