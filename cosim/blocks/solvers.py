"""Solvers for model exchange: CVODE from FMPy and solve_ivp from scipy."""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

from cosim.base.messages import Message
from cosim.blocks import messages
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler, load_library

DISCARD = 2
DOUBLES = ctypes.POINTER(ctypes.c_double)
Solver = Literal["cvode", "solve_ivp"]
REFUSALS = 10  # discarded derivatives that explain a stuck solver
FAILURES = {  # CVODE's error codes with remedies
    -1: messages.TOO_MANY_SOLVER_STEPS(),
    -2: messages.TOLERANCE_TOO_TIGHT(),
    -3: messages.NO_STEP_WITHIN_TOLERANCE(solver="CVODE"),
    -4: messages.NO_CONVERGENT_STEP(),
    -27: messages.SPAN_TOO_SHORT(),
}


def solver(name: Solver | None, fmu: Any, symbol: Callable[[str], str] | None = None, **settings: Any) -> Any:
    """Return the named solver; by default CVODE, else solve_ivp.

    solve_ivp replaces CVODE on platforms for which FMPy has none.

    Args:
        symbol: Name of an FMI function → its name in the library, for calls from C.
    """
    if name != "solve_ivp":
        try:
            return cvode(fmu, symbol=symbol, **settings)
        except (ImportError, OSError):
            if name == "cvode":
                raise
    return SolveIvp(fmu, **settings)


class SolverFailed(Exception):
    """Error: the solver could not reach the target time.

    Attributes:
        derivative: Index and value of a derivative that is not finite; None if all were finite.
    """

    def __init__(self, reason: str, derivative: tuple[int, float] | None = None) -> None:
        super().__init__(reason)
        self.reason, self.derivative = reason, derivative


class CompiledRates(ctypes.Structure):
    """Derivatives of an FMU by `rates.c`, and what CVODE could not use since `begin`."""

    names: list[str]
    _fields_ = (
        ("instance", ctypes.c_void_p),
        ("functions", ctypes.c_void_p * 3),
        ("states", ctypes.c_size_t),
        ("data", ctypes.c_size_t),
        ("refusals", ctypes.c_int),
        ("call", ctypes.c_int),
        ("status", ctypes.c_int),
        ("place", ctypes.c_ssize_t),
        ("rate", ctypes.c_double),
    )

    @classmethod
    def of(cls, fmu: Any, states: int, data: int, symbol: Callable[[str], str] | None) -> CompiledRates | None:
        """Return the derivatives of an FMU; None without states or compiler, or if its calls are logged.

        Args:
            data: Offset of the pointer to the numbers within the content of a vector.
            symbol: Name of an FMI function → its name in the library; None for a library that is not loaded by FMPy.
        """
        if not states or symbol is None or getattr(fmu, "fmiCallLogger", None) is not None:
            return None
        try:
            rates_function()
        except (NoCompiler, CompilerFailed):
            return None
        derivatives = derivatives_of(fmu).__name__
        names = "SetTime", "SetContinuousStates", f"{derivatives[0].upper()}{derivatives[1:]}"
        functions = (ctypes.cast(getattr(fmu.dll, symbol(name)), ctypes.c_void_p) for name in names)
        instance = ctypes.cast(fmu.component, ctypes.c_void_p)
        rates = cls(instance, (ctypes.c_void_p * 3)(*(f.value for f in functions)), states, data)
        version = next(number for number in "123" if hasattr(fmu, f"fmi{number}SetTime"))
        rates.names = [f"fmi{version}{name}" for name in names]
        return rates

    def error(self) -> tuple[Exception | None, bool]:
        """Return the reason for which CVODE could not use the last point, if any, and whether a call failed."""
        from fmpy.fmi1 import FMICallException

        if not self.refusals:
            return None, False
        if self.status:
            return FMICallException(function=self.names[self.call], status=self.status), self.status != DISCARD
        return SolverFailed(FAILURES[-3], (self.place, self.rate)), False


@cache
def rates_function() -> Any:
    """Return the compiled derivatives; raise NoCompiler or CompilerFailed without a working compiler."""
    return load_library(Path(__file__).with_name("rates.c").read_text(encoding="utf-8")).rates


def cvode(
    fmu: Any,
    *,
    states: int,
    indicators: int,
    start: float,
    longest: float,
    tolerance: float,
    symbol: Callable[[str], str] | None = None,
) -> Any:
    """Return FMPy's CVODE for an FMU, whose derivatives C calls if there is a compiler.

    Failed FMU calls are stored in `failed`, because exceptions cannot pass through C.

    Args:
        symbol: Name of an FMI function → its name in the library, for calls from C.
    """
    from fmpy.fmi1 import FMICallException
    from fmpy.sundials import CVodeSolver
    from fmpy.sundials.nvector_serial import _N_VectorContent_Serial

    set_time, set_states, get_derivatives = fmu.setTime, fmu.setContinuousStates, derivatives_of(fmu)
    at, data = DOUBLES.from_address, _N_VectorContent_Serial.data.offset

    compiled = CompiledRates.of(fmu, states, data, symbol)

    class Guarded(CVodeSolver):  # type: ignore[misc]
        failed: Exception | None = None
        refusals: list[Exception]  # errors of this step for which CVODE tries shorter steps

        def f(self, t: float, y: Any, ydot: Any, rest: Any) -> int:
            """Store the derivatives at a point, as FMPy's own function does with more conversions."""
            try:
                if not states:
                    return int(super().f(t, y, ydot, rest))
                set_time(t)
                set_states(at(y.contents.content + data), states)
                derivatives = at(ydot.contents.content + data)
                get_derivatives(derivatives, states)
            except FMICallException as error:
                return self._refuse(error)
            if (derivative := _not_finite(derivatives[:states])) is not None:
                self.refusals.append(SolverFailed(FAILURES[-3], derivative))
                return 1
            return 0

        def g(self, *arguments: Any) -> int:
            try:
                return int(super().g(*arguments))
            except FMICallException as error:
                return self._refuse(error)

        def step(self, t: float, target: float) -> Any:
            self.failed, self.refusals = None, []
            if compiled is not None:
                compiled.refusals = 0
            try:
                return super().step(t, target)
            except RuntimeError:
                if compiled is not None:
                    self._take(compiled)
                if self.failed is not None:
                    raise self.failed from None
                if len(self.refusals) >= REFUSALS:
                    raise self.refusals[-1] from None
                raise SolverFailed(_failure(self.error_info)) from None

        def _take(self, rates: CompiledRates) -> None:
            """Store what the compiled derivatives met."""
            error, is_failure = rates.error()
            if is_failure:
                self.failed = error
            elif error is not None:
                self.refusals += [error] * rates.refusals

        def _refuse(self, error: FMICallException) -> int:
            if error.status == DISCARD:
                self.refusals.append(error)
                return 1
            self.failed = error
            return -1

    if compiled is not None:
        Guarded.f = ctypes.cast(rates_function(), ctypes.c_void_p).value  # type: ignore[assignment]
    integrator = Guarded(
        nx=states,
        nz=indicators,
        get_x=fmu.getContinuousStates,
        set_x=fmu.setContinuousStates,
        get_dx=derivatives_of(fmu),
        get_z=fmu.getEventIndicators,
        get_nominals=partial(nominals, fmu),
        set_time=fmu.setTime,
        input=SimpleNamespace(apply=lambda time: None),  # Inputs are constant over a communication step.
        startTime=start,
        maxStep=longest,
        relativeTolerance=tolerance,
    )
    if compiled is not None:
        integrator.compiled = compiled  # lives as long as the solver
        _set_user_data(integrator, compiled)
    _silence(integrator)
    return integrator


def _set_user_data(integrator: Any, data: ctypes.Structure) -> None:
    """Let CVODE pass a structure to the compiled derivatives."""
    from fmpy.sundials.libraries import sundials_cvode

    pointer = ctypes.c_void_p(ctypes.addressof(data))
    sundials_cvode.CVodeSetUserData(ctypes.c_void_p(integrator.cvode_mem), pointer)


def _silence(integrator: Any) -> None:
    """Suppress the messages that CVODE prints itself; `_failure` reports its errors."""
    from fmpy.sundials.libraries import sundials_core

    logger = ctypes.c_void_p()
    if sundials_core.SUNContext_GetLogger(integrator.sunctx, ctypes.byref(logger)) == 0 and logger:
        for name in ("SUNLogger_SetErrorFilename", "SUNLogger_SetWarningFilename"):
            getattr(sundials_core, name)(logger, os.devnull.encode())


def _failure(report: tuple[int, str, str, str] | None) -> Message:
    """Return CVODE's reason without source locations."""
    if report is None:
        return messages.CVODE_FAILED()
    number, _, _, text = report
    return FAILURES.get(number) or messages.CVODE_FAILED_WITH_REASON(number=number, reason=" ".join(text.split()))


def _not_finite(values: Any) -> tuple[int, float] | None:
    """Return index and value of the first non-finite number."""
    if math.isfinite(sum(values)):
        return None
    return next(((k, v) for k, v in enumerate(values) if not math.isfinite(v)), None)


def derivatives_of(fmu: Any) -> Any:
    """Return the FMU's derivative function of any FMI version."""
    return getattr(fmu, "getContinuousStateDerivatives", None) or fmu.getDerivatives


def nominals(fmu: Any, cells: Any, count: int) -> None:
    """Write the nominal values of the FMU's states into `cells`, as positive numbers; 1 if a value is unknown."""
    function = getattr(fmu, "getNominalsOfContinuousStates", None) or fmu.getNominalContinuousStates  # FMI 1.0
    function(cells, count)
    values = ctypes.cast(cells, DOUBLES)
    for k in range(count):
        values[k] = abs(values[k]) if math.isfinite(values[k]) and values[k] else 1.0


class SolveIvp:
    """The method Radau of scipy's solve_ivp, with the interface of FMPy's solvers."""

    def __init__(
        self, fmu: Any, *, states: int, indicators: int, start: float, longest: float, tolerance: float
    ) -> None:
        self.fmu, self.states, self.indicators = fmu, states, indicators
        self.longest, self.tolerance = longest, tolerance
        self._x, self._dx = (ctypes.c_double * max(1, states))(), (ctypes.c_double * max(1, states))()
        self._z = (ctypes.c_double * max(1, indicators))()
        self._derivatives = derivatives_of(fmu)
        self.discarded: Exception | None = None
        self.derivative: tuple[int, float] | None = None
        self.reset(start)

    def reset(self, time: float) -> None:
        """Reread nominal values after a change of states."""
        self._nominal = (ctypes.c_double * max(1, self.states))(1.0)
        if self.states:
            nominals(self.fmu, self._pointer(self._nominal), self.states)

    def step(self, t: float, target: float) -> tuple[bool, None, float]:
        """Integrate to the target, or just beyond the first state event."""
        if self.states:
            self.fmu.getContinuousStates(self._pointer(self._x), self.states)
        self.discarded, self.derivative = None, None
        solution = self._integrate(t, target)
        if solution.status == 0:
            self._set(target, solution.y[:, -1])
            return False, None, target
        time = self._time_after_crossing(t, float(solution.t[-1]), target, solution.sol)
        self._set(time, solution.sol(time))
        return True, None, time

    def _integrate(self, t: float, target: float) -> Any:
        import numpy as np
        from scipy.integrate import solve_ivp

        try:
            with np.errstate(all="ignore"):  # Non-finite derivatives only shorten the steps.
                solution = solve_ivp(
                    self._rates,
                    (t, target),
                    list(self._x) if self.states else [0.0],
                    method="Radau",
                    rtol=self.tolerance,
                    atol=[self.tolerance * abs(n) for n in self._nominal],
                    max_step=self.longest,
                    events=[self._indicator(k) for k in range(self.indicators)] or None,
                    dense_output=self.indicators > 0,
                )
            if solution.status >= 0:
                return solution
            reason = messages.NO_STEP_WITHIN_TOLERANCE(solver="solve_ivp")
        except ValueError as error:  # from a non-finite matrix
            reason = messages.SOLVE_IVP_FAILED(reason=str(error))
        if self.discarded is not None:
            raise self.discarded
        raise SolverFailed(reason, self.derivative)

    def _time_after_crossing(self, begin: float, time: float, target: float, solution: Any) -> float:
        """Return a time just after a zero crossing. The located root itself may lie before the crossing."""
        before = self._signs(begin, solution(begin))
        ahead = max(1e-12, 4e-16 * abs(time))
        while time + ahead < target and self._signs(time + ahead, solution(time + ahead)) == before:
            ahead *= 2.0
        return min(time + ahead, target)

    def _signs(self, t: float, x: Any) -> list[bool]:
        self._set(t, x)
        self.fmu.getEventIndicators(self._pointer(self._z), self.indicators)
        return [z > 0 for z in self._z]

    def _set(self, t: float, x: Any) -> None:
        self.fmu.setTime(t)
        if self.states:
            self._x[:] = [float(v) for v in x]
            self.fmu.setContinuousStates(self._pointer(self._x), self.states)

    def _rates(self, t: float, x: Any) -> list[float]:
        """Return the derivatives; NaN if the FMU discards. Radau then tries a shorter step."""
        from fmpy.fmi1 import FMICallException

        try:
            self._set(t, x)
            if self.states:
                self._derivatives(self._pointer(self._dx), self.states)
        except FMICallException as error:
            if error.status != DISCARD:
                raise
            self.discarded = error
            return [math.nan] * len(self._dx)
        self.discarded, self.derivative = None, _not_finite(self._dx)
        return list(self._dx)

    def _indicator(self, k: int) -> Any:
        def value(t: float, x: Any) -> float:
            self._set(t, x)
            self.fmu.getEventIndicators(self._pointer(self._z), self.indicators)
            return self._z[k]

        value.terminal = True  # type: ignore[attr-defined]
        return value

    @staticmethod
    def _pointer(values: Any) -> Any:
        return ctypes.cast(values, DOUBLES)
