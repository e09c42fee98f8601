"""Policies: how a system gets from one communication point to the next. Rows stay on an equal grid.

Steps may be equal; each made once whole and once in halves to measure the coupling error; or controlled by an estimate
of their error. (Steps from event to event are in `instants`.)

Under control, each interval between rows is divided into steps. A PI controller (K. Gustafsson, Control theoretic
techniques for stepsize selection in explicit Runge-Kutta methods, ACM Trans. Math. Softw. 17 (1991)) chooses the next
one from the errors ε of the last two, relative to the tolerance:

    h' = h·0.9·ε^(−0.7/q)·ε_prev^(0.4/q),  ε ~ h^q

Estimators of ε, docs/coupling.md has their sources:

halving   Each step is made whole (y₁) and in two halves (y₂), and taken back if ε > 1:
          ε = max |y₁ − y₂| / ((2^p − 1)·τ·s),  q = p + 1, or this error per second, q = p
residual  Received inputs u against those of the step's course ũ: ε = max |u − ũ| / (τ·s),  q = p
energy    Power bonds of an effort e and a flow f: ε = max |e·f̃ − ẽ·f| / (τ·P),  q = p

The first step is judged by halving and begins with the longest one, if all FMUs save and restore their state.
p is one more than the degree of the inputs' courses; s and P are the largest magnitudes so far, or the nominal ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cosim.blocks.fmu import FmuBlock
from cosim.core.arrays import Array
from cosim.core.errors import CosimError, SimulationError
from cosim.isolation.rows import GET
from cosim.master.checkpoint import NOT_RESTORED
from cosim.master.extrapolation import Polynomial
from cosim.master.initialization import is_settled
from cosim.system.control import Control

if TYPE_CHECKING:
    from cosim.master.master import Master

SAFETY, PROPORTIONAL, INTEGRAL = 0.9, 0.4, 0.7  # factor of a step; exponents times q of the last and the present error
SMALLEST, LARGEST = 0.2, 4.0  # change of a step


LEAST_ERROR = 1e-4  # smallest error that enters the controller
ROUNDING = 1e-9  # relative
Judged = tuple[float, str]  # error of a step relative to the tolerance, and the signal that has it
Copies = Callable[[int], None]  # makes the copies of a communication point


class Active(NamedTuple):
    """A component's step with the copies around it.

    Attributes:
        copy: Copies before the step.
        step: Function of the start and the length of a step [s].
        every: Length of the step in steps of the run.
        length: Length of the step [s], 0.0 for the difference of communication points.
        late: Function that sets the known values of a point after the step, if any.
    """

    copy: Copies
    step: Callable[[float, float], None]
    every: int = 1
    length: float = 0.0
    late: Callable[[int], None] | None = None


Round = tuple[Active, ...]  # the last one makes no step: its copies are those at the end of the step


class Together:
    """Steps of components that need no output of each other, made at the same time.

    Args:
        in_threads: Whether each step may be made in a thread, because its component has a process of its own.
    """

    def __init__(self, actives: Sequence[Active], in_threads: Sequence[bool]) -> None:
        self._actives, self._pool = actives, ThreadPoolExecutor(len(actives))
        self._in_threads = [k for k, each in enumerate(in_threads) if each][1:]  # the caller's thread makes the others

    def __call__(self, t: float, h: float) -> None:
        """Step all components by h [s]; raise the error of the first one that fails."""
        tasks = {k: self._pool.submit(self._actives[k].step, t, self._actives[k].length or h) for k in self._in_threads}
        failed: dict[int, BaseException | None] = {}
        try:
            for k, active in enumerate(self._actives):
                if k not in tasks:
                    active.step(t, active.length or h)
        except CosimError as error:
            failed[k] = error
        failed |= {k: task.exception() for k, task in tasks.items()}  # once all have ended
        for k in sorted(failed):
            if (first := failed[k]) is not None:
                raise first

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()


class Policy:
    """A way from one communication point to the next.

    Attributes:
        reason: Why the steps are made in Python.
    """

    master: Master
    reason = ""

    @property
    def loop(self) -> str:
        """Return the kind of loop."""
        return f"Python: {self.reason}"

    def advance_to(self, k: int) -> None:
        """Step the system from point k − 1 to point k."""
        raise NotImplementedError

    def settle(self, k: int) -> None:
        """Handle the events of point k."""

    def make_all(self) -> None:
        """Make all steps. The calls here and in `Master.advance` determine the run time."""
        master, advance_to, settle = self.master, self.advance_to, self.settle
        values, table, row_count, asked = master.values, master.table, master.row_count, master.asked
        call_point = master.next_call(master.done)
        for k in range(master.done, master.steps + 1):
            advance_to(k)
            if k == call_point:
                master.change(k)
            settle(k)
            if k == call_point:
                master.tell(k)
                call_point = master.next_call(k + 1)
            table[k] = values
            row_count[0] = k + 1
            if asked[0]:
                master.keeper.look(master, k)

    def finish(self) -> None:
        """Note what is worth a warning, after the last step."""


class EqualSteps(Policy):
    """Equal communication steps."""

    def __init__(self, master: Master, reason: str) -> None:
        self.master, self.reason, stages = master, reason, master.system.stages
        self._period = math.lcm(*(stage.every for stage in stages), 1)
        self._round = cache(partial(master.round, stages))
        self._advance, self._begin, self._h = master.advance, master.system.start, master.h

    def advance_to(self, k: int) -> None:
        """Step each component once that is due."""
        begin, h = self._begin, self._h
        self._advance(self._round(k % self._period), k, begin + (k - 1) * h, begin + k * h)


class SavedPoint:
    """The states of FMUs, and all signals, to which steps go back."""

    def __init__(self, master: Master, fmus: Sequence[FmuBlock]) -> None:
        self.master, self._signals, self._beside = master, master.values.copy(), list(master.beside)
        self.states = [(fmu, master.announce(fmu).save_state()) for fmu in fmus]

    def restore(self, *, keep: bool = False) -> None:
        """Go back; free the states unless `keep` is set."""
        for fmu, state in self.states:
            self.master.announce(fmu).restore_state(state, keep=keep)
        self.restore_signals()

    def restore_signals(self) -> None:
        """Take back the signals only."""
        self.master.values[:] = self._signals
        self.master.beside[:] = self._beside

    def check_outputs(self, t: float) -> None:
        """Raise SimulationError if an FMU with a restored state gives other outputs than before."""
        before = list(self.master.row)
        for fmu, _ in self.states:
            self.master.announce(fmu, GET).get()
            if not is_settled(before, self.master.row):
                raise SimulationError(fmu.name, t, NOT_RESTORED)
        self.restore_signals()


class HalvedSteps(Policy):
    """Equal steps, each made once whole and once in halves, to estimate the coupling error.

        e_k = |y(t_k; h) − y(t_k; h/2, h/2)|, both from the state at t_k−1

    Rows hold the differences, zero in the first row. The run goes on from the whole steps.
    """

    reason = "steps are halved"

    def __init__(self, master: Master) -> None:
        self.master, actives = master, master.round(master.system.stages, 1, nominal=False)
        self._advance = partial(master.advance, actives)
        self._fmus = [c for c in master.components if isinstance(c, FmuBlock)]
        self._whole: SavedPoint | None = None
        master.table[0] = 0.0

    def advance_to(self, k: int) -> None:
        """Step once whole and once in halves."""
        master = self.master
        if self._whole is not None:
            self._whole.restore_signals()
        t, end = (master.system.start + j * master.h for j in (k - 1, k))
        before, middle = SavedPoint(master, self._fmus), 0.5 * (t + end)
        self._advance(k, t, end)
        values, self._whole = master.values.copy(), SavedPoint(master, self._fmus)
        before.restore()
        before.check_outputs(t)
        for since, until in ((t, middle), (middle, end)):
            self._advance(k, since, until)
        differences = np.abs(values - master.values)
        self._whole.restore()
        master.values[:] = differences


class ControlledSteps(Policy):
    """Steps of a run under control, from its first row on.

    Attributes:
        sizes: Lengths of accepted steps [s].
        made: Number of communication points, with those of rejected and comparing steps.
        worst: Largest error of an accepted step.
        failed: Time, error and signal of accepted steps with an error above the tolerance, and whether they could not
            be shorter.
    """

    reason = "steps are controlled"

    def __init__(self, master: Master, control: Control) -> None:
        self.master, self.control, system = master, control, master.system
        stages = [stage for stage in system.stages if stage.name not in control.at_rows]
        self._at_rows = [stage for stage in system.stages if stage.name in control.at_rows]
        self._names = [stage.name for stage in stages]
        self._advance = partial(master.advance, master.round(stages, 1, nominal=False))
        self.fmus = [s.component for s in stages if isinstance(s.component, FmuBlock)]
        held = (t for t in system.held if t.receiver in self._names)
        received = {t.target: t.source for t in held if not any(t.beside)}
        self.received, self.sources = {target: k for k, target in enumerate(received)}, list(received.values())
        self.signals, self.outputs = master.values, [*control.outputs]
        self.past = Polynomial(system.courses[0])
        self.scale, self.power = np.array(control.nominal), [b.nominal for b in control.bonds]

        self.p = 1 + min(system.courses)
        self.q = self.p + (control.estimator == "halving" and not control.is_per_second)
        self.wish = control.longest if control.rolls_back else control.shortest
        self.before, self._is_checked = 1.0, False
        self.sizes: list[float] = []
        self.made, self.rejected, self.worst = 0, 0, 0.0
        self.failed: list[tuple[float, float, str, bool]] = []

    def advance_to(self, k: int) -> None:
        """Make the steps between two rows, then those of components that step only at rows."""
        master = self.master
        begin, end = (master.system.start + j * master.h for j in (k - 1, k))
        t = begin
        while t < end:
            until, is_shortest = self._next(t, end)
            self.past.add(t, self.signals[self.sources])
            # The first step has no earlier inputs by which to judge the extrapolated ones.
            if self.control.estimator == "halving" or (self.control.rolls_back and not self.sizes):
                error, name = self._halve(k, t, until, final=is_shortest)
                if math.isnan(error):  # taken back
                    continue
            else:
                self._advance(k, t, until)
                self.made += 1
                error, name = self._judge_inputs(until)
            self._accept(t, until - t, error, name, final=is_shortest)
            t = until
        at_row = master.round(self._at_rows, k, self._names, nominal=False)
        if len(at_row) > 1:
            master.advance(at_row, k, begin, end)

    def finish(self) -> None:
        """Record the steps; note errors above the tolerance, and what the estimator does not judge."""
        notes, control, tolerance = self.master.notes, self.control, self.control.tolerance
        sizes, missed = np.array(self.sizes or [math.nan]), [step for step in self.failed if step[-1]]
        largest = max((step[1:3] for step in missed), default=None)
        self.master.details["steps"] = {
            "estimator": control.estimator,
            "tolerance": tolerance,
            "per": "second" if control.is_per_second else "step",
            "order": self.p,
            "accepted": len(self.sizes),
            "rejected": self.rejected,
            "communication_points": self.made,
            "above_tolerance": len(self.failed),
            "missed": largest and {"steps": len(missed), "error": largest[0] * tolerance, "signal": largest[1]},
            "largest_error": self.worst * tolerance,
            "is_met": not self.failed,
            "sizes": {f"{share:g} %": float(np.percentile(sizes, share)) for share in (0, 10, 50, 90, 100)},
        }
        if steps := missed or self.failed:
            t, error, signal, _ = steps[0]
            why, cure = f"; estimator: {control.estimator} does not repeat steps", f"max below {control.longest:g} s"
            if missed:
                why, cure = f" although min allows no shorter ones, {control.shortest:g} s", "shorter min"
            notes.append(
                f"the error of {len(steps)} steps is above the tolerance {tolerance:g}{why}: first at t = {t:.6g} s, "
                f"{error * tolerance:.2g} of {signal}; the largest is {self.worst * tolerance:.2g}. Give a {cure} or a "
                "larger tolerance"
            )

        if control.estimator == "residual" and not self.sources:
            notes.append(
                "no input is extrapolated, so that estimator: residual judges nothing and steps grow to "
                f"{control.longest:g} s whatever their error; give one step: of that length, or FMUs that save and "
                "restore their state (estimator: halving)"
            )

    def _next(self, t: float, end: float) -> tuple[float, bool]:
        """Return the end of the next step, and whether no shorter one is allowed."""
        rest = end - t
        most = math.floor(rest / self.control.shortest + ROUNDING), math.ceil(rest / self.control.longest - ROUNDING)
        parts = min(max(1, math.ceil(rest / self.wish - ROUNDING)), max(1, *most))
        return end if parts == 1 else t + rest / parts, parts == max(1, *most)

    # -- steps with event mode ------------------------------------------------------------------

    def limit(self, t: float, target: float, end: float) -> float:
        """Return the end of a step from t, at most the next event's time, and remember the held inputs."""
        self.past.add(t, self.signals[self.sources])
        return min(target, self._next(t, end)[0])

    def judge_step(self, t: float, reached: float) -> None:
        """Judge a step by the values at its end, and choose the next one."""
        error, name = self._judge_inputs(reached)
        self.made += 1
        is_shortest = reached - t <= self.control.shortest * (1.0 + ROUNDING)
        self._accept(t, reached - t, error, name, final=is_shortest)

    # -- step sizes -------------------------------------------------------------------------------

    def _accept(self, t: float, h: float, error: float, name: str, *, final: bool) -> None:
        """Count a step from t with its largest error, and choose the next one.

        Args:
            final: Whether no shorter step is allowed.
        """
        self.sizes.append(h)
        self.worst = max(self.worst, error)
        if error > 1.0:
            self.failed.append((t, error, name, final))
        error = max(error, LEAST_ERROR)
        factor = SAFETY * error ** (-INTEGRAL / self.q) * self.before ** (PROPORTIONAL / self.q)
        wish = h * min(max(factor, SMALLEST), LARGEST)
        if factor >= 1.0:  # A step that the next row cuts short says nothing against longer ones.
            wish = max(wish, self.wish)
        self.wish, self.before = min(max(wish, self.control.shortest), self.control.longest), error

    # -- estimators ---------------------------------------------------------------------------------

    def _halve(self, k: int, t: float, until: float, *, final: bool) -> Judged:
        """Step whole and by halves; return the error, NaN if the step is rejected."""
        before, middle, outputs = SavedPoint(self.master, self.fmus), 0.5 * (t + until), self.outputs
        start = self.signals[outputs]
        self._advance(k, t, until)
        whole = self.signals[outputs]
        before.restore(keep=True)
        if not self._is_checked and (whole != start).any():
            self._is_checked = True
            before.check_outputs(t)
        for since, to in ((t, middle), (middle, until)):
            self._advance(k, since, to)
        self.made += 3
        error, name = self._judge(outputs, whole)
        error /= (2.0**self.p - 1.0) * (until - t if self.control.is_per_second else 1.0)
        if error <= 1.0 or final:
            for fmu, state in before.states:
                self.master.announce(fmu).free_state(state)
            return error, name
        before.restore()
        self.rejected += 1
        shorter = (until - t) * max(SMALLEST, SAFETY * error ** (-1.0 / self.q))
        self.wish = max(shorter, self.control.shortest)
        return math.nan, name

    def _judge_inputs(self, t: float) -> Judged:
        """Return the error of inputs or of the power of bonds at the end of a step [s]."""
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
        """Return the largest difference relative to the tolerance."""
        if not len(places):
            return 0.0, ""
        values = self.signals[places]
        self.scale[places] = np.maximum(self.scale[places], np.abs(values))
        errors = np.abs(values - others) / (self.control.tolerance * self.scale[places])
        worst = int(np.argmax(errors))
        return float(errors[worst]), self.master.system.columns[places[worst]]
