"""Calls of an FMU in a common form for all versions and interfaces, made through FMPy's classes.

Order: load, instantiate, prepare, (start values), enter, (values)*, leave, (values, step, values)*, terminate, free.
"""

from __future__ import annotations

import ctypes
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from cosim.base.messages import Note
from cosim.blocks.component import EarlyEnd
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
SingleCall = tuple[Callable[[], int], ctypes.c_double, ctypes.c_double]  # with the cells of t and h
Listen = Callable[[int, bytes | None], None]  # status and message
Logger = Callable[[Any, bytes | None, int, Any, bytes | None], None]  # environment, instance, status, category, message
_listeners: dict[str, Callable[[], Listen | None]] = {}  # instance name → weak reference to its listener


class Calls(ABC):
    """Calls common to all versions and interfaces."""

    fmpy_class: str  # module and name in FMPy
    prefix = "fmi2"
    way: Way = "co-simulation"
    exchange: Any = EXCHANGE
    step: Any = STEP2
    readable_before_start = True  # whether values are readable during initialization

    def __init__(self, name: str, description: Any) -> None:
        self.name, self.description = name, description
        self.fmu: Any = None
        self.start_time, self.stop_time = 0.0, 0.0
        self.tolerance: float | None = None

    @property
    def identifier(self) -> str:
        """Return the modelIdentifier of the FMI interface in use."""
        part = self.description.coSimulation if self.way == "co-simulation" else self.description.modelExchange
        return str(part.modelIdentifier)

    def load(self, folder: Path, library: Path) -> None:
        """Load the library; failures raise bare Exceptions."""
        # FMPy derives the library's path from the identifier, and uses the identifier otherwise only in FMI 1.0.
        self._make(folder, modelIdentifier=library.stem)

    def _make(self, folder: Path, **library: str) -> None:
        """Make FMPy's object of the FMU; the import takes time."""
        module, _, name = self.fmpy_class.partition(".")
        kind = getattr(import_module(f"fmpy.{module}"), name)
        self.fmu = kind(guid=self.description.guid, unzipDirectory=str(folder), instanceName=self.name, **library)

    def instantiate(self, listen: Listen, logging: bool) -> None:
        """Instantiate the FMU; send its log messages to `listen`."""
        self.fmu.instantiate(callbacks=_callbacks2(_route(self.name, listen)), loggingOn=logging)

    def limit_logging(self) -> None:
        """Limit debug logging to categories about problems."""
        words = ("warning", "error", "fatal", "discard", "logall")  # pythonfmu is silent without logall
        names = [c.name for c in self.description.logCategories]
        problems = [name for name in names if any(word in name.lower() for word in words)]
        if problems and len(problems) < len(names):
            self.fmu.setDebugLogging(True, problems)

    def prepare(self) -> None:
        """Announce the experiment before start values are set."""
        self.fmu.setupExperiment(tolerance=self.tolerance, startTime=self.start_time, stopTime=self.stop_time)

    def enter(self) -> None:
        """Begin initialization."""
        self.fmu.enterInitializationMode()

    def leave(self) -> None:
        """End initialization."""
        self.fmu.exitInitializationMode()

    def bare(self, prototype: Any, name: str) -> Any:
        """Return a library function without FMPy's checks and copies."""
        function = getattr(self.fmu.dll, self.symbol(name))
        return prototype(ctypes.cast(function, ctypes.c_void_p).value)

    def untyped(self, symbol: str) -> Any:
        """Return a library function for prepared C arguments."""
        function = ctypes.cast(getattr(self.fmu.dll, symbol), ctypes.c_void_p)
        return ctypes.CFUNCTYPE(INT)(function.value or 0)

    def single_call(self, component: Any) -> SingleCall | None:
        """Return a single-call step with its cells, if possible."""
        return None

    def symbol(self, name: str) -> str:
        """Return the name of a function in the library."""
        return f"{self.prefix}{name}"

    def bare_step(self) -> Any:
        """Return the library's step function."""
        return self.bare(self.step, "DoStep")

    @abstractmethod
    def stepping(self) -> Step:
        """Return a function of (component, t, h, flag) → status."""

    def inputs_changed(self, take: Callable[[], None] | None) -> None:
        """Apply changed inputs by calling `take`; None says that no input has changed at the end of a step."""
        if take is not None:
            take()

    def end_time(self, t: float) -> float | None:
        """Return the end time if the FMU discarded a step to end."""
        return None


class CoSimulation2(Calls):
    """FMI 2.0 co-simulation."""

    fmpy_class = "fmi2.FMU2Slave"

    def stepping(self) -> Step:
        return self.bare_step()  # type: ignore[no-any-return]

    def single_call(self, component: Any) -> SingleCall | None:
        time, length = DOUBLE(), DOUBLE()
        step = partial(self.untyped("fmi2DoStep"), ctypes.c_void_p(component), time, length, INT(1))
        return step, time, length

    def end_time(self, t: float) -> float | None:
        try:
            if not self.fmu.getBooleanStatus(TERMINATED):
                return None
        except Exception:  # The function is optional.
            return None
        try:
            return max(t, float(self.fmu.getRealStatus(LAST_SUCCESSFUL)))
        except Exception:
            return t


class Version1(Calls):
    """Calls of FMI 1.0: a single call initializes, and values are readable only afterwards."""

    prefix = "fmi"
    readable_before_start = False

    def load(self, folder: Path, library: Path) -> None:
        self._make(folder, modelIdentifier=self.identifier, libraryPath=str(library))  # prefix of function names

    def instantiate(self, listen: Listen, logging: bool) -> None:
        self.fmu.instantiate(functions=_callbacks1(listen), loggingOn=logging)

    def limit_logging(self) -> None:
        """Do nothing; FMI 1.0 has no categories."""

    def enter(self) -> None:
        """Do nothing; FMI 1.0 has no initialization mode."""

    def symbol(self, name: str) -> str:
        return f"{self.identifier}_fmi{name}"


class CoSimulation1(Version1):
    """FMI 1.0 co-simulation."""

    fmpy_class, step = "fmi1.FMU1Slave", STEP1

    def prepare(self) -> None:
        """Do nothing; FMI 1.0 gets the experiment at initialization."""

    def leave(self) -> None:
        self.fmu.initialize(tStart=self.start_time, stopTime=self.stop_time)

    def stepping(self) -> Step:
        step = self.bare_step()
        return lambda component, t, h, _: int(step(component, t, h, b"\x01"))


class CoSimulation3(Calls):
    """Calls of an FMU for FMI 3.0 co-simulation."""

    fmpy_class, prefix, exchange, step = "fmi3.FMU3Slave", "fmi3", EXCHANGE3, STEP3

    def instantiate(self, listen: Listen, logging: bool) -> None:
        self.fmu.instantiate(loggingOn=logging, logMessage=lambda _, status, category, message: listen(status, message))

    def prepare(self) -> None:
        """Do nothing; FMI 3.0 gets the experiment in `enter`."""

    def enter(self) -> None:
        self.fmu.enterInitializationMode(tolerance=self.tolerance, startTime=self.start_time, stopTime=self.stop_time)

    def stepping(self) -> Step:
        step = self.bare_step()
        event, terminate, early, last = BOOLEAN(), BOOLEAN(), BOOLEAN(), DOUBLE()
        flags = tuple(ctypes.byref(flag) for flag in (event, terminate, early, last))  # keep their targets alive

        def do_step(component: Any, t: float, h: float, _: int) -> int:
            status = int(step(component, t, h, True, *flags))
            if terminate.value and status < DISCARD:
                raise end_of(self.name, last.value if early.value else t + h)
            return status

        return do_step


def end_of(name: str, reached: float) -> EarlyEnd:
    """Return the error of an ended FMI 3.0 simulation."""
    return EarlyEnd(name, reached, Note("the FMU ended the simulation"), readable=True)


def _route(name: str, listen: Listen) -> Logger:
    """Return a logger that routes messages by instance name.

    pythonfmu sends all messages of a process to the instance made last.
    """
    _listeners[name] = weakref.WeakMethod(listen)

    def logger(_: Any, instance: bytes | None, status: int, category: Any, message: bytes | None) -> None:
        listener = _listeners.get((instance or b"").decode("utf-8", "replace"), lambda: None)() or listen
        listener(status, message)

    return logger


def _callbacks2(logger: Logger) -> Any:
    from fmpy import calloc, fmi2, free

    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(logger)
    callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
    return _add_formatting(callbacks)


def _callbacks1(listen: Listen) -> Any:
    from fmpy import calloc, fmi1, free

    callbacks = fmi1.fmi1CallbackFunctions()
    callbacks.logger = fmi1.fmi1CallbackLoggerTYPE(lambda _, name, status, category, message: listen(status, message))
    callbacks.allocateMemory = fmi1.fmi1CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi1.fmi1CallbackFreeMemoryTYPE(free)
    callbacks.stepFinished = None
    return _add_formatting(callbacks)


def _add_formatting(callbacks: Any) -> Any:
    try:
        from fmpy.logging import addLoggerProxy  # formats C's variadic arguments
    except ImportError:
        return callbacks
    addLoggerProxy(ctypes.byref(callbacks))
    return callbacks
