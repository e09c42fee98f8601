"""An FMI 2.0 co-simulation FMU, loaded by FMPy and stepped without copies.

FMPy reads, checks, loads and instantiates; in the loop its wrappers give way to the bare functions of
the library, called on buffers laid out once.
"""

from __future__ import annotations

import ctypes
import math
import os
import shutil
import tempfile
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cosim.blocks.guard import check_fmu_file, check_identifiers, reason_of, without_wrapping
from cosim.blocks.interface import Row, Signal
from cosim.errors import FmuError, SimulationError
from fmus.archive import unpack
from fmus.lifetime import let_go_at_exit

STATUS = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
FATAL = 4
KEPT_MESSAGES = 50  # of a talkative FMU, the last ones
TERMINATED = 3  # fmi2StatusKind
BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
EXCHANGE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)
STEP = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int)
SETTERS: dict[str, tuple[str, Any]] = {
    "Real": ("Real", ctypes.c_double),
    "Integer": ("Integer", ctypes.c_int),
    "Enumeration": ("Integer", ctypes.c_int),
    "Boolean": ("Boolean", ctypes.c_int),
    "String": ("String", ctypes.c_char_p),
}


def read_description(path: Path) -> Any:
    """FMPy's model description of an FMU that can be co-simulated; FmuError where it cannot."""
    import fmpy

    check_fmu_file(path)
    try:
        description = fmpy.read_model_description(str(path))
    except Exception as error:  # FMPy raises bare Exceptions, lxml its own
        raise FmuError(f"{path} is not a valid FMU: {reason_of(error)}") from None
    check_identifiers(path, description)
    if description.fmiVersion != "2.0" or description.coSimulation is None:
        raise FmuError(f"{path} is FMI {description.fmiVersion}; FMI 2.0 for co-simulation is needed")
    return description


def unit_definition(description: Any, unit: str | None) -> tuple[float, ...] | None:
    """SI exponents, factor and offset of a unit the FMU defines."""
    for definition in description.unitDefinitions:
        if definition.name == unit and definition.baseUnit is not None:
            base = definition.baseUnit
            return (*(float(getattr(base, name) or 0) for name in BASE_UNITS), base.factor, base.offset)
    return None


def unit_of(variable: Any) -> str:
    """Unit of a variable, its own or its type's."""
    unit = variable.unit or (variable.declaredType.unit if variable.declaredType is not None else None)
    return unit or ""


class FmuBlock:
    """One FMU instance."""

    def __init__(
        self, name: str, path: Path, description: Any, start: Mapping[str, Any], connected: frozenset[str]
    ) -> None:
        self.name, self.path, self.description = name, path, description
        self.start_values = start
        self.log: deque[str] = deque(maxlen=KEPT_MESSAGES)
        reals = [v for v in description.modelVariables if v.type == "Real"]
        inputs = [v for v in reals if v.causality == "input"]
        inputs.sort(key=lambda v: v.name not in connected)  # connected ones first, so that one call sets them
        outputs = [v for v in reals if v.causality == "output"]
        self.inputs = tuple(self._signal(v) for v in inputs)
        self.outputs = tuple(self._signal(v) for v in outputs)
        self._connected = sum(v.name in connected for v in inputs)
        self._input_vrs = (ctypes.c_uint * len(inputs))(*(v.valueReference for v in inputs))
        self._output_vrs = (ctypes.c_uint * len(outputs))(*(v.valueReference for v in outputs))
        self._fmu: Any = None
        self._component: Any = None
        self._folder: Path | None = None
        self._initialized = False
        self._time = 0.0

    def _signal(self, variable: Any) -> Signal:
        unit = unit_of(variable)
        return Signal(variable.name, unit, unit_definition(self.description, unit))

    def depends_on(self, name: str) -> bool | None:
        declared = True
        for unknown in self.description.outputs:
            if unknown.dependencies is None:
                declared = False
            elif any(variable.name == name for variable in unknown.dependencies):
                return True
        return False if declared else None

    def bind(self, row: Row, first: int) -> None:
        self._row = row
        self._out = slice(first + len(self.inputs), first + len(self.inputs) + len(self.outputs))
        here = ctypes.addressof(row) + 8 * first
        self._put_arguments = (ctypes.addressof(self._input_vrs), self._connected, here)
        self._get_arguments = (ctypes.addressof(self._output_vrs), len(self.outputs), here + 8 * len(self.inputs))
        self._all_inputs = (ctypes.addressof(self._input_vrs), len(self.inputs), here)

    def open(self, start: float, stop: float) -> None:
        from fmpy.fmi1 import FMICallException
        from fmpy.fmi2 import FMU2Slave

        self._time = start
        self._folder, here = Path(tempfile.mkdtemp(prefix="cosim-fmu-")), Path.cwd()
        try:
            unpack(self.path, self._folder)
            identifier = self.description.coSimulation.modelIdentifier
            self._fmu = FMU2Slave(
                guid=self.description.guid,
                modelIdentifier=identifier,
                unzipDirectory=str(self._folder),
                instanceName=self.name,
            )
            self._fmu.instantiate(callbacks=self._callbacks(), loggingOn=True)  # or it gives no reasons
        except Exception as error:  # FMPy raises bare Exceptions; the FMU's own words say more
            self._fmu = None
            raise FmuError(f"{self.path} does not load: {self.last_words() or error}") from None
        finally:
            os.chdir(here)  # FMPy loads from within the FMU's folder
        let_go_at_exit(self._folder)  # of what pythonfmu, if it made this FMU, releases twice
        self._component = self._fmu.component
        self._bare_functions()
        try:
            self._check(self._fmu.setupExperiment(startTime=start, stopTime=stop), "fmi2SetupExperiment")
            self._set_start_values()
            self._check(self._fmu.enterInitializationMode(), "fmi2EnterInitializationMode")
        except FMICallException as error:
            self._fail(error.function, error.status)
        self._check(self._get_real(self._component, *self._all_inputs), "fmi2GetReal")

    def start(self) -> None:
        from fmpy.fmi1 import FMICallException

        try:
            self._check(self._fmu.exitInitializationMode(), "fmi2ExitInitializationMode")
        except FMICallException as error:
            self._fail(error.function, error.status)
        self._initialized = True

    def put(self) -> None:
        if self._connected:
            status = self._set_real(self._component, *self._put_arguments)
            if status:
                self._fail("fmi2SetReal", status)

    def get(self) -> None:
        status = self._get_real(self._component, *self._get_arguments)
        if status:
            self._fail("fmi2GetReal", status)
        values = self._row[self._out]
        if not math.isfinite(sum(values)):
            for signal, value in zip(self.outputs, values, strict=True):
                if not math.isfinite(value):
                    raise SimulationError(f"{self.name}.{signal.name}", self._time, f"the value is {value}")

    def advance(self, t: float, h: float) -> None:
        status = self._do_step(self._component, t, h, 1)
        self._time = t + h
        if status:
            self._time = t
            self._fail("fmi2DoStep", status)

    def close(self) -> None:
        fmu, self._fmu = self._fmu, None
        if fmu is not None:
            try:
                if self._initialized:
                    fmu.terminate()
            except Exception as error:  # the run is over; the FMU's refusal is logged, not raised
                self.log.append(str(error))
            fmu.freeInstance()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def last_words(self) -> str:
        """The FMU's last log message, on one line."""
        return without_wrapping(" ".join(self.log[-1].split())) if self.log else ""

    # -- within -------------------------------------------------------------------------------

    def _bare_functions(self) -> None:
        library = self._fmu.dll

        def bare(prototype: Any, name: str) -> Any:
            return prototype(ctypes.cast(getattr(library, name), ctypes.c_void_p).value)

        self._set_real = bare(EXCHANGE, "fmi2SetReal")
        self._get_real = bare(EXCHANGE, "fmi2GetReal")
        self._do_step = bare(STEP, "fmi2DoStep")

    def _callbacks(self) -> Any:
        from fmpy import calloc, fmi2, free

        callbacks = fmi2.fmi2CallbackFunctions()
        callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(self._listen)
        callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
        callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
        try:
            from fmpy.logging import addLoggerProxy  # formats the variadic arguments of C
        except ImportError:
            return callbacks
        addLoggerProxy(ctypes.byref(callbacks))
        return callbacks

    def _listen(self, _: Any, instance: bytes, status: int, category: bytes, message: bytes) -> None:
        self.log.append((message or b"").decode("utf-8", "replace"))

    def _set_start_values(self) -> None:
        by_name = {v.name: v for v in self.description.modelVariables}
        for name, value in self.start_values.items():
            variable = by_name[name]
            kind, ctype = SETTERS[variable.type]
            given = value.encode() if isinstance(value, str) else value
            function = f"fmi2Set{kind}"
            # FMPy's own setters do not hand the status on, and a Warning is no OK
            status = getattr(self._fmu, function)(
                self._component, (ctypes.c_uint * 1)(variable.valueReference), 1, (ctype * 1)(given)
            )
            self._check(status, f"{function} of {name}")

    def _check(self, status: int, function: str) -> None:
        if status:
            self._fail(function, status)

    def _fail(self, function: str, status: int) -> None:
        """Tell which call failed and why. After Fatal the instance is not touched again, as FMI demands."""
        reason = f"{function} returned {STATUS[status] if 0 <= status < len(STATUS) else status}"
        if status == FATAL:
            self._fmu = None
        elif function == "fmi2DoStep" and self._ended():
            reason += ": the FMU ended the simulation early"
        if "KeyboardInterrupt" in self.last_words():  # it came while the FMU's Python ran
            raise KeyboardInterrupt
        if words := self.last_words():
            reason += f": {words}"
        raise SimulationError(self.name, self._time, reason)

    def _ended(self) -> bool:
        try:
            return bool(self._fmu.getBooleanStatus(TERMINATED))
        except Exception:  # the function is optional
            return False
