"""The calls that run an FMU, in one shape for every version and way; FMPy's classes make them.

Order: load, instantiate, prepare, (start values), enter, (values)*, leave, (values, step, values)*, terminate, free.
"""

from __future__ import annotations

import ctypes
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from cosim.blocks.component import EndedEarly
from cosim.blocks.description import Way

DISCARD = 2
LAST_SUCCESSFUL, TERMINATED = 2, 3  # fmi2StatusKind
BOOLEAN, DOUBLE = ctypes.c_bool, ctypes.c_double
SIZE, REFERENCE, INT = ctypes.c_size_t, ctypes.c_void_p, ctypes.c_int
EXCHANGE = ctypes.CFUNCTYPE(INT, REFERENCE, REFERENCE, SIZE, REFERENCE)
EXCHANGE3 = ctypes.CFUNCTYPE(INT, REFERENCE, REFERENCE, SIZE, REFERENCE, SIZE)
STEP1 = ctypes.CFUNCTYPE(INT, REFERENCE, DOUBLE, DOUBLE, ctypes.c_char)
STEP2 = ctypes.CFUNCTYPE(INT, REFERENCE, DOUBLE, DOUBLE, INT)
STEP3 = ctypes.CFUNCTYPE(INT, REFERENCE, DOUBLE, DOUBLE, BOOLEAN, *[REFERENCE] * 4)
Step = Callable[[Any, float, float, int], int]
AtOnce = tuple[Callable[[], int], ctypes.c_double, ctypes.c_double]  # and the cells of t and h
Listen = Callable[[int, bytes | None], None]  # status and message
Logger = Callable[[Any, bytes | None, int, Any, bytes | None], None]  # environment, instance, status, category, message
_listening: dict[str, Callable[[], Listen | None]] = {}  # instance name → who listens for it, while it is there


class Calls(ABC):
    """What a version and a way have in common."""

    prefix = "fmi2"
    way: Way = "co-simulation"
    exchange: Any = EXCHANGE
    step: Any = STEP2
    readable_before_start = True  # values may be read while initializing

    def __init__(self, name: str, description: Any) -> None:
        self.name, self.description = name, description
        self.fmu: Any = None
        self.start_time, self.stop_time = 0.0, 0.0
        self.tolerance: float | None = None

    @property
    def identifier(self) -> str:
        """The modelIdentifier of the way."""
        part = self.description.coSimulation if self.way == "co-simulation" else self.description.modelExchange
        return str(part.modelIdentifier)

    def load(self, folder: Path, library: Path) -> None:
        """Load the library; bare Exceptions where that fails."""
        # FMPy derives the library's path from the identifier, and uses it for nothing else but in FMI 1.0
        self.fmu = self._class()(
            guid=self.description.guid,
            modelIdentifier=library.stem,
            unzipDirectory=str(folder),
            instanceName=self.name,
        )

    @abstractmethod
    def _class(self) -> Any:
        """FMPy's class."""

    def instantiate(self, listen: Listen, logging: bool) -> None:
        """Make the instance."""
        self.fmu.instantiate(callbacks=_callbacks2(_routed(self.name, listen)), loggingOn=logging)

    def limit_logging(self) -> None:
        """Of the FMU's debug categories keep those that tell what went wrong."""
        wanted = ("warning", "error", "fatal", "discard", "logall")  # the last for pythonfmu, silent without it
        names = [c.name for c in self.description.logCategories]
        kept = [name for name in names if any(word in name.lower() for word in wanted)]
        if kept and len(kept) < len(names):
            self.fmu.setDebugLogging(True, kept)

    def prepare(self) -> None:
        """Before start values: the experiment is told."""
        self.fmu.setupExperiment(tolerance=self.tolerance, startTime=self.start_time, stopTime=self.stop_time)

    def enter(self) -> None:
        """Begin initialization."""
        self.fmu.enterInitializationMode()

    def leave(self) -> None:
        """End initialization; it may step from now on."""
        self.fmu.exitInitializationMode()

    def bare(self, prototype: Any, name: str) -> Any:
        """A function of the library without FMPy's checks and copies."""
        function = getattr(self.fmu.dll, self.symbol(name))
        return prototype(ctypes.cast(function, ctypes.c_void_p).value)

    def untyped(self, symbol: str) -> Any:
        """A function of the library that takes C's own types, made before, and so converts none."""
        function = ctypes.cast(getattr(self.fmu.dll, symbol), ctypes.c_void_p)
        return ctypes.CFUNCTYPE(INT)(function.value or 0)

    def at_once(self, component: Any) -> AtOnce | None:
        """What makes a step of the instance from one cell over another, where that is a single call."""
        return None

    def symbol(self, name: str) -> str:
        """Name of a function in the library."""
        return f"{self.prefix}{name}"

    def bare_step(self) -> Any:
        """The library's function that makes a step."""
        return self.bare(self.step, "DoStep")

    @abstractmethod
    def stepping(self) -> Step:
        """What makes a step of the instance from t over h and returns a status."""

    def inputs_changed(self, take: Callable[[], None]) -> None:
        """Inputs are not what they were: let them be taken."""
        take()

    def ended(self, t: float) -> float | None:
        """The time to which the FMU came, where it discarded a step in order to end the simulation."""
        return None


class CoSimulation2(Calls):
    """FMI 2.0 co-simulation."""

    def _class(self) -> Any:
        from fmpy.fmi2 import FMU2Slave

        return FMU2Slave

    def stepping(self) -> Step:
        step: Step = self.bare_step()
        return step

    def at_once(self, component: Any) -> AtOnce | None:
        if self.symbol("DoStep") != "fmi2DoStep" or self.way != "co-simulation":
            return None
        at, over = DOUBLE(), DOUBLE()
        step = partial(self.untyped("fmi2DoStep"), ctypes.c_void_p(component), at, over, INT(1))
        return step, at, over

    def ended(self, t: float) -> float | None:
        try:
            if not self.fmu.getBooleanStatus(TERMINATED):
                return None
        except Exception:  # the function is optional
            return None
        try:
            return max(t, float(self.fmu.getRealStatus(LAST_SUCCESSFUL)))
        except Exception:
            return t


class Version1(Calls):
    """The calls of FMI 1.0: one call initializes, and values are read only after it."""

    prefix = "fmi"
    readable_before_start = False

    def load(self, folder: Path, library: Path) -> None:
        self.fmu = self._class()(
            guid=self.description.guid,
            modelIdentifier=self.identifier,  # which the names of the functions begin with
            unzipDirectory=str(folder),
            instanceName=self.name,
            libraryPath=str(library),
        )

    def instantiate(self, listen: Listen, logging: bool) -> None:
        self.fmu.instantiate(functions=_callbacks1(listen), loggingOn=logging)

    def limit_logging(self) -> None:
        """FMI 1.0 has no categories."""

    def enter(self) -> None:
        """FMI 1.0 has no initialization mode."""

    def symbol(self, name: str) -> str:
        return f"{self.identifier}_fmi{name}"


class CoSimulation1(Version1, CoSimulation2):
    """FMI 1.0 co-simulation."""

    step = STEP1

    def _class(self) -> Any:
        from fmpy.fmi1 import FMU1Slave

        return FMU1Slave

    def prepare(self) -> None:
        """FMI 1.0 is told when it is initialized."""

    def leave(self) -> None:
        self.fmu.initialize(tStart=self.start_time, stopTime=self.stop_time)

    def stepping(self) -> Step:
        step = self.bare_step()
        return lambda component, t, h, _: int(step(component, t, h, b"\x01"))

    def ended(self, t: float) -> float | None:
        return None


class CoSimulation3(Calls):
    """FMI 3.0 co-simulation."""

    prefix, exchange, step = "fmi3", EXCHANGE3, STEP3

    def _class(self) -> Any:
        from fmpy.fmi3 import FMU3Slave

        return FMU3Slave

    def instantiate(self, listen: Listen, logging: bool) -> None:
        self.fmu.instantiate(loggingOn=logging, logMessage=lambda _, status, category, message: listen(status, message))

    def prepare(self) -> None:
        """FMI 3.0 is told when it enters initialization mode."""

    def enter(self) -> None:
        self.fmu.enterInitializationMode(tolerance=self.tolerance, startTime=self.start_time, stopTime=self.stop_time)

    def stepping(self) -> Step:
        step = self.bare_step()
        event, terminate, early, last = BOOLEAN(), BOOLEAN(), BOOLEAN(), DOUBLE()
        flags = tuple(ctypes.byref(flag) for flag in (event, terminate, early, last))  # which keep what they point to

        def do_step(component: Any, t: float, h: float, _: int) -> int:
            status = int(step(component, t, h, True, *flags))
            if terminate.value and status < DISCARD:
                reached = last.value if early.value else t + h
                raise ended(self.name, reached)
            return status

        return do_step


def ended(name: str, reached: float) -> EndedEarly:
    """What tells that an FMU of FMI 3.0 has ended the simulation."""
    return EndedEarly(name, reached, "the FMU ended the simulation", readable=True)


def _routed(name: str, listen: Listen) -> Logger:
    """A logger that hands messages to the instance they name: pythonfmu gives all of a process to that made last."""
    _listening[name] = weakref.WeakMethod(listen)

    def logger(_: Any, named: bytes | None, status: int, category: Any, message: bytes | None) -> None:
        meant = _listening.get((named or b"").decode("utf-8", "replace"), lambda: None)() or listen
        meant(status, message)

    return logger


def _callbacks2(logger: Logger) -> Any:
    from fmpy import calloc, fmi2, free

    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(logger)
    callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
    return _formatting(callbacks)


def _callbacks1(listen: Listen) -> Any:
    from fmpy import calloc, fmi1, free

    callbacks = fmi1.fmi1CallbackFunctions()
    callbacks.logger = fmi1.fmi1CallbackLoggerTYPE(lambda _, name, status, category, message: listen(status, message))
    callbacks.allocateMemory = fmi1.fmi1CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi1.fmi1CallbackFreeMemoryTYPE(free)
    callbacks.stepFinished = None
    return _formatting(callbacks)


def _formatting(callbacks: Any) -> Any:
    try:
        from fmpy.logging import addLoggerProxy  # formats the variadic arguments of C
    except ImportError:
        return callbacks
    addLoggerProxy(ctypes.byref(callbacks))
    return callbacks
