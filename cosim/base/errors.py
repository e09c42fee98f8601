"""Everything that can go wrong, as one tree; the exit code of the command line stands on each class."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


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

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.faults,)

    @property
    def exit_code(self) -> int:  # type: ignore[override]
        """2 where any fault is the user's own; 3 where only FMUs are at fault."""
        return min(fault.exit_code for fault in self.faults)


def refuse(faults: Iterable[Fault]) -> None:
    """Raise InputError with all faults, if there are any."""
    if every := tuple(faults):
        raise InputError(every)


class NotExecuted(CosimError):
    """A file of Python was named where none is executed."""

    exit_code = 2

    def __init__(self, file: Path) -> None:
        self.file = file
        super().__init__(file)

    def __str__(self) -> str:
        return f"{self.file} is Python, which is not executed here"


class FmuError(CosimError):
    """An FMU cannot be read, is not valid or does not load."""

    exit_code = 3


class SimulationError(CosimError):
    """The simulation stopped before its end: which component, when, why; `left`: the folder with the rows so far."""

    exit_code = 4
    left: Path | None = None

    def __init__(self, component: str, time: float, reason: str) -> None:
        self.component, self.time, self.reason = component, time, reason
        super().__init__(f"{component} at t = {time:.6g} s: {reason}")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.component, self.time, self.reason)


class Crashed(SimulationError):
    """A call of an FMU ended the process in which it was made."""


class DiskFull(SimulationError):
    """There is no room left for the rows of a run."""


class TimedOut(SimulationError):
    """A limit of time that the user set is exceeded."""

    exit_code = 124


class Interrupted(SimulationError):
    """Stopped from the keyboard."""

    exit_code = 130


class Signalled(SimulationError):
    """Ended by a signal from outside."""


class SweepStopped(CosimError):
    """A sweep ended before its last run, from the keyboard or by a signal; what was made is kept."""

    exit_code = 130


class SweepFailed(CosimError):
    """No run of a sweep came to its end."""

    exit_code = 4


class Terminated(BaseException):
    """Asked to end by a signal; as KeyboardInterrupt no Exception, so that nothing takes it for a fault of an FMU."""

    exit_code = 4

    def __init__(self, signal: str = "SIGTERM") -> None:
        super().__init__(f"ended by {signal}")


def stopped(stop: BaseException, now: float, what: str = "the run") -> SimulationError:
    """What ended a run at a time [s], a signal perhaps, as an error that says so."""
    if isinstance(stop, SimulationError):
        return stop
    if isinstance(stop, KeyboardInterrupt):
        return Interrupted(what, now, "interrupted from the keyboard")
    return Signalled(what, now, str(stop))


class CriterionMissed(CosimError):
    """The run is complete, but a criterion is not met; or two runs differ beyond the tolerance."""

    exit_code = 5
