"""Everything that can go wrong, as one tree; the exit code of the command line stands on each class."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, order=True)
class Fault:
    """One thing wrong with a file: where, what, and the cure. Line and column count from 1; 0 is unknown."""

    file: Path
    line: int
    column: int
    message: str
    exit_code: int = 2

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}:{self.column}" if self.line else str(self.file)
        return f"{place}: {self.message}"


class CosimError(Exception):
    """Base of every error this package raises on purpose."""

    exit_code = 1


class InputError(CosimError):
    """The user's input is wrong; carries every fault found, in the order of the file."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        self.faults = tuple(sorted(set(faults)))
        super().__init__("\n".join(map(str, self.faults)))

    @property
    def exit_code(self) -> int:  # type: ignore[override]
        """2 where any fault is the user's own; 3 where only FMUs are at fault."""
        return min(fault.exit_code for fault in self.faults)


class FmuError(CosimError):
    """An FMU cannot be read, is not valid or does not load."""

    exit_code = 3


class SimulationError(CosimError):
    """The simulation stopped before its end: which component, when, why."""

    exit_code = 4

    def __init__(self, component: str, time: float, reason: str) -> None:
        self.component, self.time, self.reason = component, time, reason
        super().__init__(f"{component} at t = {time:.6g} s: {reason}")


class CriterionMissed(CosimError):
    """The run is complete, but a criterion of the scenario is not met."""

    exit_code = 5
