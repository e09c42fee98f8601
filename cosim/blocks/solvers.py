"""Solvers for model exchange: CVODE from FMPy and solve_ivp from scipy."""

from __future__ import annotations

import ctypes
import math
import os
from typing import Any, Literal

DISCARD = 2
DOUBLES = ctypes.POINTER(ctypes.c_double)
Solver = Literal["cvode", "solve_ivp"]
TOO_MUCH_WORK, NO_STEP, TOO_CLOSE = -1, -3, -27
REFUSALS = 10  # discarded derivatives that explain a stuck solver
FAILURES = {  # CVODE's error codes with remedies
    TOO_MUCH_WORK: "CVODE does not come to the next communication point in 500 steps of its own: shorten the step, or "
    "see whether a state grows without bound",
    -2: "CVODE cannot reach the tolerance, as doubles are not that exact; loosen it",
    NO_STEP: "CVODE finds no step so short that its error is within the tolerance; a derivative jumps, or has no bound",
    -4: "CVODE finds no step so short that its iteration converges; a derivative jumps, or has no bound",
    TOO_CLOSE: "CVODE is to integrate over less time than doubles tell apart",
}


def solver(name: Solver | None, fmu: Any, **settings: Any) -> Any:
    """Return the named solver; by default CVODE, else solve_ivp.

    solve_ivp replaces CVODE on platforms for which FMPy has none.
    """
    if name == "solve_ivp":
        return SolveIvp(fmu, **settings)
    try:
        return cvode(fmu, **settings)
    except (ImportError, OSError, FileNotFoundError):
        if name == "cvode":
            raise
        return SolveIvp(fmu, **settings)


class Held:
    """Inputs in the form of FMPy's solver, held over a communication step."""

    def apply(self, time: float) -> None:
        """Do nothing."""


class SolverFailed(Exception):
    """A failure to reach the target time.

    Attributes:
        derivative: Index and value of a non-finite derivative, if any.
    """

    def __init__(self, reason: str, derivative: tuple[int, float] | None = None) -> None:
        super().__init__(reason)
        self.derivative = derivative


def cvode(fmu: Any, *, states: int, indicators: int, start: float, longest: float, tolerance: float) -> Any:
    """Return FMPy's CVODE for an FMU.

    Failed FMU calls are stored in `failed`, because exceptions cannot pass through C.
    """
    from fmpy.fmi1 import FMICallException
    from fmpy.sundials import CVodeSolver
    from fmpy.sundials.nvector_serial import NV_DATA_S

    class Guarded(CVodeSolver):  # type: ignore[misc]
        failed: Exception | None = None
        refused: list[Exception]  # errors of this step for which CVODE tries shorter steps

        def f(self, t: float, y: Any, ydot: Any, *rest: Any) -> int:
            answer = self._caught(super().f, (t, y, ydot, *rest))
            if answer == 0 and states and (found := _not_finite(NV_DATA_S(ydot)[:states])) is not None:
                self.refused.append(SolverFailed("", found))
                return 1
            return answer

        def g(self, *arguments: Any) -> int:
            return self._caught(super().g, arguments)

        def step(self, t: float, target: float) -> Any:
            self.failed, self.refused = None, []
            try:
                return super().step(t, target)
            except RuntimeError:
                if self.failed is not None:
                    raise self.failed from None
                if len(self.refused) >= REFUSALS:
                    raise self.refused[-1] from None
                raise SolverFailed(_failure(self.error_info)) from None

        def _caught(self, function: Any, arguments: Any) -> int:
            try:
                return int(function(*arguments))
            except FMICallException as error:
                if error.status == DISCARD:
                    self.refused.append(error)
                    return 1
                self.failed = error
            return -1

    made = Guarded(
        nx=states,
        nz=indicators,
        get_x=fmu.getContinuousStates,
        set_x=fmu.setContinuousStates,
        get_dx=derivatives_of(fmu),
        get_z=fmu.getEventIndicators,
        get_nominals=lambda where, count: nominals(fmu, where, count),
        set_time=fmu.setTime,
        input=Held(),
        startTime=start,
        maxStep=longest,
        relativeTolerance=tolerance,
    )
    _silence(made)
    return made


def _silence(made: Any) -> None:
    """Silence CVODE's own messages; `_failure` reports them."""
    from fmpy.sundials.libraries import sundials_core

    logger = ctypes.c_void_p()
    if sundials_core.SUNContext_GetLogger(made.sunctx, ctypes.byref(logger)) == 0 and logger:
        for name in ("SUNLogger_SetErrorFilename", "SUNLogger_SetWarningFilename"):
            getattr(sundials_core, name)(logger, os.devnull.encode())


def _failure(said: tuple[int, str, str, str] | None) -> str:
    """Return CVODE's reason without source locations."""
    if said is None:
        return "CVODE failed"
    code, _, _, message = said
    return FAILURES.get(code, f"CVODE failed (code {code}): {' '.join(message.split())}")


def _not_finite(values: Any) -> tuple[int, float] | None:
    """Return index and value of the first non-finite number."""
    if math.isfinite(sum(values)):
        return None
    return next(((k, v) for k, v in enumerate(values) if not math.isfinite(v)), None)


def derivatives_of(fmu: Any) -> Any:
    """Return the FMU's derivative function of any FMI version."""
    return getattr(fmu, "getContinuousStateDerivatives", None) or fmu.getDerivatives


def nominals(fmu: Any, where: Any, count: int) -> None:
    """Write positive nominal values of the states; 1 if unknown."""
    named = getattr(fmu, "getNominalsOfContinuousStates", None) or fmu.getNominalContinuousStates  # FMI 1.0
    named(where, count)
    values = ctypes.cast(where, DOUBLES)
    for k in range(count):
        values[k] = abs(values[k]) if math.isfinite(values[k]) and values[k] else 1.0


class SolveIvp:
    """scipy's solve_ivp (Radau) in the form of FMPy's solver."""

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
            nominals(self.fmu, self._at(self._nominal), self.states)

    def step(self, t: float, target: float) -> tuple[bool, None, float]:
        """Integrate to the target, or just beyond the first state event."""
        if self.states:
            self.fmu.getContinuousStates(self._at(self._x), self.states)
        self.discarded, self.derivative = None, None
        found = self._solved(t, target)
        if found.status == 0:
            self._set(target, found.y[:, -1])
            return False, None, target
        time = self._behind(t, float(found.t[-1]), target, found.sol)
        self._set(time, found.sol(time))
        return True, None, time

    def _solved(self, t: float, target: float) -> Any:
        import numpy as np
        from scipy.integrate import solve_ivp

        try:
            with np.errstate(all="ignore"):  # Non-finite derivatives only shorten the steps.
                found = solve_ivp(
                    self._right,
                    (t, target),
                    list(self._x) if self.states else [0.0],
                    method="Radau",
                    rtol=self.tolerance,
                    atol=[self.tolerance * abs(n) for n in self._nominal],
                    max_step=self.longest,
                    events=[self._indicator(k) for k in range(self.indicators)] or None,
                    dense_output=self.indicators > 0,
                )
            if found.status >= 0:
                return found
            reason = FAILURES[NO_STEP].replace("CVODE", "solve_ivp")
        except ValueError as error:  # from a non-finite matrix
            reason = f"solve_ivp: {error}"
        if self.discarded is not None:
            raise self.discarded
        raise SolverFailed(reason, self.derivative)

    def _behind(self, begin: float, time: float, target: float, solution: Any) -> float:
        """Return a time just after a zero crossing. The located root itself may lie before the crossing."""
        before = self._signs(begin, solution(begin))
        ahead = max(1e-12, 4e-16 * abs(time))
        while time + ahead < target and self._signs(time + ahead, solution(time + ahead)) == before:
            ahead *= 2.0
        return min(time + ahead, target)

    def _signs(self, t: float, x: Any) -> list[bool]:
        self._set(t, x)
        self.fmu.getEventIndicators(self._at(self._z), self.indicators)
        return [z > 0 for z in self._z]

    def _set(self, t: float, x: Any) -> None:
        self.fmu.setTime(t)
        if self.states:
            self._x[:] = [float(v) for v in x]
            self.fmu.setContinuousStates(self._at(self._x), self.states)

    def _right(self, t: float, x: Any) -> list[float]:
        """Return the derivatives; NaN if the FMU discards. Radau then tries a shorter step."""
        from fmpy.fmi1 import FMICallException

        try:
            self._set(t, x)
            if self.states:
                self._derivatives(self._at(self._dx), self.states)
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
            self.fmu.getEventIndicators(self._at(self._z), self.indicators)
            return self._z[k]

        value.terminal = True  # type: ignore[attr-defined]
        return value

    @staticmethod
    def _at(values: Any) -> Any:
        return ctypes.cast(values, DOUBLES)
