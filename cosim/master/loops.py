"""Algebraic loops of a run: inputs and outputs that depend on each other at the same time.

The unknowns z are the inputs whose connections come from a later component in the order of the loop. Evaluating the
components in order gives g(z), the values at the sources of these connections; the solution is g(z) = z. The Jacobian
of g is a product of the components' Jacobians, which are directional derivatives or differences.

At a communication point, the components have stepped with the inputs of the previous point. Their outputs for other
inputs are then computed without a step. If outputs of an FMU react only after a step, each trial repeats the step from
the saved state, so that the trial input acts during the whole step. If the FMU cannot save its state, the loop is not
solved, but coupled with a delay (`DelayedLoop`).
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.blocks.component import ADVANCE, GET, PUT, EarlyEnd
from cosim.blocks.coupling import torn
from cosim.blocks.fmu import FmuBlock
from cosim.core.arrays import Array, Flags
from cosim.core.errors import NotFinite, SimulationError
from cosim.core.times import first_point
from cosim.master.root_finding import ROUNDING_RESIDUAL, Outcome, RootFinding
from cosim.scenario.scenario import LoopSettings
from cosim.system.schedule import Loop
from cosim.system.wiring import Transfer

if TYPE_CHECKING:
    from cosim.master.master import Master

SHIFT = 1e-5  # change of an input for differences, relative to its magnitude
PROBES = (1e-3, -1e-3, 0.5, -0.5)  # relative changes of an input, to test whether an output depends on it
MOST_ITEMS = 4  # tried items of an enumeration
REACTION = 1e-9  # smallest relative change of an output that counts
PROPOSED = 1e-8  # tolerance that a message proposes for a smaller one
UNIT_GAIN = 1e-8  # smallest singular value of I − ∂g/∂z that counts
UNIT_GAIN_POINTS = 0.0, 1.0, -0.37  # displacements in magnitudes of the unknowns
RETRY_EXPONENTS = -3, 5  # exponents of 2 of other first points, where a component refuses the inputs
MOST_DIFFERENCES = 50  # inputs of a loop without derivatives, beyond which Newton's method costs too much

RESIDUAL_DOUBLINGS = 12  # of the residual, for the judgement whether it grows without bound
MAX_HALVES_RATIO = 1.5  # ratio of the steps that the second and the first half of these doublings take
DIVERGED_RESIDUAL = 1e9  # residual in nominal values from which on such growth ends a run


class DelayedLoop:
    """Residuals of a loop that is coupled with a delay, not solved, at the end of each step.

    A component whose outputs react only after a step, and which cannot save its state, makes each step with the inputs
    z of the step's start. At the end of the step, the loop gives g(z). While signals change, the residual g(z) − z is
    proportional to the step. With a loop gain G, it is multiplied by G in each step, so that the coupling diverges for
    |G| > 1.

    Exponential growth differs from other growth by the number of steps in which the residual doubles: this number is
    constant. It increases for polynomial growth, and for values that settle.

    Args:
        reason: Why the loop is not solved.
        places: Indices of the delayed inputs in the row; further arguments are their names and nominal values.
    """

    def __init__(self, reason: str, places: Sequence[int], names: Sequence[str], nominal: Sequence[float]) -> None:
        self.reason, self.places, self._names, self._nominal = reason, places, names, np.array(nominal)
        self._shares = array("d")  # residual of each step, relative to its signal
        self._largest = 0.0  # largest residual so far, in nominal values
        self.worst: dict[str, Any] = {}
        self.last: dict[str, Any] = {}
        self._doublings: list[tuple[int, float]] = []  # step and size of the residual at each doubling

    def note(self, t: float, assumed: Array, returned: Array) -> bool:
        """Record a residual; return True if it grows without bound."""
        residual = returned - assumed
        sizes = np.abs(residual) / self._nominal
        worst = int(np.argmax(sizes))
        size, value, change = (float(each[worst]) for each in (sizes, assumed, residual))
        self.last = {"signal": self._names[worst], "time": t, "value": value, "residual": change}
        if not self.worst or size > self._largest:
            self._largest, self.worst = size, self.last
        self._shares.append(abs(change) / max(abs(value), abs(value + change)) if change else 0.0)
        if size <= 0.0 or (self._doublings and size < 2.0 * self._doublings[-1][1]):
            return False
        self._doublings.append((len(self._shares), size))
        steps = [step for step, _ in self._doublings[-RESIDUAL_DOUBLINGS - 1 :]]
        if size < DIVERGED_RESIDUAL or len(steps) <= RESIDUAL_DOUBLINGS:
            return False
        middle = steps[RESIDUAL_DOUBLINGS // 2]
        return steps[-1] - middle <= MAX_HALVES_RATIO * (middle - steps[0])

    def record(self) -> dict[str, Any]:
        """Return the entry of the loop in the manifest."""
        if not self._shares:
            return {"reason": self.reason}
        shares = np.frombuffer(self._shares)
        relative = {"median": float(np.median(shares)), "last": float(shares[-1])}
        return {"reason": self.reason, "largest": self.worst, "last": self.last, "relative": relative}


class Member:
    """A component of a loop, with the indices in the row of its inputs and outputs within the loop.

    Attributes:
        nominal: Input → nominal value; 1 for an input that is not in `declared`.
        repeats: True if outputs react to inputs only after a step, which is therefore repeated.
        late: Reason why inputs act only in the next step; "" if they act at once.
        reacts: True where an output (row) reacted to an input (column) during initialization.
        promised: True if the last Jacobian consisted of directional derivatives of the FMU.
    """

    def __init__(self, master: Master, component: Any, loop: Loop) -> None:
        self.component, self.row, self.signals = component, master.row, master.values
        own = {k for k, column in enumerate(master.system.columns) if column.partition(".")[0] == component.name}
        self.inputs = inputs = sorted({t.target for t in loop.transfers if not t.beside[1]} & own)
        self.outputs = outputs = sorted({t.source for t in loop.transfers if not t.beside[0]} & own)
        self.call = partial(master.announce, component)
        self.declarations = [master.system.signals[column] for column in master.system.columns]
        self.variables = [[master.system.columns[k].partition(".")[2] for k in ends] for ends in (outputs, inputs)]
        self.nominal, self.declared = dict.fromkeys(inputs, 1.0), set[int]()
        for k, name in zip(inputs, self.variables[1], strict=True):
            if isinstance(component, FmuBlock) and (nominal := component.nominal(name, default=0.0)) > 0.0:
                self.nominal[k] = nominal
                self.declared.add(k)
        self.changes_by_events = getattr(component, "changes_by_events", False)
        self.repeats, self.promised, self.late = False, False, ""
        self.reacts = np.zeros((len(outputs), len(inputs)), bool)
        self._state: Any = None
        self._is_stepped = True
        self._step: tuple[float, float] = (0.0, 0.0)

    def begin_step(self, t: float, h: float) -> None:
        """Step; if the step will be repeated, only save the state."""
        if self.repeats:
            self._state, self._is_stepped, self._step = self.call().save_state(), False, (t, h)
            return
        self.call(PUT).put()
        self.call(ADVANCE).advance(t, h)

    def evaluate(self) -> None:
        """Compute the outputs for the current inputs, and write them to the row."""
        if self._state is not None and self._is_stepped:
            self.call().restore_state(self._state, keep=True)
        component = self.call(PUT)
        getattr(component, "try_inputs", component.put)()
        if self._state is not None:
            self._is_stepped = True
            self.call(ADVANCE).advance(*self._step)
        self.call(GET).get()

    def end_step(self) -> None:
        """Handle the event of changed inputs in model exchange; free the saved state."""
        if self._state is not None:
            state, self._state = self._state, None
            self.call().free_state(state)
        elif self.changes_by_events:
            self.call(PUT).put()
            self.call(GET).get()

    def try_at(self, place: int, value: float) -> Array | None:
        """Return the outputs for another value of an input; None if the component refuses the value."""
        before, self.row[place] = self.row[place], value
        try:
            self.evaluate()
        except EarlyEnd:
            raise
        except SimulationError:
            return None
        finally:
            self.row[place] = before
        return self.signals[self.outputs]

    def size(self, place: int) -> float:
        """Return the magnitude of an input, at least its nominal value."""
        return max(abs(self.row[place]), self.nominal[place])

    def reactions(
        self, places: Sequence[int], least: float = REACTION, noise: Array | float = 0.0
    ) -> tuple[Flags, Flags]:
        """Return where outputs (rows) react to inputs (columns) without a step, and which inputs accept other values.

        Args:
            places: Indices of the inputs in the row.
            least: Least change of an output, relative to its value, that counts as a reaction.
            noise: Least absolute change that counts, for each output.
        """
        base = self.signals[self.outputs]
        follows, accepts = np.zeros((len(self.outputs), len(places)), bool), np.zeros(len(places), bool)
        for j, place in enumerate(places):
            value, signal = self.row[place], self.declarations[place]
            if signal.kind == "Boolean":
                others = [1.0 - value]
            elif signal.items:
                others = [float(item) for item in signal.items.values() if item != value][:MOST_ITEMS]
            elif signal.is_whole:
                others = [value + 1.0, value - 1.0]
            else:
                others = [value + share * self.size(place) for share in PROBES]
            for other in others:
                if (values := self.try_at(place, other)) is not None:
                    accepts[j] = True
                    size = np.maximum(np.abs(base), np.abs(values))
                    follows[:, j] |= np.abs(values - base) > np.maximum(noise, least * size)
        return follows, accepts


class LoopSolver:
    """Solver of an algebraic loop of a run.

    Attributes:
        name: Text that names the components of the loop in messages.
        names: Names of the components; `last` is the last one.
    """

    def __init__(self, loop: Loop, master: Master) -> None:
        system, copying = master.system, master.copying
        self.row, self.signals, self.start, self._h = master.row, master.values, system.start, master.h
        self.settings = system.solving or LoopSettings()
        self.name, self.names, self.last = loop.name, loop.members, loop.members[-1]
        self._transfers, self._columns = loop.transfers, system.columns
        owners = [column.partition(".")[0] for column in system.columns]
        ends = [(owners[t.source], owners[t.target]) for t in loop.transfers]
        marked = list(zip(loop.transfers, torn(loop.members, ends), strict=True))
        self.back = [t for t, is_back in marked if is_back]
        self.unknowns = [t.target for t in self.back]
        self._forward = {n: [t for t, is_back in marked if owners[t.target] == n and not is_back] for n in loop.members}
        self._into = {name: copying.of(transfers) for name, transfers in self._forward.items()}
        self._to_back = copying.of(self.back)
        self._known_into = {s.component.name: copying.of(s.late) for s in system.stages}
        self._functions = copying.functions
        self.members = members_of(loop, master)
        nominal = {place: value for member in self.members for place, value in member.nominal.items()}
        scale = np.array([nominal[place] for place in self.unknowns])
        is_assumed = ~np.isin(self.unknowns, [place for member in self.members for place in member.declared])
        self._roots = RootFinding(self.settings.tolerance, self.settings.iterations, scale, is_assumed)
        self._seen: dict[int, float] = {}  # place of a signal → its largest magnitude
        self._rough: list[tuple[float, float, float, str]] = []  # time, residual, value and signal of inexact solutions
        self._point, self._at_start = 0, 0
        self._iterations: list[int] = []
        self._guesses: list[Array] = []
        self._refusal: SimulationError | None = None
        self._delayed: DelayedLoop | None = None  # used if the loop is not solved
        self._is_warned = False  # True if a warning about the delay was given before the first step

    # -- solutions ----------------------------------------------------------------------------------

    def solve_start(self) -> None:
        """Solve the loop during initialization."""
        if not self._guesses:
            before = self.signals[self.unknowns]
            for member in self.members:
                try:
                    member.evaluate()
                except EarlyEnd:
                    raise
                except SimulationError:
                    continue
                member.reacts, _ = member.reactions(member.inputs)
            self._to_back(0)
            self._guesses = [self.signals[self.unknowns]]
            self.signals[self.unknowns] = before
        self._at_start += self._solve(self.start)

    def begin(self) -> list[str]:
        """Find components whose outputs react only after a step.

        Returns:
            Warnings.

        Raises:
            SimulationError: Steps of a component must be repeated, but the component does not support this.
        """
        z = self.signals[self.unknowns]
        slopes = self._roots.slopes if self._roots.slopes is not None else self._slopes(z, z, fresh=False)
        is_finite = np.isfinite(slopes).all()
        gain = float(np.max(np.abs(np.linalg.eigvals(slopes)), initial=0.0)) if is_finite else math.inf
        self._roots.slopes = None
        members = [m for m in self.members if m.inputs and not m.changes_by_events]
        warnings = [warning for member in members for warning in self._find_repeats(member, gain)]
        if late := [member for member in self.members if member.late]:
            nominal = dict(sorted((place, size) for member in late for place, size in member.nominal.items()))
            names = [self._columns[place] for place in nominal]
            reason = "; ".join(member.late for member in late)
            self._delayed = DelayedLoop(reason, [*nominal], names, [*nominal.values()])
        return warnings

    def step(self, t: float, h: float) -> None:
        """Step the components from t to t + h [s], and solve the loop at the end.

        Raises:
            SimulationError: A component failed, the iterations do not converge, or values grow without bound.
        """
        self._point = first_point(t + h, self.start, self._h)
        delayed = self._delayed
        assumed = None if delayed is None else self.signals[delayed.places]
        try:
            for member in self.members:
                member.begin_step(t, h)
            self._set_late(repeats=False)
            self._iterations.append(self._solve(t + h))
            for member in self.members:
                member.end_step()
            self._set_late(repeats=True)
        except NotFinite as error:
            if delayed is None or not delayed.last:
                raise
            last = delayed.last
            message = (
                f"{error.reason}. {self.name} is an algebraic loop that is not solved: {delayed.reason}. At "
                f"t = {last['time']:.6g} s, {last['signal']} was {last['value']:.3g} with the residual "
                f"{last['residual']:+.3g}"
            )
            raise SimulationError(error.component, error.time, message) from None
        if delayed is not None and assumed is not None and delayed.note(t + h, assumed, self.signals[delayed.places]):
            last = delayed.last
            message = (
                f"{self.name} is not solved ({delayed.reason}) and grows without bound: {last['signal']} is "
                f"{last['value']:.3g} in the last step, and its residual {last['residual']:+.3g} doubles in equal "
                "times. Use an FMU that saves and restores its state, one without direct feedthrough, or a shorter "
                "step. order: [...] runs the loop without this check"
            )
            raise SimulationError("algebraic loop", t + h, message)

    def _set_late(self, *, repeats: bool) -> None:
        """Copy known values at the end of a step; for components with repeated steps, after the last repetition."""
        for member in self.members:
            if member.repeats == repeats:
                self._known_into[member.component.name](self._point)

    def record(self) -> dict[str, Any]:
        """Return the entry of the loop in the manifest."""
        counts = self._iterations
        return {
            "components": [member.component.name for member in self.members],
            "signals": [t.name for t in self._transfers],
            "unknowns": [t.name for t in self.back],
            "method": self.method,
            "tolerance": self.settings.tolerance,
            "derivatives": {
                m.component.name: "directional" if m.promised else "differences" for m in self.members if m.inputs
            },
            "repeated": [m.component.name for m in self.members if m.repeats],
            "slopes_computed": self._roots.computed,
            "iterations": {"start": self._at_start, "most": max(counts, default=0), "total": sum(counts)},
            "points": len(counts),
            **({} if self._delayed is None else {"not_solved": self._delayed.record()}),
        }

    def notes(self) -> list[str]:
        """Return warnings about an unsolved loop and about inexact solutions."""
        notes: list[str] = []
        if self._delayed is not None and self._delayed.worst and not self._is_warned:
            worst, relative = self._delayed.worst, self._delayed.record()["relative"]
            notes.append(
                f"the algebraic loop {self.name} is not solved: {self._delayed.reason}. Inputs have the values of the "
                f"start of each step. The residual at its end, relative to the signal, is {relative['median']:.2g} in "
                f"the median and {relative['last']:.2g} at the last point; the largest is {worst['residual']:+.3g} of "
                f"{worst['signal']} at t = {worst['time']:.6g} s. A shorter step may reduce it"
            )
        if self._rough:
            t, residual, value, signal = self._rough[0]
            notes.append(
                f"the algebraic loop {self.name} is not solved to the relative tolerance "
                f"{self.settings.tolerance:g} at {len(self._rough)} points: first at t = {t:.6g} s, where {signal} is "
                f"{value:.3g} with a residual of ±{abs(residual):.2g} that no iteration reduces. Declare the size of "
                "this input as its nominal value in the FMU"
            )
        return notes

    @property
    def method(self) -> str:
        """Return a phrase for the method of solution."""
        if self.settings.method is not None:
            return self.settings.method
        differences = sum(len(m.inputs) for m in self.members if not m.promised)
        return "anderson" if differences > MOST_DIFFERENCES else "newton"

    # -- internal -------------------------------------------------------------------------------

    def _solve(self, t: float) -> int:
        """Solve the loop; return the number of iterations.

        Raises:
            SimulationError: The iterations do not converge.
        """
        start, roots, tolerance = self.signals[self.unknowns], self._roots, self.settings.tolerance
        outcome = self._outcome(start)
        worst = int(np.argmax(np.abs(outcome.residual) / np.maximum(np.abs(outcome.z), roots.scale)))
        value, residual = float(outcome.z[worst]), float(outcome.residual[worst])
        signal, count = self.back[worst].name, outcome.iterations
        if outcome.converged:
            self.signals[self.unknowns] = outcome.z
            if outcome.is_rough:
                self._rough.append((t, residual, value, signal))
            return count
        signals = ", ".join(t.name for t in self._transfers)
        if self._has_unit_gain(start):
            message = (
                f"{self.name} has no solution, or no unique one: its gain is 1, so {signal} has the residual "
                f"{residual:+.3g} whatever its value. Signals of the loop: {signals}. Start values, tolerance, order "
                "and algorithm do not help; change a parameter of an FMU, or put an FMU without direct feedthrough "
                "into the loop"
            )
        else:
            more = ""
            if abs(residual) <= ROUNDING_RESIDUAL * max(abs(value), roots.scale[worst]) and tolerance < PROPOSED:
                more = f", or a larger tolerance: this residual is rounding (loops: {{tolerance: {PROPOSED:g}}})"
            elif count >= self.settings.iterations:  # with fewer, no step leads nearer
                more = f", or more iterations (loops: {{iterations: {5 * self.settings.iterations}}})"
            message = (
                f"{self.name} does not converge: after {count} iterations {signal} is {value:.6g} with the "
                f"residual {residual:+.3g} (relative tolerance {tolerance:g}). Signals of the loop: {signals}. Use "
                f"start values near the solution{more}; order: [...] and algorithm: jacobi do not solve it"
            )
        raise SimulationError("algebraic loop", t, message)

    def _has_unit_gain(self, z: Array) -> bool:
        """Return True if I − ∂g/∂z is singular at several points around z, so that no solution is unique."""
        if z.size > MOST_DIFFERENCES:
            return False
        for share in UNIT_GAIN_POINTS:
            at = z + share * np.maximum(np.abs(z), self._roots.scale)
            g = self._sweep(at)
            if g is None:
                return False
            slopes = self._slopes(at, g, fresh=False)
            if not np.isfinite(slopes).all() or np.linalg.svd(np.eye(z.size) - slopes)[1][-1] > UNIT_GAIN:
                return False
        return True

    def _outcome(self, z: Array) -> Outcome:
        """Return the end of the iterations from z."""
        shifts = (z + s * self._roots.scale for k in range(*RETRY_EXPONENTS) for s in (2.0**k, -(2.0**k)))
        for start in (z, *self._guesses, *shifts):
            if self.method == "newton":
                outcome = self._roots.newton(self._sweep, start, self._slopes)
            else:
                outcome = self._roots.anderson(self._sweep, start)
            if outcome is not None:
                return outcome
            self._roots.slopes = None
        assert self._refusal is not None
        raise self._refusal

    def _sweep(self, z: Array) -> Array | None:
        """Return g(z); None if a component refuses its inputs."""
        self.signals[self.unknowns] = z
        try:
            for member in self.members:
                self._into[member.component.name](self._point)
                member.evaluate()
        except EarlyEnd:
            raise
        except SimulationError as error:
            if any(is_lost(member.component) for member in self.members):
                raise
            self._refusal = error
            return None
        self._to_back(self._point)
        for transfer in self._transfers:
            for place in (transfer.source, transfer.target):
                self._seen[place] = max(self._seen.get(place, 0.0), abs(self.row[place]))
        self._roots.largest = max(self._seen.values())
        returned = self.signals[self.unknowns]
        self.signals[self.unknowns] = z
        return returned

    def _slopes(self, z: Array, g: Array, *, fresh: bool) -> Array:
        """Return the Jacobian ∂g/∂z, a product of the Jacobians of components and transfers."""
        self.signals[self.unknowns] = z
        along = dict(zip(self.unknowns, np.eye(z.size), strict=True))
        for member in self.members:
            for t in self._forward[member.component.name]:
                along[t.target] = self._gain(t) * along[t.source]
            slopes = self._member_slopes(member, fresh=fresh)
            for place, row in zip(member.outputs, slopes, strict=True):
                along[place] = sum((s * along[k] for s, k in zip(row, member.inputs, strict=True)), np.zeros(z.size))
        return np.array([self._gain(t) * along[t.source] for t in self.back])

    def _member_slopes(self, member: Member, *, fresh: bool) -> Array:
        """Return the Jacobian of a component, from its directional derivatives or differences."""
        shape = len(member.outputs), len(member.inputs)
        promise = getattr(member.component, "slopes", None)
        member.promised = False
        if promise is not None and not fresh and all(shape):
            with suppress(SimulationError):
                promised = promise(*member.variables)
                if promised is not None and np.isfinite(promised).all():
                    member.promised = True
                    return np.array(promised).reshape(shape)
        base, slopes = self.signals[member.outputs], np.zeros(shape)
        for j, place in enumerate(member.inputs):
            shift, seen = SHIFT * member.size(place), self._seen.get(place, 0.0)
            if fresh and seen > 0.0 and place not in member.declared:
                shift = min(shift, SHIFT * seen)
            for step in (shift, -shift):
                values = member.try_at(place, self.row[place] + step)
                if values is not None:
                    slopes[:, j] = (values - base) / step
                    break
        self.signals[member.outputs] = base
        return slopes

    def _gain(self, transfer: Transfer) -> float:
        """Return the derivative of a transfer's target value by its source value."""
        value, function = self.row[transfer.source], self._functions[transfer.name]
        ahead = function(self._point, value + 1.0)
        return float(ahead - function(self._point, value))  # this call does not change the memory of faults

    def _find_repeats(self, member: Member, gain: float) -> list[str]:
        """Determine if steps must be repeated, because outputs react to inputs only after a step; return warnings.

        Args:
            gain: Loop gain during initialization: the largest factor by which a deviation grows around the loop.
        """
        member.evaluate()
        reacts, _ = member.reactions(member.inputs)
        member.evaluate()
        name, inputs, fmu = member.component.name, member.variables[1], member.component
        missing = member.reacts & ~reacts
        is_declared, has_reacted = any(map(fmu.depends_on, inputs)), bool(reacts.any() or member.reacts.any())
        is_silent = is_declared and not has_reacted
        can_repeat = isinstance(fmu, FmuBlock) and fmu.rolls_back
        member.repeats = can_repeat and bool(missing.any() or is_silent)
        if not (is_declared or has_reacted):
            member.late = f"{name} neither declares nor shows direct feedthrough"
            self._is_warned = True
            return [
                f"{name} neither declares nor shows direct feedthrough in the algebraic loop {self.name}; its outputs "
                "are computed by a step with the inputs of the start of the step. If it has direct feedthrough, "
                f"declare it (components.{name}.feedthrough: [{', '.join(inputs)}])"
            ]
        if is_silent and not can_repeat:
            member.late = f"{name} responds to inputs only after a step and cannot save its state"
        elif missing.any() and not can_repeat:
            j, k = (int(each[0]) for each in np.nonzero(missing))
            cure = "no cure: with values of the previous step, the signals grow"
            more = ". The loop needs an FMU that saves and restores its state, or one without direct feedthrough"
            if gain < 1.0:
                cure, more = "a cure: the loop then uses values of the previous step, and its signals settle", ""
            raise SimulationError(
                name,
                self.start,
                f"{self._columns[member.outputs[j]]} follows {self._columns[member.inputs[k]]} only after a step, "
                f"which cannot be repeated, because the FMU saves no state; so the algebraic loop {self.name} cannot "
                f"be solved. order: [...] or algorithm: jacobi is {cure} (the loop gain is {gain:.3g}){more}",
            )
        return []


def is_lost(component: Any) -> bool:
    """Return True for an FMU that cannot be called any more after a fatal error."""
    return isinstance(component, FmuBlock) and component.instance.fmu is None


def members_of(loop: Loop, master: Master) -> list[Member]:
    """Return the components of a loop in their order."""
    return [Member(master, component, loop) for component in master.components if component.name in loop.members]
