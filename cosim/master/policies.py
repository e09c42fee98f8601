"""Step policies: how a system is stepped from one communication point to the next.

Steps may be equal, or controlled by an estimate of their coupling error; rows stay equidistant in any case. (Steps from
event to event are in `instants`.)

With error control, each interval between rows is divided into steps. A PI controller (K. Gustafsson, Control theoretic
techniques for stepsize selection in explicit Runge-Kutta methods, ACM Trans. Math. Softw. 17 (1991)) chooses the next
step h' from the errors ε, relative to the tolerance, of the last two steps:

    h' = h·0.9·ε^(−0.7/q)·ε_prev^(0.4/q),  ε ~ h^q

Estimators of ε, docs/coupling.md has their sources:

halving   Each step is made whole (y₁) and in two halves (y₂), and taken back if ε > 1:
          ε = max |y₁ − y₂| / ((2^p − 1)·τ·s),  q = p + 1, or this error per second, q = p
residual  Received inputs u against those of the step's course ũ: ε = max |u − ũ| / (τ·s),  q = p
energy    Power bonds of an effort e and a flow f: ε = max |e·f̃ − ẽ·f| / (τ·P),  q = p

If all FMUs can save and restore their state, the first step is tried with the greatest length and judged by halving. p
is the degree of the inputs' polynomials plus one; s and P are the largest magnitudes so far, or the nominal ones.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cosim.blocks.component import GET
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.stepping import NotCompiled, cores
from cosim.core.arrays import Array
from cosim.core.errors import CosimError, SimulationError
from cosim.core.times import STEP_COUNT_TOLERANCE
from cosim.master.c_loop import CompiledSteps
from cosim.master.checkpoint import NOT_RESTORED
from cosim.master.extrapolation import Polynomial
from cosim.master.initialization import is_settled
from cosim.system.control import Control
from cosim.system.wiring import Copies

if TYPE_CHECKING:
    from cosim.master.master import Master

SAFETY, PROPORTIONAL, INTEGRAL = 0.9, 0.4, 0.7  # factor of a step; exponents times q of the last and the present error
MIN_STEP_FACTOR, MAX_STEP_FACTOR = 0.2, 4.0  # change of a step
MUCH, MOST_NAMED = 0.01, 3  # allowed error of a step as a share of a signal that is named; number of names
TIMED, SLOW = 4, 50e-6  # first steps that are timed; shortest step [s] that is worth a thread, as in stepping.c
LEAST_ERROR = 1e-4  # smallest error that enters the controller
Judged = tuple[float, str]  # error of a step relative to the tolerance, and the signal that has it


class Active(NamedTuple):
    """A component's step with the copies around it.

    Attributes:
        copy: Copies before the step.
        step: Function of the start and the length of a step [s] that makes the step.
        every: Length of the component's step in communication steps.
        length: Length of the component's step [s]; 0.0 if it is the difference of communication points.
        late: Function that sets the known values of a point after the step, if any.
    """

    copy: Copies
    step: Callable[[float, float], None]
    every: int = 1
    length: float = 0.0
    late: Callable[[int], None] | None = None


Round = tuple[Active, ...]  # the last one only copies, at the end of the step


class Together:
    """Steps of components that do not need each other's outputs. If at least two steps are slow, they run in parallel.

    The first few steps run one after another, to measure their time.

    Args:
        in_threads: For each step, True if it may run in a thread.
    """

    def __init__(self, actives: Sequence[Active], in_threads: Sequence[bool]) -> None:
        self._actives, self._timed, self._pool = actives, 0, ThreadPoolExecutor(min(cores(), len(actives)))
        self._least = [math.inf if each else 0.0 for each in in_threads]  # shortest time [s] among the first steps
        self._others: list[int] = []  # steps that run in other threads than the caller's

    def copy(self, k: int) -> None:
        """Make the copies before all steps."""
        for active in self._actives:
            active.copy(k)

    def late(self, k: int) -> None:
        """Set the known values of a point after all steps."""
        for active in self._actives:
            if active.late is not None:
                active.late(k)

    def __call__(self, t: float, h: float) -> None:
        """Step all components by h [s]; raise the error of the first one that fails."""
        if self._timed < TIMED:
            for k, active in enumerate(self._actives):
                begin = time.perf_counter()
                active.step(t, active.length or h)
                self._least[k] = min(self._least[k], time.perf_counter() - begin)
            self._timed += 1
            if self._timed == TIMED:
                self._others = [k for k, least in enumerate(self._least) if least >= SLOW][1:]
            return
        others = self._others
        tasks = [self._pool.submit(self._actives[k].step, t, self._actives[k].length or h) for k in others]
        failed: dict[int, BaseException | None] = {}
        try:
            for k, active in enumerate(self._actives):
                if k not in others:
                    active.step(t, active.length or h)
        except CosimError as error:
            failed[k] = error
        finally:
            wait(tasks)
        failed |= {k: task.exception() for k, task in zip(others, tasks, strict=True)}
        for k in sorted(failed):
            if (first := failed[k]) is not None:
                raise first

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()


class Policy:
    """A step policy: how the system is stepped from one communication point to the next.

    Attributes:
        reason: Reason why the steps are made in Python and not in C.
    """

    reason = ""

    def advance_to(self, k: int) -> None:
        """Step the system from point k − 1 to point k."""
        raise NotImplementedError

    def finish(self) -> None:
        """Record warnings after the last step."""


class EqualSteps(Policy):
    """Equal communication steps."""

    def __init__(self, master: Master, reason: str) -> None:
        self.reason, stages = reason, master.system.stages
        self._period = math.lcm(*(stage.every for stage in stages), 1)
        self._round = cache(partial(master.round, stages))
        self._advance, self._begin, self._h = master.advance, master.system.start, master.h

    def advance_to(self, k: int) -> None:
        """Step each component that is due once."""
        begin, h = self._begin, self._h
        self._advance(self._round(k % self._period), k, begin + (k - 1) * h, begin + k * h)


class SavedPoint:
    """Saved states of FMUs and values of all signals, from which steps are repeated."""

    def __init__(self, master: Master, fmus: Sequence[FmuBlock]) -> None:
        self.master, self._signals, self._beside = master, master.values.copy(), list(master.beside)
        self.states = [(fmu, master.announce(fmu).save_state()) for fmu in fmus]

    def restore(self, *, keep: bool = False) -> None:
        """Restore states and signals; free the states unless `keep` is True."""
        for fmu, state in self.states:
            self.master.announce(fmu).restore_state(state, keep=keep)
        self.restore_signals()

    def restore_signals(self) -> None:
        """Restore the signals only."""
        self.master.values[:] = self._signals
        self.master.beside[:] = self._beside

    def check_outputs(self, t: float) -> None:
        """Raise SimulationError if the outputs of an FMU with a restored state differ from those when it was saved."""
        before = list(self.master.row)
        for fmu, _ in self.states:
            self.master.announce(fmu, GET).get()
            if not is_settled(before, self.master.row):
                raise SimulationError(fmu.name, t, NOT_RESTORED)
        self.restore_signals()


class ControlledSteps(Policy):
    """Steps that are controlled by an estimate of their error.

    Attributes:
        sizes: Lengths of accepted steps [s].
        made: Number of steps, including rejected steps and steps for comparison.
        worst: Largest error of an accepted step.
        failed: Time, error and signal of accepted steps with an error above the tolerance. `missed` contains those that
            could not be shortened.
    """

    reason = "steps are controlled"

    def __init__(self, master: Master, control: Control) -> None:
        self.master, self.control, system = master, control, master.system
        stages = [stage for stage in system.stages if stage.component.name not in control.at_rows]
        self._at_rows = [stage for stage in system.stages if stage.component.name in control.at_rows]
        self._names = [stage.component.name for stage in stages]
        self._advance: Callable[[int, float, float], None]
        try:  # steps of any length, in C if possible
            self._advance = CompiledSteps(master, stages).advance
        except NotCompiled:
            self._advance = partial(master.advance, master.round(stages, 1, nominal=False))
        self.fmus = [s.component for s in stages if isinstance(s.component, FmuBlock)]
        held = (t for t in system.held if t.name.partition(".")[0] in self._names)
        received = {t.target: t.source for t in held if not any(t.beside)}
        self.received, self.sources = {target: k for k, target in enumerate(received)}, list(received.values())
        self.signals, self.outputs = master.values, [*control.outputs]
        self.past = Polynomial(system.courses[0])
        self.scale, self.power = np.array(control.nominal), [b.nominal for b in control.bonds]
        self.largest = np.zeros(len(control.nominal))  # magnitude of each judged signal
        self.p = 1 + min(system.courses)
        self.q = self.p + (control.estimator == "halving" and not control.is_per_second)
        self.wish = control.longest if control.rolls_back else control.shortest
        self.before, self._is_checked = 1.0, False
        self.sizes: list[float] = []
        self.made, self.rejected, self.worst = 0, 0, 0.0
        self.failed: list[tuple[float, float, str]] = []
        self.missed: list[tuple[float, float, str]] = []

    def advance_to(self, k: int) -> None:
        """Make the steps between two rows; then step the components that step only at rows."""
        master = self.master
        begin, end = (master.system.start + j * master.h for j in (k - 1, k))
        t = begin
        while t < end:
            until, is_shortest = self._next(t, end)
            self.past.add(t, self.signals[self.sources])
            # The first step has no earlier inputs with which extrapolated ones could be compared.
            if self.control.estimator == "halving" or (self.control.rolls_back and not self.sizes):
                error, name = self._halve(k, t, until, final=is_shortest)
                if math.isnan(error):  # the step was rejected
                    continue
            else:
                self._step(k, t, until)
                error, name = self._judge_inputs(until)
            self._accept(t, until - t, error, name, final=is_shortest)
            t = until
        at_row = master.round(self._at_rows, k, self._names, nominal=False)
        if len(at_row) > 1:
            master.advance(at_row, k, begin, end)

    def finish(self) -> None:
        """Record warnings: steps above the tolerance, signals far below nominal, estimators without signals."""
        notes, control, tolerance = self.master.notes, self.control, self.control.tolerance
        if steps := self.missed or self.failed:
            t, error, signal = steps[0]
            cure = f"min below {control.shortest:g} s" if self.missed else f"max below {control.longest:g} s"
            notes.append(
                f"the error of {len(steps)} steps is above the tolerance {tolerance:g}: first at t = {t:.6g} s, "
                f"{error * tolerance:.2g} of {signal}; the largest is {self.worst * tolerance:.2g}. Give a {cure}, or "
                "a larger tolerance"
            )
        allowed = tolerance * np.array(control.nominal)
        if (small := np.flatnonzero((self.largest > 0.0) & (allowed > MUCH * self.largest))).size:
            names = ", ".join(self.master.system.columns[k] for k in small[:MOST_NAMED])
            notes.append(
                f"{small.size} signals are far below their nominal values (1 if the FMU declares none), so that the "
                f"tolerance {tolerance:g} allows errors of up to {np.max(allowed[small] / self.largest[small]):.2g} "
                f"times the signal: {names}. Declare their nominal values in the FMUs, or give a smaller tolerance"
            )
        if control.estimator == "residual" and not self.sources:
            notes.append(
                "no input is extrapolated, so estimator: residual measures no error and steps grow to "
                f"{control.longest:g} s; set step: to a fixed length, or use FMUs that save and restore their state "
                "(estimator: halving)"
            )

    def record(self) -> dict[str, Any]:
        """Return the entry of the manifest."""
        sizes, tolerance = np.array(self.sizes or [math.nan]), self.control.tolerance
        missed = None
        if self.missed:
            error, name = max(step[1:] for step in self.missed)
            missed = {"steps": len(self.missed), "error": error * tolerance, "signal": name}
        return {
            "estimator": self.control.estimator,
            "tolerance": tolerance,
            "accepted": len(self.sizes),
            "rejected": self.rejected,
            "communication_points": self.made,
            "missed": missed,
            "largest_error": self.worst * tolerance,
            "is_met": not self.failed,
            "sizes": {f"{share:g} %": float(np.percentile(sizes, share)) for share in (0, 10, 50, 90, 100)},
        }

    def _next(self, t: float, end: float) -> tuple[float, bool]:
        """Return the end of the next step, and True if no shorter step is allowed."""
        rest = end - t
        most = (
            math.floor(rest / self.control.shortest + STEP_COUNT_TOLERANCE),
            math.ceil(rest / self.control.longest - STEP_COUNT_TOLERANCE),
        )
        parts = min(max(1, math.ceil(rest / self.wish - STEP_COUNT_TOLERANCE)), max(1, *most))
        return end if parts == 1 else t + rest / parts, parts == max(1, *most)

    # -- steps with event mode ------------------------------------------------------------------

    def limit(self, t: float, target: float, end: float) -> float:
        """Return the end of a step from t [s], at most the next event's time; remember the held inputs."""
        self.past.add(t, self.signals[self.sources])
        return min(target, self._next(t, end)[0])

    def judge_step(self, t: float, reached: float) -> None:
        """Estimate the error of a step from the values at its end, and choose the next step."""
        error, name = self._judge_inputs(reached)
        self.made += 1
        is_shortest = reached - t <= self.control.shortest * (1.0 + STEP_COUNT_TOLERANCE)
        self._accept(t, reached - t, error, name, final=is_shortest)

    # -- step sizes -------------------------------------------------------------------------------

    def _accept(self, t: float, h: float, error: float, name: str, *, final: bool) -> None:
        """Record an accepted step from t [s] with its largest error, and choose the next step.

        Args:
            final: True if no shorter step is allowed.
        """
        self.sizes.append(h)
        self.worst = max(self.worst, error)
        if error > 1.0:
            self.failed.append((t, error, name))
            if final:
                self.missed.append((t, error, name))
        error = max(error, LEAST_ERROR)
        factor = SAFETY * error ** (-INTEGRAL / self.q) * self.before ** (PROPORTIONAL / self.q)
        wish = h * min(max(factor, MIN_STEP_FACTOR), MAX_STEP_FACTOR)
        if factor >= 1.0:  # A step that the next row cuts short says nothing against longer ones.
            wish = max(wish, self.wish)
        self.wish, self.before = min(max(wish, self.control.shortest), self.control.longest), error

    # -- estimators ---------------------------------------------------------------------------------

    def _halve(self, k: int, t: float, until: float, *, final: bool) -> Judged:
        """Make a step whole and in two halves; return the error, NaN if the step is rejected."""
        before, middle, outputs = SavedPoint(self.master, self.fmus), 0.5 * (t + until), self.outputs
        start = self.signals[outputs]
        self._step(k, t, until)
        whole = self.signals[outputs]
        before.restore(keep=True)
        if not self._is_checked and (whole != start).any():
            self._is_checked = True
            before.check_outputs(t)
        for since, to in ((t, middle), (middle, until)):
            self._step(k, since, to)
        error, name = self._judge(outputs, whole)
        error /= (2.0**self.p - 1.0) * (until - t if self.control.is_per_second else 1.0)
        if error <= 1.0 or final:
            for fmu, state in before.states:
                self.master.announce(fmu).free_state(state)
            return error, name
        before.restore()
        self.rejected += 1
        shorter = (until - t) * max(MIN_STEP_FACTOR, SAFETY * error ** (-1.0 / self.q))
        self.wish = max(shorter, self.control.shortest)
        return math.nan, name

    def _judge_inputs(self, t: float) -> Judged:
        """Return the error of inputs, or of the power of bonds, at the end of a step (t [s])."""
        expected, row, worst = self.past.mean(t), self.master.row, (0.0, "")
        if self.control.estimator != "energy":
            return self._judge(self.sources, expected)
        for number, bond in enumerate(self.control.bonds):
            (e, to_flow), (f, to_effort) = bond.effort, bond.flow
            assumed = [
                float(expected[self.received[p]]) if p in self.received else row[p] for p in (to_flow, to_effort)
            ]
            one, other = row[e] * assumed[1], assumed[0] * row[f]
            self.power[number] = max(self.power[number], abs(one), abs(other))
            worst = max(worst, (abs(one - other) / (self.control.tolerance * self.power[number]), bond.name))
        return worst

    def _judge(self, places: list[int], others: Array) -> Judged:
        """Return the largest difference between signals and `others`, relative to the tolerance."""
        if not len(places):
            return 0.0, ""
        values = self.signals[places]
        for sizes in (self.scale, self.largest):
            sizes[places] = np.maximum(sizes[places], np.abs(values))
        errors = np.abs(values - others) / (self.control.tolerance * self.scale[places])
        worst = int(np.argmax(errors))
        return float(errors[worst]), self.master.system.columns[places[worst]]

    def _step(self, k: int, t: float, until: float) -> None:
        """Step all components with controlled steps."""
        self._advance(k, t, until)
        self.made += 1
