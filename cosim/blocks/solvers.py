"""Solvers for model exchange: CVODE as FMPy brings it, and scipy's solve_ivp."""

from __future__ import annotations

import ctypes
from typing import Any, Literal

DISCARD = 2
DOUBLES = ctypes.POINTER(ctypes.c_double)
Solver = Literal["cvode", "solve_ivp"]


def solver(name: Solver | None, fmu: Any, **settings: Any) -> Any:
    """The solver of this name; without one CVODE, and solve_ivp where FMPy has no CVODE for this platform."""
    if name == "solve_ivp":
        return SolveIvp(fmu, **settings)
    try:
        return cvode(fmu, **settings)
    except (ImportError, OSError, FileNotFoundError):
        if name == "cvode":
            raise
        return SolveIvp(fmu, **settings)


class Held:
    """Inputs as FMPy's solver asks for them: they are held over a communication step."""

    def apply(self, time: float) -> None:
        """Nothing changes."""


def cvode(fmu: Any, *, states: int, indicators: int, start: float, longest: float, tolerance: float) -> Any:
    """FMPy's CVODE on an FMU, whose failing calls are kept as `failed`: no exception passes through C."""
    from fmpy.fmi1 import FMICallException
    from fmpy.sundials import CVodeSolver

    class Guarded(CVodeSolver):  # type: ignore[misc]
        failed: Exception | None = None

        def f(self, *arguments: Any) -> int:
            return self._caught(super().f, arguments)

        def g(self, *arguments: Any) -> int:
            return self._caught(super().g, arguments)

        def _caught(self, function: Any, arguments: Any) -> int:
            try:
                return int(function(*arguments))
            except FMICallException as error:
                if error.status == DISCARD:
                    return 1  # CVODE tries a shorter step
                self.failed = error
            return -1

    return Guarded(
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


def derivatives_of(fmu: Any) -> Any:
    """FMI 3.0 has a longer name for it."""
    return getattr(fmu, "getContinuousStateDerivatives", None) or fmu.getDerivatives


def nominals(fmu: Any, where: Any, count: int) -> None:
    """Nominal values of the states; 1 where the FMU knows none, for solvers need some."""
    fmu.getNominalsOfContinuousStates(where, count)
    values = ctypes.cast(where, DOUBLES)
    for k in range(count):
        if values[k] == 0.0:
            values[k] = 1.0


class SolveIvp:
    """scipy's solve_ivp (Radau) in the shape of FMPy's solver, where there is no CVODE or it is asked for."""

    failed: Exception | None = None

    def __init__(
        self, fmu: Any, *, states: int, indicators: int, start: float, longest: float, tolerance: float
    ) -> None:
        self.fmu, self.states, self.indicators = fmu, states, indicators
        self.longest, self.tolerance = longest, tolerance
        self._x, self._dx = (ctypes.c_double * max(1, states))(), (ctypes.c_double * max(1, states))()
        self._z = (ctypes.c_double * max(1, indicators))()
        self._derivatives = derivatives_of(fmu)
        self.reset(start)

    def reset(self, time: float) -> None:
        """States may have changed."""
        self._nominal = (ctypes.c_double * max(1, self.states))(1.0)
        if self.states:
            nominals(self.fmu, self._at(self._nominal), self.states)

    def step(self, t: float, target: float) -> tuple[bool, None, float]:
        """To the target, or to just behind the first event of state before it."""
        from scipy.integrate import solve_ivp

        if self.states:
            self.fmu.getContinuousStates(self._at(self._x), self.states)
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
        if found.status < 0:
            raise RuntimeError(f"solve_ivp: {found.message}")
        if found.status == 0:
            self._set(target, found.y[:, -1])
            return False, None, target
        time = self._behind(t, float(found.t[-1]), target, found.sol)
        self._set(time, found.sol(time))
        return True, None, time

    def _behind(self, begin: float, time: float, target: float, solution: Any) -> float:
        """A time at which the indicator that crosses zero has done so: the root itself may lie before."""
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
        self._set(t, x)
        if self.states:
            self._derivatives(self._at(self._dx), self.states)
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
