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

from cosim.blocks.instance import DISCARD
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler, load_library

NO_STEP_WITHIN_TOLERANCE = (
    "{solver} cannot keep the tolerance even with its shortest step; a derivative jumps, or is unbounded"
)
TOO_MANY_SOLVER_STEPS = (
    "{solver} does not reach the next communication point in {count} steps of its own. Allow more (max_steps), "
    "shorten the step{other}, or check whether a state grows without bound"
)

DOUBLES = ctypes.POINTER(ctypes.c_double)
Solver = Literal["cvode", "solve_ivp"]
REFUSALS = 10  # discarded derivatives that explain a stuck solver
MAX_CVODE_STEPS = 500  # of CVODE between communication points and events, as in FMPy
NORMAL, TOO_MUCH_WORK, ROOT_RETURN = 1, -1, 2  # task and return values of CVODE
NO_STEP_CODE = -3  # CVODE's code for an error above the tolerance even in the shortest step
CVODE_STUCK = NO_STEP_WITHIN_TOLERANCE.format(solver="CVODE")


def solver(name: Solver | None, fmu: Any, symbol: Callable[[str], str], **settings: Any) -> Any:
    """Return the named solver; without a name, CVODE, or solve_ivp on platforms for which FMPy has no CVODE.

    Both have the same interface:

    step(t, target): Integrate from t [s] towards the target; return True if a state event occurred, the direction in
        which each indicator crossed zero (0 for none), and the time reached, which is just after an event. CVODE
        returns at the target, at an event, or after one step (after `reset`, or if `single_steps` is set); solve_ivp
        returns after each accepted step.
    reset(t, longest): Restart from the states of the FMU; no step is longer than `longest` [s] until the next reset.
    is_first: True if the next step is the first one after a reset.
    last_step: Length of the last accepted step [s].

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
    """Compiled derivatives of an FMU (`rates.c`), and errors since `begin` that made them unusable for CVODE."""

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
        ("start", ctypes.c_double),
    )

    @classmethod
    def of(cls, fmu: Any, states: int, data: int, start: float, symbol: Callable[[str], str]) -> CompiledRates | None:
        """Return the derivatives of an FMU as compiled code; None if there are no states or no compiler.

        Args:
            data: Offset, in CVODE's vector structure, of the pointer to its numbers.
            symbol: Name of an FMI function → its name in the library.
        """
        try:
            if not states:
                return None
            rates_function()
        except (NoCompiler, CompilerFailed):
            return None
        derivatives = derivatives_of(fmu).__name__
        names = "SetTime", "SetContinuousStates", f"{derivatives[0].upper()}{derivatives[1:]}"
        functions = (ctypes.cast(getattr(fmu.dll, symbol(name)), ctypes.c_void_p) for name in names)
        instance = ctypes.cast(fmu.component, ctypes.c_void_p)
        rates = cls(instance, (ctypes.c_void_p * 3)(*(f.value for f in functions)), states, data, start=start)
        version = next(number for number in "123" if hasattr(fmu, f"fmi{number}SetTime"))
        rates.names = [f"fmi{version}{name}" for name in names]
        return rates


@cache
def rates_function() -> Any:
    """Return the compiled function for derivatives; raise NoCompiler or CompilerFailed if it cannot be compiled."""
    return load_library(Path(__file__).with_name("rates.c").read_text(encoding="utf-8")).rates


def cvode(
    fmu: Any,
    *,
    states: int,
    indicators: int,
    start: float,
    longest: float,
    tolerance: float,
    single_steps: bool = False,
    max_steps: int | None = None,
    symbol: Callable[[str], str],
) -> Any:
    """Return FMPy's CVODE for an FMU. With a compiler, C code calls the derivatives.

    CVODE's time counts from the start of the run, because CVODE locates events within 100 roundings of its time. Failed
    FMU calls are stored in `failed`, because exceptions cannot pass through C.

    Args:
        single_steps: Return from `step` after each step of the solver.
        max_steps: Largest number of steps between communication points and events.
        symbol: Name of an FMI function → its name in the library, for calls from C.
    """
    from fmpy.fmi1 import FMICallException
    from fmpy.sundials import NV_DATA_S, CVodeSolver
    from fmpy.sundials.libraries import sundials_core as core
    from fmpy.sundials.libraries import sundials_cvode as library
    from fmpy.sundials.nvector_serial import _N_VectorContent_Serial

    compiled = CompiledRates.of(fmu, states, _N_VectorContent_Serial.data.offset, start, symbol)
    most = MAX_CVODE_STEPS if max_steps is None else max_steps

    class Guarded(CVodeSolver):  # type: ignore[misc]
        is_first, goal, steps = True, math.nan, 0  # first step after a reset; last target; single steps to it
        failed: Exception | None = None
        refusals: list[Exception]  # errors in this step because of which CVODE tries shorter steps

        def f(self, t: float, y: Any, ydot: Any, rest: Any) -> int:
            """Store the derivatives at a point; a derivative that is not finite requests a shorter step."""
            try:
                super().f(t, y, ydot, rest)
            except FMICallException as error:
                return self._refuse(error)
            if (derivative := _not_finite(NV_DATA_S(ydot)[: self.nx])) is not None:
                self.refusals.append(SolverFailed(CVODE_STUCK, derivative))
                return 1
            return 0

        def g(self, *arguments: Any) -> int:
            try:
                return int(super().g(*arguments))
            except FMICallException as error:
                return self._refuse(error)

        def step(self, t: float, target: float) -> tuple[bool, list[int], float]:
            """Integrate towards the target.

            For single steps, CVODE is allowed one step per call and reports too much work, which leaves the steps
            unchanged. If a step has passed the last target, the next call returns at the end of that step.
            """
            is_single = single_steps or (self.is_first and indicators > 0)
            goal, since = target, target - start
            current = self._number("CVodeGetCurrentTime")
            if is_single and t < start + current < target:
                goal, since = start + current, current
            if target != self.goal:
                self.goal, self.steps = target, 0
                self.failed, self.refusals = None, []
                if compiled is not None:
                    compiled.refusals = 0
            library.CVodeSetMaxNumSteps(self.memory, ctypes.c_long(1 if is_single else most - self.steps))
            if states:
                self.get_x(self.px, self.nx)
            time = ctypes.c_double()
            flag = library.CVode(self.memory, ctypes.c_double(since), self.x, ctypes.byref(time), NORMAL)
            if states:
                self.set_x(self.px, self.nx)
            self.steps += is_single
            if flag < 0 and not (flag == TOO_MUCH_WORK and is_single and self.steps < most):
                self._raise()
            self.is_first = False
            roots = (ctypes.c_int * indicators)()
            if flag == ROOT_RETURN:
                library.CVodeGetRootInfo(self.memory, roots)
            reached = goal if time.value == since else min(start + time.value, goal)
            return flag == ROOT_RETURN, list(roots), reached

        def reset(self, time: float, shorter: float | None = None) -> None:
            super().reset(time - start)
            self.is_first, self.goal = True, math.nan
            library.CVodeSetInitStep(self.memory, ctypes.c_double(shorter or 0.0))
            library.CVodeSetMaxStep(self.memory, ctypes.c_double(shorter or longest))

        def __del__(self) -> None:
            super().__del__()
            core.SUNContext_Free(ctypes.byref(self.sunctx))  # otherwise its log stays open

        @property
        def last_step(self) -> float:
            return self._number("CVodeGetLastStep")

        @property
        def memory(self) -> ctypes.c_void_p:
            return ctypes.c_void_p(self.cvode_mem)

        def _number(self, function: str) -> float:
            number = ctypes.c_double()
            getattr(library, function)(self.memory, ctypes.byref(number))
            return number.value

        def _raise(self) -> None:
            """Raise the error because of which CVODE did not reach the target."""
            if compiled is not None and compiled.refusals:
                error: Exception = SolverFailed(CVODE_STUCK, (compiled.place, compiled.rate))
                if compiled.status:
                    error = FMICallException(function=compiled.names[compiled.call], status=compiled.status)
                if compiled.status not in (0, DISCARD):
                    raise error
                self.refusals += [error] * compiled.refusals
            if self.failed is not None:
                raise self.failed
            if len(self.refusals) >= REFUSALS:
                raise self.refusals[-1]
            if self.error_info is None:
                raise SolverFailed("CVODE failed")
            number, _, _, text = self.error_info
            details = f"CVODE failed (code {number}): {' '.join(text.split())}"
            reason = CVODE_STUCK if number == NO_STEP_CODE else details
            if number == TOO_MUCH_WORK:
                other = ", or use solver: solve_ivp"
                reason = TOO_MANY_SOLVER_STEPS.format(solver="CVODE", count=most, other=other)
            raise SolverFailed(reason)

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
        set_time=lambda since: fmu.setTime(start + since),
        input=SimpleNamespace(apply=lambda time: None),  # Inputs are constant over a communication step.
        startTime=0.0,
        maxStep=longest,
        relativeTolerance=tolerance,
    )
    if compiled is not None:
        integrator.compiled = compiled  # kept as long as the solver exists
        library.CVodeSetUserData(integrator.memory, ctypes.c_void_p(ctypes.addressof(compiled)))
    # CVODE prints nothing itself; `_raise` reports its errors.
    logger = ctypes.c_void_p()
    if core.SUNContext_GetLogger(integrator.sunctx, ctypes.byref(logger)) == 0 and logger:
        for name in ("SUNLogger_SetErrorFilename", "SUNLogger_SetWarningFilename"):
            getattr(core, name)(logger, os.devnull.encode())
    return integrator


def _not_finite(values: Any) -> tuple[int, float] | None:
    """Return index and value of the first non-finite number."""
    if math.isfinite(sum(values)):
        return None
    return next(((k, v) for k, v in enumerate(values) if not math.isfinite(v)), None)


def derivatives_of(fmu: Any) -> Any:
    """Return FMPy's method that computes derivatives, for any version of FMI."""
    return getattr(fmu, "getContinuousStateDerivatives", None) or fmu.getDerivatives


def nominals(fmu: Any, cells: Any, count: int) -> None:
    """Write the nominal values of the FMU's states, as positive numbers, into `cells`; unknown values become 1."""
    function = getattr(fmu, "getNominalsOfContinuousStates", None) or fmu.getNominalContinuousStates  # FMI 1.0
    function(cells, count)
    values = ctypes.cast(cells, DOUBLES)
    for k in range(count):
        values[k] = abs(values[k]) if math.isfinite(values[k]) and values[k] else 1.0


def numbers(function: Any, count: int) -> list[float]:
    """Return the `count` numbers that a function of the FMU writes into an array."""
    cells = (ctypes.c_double * count)()
    if count:
        function(ctypes.cast(cells, DOUBLES), count)
    return list(cells)


class SolveIvp:
    """The method Radau of scipy's solve_ivp, called for single steps."""

    def __init__(
        self,
        fmu: Any,
        *,
        states: int,
        indicators: int,
        start: float,
        longest: float,
        tolerance: float,
        single_steps: bool = True,
        max_steps: int | None = None,
    ) -> None:
        self.fmu, self.states, self.indicators = fmu, states, indicators
        self.whole, self.tolerance, self.max_steps = longest, tolerance, max_steps
        self.discarded: Exception | None = None
        self.derivative: tuple[int, float] | None = None
        self.last_step = 0.0
        self.reset(start)

    def reset(self, time: float, longest: float | None = None) -> None:
        """Restart at a time [s], and read the nominal values again."""
        self._radau: Any = None
        self.is_first = True
        self._first_step, self._longest = longest, longest or self.whole
        self._nominal = numbers(partial(nominals, self.fmu), self.states) or [1.0]

    def step(self, t: float, target: float) -> tuple[bool, list[int], float]:
        """Integrate by one step towards the target, or just beyond the first state event."""
        import numpy as np

        self.discarded, self.derivative = None, None
        with np.errstate(all="ignore"):  # non-finite derivatives only shorten the steps
            try:
                if self._radau is None or self._radau.t_bound != target:
                    from scipy.integrate import Radau

                    x = numbers(self.fmu.getContinuousStates, self.states) or [0.0]
                    scale = [self.tolerance * abs(n) for n in self._nominal]
                    settings = {"rtol": self.tolerance, "atol": scale, "max_step": self._longest}
                    first = None if self._first_step is None else min(self._first_step, target - t)
                    self._radau, self._steps = Radau(self._rates, t, x, target, first_step=first, **settings), 0
                radau = self._radau
                before = self._signs(t, radau.y)
                radau.step()
            except ValueError as error:  # a matrix is not finite
                raise self.discarded or SolverFailed(f"solve_ivp: {error!s}") from None
            if radau.status == "failed":
                reason = NO_STEP_WITHIN_TOLERANCE.format(solver="solve_ivp")
                raise self.discarded or SolverFailed(reason, self.derivative)
        self._steps += 1
        self.is_first, self.last_step = False, radau.t - t
        if self._signs(radau.t, radau.y) != before:
            end, solution = radau.t, radau.dense_output()
            while t < (middle := 0.5 * (t + end)) < end:  # bisection for the first time with changed signs
                if self._signs(middle, solution(middle)) == before:
                    t = middle
                else:
                    end = middle
            after = self._signs(end, solution(end))
            return True, [new - old for old, new in zip(before, after, strict=True)], float(end)
        if radau.status == "running" and self._steps == self.max_steps:
            raise SolverFailed(TOO_MANY_SOLVER_STEPS.format(solver="solve_ivp", count=self._steps, other=""))
        self._set(radau.t, radau.y)
        return False, [0] * self.indicators, float(radau.t)

    def _signs(self, t: float, x: Any) -> list[bool]:
        """Return for each event indicator whether it is positive; set time and states of the FMU to the point."""
        self._set(t, x)
        return [z > 0 for z in numbers(self.fmu.getEventIndicators, self.indicators)]

    def _set(self, t: float, x: Any) -> None:
        self.fmu.setTime(t)
        if self.states:
            cells = (ctypes.c_double * self.states)(*map(float, x))
            self.fmu.setContinuousStates(ctypes.cast(cells, DOUBLES), self.states)

    def _rates(self, t: float, x: Any) -> list[float]:
        """Return the derivatives; NaN if the FMU discards the call, so that Radau tries a shorter step."""
        from fmpy.fmi1 import FMICallException

        try:
            self._set(t, x)
            rates = numbers(derivatives_of(self.fmu), self.states) or [0.0]
        except FMICallException as error:
            if error.status != DISCARD:
                raise
            self.discarded = error
            return [math.nan] * max(1, self.states)
        self.discarded, self.derivative = None, _not_finite(rates)
        return rates
