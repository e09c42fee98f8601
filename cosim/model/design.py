"""What designs a controller for a model, and what may be said to it: general rooms ask, a controller answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from cosim.model.model import Model


@dataclass(frozen=True)
class Option:
    """A key of `design:`, declared once.

    default:  None where it may be left out
    length:   of a list of numbers; None: one number
    positive: numbers are above 0; else 0 too
    choices:  names to choose from, in place of numbers
    complex:  numbers may be complex and of any sign; `-4+1j` is text then
    laws:     control laws that it is about, and that take its default; without one, all
    """

    doc: str
    default: Any = None
    length: int | None = None
    positive: bool = True
    choices: tuple[str, ...] = ()
    complex: bool = False
    laws: tuple[str, ...] = ()


class Objection(NamedTuple):
    """What is wrong with a design: which option it is about, an entry of a list by its number, and the cure.

    values: start values that it is about; where a scenario gives one of them itself, it is that which is at fault
    """

    about: tuple[str | int, ...]
    message: str
    values: tuple[str, ...] = ()


class Undesigned(ValueError):
    """There is no design with these options."""

    def __init__(self, objection: Objection) -> None:
        super().__init__(objection.message)
        self.objection = objection


class Judged(NamedTuple):
    """What is to be said of designed start values: why they cannot be, and what is worth a warning."""

    objections: Sequence[Objection] = ()
    warnings: Sequence[str] = ()


class Designer(Protocol):
    """Designs start values of a controller FMU before a run."""

    options: Mapping[str, Option]
    version: int  # raised when the meaning of a design changes, for designs are cached

    def depends_on(self, model: Model | None) -> Mapping[str, Any]:
        """What a design depends on beside its options: numbers of a model, or without one the controller's own.

        Raises ValueError where it designs for no such model.
        """

    def objections(self, options: Mapping[str, Any], law: str) -> list[Objection]:
        """What is wrong with the options themselves, all of it."""

    def values(self, options: Mapping[str, Any], model: Model | None, law: str = "") -> dict[str, float]:
        """Designed start values by variable, for an FMU with this control law ("": the designer's first).

        The options have no objections. Raises Undesigned, or ValueError where it is no matter of an option.
        """

    def judged(self, values: Mapping[str, Any], own: Mapping[str, Any], options: Mapping[str, Any], law: str) -> Judged:
        """Of designed values, and over them a scenario's `own`, each within its bounds: whether they go together."""

    def given(self, options: Mapping[str, Any], law: str) -> dict[str, Any]:
        """Return start values that the options of this law say themselves; they win."""

    def rests_on(self, designed: Mapping[str, Any], law: str) -> Mapping[str, float]:
        """Numbers of the plant with which designed start values were made, those of them that are start values too."""
