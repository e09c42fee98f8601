"""Native FMUs in the hands of a host of ours: model exchange by names, solvers driven from outside."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy import fmi2
from scipy.integrate import solve_ivp

from cosim.fmi.native.compiler import compiler
from tests.hosts_fmpy import description_of, extracted

NEEDS_COMPILER = pytest.mark.skipif(compiler() is None, reason="no C compiler")


class Exchange:
    """An FMU for model exchange, from its start to its end."""

    def __init__(self, fmu: Path, values: Mapping[str, Any], start: float = 0.0) -> None:
        self.description = description_of(fmu)
        self.log: list[str] = []
        self.place = {v.name: v.valueReference for v in self.description.modelVariables}
        listed = self.description.modelVariables
        self.inputs = [v.valueReference for v in listed if v.causality == "input"]
        self.outputs = [v.valueReference for v in listed if v.causality == "output"]
        self.states = len(self.description.derivatives)
        self._callbacks = fmi2.fmi2CallbackFunctions()
        self._callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(lambda *said: self.log.append(said[4].decode()))
        self._callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
        self._callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free)
        self.fmu = fmi2.FMU2Model(
            guid=self.description.guid,
            modelIdentifier=self.description.modelExchange.modelIdentifier,
            unzipDirectory=extracted(fmu),
            instanceName="exchange",
        )
        self.fmu.instantiate(callbacks=self._callbacks)
        self.fmu.setupExperiment(startTime=start)
        self.fmu.enterInitializationMode()
        for name, value in values.items():
            if isinstance(value, bool):
                self.fmu.setBoolean([self.place[name]], [value])
            else:
                self.fmu.setReal([self.place[name]], [value])

    def begin(self, inputs: Sequence[float] = ()) -> float | None:
        """Out of initialization; when the first event is due."""
        if len(inputs):
            self.fmu.setReal(self.inputs, list(inputs))
        self.fmu.exitInitializationMode()
        return self._events()

    def event(self, t: float, inputs: Sequence[float]) -> float | None:
        """Handle an event with a possible jump of inputs; return the time of the next event."""
        self.fmu.setTime(t)
        self.fmu.enterEventMode()
        self.fmu.setReal(self.inputs, list(inputs))
        return self._events()

    def _events(self) -> float | None:
        needed = True
        while needed:
            needed, _, _, _, due, when = self.fmu.newDiscreteStates()
        self.fmu.enterContinuousTimeMode()
        return float(when) if due else None

    @property
    def x(self) -> Any:
        x = np.zeros(self.states)
        self.fmu.getContinuousStates(x.ctypes.data_as(fmi2.POINTER(fmi2.fmi2Real)), x.size)
        return x

    @x.setter
    def x(self, x: Any) -> None:
        x = np.ascontiguousarray(x)
        self.fmu.setContinuousStates(x.ctypes.data_as(fmi2.POINTER(fmi2.fmi2Real)), x.size)

    def rates(self, t: float, x: Any) -> Any:
        """Return f(t, x) with the current inputs."""
        self.fmu.setTime(t)
        self.x = x
        dx = np.zeros(self.states)
        self.fmu.getDerivatives(dx.ctypes.data_as(fmi2.POINTER(fmi2.fmi2Real)), dx.size)
        return dx

    def indicators(self) -> Any:
        z = np.zeros(self.description.numberOfEventIndicators)
        self.fmu.getEventIndicators(z.ctypes.data_as(fmi2.POINTER(fmi2.fmi2Real)), z.size)
        return z

    def read(self, t: float, x: Any) -> list[float]:
        """The outputs at an instant."""
        self.fmu.setTime(t)
        self.x = x
        values: list[float] = self.fmu.getReal(self.outputs)
        return values

    def finish(self) -> None:
        """Terminated and freed."""
        self.fmu.terminate()
        self.fmu.freeInstance()


def is_subnormal(a: Any) -> Any:
    """Return True for subnormal values, neither zero nor normal numbers."""
    return (a != 0.0) & (np.abs(a) < np.finfo(float).tiny)


def rk4(f: Callable[[float, Any], Any], t: float, x: Any, h: float, substeps: int) -> Any:
    """The plant's own integration, driven from outside."""
    dt = h / substeps
    for k in range(substeps):
        now, half = t + k * dt, 0.5 * dt
        k1 = f(now, x)
        k2 = f(now + half, x + half * k1)
        k3 = f(now + half, x + half * k2)
        k4 = f(now + dt, x + dt * k3)
        x = x + dt / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    return x


def dop853(f: Callable[[float, Any], Any], t: float, x: Any, end: float) -> Any:
    """Return an integration far more accurate than the compared results."""
    return solve_ivp(f, (t, end), x, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
