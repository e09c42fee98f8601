"""Calls of an FMU in a common form for all versions and interfaces, made through FMPy's classes.

Order: load, instantiate, prepare, (start values), enter, (values)*, leave, (values, step, values)*, terminate, free.
"""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from cosim.blocks.component import EarlyEnd
from cosim.core.messages import Note
from cosim.fmi.description import PARTS, Way

DISCARD = 2
LAST_SUCCESSFUL, TERMINATED = 2, 3  # fmi2StatusKind
BOOLEAN, DOUBLE = ctypes.c_bool, ctypes.c_double
SIZE, REFERENCE, INT = ctypes.c_size_t, ctypes.c_void_p, ctypes.c_int
EXCHANGE = ctypes.CFUNCTYPE(INT, REFERENCE, REFERENCE, SIZE, REFERENCE)
EXCHANGE3 = ctypes.CFUNCTYPE(INT, REFERENCE, REFERENCE, SIZE, REFERENCE, SIZE)
STEPS = {
    1: ctypes.CFUNCTYPE(INT, REFERENCE, DOUBLE, DOUBLE, ctypes.c_byte),
    2: ctypes.CFUNCTYPE(INT, REFERENCE, DOUBLE, DOUBLE, INT),
    3: ctypes.CFUNCTYPE(INT, REFERENCE, DOUBLE, DOUBLE, BOOLEAN, *[REFERENCE] * 4),
}
Step = Callable[[Any, float, float, int], int]
Listen = Callable[[int, bytes | None], None]  # status and message
_listeners: dict[str, Callable[[], Listen | None]] = {}  # instance name → weak reference to its listener


class Calls:
    """Calls of an FMU, here for co-simulation.

    Attributes:
        version: Version of FMI: 1, 2 or 3.
        prefix: Prefix of FMI's functions.
        about: Description of the interface.
        readable_before_start: Whether values are readable during initialization; in FMI 1.0, a single call initializes.
        is_event, ends, is_early, last: Outcome of a step of FMI 3.0.
    """

    fmpy_class = "Slave"
    way: Way = "co-simulation"

    def __init__(self, name: str, description: Any) -> None:
        self.name, self.description = name, description
        self.version = int(description.fmiVersion[0])
        self.prefix = "fmi" if self.version == 1 else f"fmi{self.version}"
        self.about = getattr(description, PARTS[self.way])
        self.readable_before_start = self.version > 1
        self.exchange = EXCHANGE3 if self.version == 3 else EXCHANGE
        self.fmu: Any = None
        self.start_time, self.stop_time = 0.0, 0.0
        self.tolerance: float | None = None
        self.is_event, self.ends, self.is_early, self.last = BOOLEAN(), BOOLEAN(), BOOLEAN(), DOUBLE()
        self.flags = tuple(ctypes.byref(cell) for cell in (self.is_event, self.ends, self.is_early, self.last))

    def load(self, folder: Path, library: Path) -> None:
        """Load the library; failures raise bare Exceptions."""
        kind = getattr(import_module(f"fmpy.fmi{self.version}"), f"FMU{self.version}{self.fmpy_class}")
        # FMPy derives the library's path from the identifier. In FMI 1.0 the names of functions begin with it.
        names = {"modelIdentifier": library.stem}
        if self.version == 1:
            names = {"modelIdentifier": str(self.about.modelIdentifier), "libraryPath": str(library)}
        self.fmu = kind(guid=self.description.guid, unzipDirectory=str(folder), instanceName=self.name, **names)

    def instantiate(self, listen: Listen, logging: bool, **options: Any) -> None:
        """Instantiate the FMU; send its log messages to `listen`."""
        if self.version == 3:
            options["logMessage"] = lambda _, status, category, message: listen(status, message)
        else:
            options["functions" if self.version == 1 else "callbacks"] = _callbacks(self.version, self.name, listen)
        self.fmu.instantiate(loggingOn=logging, **options)

    def limit_logging(self) -> None:
        """Limit debug logging to categories about problems."""
        words = ("warning", "error", "fatal", "discard", "logall")  # pythonfmu is silent without logall
        names = [c.name for c in self.description.logCategories]
        problems = [name for name in names if any(word in name.lower() for word in words)]
        if problems and len(problems) < len(names):
            self.fmu.setDebugLogging(True, problems)

    def prepare(self) -> None:
        """Announce the experiment before start values are set."""
        if self.version == 2:
            self.fmu.setupExperiment(**self._experiment)

    def enter(self) -> None:
        """Begin initialization."""
        if self.version > 1:
            self.fmu.enterInitializationMode(**self._experiment if self.version == 3 else {})

    @property
    def _experiment(self) -> dict[str, float | None]:
        tolerance = None if self.way == "model-exchange" else self.tolerance  # It is the solver's there.
        return {"tolerance": tolerance, "startTime": self.start_time, "stopTime": self.stop_time}

    def leave(self) -> None:
        """End initialization."""
        if self.version == 1:
            self.fmu.initialize(tStart=self.start_time, stopTime=self.stop_time)
        else:
            self.fmu.exitInitializationMode()

    def symbol(self, name: str) -> str:
        """Return the name of a function in the library."""
        return f"{self.about.modelIdentifier}_fmi{name}" if self.version == 1 else f"{self.prefix}{name}"

    def bare(self, prototype: Any, name: str) -> Any:
        """Return a library function without FMPy's checks and copies."""
        function = getattr(self.fmu.dll, self.symbol(name))
        return prototype(ctypes.cast(function, ctypes.c_void_p).value)

    def prepared(self, prototype: Any, name: str, *arguments: Any) -> partial[int]:
        """Return a library function with arguments that no call converts again; those beyond its prototype are left."""
        values = [kind(value) for kind, value in zip(prototype._argtypes_, arguments, strict=False)]
        return partial(self.bare(ctypes.CFUNCTYPE(ctypes.c_int), name), *values)

    def stepping(self) -> Step:
        """Return a function of (component, t, h, flag) → status."""
        step: Any = self.bare(STEPS[self.version], "DoStep")
        if self.version < 3:
            return step  # type: ignore[no-any-return]

        def do_step(component: Any, t: float, h: float, _: int) -> int:
            status = int(step(component, t, h, True, *self.flags))
            if self.ends.value and status < DISCARD:
                raise end_of(self.name, self.last.value if self.is_early.value else t + h)
            return status

        return do_step

    def inputs_changed(self, take: Callable[[], None] | None) -> None:
        """Apply changed inputs by calling `take`; None says that no input has changed at the end of a step."""
        if take is not None:
            take()

    def end_time(self, t: float) -> float | None:
        """Return the end time if the FMU discarded a step to end."""
        try:
            if self.version != 2 or not self.fmu.getBooleanStatus(TERMINATED):
                return None
        except Exception:  # The function is optional.
            return None
        try:
            return max(t, float(self.fmu.getRealStatus(LAST_SUCCESSFUL)))
        except Exception:
            return t


def end_of(name: str, reached: float) -> EarlyEnd:
    """Return the error of an ended simulation."""
    return EarlyEnd(name, reached, Note("the FMU ended the simulation"), readable=True)


def _callbacks(version: int, name: str, listen: Listen) -> Any:
    """Return the callbacks of an instance of FMI 1.0 or 2.0, whose messages are routed by instance name.

    pythonfmu sends all messages of a process to the instance made last.
    """
    import fmpy

    module = import_module(f"fmpy.fmi{version}")
    _listeners[name] = weakref.WeakMethod(listen)

    def logger(_: Any, instance: bytes | None, status: int, category: Any, message: bytes | None) -> None:
        listener = _listeners.get((instance or b"").decode("utf-8", "replace"), lambda: None)() or listen
        listener(status, message)

    functions = {"Logger": logger, "AllocateMemory": fmpy.calloc, "FreeMemory": fmpy.free}
    callbacks = getattr(module, f"fmi{version}CallbackFunctions")()
    for kind, function in functions.items():
        field = f"{kind[0].lower()}{kind[1:]}"
        setattr(callbacks, field, getattr(module, f"fmi{version}Callback{kind}TYPE")(function))
    with suppress(ImportError):
        from fmpy.logging import addLoggerProxy  # formats C's variadic arguments

        addLoggerProxy(ctypes.byref(callbacks))
    return callbacks
