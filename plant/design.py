"""What designs a controller for a model, and what may be said to it: general rooms ask, a controller answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from plant.model import Model


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


class BadOption(ValueError):
    """One option is at fault, by its name."""

    def __init__(self, option: str, message: str) -> None:
        super().__init__(message)
        self.option = option


class Designer(Protocol):
    """Designs start values of a controller FMU before a run."""

    options: Mapping[str, Option]
    version: int  # raised when the meaning of a design changes, for designs are cached

    def depends_on(self, model: Model | None) -> Mapping[str, Any]:
        """What a design depends on beside its options: numbers of a model, or without one the controller's own.

        Raises ValueError where it designs for no such model.
        """

    def values(self, options: Mapping[str, Any], model: Model | None, law: str = "") -> dict[str, float]:
        """Designed start values by variable, for an FMU with this control law ("": the designer's first).

        Raises BadOption where one option is at fault, ValueError where there is no such design.
        """

    def conflicts(self, values: Mapping[str, Any], law: str) -> list[str]:
        """Why a controller with these start values, each within its bounds, could not be."""

    def given(self, options: Mapping[str, Any]) -> dict[str, Any]:
        """Start values that the options say themselves; they win."""
