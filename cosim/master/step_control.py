"""Communication steps controlled by an estimate of their error; rows stay on an equal grid.

Each interval between rows is divided into steps. A PI controller (K. Gustafsson, Control theoretic techniques for
stepsize selection in explicit Runge-Kutta methods, ACM Trans. Math. Softw. 17 (1991)) chooses the next one from the
errors ε of the last two, relative to the tolerance:

    h' = h·0.9·ε^(−0.7/q)·ε_prev^(0.4/q),  ε ~ h^q

Estimators of ε, docs/coupling.md has their sources:

halving   Each step is made whole (y₁) and in two halves (y₂), and taken back if ε > 1:
          ε = max |y₁ − y₂| / ((2^p − 1)·τ·s),  q = p + 1
residual  Received inputs u against those of the step's course ũ: ε = max |u − ũ| / (τ·s),  q = p
energy    Power bonds of an effort e and a flow f: ε = max |e·f̃ − ẽ·f| / (τ·P),  q = p

p is one more than the degree of the inputs' courses; s and P are the largest magnitudes so far, or the nominal ones.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, MutableSequence, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.blocks.fmu import FmuBlock
from cosim.isolation.rows import Rows
from cosim.master.copying import Copying, Noisy, Plain, Through, copy_values
from cosim.master.extrapolation import Polynomial
from cosim.master.initialization import is_settled
from cosim.master.rollback import Announcer, free, restore, save
from cosim.system.control import Control
from cosim.system.schedule import Stage
from cosim.system.system import System
from cosim.system.wiring import Transfer

SAFETY, PROPORTIONAL, INTEGRAL = 0.9, 0.4, 0.7  # factor of a step; exponents times q of the last and the present error
SMALLEST, LARGEST = 0.2, 4.0  # change of a step
MUCH, MOST_NAMED = 0.01, 3  # allowed error of a step as a share of a signal that is named; number of names
LEAST_ERROR = 1e-4  # smallest error that enters the controller
ROUNDING = 1e-9  # relative
# step function, its length in steps of the run and in seconds, copies before it, and what sets known values after it
Active = tuple[Callable[[float, float], None], int, float, Plain, Noisy, Through, Callable[[int], None] | None]
Judged = tuple[float, str]  # error of a step relative to the tolerance, and the signal that has it


@dataclass
class StepCount:
    """Record of the steps of a run.

    Attributes:
        sizes: Lengths of accepted steps [s].
        made: Number of communication points, with those of rejected and comparing steps.
        failed: Accepted steps with an error above the tolerance, `missed` those of them that could not be shorter.
        first: Time, error and signal of the first failed step, `first_missed` of the first missed one.
        worst: Largest error of an accepted step.
        worst_missed: Error and signal of the worst missed step.
    """

    sizes: list[float] = field(default_factory=list)
    rejected: int = 0
    made: int = 0
    failed: int = 0
    missed: int = 0
    first: tuple[float, float, str] = (0.0, 0.0, "")
    first_missed: tuple[float, float, str] = (0.0, 0.0, "")
    worst: float = 0.0
    worst_missed: Judged = (0.0, "")

    def accept(self, t: float, h: float, error: float, name: str, *, final: bool) -> None:
        """Count a step from t with its largest error.

        Args:
            final: Whether no shorter step is allowed.
        """
        self.sizes.append(h)
        self.worst = max(self.worst, error)
        if error > 1.0:
            self.first = self.first if self.failed else (t, error, name)
            self.failed += 1
            if final:
                self.first_missed = self.first_missed if self.missed else (t, error, name)
                self.worst_missed = max(self.worst_missed, (error, name))
                self.missed += 1

    def warning(self, control: Control) -> str:
        """Return the warning about steps above the tolerance."""
        t, error, name = self.first_missed if self.missed else self.first
        fields = {"signal": name, "time": t, "error": error * control.tolerance, "count": self.missed or self.failed}
        fields |= {"worst": self.worst * control.tolerance}
        if self.missed:
            return (
                "the error of {count} steps is above the tolerance {tolerance:g} although min allows no shorter "
                "ones, {step:g} s: first at t = {time:.6g} s, {error:.2g} of {signal}; the largest is "
                "{worst:.2g}. Give a shorter min or a larger tolerance"
            ).format(step=control.shortest, tolerance=control.tolerance, **fields)
        limits = {"step": control.longest, "tolerance": control.tolerance}
        return (
            "the error of {count} steps turned out above the tolerance {tolerance:g}; estimator: {estimator} "
            "does not repeat steps: first at t = {time:.6g} s, {error:.2g} of {signal}; the largest is "
            "{worst:.2g}. Give a max below {step:g} s or a larger tolerance"
        ).format(estimator=control.estimator, **limits, **fields)

    def record(self, control: Control, p: int) -> dict[str, Any]:
        """Return the entry of the manifest."""
        sizes = np.array(self.sizes or [math.nan])
        shares = {f"{share:g} %": float(np.percentile(sizes, share)) for share in (0, 10, 50, 90, 100)}
        return {
            "estimator": control.estimator,
            "tolerance": control.tolerance,
            "order": p,
            "accepted": len(self.sizes),
            "rejected": self.rejected,
            "communication_points": self.made,
            "above_tolerance": self.failed,
            "missed": self._missed(control),
            "largest_error": self.worst * control.tolerance,
            "is_met": not self.failed,
            "sizes": shares,
        }

    def _missed(self, control: Control) -> dict[str, Any] | None:
        """Return number, largest error and signal of shortest steps above the tolerance, if any."""
        error, name = self.worst_missed
        return {"steps": self.missed, "error": error * control.tolerance, "signal": name} if self.missed else None


class ControlledRun(Announcer, Protocol):
    """What controlled steps take from a run, and leave in it: see `Master`."""

    system: System
    steps: int
    h: float
    row: Any
    beside: list[Any]
    copying: Copying
    table: Array
    row_count: MutableSequence[int]
    done: int
    has_events: bool
    rows: Rows
    notes: list[str]
    calls: tuple[Callable[[int], None], ...]

    def active(self, stage: Stage) -> Active:
        """Return a component's step with the copies around it."""

    def look(self, k: int) -> None:
        """Make a due checkpoint after point k."""

    def _next_call(self, k: int) -> int: ...


class ControlledSteps:
    """Steps of a run under control, from its first row on."""

    def __init__(self, master: ControlledRun, control: Control) -> None:
        self.master, self.control, system = master, control, master.system
        stages, others, held = self._divided()
        self.fmus = [s.component for s in stages if isinstance(s.component, FmuBlock)]
        if not master.has_events:
            self.actives = [master.active(stage) for stage in stages]
            self.others = [(stage.every, master.active(stage), master.copying.of(late)) for stage, late in others]
        self.held = master.copying.of(held)
        received = {t.target: t.source for t in held if not any(t.beside)}
        self.received, self.sources = {target: k for k, target in enumerate(received)}, list(received.values())
        self.past = Polynomial(system.courses[0])
        self.scale, self.power = np.array(control.nominal), [b.nominal for b in control.bonds]
        self.largest = np.zeros(len(control.nominal))  # magnitude of each judged signal
        self.count, self.p = StepCount(), 1 + min(system.courses)
        self.q = self.p + (control.estimator == "halving")
        self.wish, self.before = control.shortest, 1.0
        self._is_checked = False

    def _divided(self) -> tuple[list[Stage], list[tuple[Stage, list[Transfer]]], list[Transfer]]:
        """Return controlled components, the others, and held transfers."""
        system, at_rows = self.master.system, self.control.at_rows
        late: dict[str, list[Transfer]] = {name: [] for name in at_rows}
        held: list[Transfer] = []
        for transfer in system.held:
            late.get(transfer.name.partition(".")[0], held).append(transfer)
        others = [(stage, late[stage.component.name]) for stage in system.stages if stage.component.name in at_rows]
        return [stage for stage in system.stages if stage.component.name not in at_rows], others, held

    def make_all(self) -> None:
        """Make all steps."""
        master, call_point = self.master, self.master._next_call(1)
        try:
            for k in range(1, master.steps + 1):
                begin, end = (master.system.start + j * master.h for j in (k - 1, k))
                self._fill(k, begin, end)
                self._step_others(k, end)
                if k == call_point:
                    for call in master.calls:
                        call(k)
                    call_point = master._next_call(k + 1)
                ctypes.memmove(master.table[k].ctypes.data, ctypes.addressof(master.row), ctypes.sizeof(master.row))
                master.done = master.row_count[0] = k + 1
                master.look(k)
        finally:
            self.note()

    def note(self) -> None:
        """Note steps above the tolerance, signals far below their nominal value, and an estimator without signals."""
        notes, control = self.master.notes, self.control
        if self.count.failed:
            notes.append(self.count.warning(control))
        allowed = control.tolerance * np.array(control.nominal)
        if (small := np.flatnonzero((self.largest > 0.0) & (allowed > MUCH * self.largest))).size:
            names = ", ".join(self.master.system.columns[k] for k in small[:MOST_NAMED])
            share = float(np.max(allowed[small] / self.largest[small]))
            fields = {"tolerance": control.tolerance, "share": share, "count": small.size}
            notes.append(
                (
                    "{count} signals stay so far below their nominal value, 1 if the FMU states none, that a step "
                    "within the tolerance {tolerance:g} may err by up to {share:.2g} times the signal: {names}. "
                    "State their nominal values in the FMUs, or give a smaller tolerance"
                ).format(names=names, **fields)
            )
        if self.control.estimator == "residual" and not self.sources:
            notes.append(
                "no input is extrapolated, so that estimator: residual judges nothing and steps grow to "
                f"{self.control.longest:g} s whatever their error; give one step: of that length, or FMUs that "
                "save and restore their state (estimator: halving)"
            )

    def record(self) -> dict[str, Any]:
        """Return the entry of the manifest."""
        return self.count.record(self.control, self.p)

    def _fill(self, k: int, t: float, end: float) -> None:
        """Make the steps between two rows."""
        make = self._halve if self.control.estimator == "halving" else self._step_once
        while t < end:
            until, is_shortest = self._next(t, end)
            h = until - t
            error, name = make(k, t, until, final=is_shortest)
            if math.isnan(error):  # taken back
                continue
            self.count.accept(t, h, error, name, final=is_shortest)
            self._choose(h, error)
            t = until

    def _next(self, t: float, end: float) -> tuple[float, bool]:
        """Return the end of the next step, and whether no shorter one is allowed."""
        rest = end - t
        most = math.floor(rest / self.control.shortest + ROUNDING), math.ceil(rest / self.control.longest - ROUNDING)
        parts = min(max(1, math.ceil(rest / self.wish - ROUNDING)), max(1, *most))
        return end if parts == 1 else t + rest / parts, parts == max(1, *most)

    # -- steps with event mode ------------------------------------------------------------------

    def limit(self, t: float, target: float, end: float) -> float:
        """Return the end of a step from t, at most the next event's time, and remember the held inputs."""
        self.past.add(t, self._values(self.sources))
        return min(target, self._next(t, end)[0])

    def judge_step(self, t: float, reached: float) -> None:
        """Judge a step by the values at its end, and choose the next one."""
        expected = self.past(reached)
        judged = self._bonds(expected) if self.control.estimator == "energy" else self._judge(self.sources, expected)
        self.count.made += 1
        is_shortest = reached - t <= self.control.shortest * (1.0 + ROUNDING)
        self.count.accept(t, reached - t, *judged, final=is_shortest)
        self._choose(reached - t, judged[0])

    # -- step sizes -------------------------------------------------------------------------------

    def _choose(self, h: float, error: float) -> None:
        """Choose the next step."""
        error = max(error, LEAST_ERROR)
        factor = SAFETY * error ** (-INTEGRAL / self.q) * self.before ** (PROPORTIONAL / self.q)
        wish = h * min(max(factor, SMALLEST), LARGEST)
        if factor >= 1.0:  # A step that the next row cuts short says nothing against longer ones.
            wish = max(wish, self.wish)
        self.wish, self.before = min(max(wish, self.control.shortest), self.control.longest), error

    # -- estimators ---------------------------------------------------------------------------------

    def _step_once(self, k: int, t: float, until: float, *, final: bool) -> Judged:
        """Step once; return the error of inputs or bonds."""
        row = self.master.row
        self.past.add(t, self._values(self.sources))
        self._step(k, t, until)
        expected = self.past(until)
        judged = self._bonds(expected) if self.control.estimator == "energy" else self._judge(self.sources, expected)
        copy_values(row, self.held, k)
        return judged

    def _halve(self, k: int, t: float, until: float, *, final: bool) -> Judged:
        """Step whole and by halves; return NaN if rejected."""
        master, middle = self.master, 0.5 * (t + until)
        states, row, beside = save(master, self.fmus), bytes(master.row), list(master.beside)
        start = self._values(self.control.outputs)
        self._step(k, t, until)
        whole = self._values(self.control.outputs)
        self._go_back(states, row, beside, keep=True)
        if not self._is_checked and (whole != start).any():
            self._check_outputs(row, t)
        for since, to in ((t, middle), (middle, until)):
            self._step(k, since, to)
            copy_values(master.row, self.held, k)
        error, name = self._judge(self.control.outputs, whole)
        error /= 2.0**self.p - 1.0
        if error <= 1.0 or final:
            free(master, self.fmus, states)
            return error, name
        self._go_back(states, row, beside, keep=False)
        self.count.rejected += 1
        shorter = (until - t) * max(SMALLEST, SAFETY * error ** (-1.0 / self.q))
        self.wish = max(shorter, self.control.shortest)
        return math.nan, name

    def _judge(self, places: Sequence[int], others: Array) -> Judged:
        """Return the largest difference relative to the tolerance."""
        if not len(places):
            return 0.0, ""
        values, index = self._values(places), np.array(places)
        for sizes in (self.scale, self.largest):
            sizes[index] = np.maximum(sizes[index], np.abs(values))
        errors = np.abs(values - others) / (self.control.tolerance * self.scale[index])
        worst = int(np.argmax(errors))
        return float(errors[worst]), self.master.system.columns[places[worst]]

    def _bonds(self, expected: Array) -> Judged:
        """Return the largest residual of a bond's power."""
        row, worst = self.master.row, (0.0, "")
        for k, bond in enumerate(self.control.bonds):
            (e, to_flow), (f, to_effort) = bond.effort, bond.flow
            assumed = [
                float(expected[self.received[p]]) if p in self.received else row[p] for p in (to_flow, to_effort)
            ]
            one, other = row[e] * assumed[1], assumed[0] * row[f]
            self.power[k] = max(self.power[k], abs(one), abs(other))
            worst = max(worst, (abs(one - other) / (self.control.tolerance * self.power[k]), bond.name))
        return worst

    # -- internal -------------------------------------------------------------------------------

    def _step(self, k: int, t: float, until: float) -> None:
        """Exchange values and step all components."""
        for step, _, _, plain, noisy, others, late in self.actives:
            copy_values(self.master.row, (plain, noisy, others), k)
            step(t, until - t)
            if late is not None:
                late(k)
        self.count.made += 1

    def _step_others(self, k: int, end: float) -> None:
        """Step the components that step only at rows."""
        master = self.master
        due = [other for other in self.others if k % other[0] == 0]
        for every, (step, _, _, plain, noisy, others, set_late), _ in due:
            copy_values(master.row, (plain, noisy, others), k)
            begin = master.system.start + (k - every) * master.h
            step(begin, end - begin)
            if set_late is not None:
                set_late(k)
        for _, _, late in due:
            copy_values(master.row, late, k)
        if due:
            copy_values(master.row, self.held, k)

    def _values(self, places: Sequence[int]) -> Array:
        row = self.master.row
        return np.array([row[k] for k in places])

    def _go_back(self, states: Sequence[Any], row: bytes, beside: Sequence[Any], *, keep: bool) -> None:
        """Restore the state of all FMUs and all signals."""
        restore(self.master, self.fmus, states, keep=keep)
        ctypes.memmove(self.master.row, row, len(row))
        self.master.beside[:] = beside

    def _check_outputs(self, row: bytes, t: float) -> None:
        """Check that restoring the states restores the outputs."""
        self._is_checked, before = True, list(self.master.row)
        for fmu in self.fmus:
            fmu.get()
            if not is_settled(before, self.master.row):
                raise SimulationError(
                    fmu.name,
                    t,
                    (
                        "its outputs differ after a saved state is restored; use an FMU that restores its state, or "
                        "one that does not declare that it can"
                    ),
                )
        ctypes.memmove(self.master.row, row, len(row))
