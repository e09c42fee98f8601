"""Interface between a scenario and the design of its controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from cosim.model.model import Model


@dataclass(frozen=True)
class Option:
    """A key of a scenario's `design:`.

    Attributes:
        default: None for an optional key.
        length: Length of a list of numbers; None for a single number.
        positive: True if 0 is not allowed.
        choices: Allowed names instead of numbers.
        complex: True for complex numbers of any sign, written as text such as `-4+1j`.
        laws: Control laws that use the key; empty for all.
    """

    doc: str
    default: Any = None
    length: int | None = None
    positive: bool = True
    choices: tuple[str, ...] = ()
    complex: bool = False
    laws: tuple[str, ...] = ()


class Objection(NamedTuple):
    """A fault of a design: option (with list index) and cure.

    Attributes:
        values: Start values concerned; if the scenario sets one, that entry is at fault.
    """

    about: tuple[str | int, ...]
    message: str
    values: tuple[str, ...] = ()


class Undesigned(ValueError):
    """Error: no controller design exists for these options."""

    def __init__(self, objection: Objection) -> None:
        super().__init__(objection.message)
        self.objection = objection


class Judged(NamedTuple):
    """Judgement of designed start values: objections and warnings."""

    objections: Sequence[Objection] = ()
    warnings: Sequence[str] = ()


class Designer(Protocol):
    """Design of a controller FMU's start values before a run."""

    options: Mapping[str, Option]
    version: int  # version of the design method; a new version invalidates cached designs

    def depends_on(self, model: Model | None) -> Mapping[str, Any]:
        """Return the dependencies of a design besides its options: parameters of the model or the controller.

        Raises:
            ValueError: No design exists for this kind of model.
        """

    def objections(self, options: Mapping[str, Any], law: str) -> list[Objection]:
        """Return all faults of the options."""

    def values(self, options: Mapping[str, Any], model: Model | None, law: str = "") -> dict[str, float]:
        """Return designed start values by variable.

        Args:
            options: Options without faults.
            law: Control law of the FMU; "" for the first one.

        Raises:
            Undesigned: The options allow no design.
            ValueError: The fault is not in an option.
        """

    def judged(self, values: Mapping[str, Any], own: Mapping[str, Any], options: Mapping[str, Any], law: str) -> Judged:
        """Return objections and warnings on designed values, overridden by the scenario's `own` values."""

    def collect_start_values(self, options: Mapping[str, Any], law: str) -> dict[str, Any]:
        """Return start values set directly by options."""

    def rests_on(self, designed: Mapping[str, Any], law: str) -> Mapping[str, float]:
        """Return plant parameters on which designed start values depend, if they are start values of the controller."""
