"""A gain of one input, which every model may lack."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

from plant.model import Effect, Number, Values
from plant.namespaces import Namespace
from plant.quantities import parameter


@dataclass(frozen=True, kw_only=True)
class Gain(Effect):
    """One input does k times what it is told: u → k·u.

    A model names it, and the input in `input`; its place in the catalogue is where it acts among what else shapes the
    command. It acts on the states: an output that takes a command takes it as it was given.
    """

    equation = "k·u in place of u"
    input: ClassVar[str]

    gain: float = parameter(1.0, unit="1", bounds=(0.1, 10), neutral=1.0, typical=0.1, doc="gain k of the input")
    place: int = field(default=-1, repr=False)  # of the input, once bound

    def bound(self, inputs: tuple[str, ...]) -> Self:
        """The gain, knowing which of the commands is its own."""
        return replace(self, place=inputs.index(self.input))

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        """k·u of the one, the other commands as they are."""
        return tuple(self.gain * u if k == self.place else u for k, u in enumerate(command)), memory
