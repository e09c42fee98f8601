"""FMPy as a host that speaks names: one instance of an FMU, what it logs, and which calls it refused."""

from __future__ import annotations

import contextlib
import functools
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import fmpy
import pytest
from fmpy import fmi2
from fmpy.fmi1 import FMICallException

SETTERS = {"Real": "setReal", "Boolean": "setBoolean", "String": "setString"}
GETTERS = {"Real": "getReal", "Boolean": "getBoolean", "String": "getString"}
GRAVEYARD: list[Instance] = []  # instances that refused a call: not touched again, their callbacks kept alive


@functools.cache
def description_of(fmu: Path) -> Any:
    return fmpy.read_model_description(str(fmu))


def extracted(fmu: Path) -> str:
    """Return the FMU unpacked once beside itself, since overwriting a loaded library would crash the process."""
    folder = fmu.with_suffix(".extracted")
    if not folder.exists():
        draft = tempfile.mkdtemp(dir=fmu.parent)
        fmpy.extract(str(fmu), draft)
        with contextlib.suppress(OSError):  # another process has unpacked it meanwhile
            Path(draft).rename(folder)
    return str(folder)


class Instance:
    """One instance. After a refused call it is left alone for good, as FMI demands after fmi2Fatal."""

    def __init__(self, fmu: Path, name: str = "instance") -> None:
        self.description = description_of(fmu)
        self.variables = {v.name: v for v in self.description.modelVariables}
        self.log: list[str] = []
        self.dead = False
        self._callbacks = fmi2.fmi2CallbackFunctions()
        self._callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(self._listen)
        self._callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
        self._callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free)
        self.fmu = fmi2.FMU2Slave(
            guid=self.description.guid,
            modelIdentifier=self.description.coSimulation.modelIdentifier,
            unzipDirectory=extracted(fmu),
            instanceName=name,
        )
        self.fmu.instantiate(callbacks=self._callbacks, loggingOn=True)

    def _listen(self, _: Any, name: bytes, status: int, category: bytes, message: bytes) -> None:
        self.log.append(message.decode())

    def __enter__(self) -> Instance:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self.dead:
            self.fmu.freeInstance()
        else:
            GRAVEYARD.append(self)

    def call(self, function: str, *arguments: Any) -> Any:
        try:
            return getattr(self.fmu, function)(*arguments)
        except FMICallException:
            self.dead = True
            raise

    # -- by name ------------------------------------------------------------------------------

    def names(self, causality: str) -> list[str]:
        return [name for name, v in self.variables.items() if v.causality == causality]

    def set(self, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            variable = self.variables[name]
            self.call(SETTERS[variable.type], [variable.valueReference], [value])

    def get(self, names: Iterable[str]) -> list[Any]:
        variables = [self.variables[name] for name in names]
        return [self.call(GETTERS[v.type], [v.valueReference])[0] for v in variables]

    def outputs(self) -> dict[str, float]:
        names = self.names("output")
        references = [self.variables[name].valueReference for name in names]
        return dict(zip(names, self.call("getReal", references), strict=True))

    # -- phases -------------------------------------------------------------------------------

    def begin(self, values: Mapping[str, Any] | None = None, start_time: float = 0.0) -> Instance:
        """Into initialization mode, `values` set."""
        self.call("setupExperiment", None, start_time)
        self.call("enterInitializationMode")
        self.set(values or {})
        return self

    def initialize(self, values: Mapping[str, Any] | None = None, start_time: float = 0.0) -> Instance:
        self.begin(values, start_time)
        self.call("exitInitializationMode")
        return self

    def step(self, t: float, h: float, inputs: Mapping[str, float] | None = None) -> dict[str, float]:
        """Inputs at `t`, held; outputs at `t + h`."""
        if inputs:
            references = [self.variables[name].valueReference for name in inputs]
            self.call("setReal", references, list(inputs.values()))
        self.call("doStep", t, h)
        return self.outputs()

    # -- state --------------------------------------------------------------------------------

    def serialized(self) -> bytes:
        """The FMU state as bytes."""
        state = self.call("getFMUstate")
        data = self.call("serializeFMUstate", state)
        self.call("freeFMUstate", state)
        return bytes(data)

    def restore(self, data: bytes) -> None:
        """Go to a state given as bytes."""
        state = self.call("deSerializeFMUstate", data)
        self.call("setFMUstate", state)
        self.call("freeFMUstate", state)


def refused(fmu: Path, values: dict[str, Any], call: Any) -> str:
    """Make a call that must fail, and return the message of the FMU. The instance is unusable afterwards."""
    with Instance(fmu) as instance:
        instance.begin(values)
        with pytest.raises(FMICallException) as caught:
            call(instance)
        assert caught.value.status in (3, 4)  # Error or Fatal, never a Discard that hosts swallow
        assert instance.log, "no reason given"
        return instance.log[-1]
