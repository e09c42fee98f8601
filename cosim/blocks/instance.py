"""An FMU instance: loading, uniform calls for all versions and interfaces of FMI, messages and status values.

The calls go through FMPy's classes, in this order: load, prepare, (start values), enter, (values)*, leave,
(values, step, values)*, free.
"""

from __future__ import annotations

import ctypes
import functools
import os
import shutil
import tempfile
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from cosim.blocks.compiling import compile_library
from cosim.blocks.component import EarlyEnd
from cosim.blocks.loading import load_error
from cosim.blocks.shared_code import claim, code_of, own_symbols_first
from cosim.core.drafts import is_full
from cosim.core.errors import CallFailed, DiskFull, FmuError, Terminated
from cosim.core.messages import Note
from cosim.core.scratch import process_folder
from cosim.files.archive import unpack, unpack_once
from cosim.fmi.description import (
    C_CODE,
    INTERFACE_ATTRIBUTES,
    Way,
    library_of,
    no_library,
    platform_of,
    platforms_among,
    without_wrapping,
)
from cosim.fmi.lifetime import KEEPER, let_go_at_exit

LAST_SUCCESSFUL, TERMINATED = 2, 3  # fmi2StatusKind
BOOLEAN, DOUBLE = ctypes.c_bool, ctypes.c_double
SIZE, REFERENCE, INT = ctypes.c_size_t, ctypes.c_void_p, ctypes.c_int
CALL = ctypes.CFUNCTYPE(INT)
MOVED = REFERENCE, REFERENCE, SIZE, REFERENCE, SIZE  # arguments that set or get values; the last one is of FMI 3.0
DO_STEP_TYPES = {
    1: ctypes.CFUNCTYPE(INT, REFERENCE, DOUBLE, DOUBLE, ctypes.c_byte),
    2: ctypes.CFUNCTYPE(INT, REFERENCE, DOUBLE, DOUBLE, INT),
    3: ctypes.CFUNCTYPE(INT, REFERENCE, DOUBLE, DOUBLE, BOOLEAN, *[REFERENCE] * 4),
}
Step = Callable[[Any, float, float, int], int]
Listen = Callable[[int, bytes | None], None]  # status and message
STATUS_NAMES = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
WARNING, DISCARD, FATAL = 1, 2, 4
LONGEST_MESSAGE = 1000  # characters
KEPT_FIRST, KEPT_LAST = 50, 50  # messages
LAST = ""  # name of the instance made last
_listeners: dict[str, Callable[[], Listen | None]] = {}  # instance name → weak reference to its listener


class _Functions(dict[str, Any]):
    """FMI functions of a library by name; each is looked up at its first call, because most are never called."""

    def __init__(self, fmu: Any, signatures: Mapping[str, tuple[Any, Any, Any]]) -> None:
        self._library, self._signatures = fmu.dll, signatures
        self._prefix = f"{fmu.modelIdentifier}_" if next(iter(signatures)).startswith("fmi1") else ""
        for name in signatures:
            fmu.dll[self._symbol(name)]  # AttributeError without it

    def _symbol(self, name: str) -> str:
        return f"{self._prefix}{name.replace('fmi1', 'fmi')}" if self._prefix else name

    def __missing__(self, name: str) -> Any:
        function = self._library[self._symbol(name)]
        function.argnames, function.argtypes, function.restype = self._signatures[name]
        self[name] = function
        return function


@functools.cache
def with_known_signatures(module: str, name: str) -> Any:
    """Return a class of FMPy, changed so that it inspects the signatures of FMI functions only once."""
    kind = getattr(import_module(module), name)
    signatures: dict[str, tuple[Any, Any, Any]] = {}

    def load(fmu: Any) -> None:
        if not signatures:
            kind._loadFunctions(fmu)
            signatures.update({n: (f.argnames, f.argtypes, f.restype) for n, f in fmu._functions.items()})
        else:
            fmu._functions = _Functions(fmu, signatures)

    return type(name, (kind,), {"_loadFunctions": load})


@dataclass(eq=False)
class MessageLog:
    """The first and the last messages of an FMU without repetitions, and the number of messages between them.

    Attributes:
        share: Function that is called with each message; None for no function.
    """

    first: list[str] = field(default_factory=list)
    last: deque[str] = field(default_factory=lambda: deque(maxlen=KEPT_LAST))
    omitted: int = 0
    share: Callable[[str], None] | None = None

    def __iter__(self) -> Iterator[str]:
        """Yield the messages, with a note in place of the omitted ones."""
        yield from self.first
        if self.omitted:
            yield (
                f"{self.omitted:,} messages are omitted here: the first {len(self.first)} and the last "
                f"{len(self.last)} are recorded"
            )
        yield from self.last

    def append(self, text: str) -> None:
        """Add a message."""
        if self.share is not None:
            self.share(text)
        if text in self.first:
            return
        if len(self.first) < KEPT_FIRST:
            self.first.append(text)
            return
        if text in self.last:
            self.last.remove(text)
        self.omitted += len(self.last) == KEPT_LAST
        self.last.append(text)

    def state(self) -> dict[str, Any]:
        """Return the log as JSON types."""
        return {"first": [*self.first], "last": [*self.last], "omitted": self.omitted}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore a log from `state`."""
        self.first, self.omitted = list(state["first"]), int(state["omitted"])
        self.last = deque(state["last"], maxlen=KEPT_LAST)


class Instance:
    """An FMU instance for co-simulation, and the folder of the unpacked FMU.

    Attributes:
        version: Version of FMI: 1, 2 or 3.
        prefix: Prefix of FMI's functions.
        about: FMPy's description of the interface.
        fmu: FMPy's object; None before loading and after a fatal error. `fmu.component` is the pointer of C.
        is_event, ends, is_early, last: Results of fmi3DoStep: event needed, simulation ended, early return, last
            successful time.
        log: Messages and warnings.
        time: Time [s] reached, for messages.
        place: Folder of the already unpacked FMU, left unchanged.
        logging: True if debug logging is on.
        compiles: True if sources may be compiled when the library is missing.
        keeps_library: True if library and folder are kept for the next `load` when the instance is freed.
    """

    keeps_library = False
    fmpy_class = "Slave"
    way: Way = "co-simulation"
    start_time = stop_time = time = 0.0
    tolerance: float | None = None
    fmu: Any = None
    component: Any = None
    place: Path | None = None
    initialized = False
    _folder: Path | None = None
    _stop: BaseException | None = None
    _words = ""  # last message

    def __init__(
        self, name: str, path: Path, description: Any, *, logging: bool = False, compiles: bool = False
    ) -> None:
        self.name, self.path, self.description = name, path, description
        self.version = int(description.fmiVersion[0])
        self.prefix = "fmi" if self.version == 1 else f"fmi{self.version}"
        self.about = getattr(description, INTERFACE_ATTRIBUTES[self.way])
        self.is_event, self.ends, self.is_early, self.last = BOOLEAN(), BOOLEAN(), BOOLEAN(), DOUBLE()
        self.flags = tuple(ctypes.byref(cell) for cell in (self.is_event, self.ends, self.is_early, self.last))
        self.by_pythonfmu = "pythonfmu" in (description.generationTool or "").lower()
        self.log = MessageLog()
        self.step_name = f"{self.prefix}DoStep"
        self._logging, self._compiles = logging, compiles

    # -- life cycle ---------------------------------------------------------------------------------

    def load(self) -> None:
        """Unpack the FMU if necessary, load it and instantiate it.

        Raises:
            FmuError: The library does not load.
            SharedCode: The process has loaded different code under the same name.
            DiskFull: The disk is full.
        """
        is_kept = self.fmu is not None
        if not is_kept:
            claim(self.path)
        folder = self._folder or self._unpack()
        previous, self._words = os.getcwd(), ""
        try:
            if not is_kept:
                self._load_library(folder)
            self._instantiate()
        except Exception as error:  # FMPy raises bare Exceptions; the FMU's own message explains more
            self.fmu = None
            raise FmuError(f"{self.path} does not load: {self.last_words() or error}") from None
        finally:
            os.chdir(previous)  # FMPy changes to the FMU's folder
        if not is_kept and KEEPER in code_of(self.path).symbols:
            let_go_at_exit(folder)  # otherwise pythonfmu would release its objects twice at exit

    def _load_library(self, folder: Path) -> None:
        """Load the library; compile it first if it is missing and compilation is allowed."""
        identifier = str(self.about.modelIdentifier)
        library, warning = library_of(folder, self.description, identifier) or (None, "")
        if library is None:
            platforms = platforms_among([p.relative_to(folder).as_posix() for p in folder.rglob("*")])
            if not self._compiles or C_CODE not in platforms:
                raise FmuError(no_library(platform_of(self.description), platforms))
            library = compile_library(folder, self.description, identifier)
        kind = with_known_signatures(f"fmpy.fmi{self.version}", f"FMU{self.version}{self.fmpy_class}")
        # FMPy derives the library's path from the identifier. In FMI 1.0 the names of functions begin with it.
        names = {"modelIdentifier": library.stem}
        if self.version == 1:
            names = {"modelIdentifier": identifier, "libraryPath": str(library)}
        self._functions: dict[tuple[Any, str], Any] = {}
        try:
            with own_symbols_first(self.path, library):
                self.fmu = kind(guid=self.description.guid, unzipDirectory=str(folder), instanceName=self.name, **names)
        except Exception as error:  # FMPy raises bare Exceptions.
            raise FmuError(load_error(library, error)) from None
        if warning:
            self.remember(warning)

    def _unpack(self) -> Path:
        """Unpack the FMU unless this has been done; return the folder."""
        if self.place is not None:
            self._folder = self.place
            return self.place
        try:
            if not ((code := code_of(self.path)).has_variables or code.has_resources):
                self._folder = self.place = unpack_once(self.path)
                return self.place
            self._folder = folder = Path(tempfile.mkdtemp(prefix="fmu-", dir=process_folder()))
            unpack(self.path, folder)
        except Exception as error:  # FMPy raises bare Exceptions, zipfile its own.
            if is_full(error):
                full = (
                    f"the disk is full: no room to unpack {self.path.name} in the folder for temporary files (TMPDIR)"
                )
                raise DiskFull(self.name, self.time, full) from None
            raise FmuError(f"{self.path} does not load: {error}") from None
        return folder

    def free(self) -> None:
        """Terminate and free the instance; keep the folder."""
        fmu, component, self.component = self.fmu, self.component, None
        if not self.keeps_library:
            self.fmu = None
        if fmu is not None and component is not None:
            try:
                if self.initialized:
                    fmu.terminate()
            except Exception as error:  # the run is over, so an error is only logged
                self.log.append(str(error))
            getattr(fmu, f"{self.prefix}FreeInstance")(component) if self.keeps_library else fmu.freeInstance()
        elif fmu is not None and not self.keeps_library:
            fmu.freeLibrary()
        self.initialized = False

    def renew(self) -> None:
        """Replace the instance by a new one without loading the library again."""
        with suppress(Exception):  # FMPy raises bare Exceptions; a failure to terminate does not matter
            if self.initialized:
                self.fmu.terminate()
        self.initialized = False
        component, self.component = self.component, None
        getattr(self.fmu, f"{self.prefix}FreeInstance")(component)
        self._instantiate()

    def remove(self) -> None:
        """Delete the folder of the unpacked FMU, unless the caller provided it."""
        if self._folder is not None and self._folder != self.place and not self.keeps_library:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def _instantiate(self) -> None:
        """Instantiate the FMU. pythonfmu's FMUs need debug logging, since only debug messages contain reasons."""
        self.make_instance(self._logging or self.by_pythonfmu)
        self.component = self.fmu.component
        if self.by_pythonfmu and not self._logging:  # Limit debug logging to categories of problems.
            words = ("warning", "error", "fatal", "discard", "logall")  # without logall, pythonfmu logs nothing
            names = [c.name for c in self.description.logCategories]
            problems = [name for name in names if any(word in name.lower() for word in words)]
            if problems and len(problems) < len(names):
                self.fmu.setDebugLogging(True, problems)

    def make_instance(self, logging: bool, **options: Any) -> None:
        """Instantiate the FMU by FMPy's method, with options of that method."""
        if self.version == 3:
            options["logMessage"] = lambda _, status, category, message: self.listen(status, message)
        else:
            _listeners[self.name] = _listeners[LAST] = weakref.WeakMethod(self.listen)
            options["functions" if self.version == 1 else "callbacks"] = _callbacks(self.version)
        self.fmu.instantiate(loggingOn=logging, **options)

    # -- call sequence ----------------------------------------------------------------------------

    def prepare(self) -> None:
        """Set up the experiment (start, stop, tolerance) before start values are set."""
        if self.version == 2:
            self.fmu.setupExperiment(**self._experiment)

    def enter(self) -> None:
        """Enter initialization mode."""
        if self.version > 1:
            self.fmu.enterInitializationMode(**self._experiment if self.version == 3 else {})

    @property
    def _experiment(self) -> dict[str, float | None]:
        tolerance = None if self.way == "model-exchange" else self.tolerance  # then of the solver
        return {"tolerance": tolerance, "startTime": self.start_time, "stopTime": self.stop_time}

    def leave(self) -> None:
        """Leave initialization mode."""
        if self.version == 1:
            self.fmu.initialize(tStart=self.start_time, stopTime=self.stop_time)
        else:
            self.fmu.exitInitializationMode()

    def symbol(self, name: str) -> str:
        """Return the name that an FMI function has in the library."""
        return f"{self.about.modelIdentifier}_fmi{name}" if self.version == 1 else f"{self.prefix}{name}"

    def bare(self, prototype: Any, name: str) -> Any:
        """Return a library function without FMPy's checks and copies."""
        if (key := (prototype, name)) not in self._functions:
            function = getattr(self.fmu.dll, self.symbol(name))
            self._functions[key] = prototype(ctypes.cast(function, ctypes.c_void_p).value)
        return self._functions[key]

    def prepared(self, name: str, *arguments: Any) -> partial[int]:
        """Return a set or get function of the library, with arguments that are converted only once."""
        kinds = MOVED if self.version == 3 else MOVED[:-1]
        values = [kind(value) for kind, value in zip(kinds, (self.component, *arguments), strict=False)]
        return partial(self.bare(CALL, name), *values)

    def step_function(self) -> Any:
        """Return the library's function for a step."""
        return self.bare(DO_STEP_TYPES[self.version], "DoStep")

    def stepping(self) -> Step:
        """Return a function of (component, t, h, flag) → status."""
        step: Any = self.step_function()
        if self.version < 3:
            return step  # type: ignore[no-any-return]

        def do_step(component: Any, t: float, h: float, _: int) -> int:
            status = int(step(component, t, h, True, *self.flags))
            if self.ends.value and status < DISCARD:
                raise end_of(self.name, self.last.value if self.is_early.value else t + h)
            return status

        return do_step

    def inputs_changed(self, take: Callable[[], None] | None) -> None:
        """Apply changed inputs by calling `take`; None means that no input has changed at the end of a step."""
        if take is not None:
            take()

    # -- messages -------------------------------------------------------------------------

    def listen(self, status: int, message: bytes | None) -> None:
        """Store a message of the FMU; debug messages only if debug logging is on."""
        try:
            if status >= WARNING or self._logging:
                self._words = (message or b"").decode("utf-8", "replace")
                self.remember(self._words)
        except (KeyboardInterrupt, Terminated) as stop:  # Exceptions cannot pass through C.
            self._stop = stop

    def raise_stop(self) -> None:
        """Raise the interruption that occurred while a message was stored, if any."""
        stop, self._stop = self._stop, None
        if stop is not None:
            raise stop

    def remember(self, text: str) -> None:
        """Add a message to the log."""
        self.log.append(text if len(text) <= LONGEST_MESSAGE else text[:LONGEST_MESSAGE])

    def last_words(self) -> str:
        """Return the FMU's last message on a single line."""
        return without_wrapping(" ".join(self._words[:LONGEST_MESSAGE].split()))

    # -- status values ---------------------------------------------------------------

    @contextmanager
    def check_calls(self) -> Iterator[None]:
        """Convert failed FMPy calls to SimulationError."""
        from fmpy.fmi1 import FMICallException

        try:
            yield
        except FMICallException as error:
            self.judge(error.function, error.status)

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a method of FMPy's object; a failure becomes a SimulationError."""
        with self.check_calls():
            return getattr(self.fmu, name)(*arguments)

    def directional_derivatives(self, unknowns: Sequence[Any], knowns: Sequence[Any]) -> list[Sequence[float]]:
        """Return one column of derivatives of the unknowns for each known variable."""
        references = [v.valueReference for v in unknowns]
        return [self.call("getDirectionalDerivative", references, [v.valueReference], [1.0]) for v in knowns]

    def judge(self, function: str, status: int) -> None:
        """Handle a status other than OK: log a warning, or raise an error.

        Raises:
            EarlyEnd: The FMU ended the simulation by Discard.
            SimulationError: The call failed.
        """
        if status == WARNING:
            self.remember(f"{function} returned Warning")
            return
        if status == DISCARD and function == self.step_name and (reached := self._end_time()) is not None:
            words = self.last_words()
            raise EarlyEnd(
                self.name,
                reached,
                f"{function} returned Discard: the FMU ended the simulation early{words and f': {words}'}",
                readable=True,
            )
        if status == FATAL:  # FMI requires to abandon the instance
            self.fmu = None
        words, name = self.last_words(), STATUS_NAMES[status] if 0 <= status < len(STATUS_NAMES) else status
        if "KeyboardInterrupt" in words:  # Ctrl-C arrived while the FMU's Python code ran.
            raise KeyboardInterrupt
        because = f": {words}" if words else ""
        raise CallFailed(self.name, self.time, f"{function} returned {name}{because}")

    def _end_time(self) -> float | None:
        """Return the end time [s] if the FMU discarded a step to end the simulation; otherwise None."""
        reached = None
        with suppress(Exception):  # FMPy raises bare Exceptions; the functions are optional
            if self.version == 2 and self.fmu.getBooleanStatus(TERMINATED):
                reached = self.time
                reached = max(reached, float(self.fmu.getRealStatus(LAST_SUCCESSFUL)))
        return reached


def end_of(name: str, reached: float) -> EarlyEnd:
    """Return the EarlyEnd of a simulation that an FMU ended at time `reached` [s]."""
    return EarlyEnd(name, reached, Note("the FMU ended the simulation"), readable=True)


@functools.cache
def _callbacks(version: int) -> Any:
    """Return the callbacks of all instances of FMI 1.0 or 2.0, because FMPy has one function for all messages.

    A message goes to the instance of its name or, if that has ended, to the instance made last: pythonfmu gives all
    messages of a process the name of one instance.
    """
    import fmpy

    module = import_module(f"fmpy.fmi{version}")

    def logger(_: Any, instance: bytes | None, status: int, category: Any, message: bytes | None) -> None:
        for name in ((instance or b"").decode("utf-8", "replace"), LAST):
            if (listener := _listeners.get(name, lambda: None)()) is not None:
                listener(status, message)
                break

    functions = {"Logger": logger, "AllocateMemory": fmpy.calloc, "FreeMemory": fmpy.free}
    callbacks = getattr(module, f"fmi{version}CallbackFunctions")()
    for kind, function in functions.items():
        field = f"{kind[0].lower()}{kind[1:]}"
        setattr(callbacks, field, getattr(module, f"fmi{version}Callback{kind}TYPE")(function))
    with suppress(ImportError):
        from fmpy.logging import addLoggerProxy  # formats C's variadic arguments

        addLoggerProxy(ctypes.byref(callbacks))
    return callbacks
