"""All errors of the package as one tree; each class has the exit code of the command that fails with it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.core.messages import printable


@dataclass(frozen=True, order=True)
class Fault:
    """A fault in a file: its place, and a message with the cure. Line and column count from 1; 0 means unknown."""

    file: Path
    line: int
    column: int
    message: str
    exit_code: int = 2

    def __str__(self) -> str:
        file = printable(str(self.file), one_line=True)
        place = f"{file}:{self.line}:{self.column}" if self.line else file
        return f"{place}: {self.message}"


class CosimError(Exception):
    """Base class of all errors raised on purpose."""

    exit_code = 1

    def __str__(self) -> str:
        return printable(super().__str__())

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).__new__, (type(self), *self.args), self.__dict__  # independent of the arguments of the class


def _message_only(error: CosimError) -> list[str]:
    """Show only the message in a notebook, without the traceback inside this package."""
    return [f"{type(error).__name__}: {error}"]


class InputError(CosimError):
    """Error with all faults of the user's input, sorted by file and place."""

    _render_traceback_ = _message_only

    def __init__(self, faults: Sequence[Fault]) -> None:
        self.faults = tuple(sorted(set(faults)))
        super().__init__("\n".join(map(str, self.faults)))

    @classmethod
    def at(cls, file: Path, message: str, exit_code: int = 2) -> InputError:
        """Return an InputError with a single fault of a file or folder, without line and column."""
        return cls([Fault(file, 0, 0, message, exit_code)])

    @property
    def exit_code(self) -> int:  # type: ignore[override]
        """Return 2 (wrong input) if any fault has exit code 2, else 3 (invalid FMU)."""
        return min(fault.exit_code for fault in self.faults)


def refuse(faults: Iterable[Fault]) -> None:
    """Raise InputError with all faults; do nothing if there are none."""
    if every := tuple(faults):
        raise InputError(every)


class NotExecuted(CosimError):
    """A scenario or study names a Python file in a place where cosim does not execute code."""

    exit_code = 2

    def __init__(self, file: Path) -> None:
        self.file = file
        super().__init__(f"{file} is Python, which is not executed here")


class FmuError(CosimError):
    """An unreadable or invalid FMU, or a failure to load one."""

    _render_traceback_ = _message_only

    exit_code = 3

    def fault(self, file: Path, name: Path | None = None) -> Fault:
        """Return the error as a `Fault` of a file.

        The prefix `name` (default: the file's path) is removed from the message.
        """
        beginning = f"{name or file} "
        return Fault(file, 0, 0, str(self).removeprefix(beginning), self.exit_code)


class SimulationError(CosimError):
    """A simulation that stopped early: component, time [s] and reason.

    Attributes:
        left: Folder with the rows recorded so far.
    """

    exit_code = 4
    left: Path | None = None

    def __init__(self, component: str, time: float, reason: str) -> None:
        self.component, self.time, self.reason = component, time, reason
        super().__init__(f"{component} at t = {time:.6g} s: {reason}")


class Crashed(SimulationError):
    """The process of an FMU crashed during a call."""


class CallFailed(SimulationError):
    """An FMU returned an error status from a call."""


class NotFinite(SimulationError):
    """A value is infinite or NaN, or an algebraic loop does not converge."""


class DiskFull(SimulationError):
    """No disk space is left for the rows of a run."""


class TimedOut(SimulationError):
    """A time limit set by the user was exceeded."""

    exit_code = 124


class Interrupted(SimulationError):
    """The user stopped the run from the keyboard."""

    exit_code = 130


class Signalled(SimulationError):
    """A signal from outside stopped the run."""


class SweepStopped(CosimError):
    """A sweep stopped early by the keyboard or a signal; finished runs are saved."""

    exit_code = 130


class SweepFailed(CosimError):
    """A sweep without a single completed run."""

    exit_code = 4


class Terminated(BaseException):
    """A request by SIGTERM or SIGHUP to end the process; not an Exception, which handlers of FMU faults would catch."""

    exit_code = 4

    def __init__(self, signal: str = "SIGTERM") -> None:
        self.signal = signal
        super().__init__(f"ended by {signal}")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.signal,), self.__dict__


def stop_error(stop: BaseException, now: float, subject: str = "the run") -> SimulationError:
    """Return the SimulationError for a run that Ctrl-C or a signal stopped at time `now` [s]."""
    if isinstance(stop, SimulationError):
        return stop
    if isinstance(stop, KeyboardInterrupt):
        return Interrupted(subject, now, "interrupted from the keyboard")
    return Signalled(subject, now, str(stop))


class CriterionMissed(CosimError):
    """A completed run missed a criterion, or two runs differ by more than the tolerance."""

    exit_code = 5
