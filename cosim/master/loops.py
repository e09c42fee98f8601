"""Algebraic loops of a run: inputs and outputs of the same time that depend on each other.

The unknowns z are the inputs fed by connections that lead back in the order of a loop's components. One sweep through
the components gives g(z), the values that these connections return; the solution is g(z) = z. Its slopes are chained
from those of the components: their directional derivatives, or differences.

At a communication point the components have stepped with the inputs of the point before. They are then asked for
outputs to other inputs without a step. An FMU that answers only after a step repeats the step from its saved state with
each try, so that its input acts during the whole step. If it cannot save its state, the loop is not solved, but
coupled with a delay (`DelayedLoop`).
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

SHIFT = 1e-5  # displacement of an input for differences, relative to its magnitude
PROBES = (1e-3, -1e-3, 0.5, -0.5)  # displacements that show whether an output depends on an input
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
    """Residuals at the ends of the steps of a loop that is coupled with a delay, not solved.

    A component that answers only after a step, and cannot save its state, makes each step with the inputs z of the
    step's start. At its end the loop returns g(z). Motion makes the residual g(z) − z of the order of the step. With a
    loop gain G it is multiplied by G from step to step, so that the coupling diverges for |G| > 1.

    Exponential growth is told from other growth by the steps in which the residual doubles: their number is constant.
    That of a polynomial, or of values that settle, rises.

    Args:
        reason: Why the loop is not solved.
        places: Places of the delayed inputs in the row, `names` of them, and their nominal values.
    """

    def __init__(self, reason: str, places: Sequence[int], names: Sequence[str], nominal: Sequence[float]) -> None:
        self.reason, self.places, self._names, self._nominal = reason, places, names, np.array(nominal)
        self._shares = array("d")  # residual of each step, relative to its signal
        self._largest = 0.0  # residual in nominal values
        self.worst: dict[str, Any] = {}
        self.last: dict[str, Any] = {}
        self._doublings: list[tuple[int, float]] = []  # step and size at which the residual had doubled again

    def note(self, t: float, assumed: Array, returned: Array) -> bool:
        """Note a residual; return whether it grows without bound."""
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
        """Return the entry of the manifest."""
        if not self._shares:
            return {"reason": self.reason}
        shares = np.frombuffer(self._shares)
        relative = {"median": float(np.median(shares)), "last": float(shares[-1])}
        return {"reason": self.reason, "largest": self.worst, "last": self.last, "relative": relative}


class Member:
    """A component of a loop, with the places in the row of its inputs and outputs within the loop.

    Attributes:
        nominal: Input → nominal value, 1 if none is among `declared`.
        repeats: Whether its outputs follow its inputs only after a step, which is therefore repeated.
        late: Why its inputs act only in the next step, "" if they do not.
        reacts: Whether an output (row) followed an input (column) in initialization.
        promised: Whether its last slopes were its own directional derivatives.
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
        """Step, or save the state for repeated steps."""
        if self.repeats:
            self._state, self._is_stepped, self._step = self.call().save_state(), False, (t, h)
            return
        self.call(PUT).put()
        self.call(ADVANCE).advance(t, h)

    def evaluate(self) -> None:
        """Write the outputs to the current inputs."""
        if self._state is not None and self._is_stepped:
            self.call().restore_state(self._state, keep=True)
        component = self.call(PUT)
        getattr(component, "try_inputs", component.put)()
        if self._state is not None:
            self._is_stepped = True
            self.call(ADVANCE).advance(*self._step)
        self.call(GET).get()

    def end_step(self) -> None:
        """Make the event of changed inputs; free the state."""
        if self._state is not None:
            state, self._state = self._state, None
            self.call().free_state(state)
        elif self.changes_by_events:
            self.call(PUT).put()
            self.call(GET).get()

    def try_at(self, place: int, value: float) -> Array | None:
        """Return the outputs to another input, None if refused."""
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
        """Return the size of an input: its magnitude, at least its nominal value."""
        return max(abs(self.row[place]), self.nominal[place])

    def reactions(
        self, places: Sequence[int], least: float = REACTION, noise: Array | float = 0.0
    ) -> tuple[Flags, Flags]:
        """Return whether outputs (rows) follow inputs (columns) without a step, and whether inputs take other values.

        Args:
            places: Inputs.
            least: Smallest change of an output that counts, relative to its value.
            noise: The same for each output, absolute.
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
        name: Components of the loop in a message.
        names: Their names; that of the last one is `last`.
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
        self._rough: list[tuple[float, float, float, str]] = []  # time, residual, value and signal of rough solutions
        self._point, self._at_start = 0, 0
        self._iterations: list[int] = []
        self._guesses: list[Array] = []
        self._refusal: SimulationError | None = None
        self._delayed: DelayedLoop | None = None  # if the loop is not solved
        self._is_warned = False  # of that, before the first step

    # -- solutions ----------------------------------------------------------------------------------

    def solve_start(self) -> None:
        """Solve the loop in initialization."""
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
        """Find components that answer only after a step.

        Returns:
            Warnings.

        Raises:
            SimulationError: The steps of such a component cannot be repeated.
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
        """Step from t to t + h [s] and solve the loop there.

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
                f"{error.reason}. {self.name} is an algebraic loop that is not solved: {delayed.reason}; at "
                f"t = {last['time']:.6g} s {last['signal']} was {last['value']:.3g} and the loop returned "
                f"{last['residual']:+.3g} more"
            )
            raise SimulationError(error.component, error.time, message) from None
        if delayed is not None and assumed is not None and delayed.note(t + h, assumed, self.signals[delayed.places]):
            last = delayed.last
            message = (
                f"{self.name} is not solved ({delayed.reason}) and grows without bound: {last['signal']} is "
                f"{last['value']:.3g} in the last step, and the loop returns {last['residual']:+.3g} more, a residual "
                "that doubles in equal times. It needs an FMU that saves and restores its state, or one without "
                "direct feedthrough; a shorter step if the growth is of motion; order: [...] runs it without this "
                "judgement"
            )
            raise SimulationError("algebraic loop", t + h, message)

    def _set_late(self, *, repeats: bool) -> None:
        """Copy known values of the end of a step, to components whose step is repeated after the last repetition."""
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
        """Return warnings of an unsolved loop and of rough solutions."""
        notes: list[str] = []
        if self._delayed is not None and self._delayed.worst and not self._is_warned:
            worst, relative = self._delayed.worst, self._delayed.record()["relative"]
            notes.append(
                f"the algebraic loop {self.name} is not solved: {self._delayed.reason}. Each step has the inputs of "
                f"its start; at its end the loop returns others, by {relative['median']:.2g} of the signal at half of "
                f"the points and {relative['last']:.2g} at the last; the largest residual is {worst['residual']:+.3g} "
                f"of {worst['signal']} at t = {worst['time']:.6g} s. A shorter step makes a residual of motion smaller"
            )
        if self._rough:
            t, residual, value, signal = self._rough[0]
            notes.append(
                f"the algebraic loop {self.name} is solved less exactly than to {self.settings.tolerance:g} of its "
                f"signals at {len(self._rough)} points: first at t = {t:.6g} s, where {signal} is {value:.3g} and the "
                f"loop returns {abs(residual):.2g} more or less, which no iteration makes smaller. A nominal value of "
                "this input in its FMU states the size that counts"
            )
        return notes

    @property
    def method(self) -> str:
        """Return the method of solution."""
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
                f"{self.name} has no solution, or no unique one: its gain is 1, so that the loop returns "
                f"{residual:+.3g} more than {signal}, whatever its value. Signals of the loop: {signals}. No start "
                "value, tolerance, order or algorithm is a cure; change its equations (a parameter of an FMU), or put "
                "an FMU without direct feedthrough into it"
            )
        else:
            more = ""
            if abs(residual) <= ROUNDING_RESIDUAL * max(abs(value), roots.scale[worst]) and tolerance < PROPOSED:
                more = f", or a larger tolerance: this residual is rounding (loops: {{tolerance: {PROPOSED:g}}})"
            elif count >= self.settings.iterations:  # with fewer, no step leads nearer
                more = f", or more iterations (loops: {{iterations: {5 * self.settings.iterations}}})"
            message = (
                f"{self.name} does not converge: after {count} iterations {signal} is {value:.6g}, and the loop "
                f"returns {residual:+.3g} more (relative tolerance {tolerance:g}). Signals of the loop: {signals}. If "
                f"it has a solution, start values near it help{more}; order: [...] or algorithm: jacobi do not solve it"
            )
        raise SimulationError("algebraic loop", t, message)

    def _has_unit_gain(self, z: Array) -> bool:
        """Return whether I − ∂g/∂z is singular at several points about z, so that no solution is unique."""
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
        """Return g(z), None where a component refuses its inputs."""
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
        """Return ∂g/∂z, chained from components and transfers."""
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
        """Return the slopes of a component's outputs: its directional derivatives, or differences."""
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
        """Return the slope of a transfer."""
        value, function = self.row[transfer.source], self._functions[transfer.name]
        ahead = function(self._point, value + 1.0)
        return float(ahead - function(self._point, value))  # This call leaves the memory of faults as it was.

    def _find_repeats(self, member: Member, gain: float) -> list[str]:
        """Note whether steps must be repeated, because outputs follow inputs only after a step; return warnings.

        Args:
            gain: Loop gain in initialization: the largest growth of a deviation around the loop.
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
            member.late = f"{name} answers no input without a step, and none is declared to act"
            self._is_warned = True
            return [
                f"{name}: no output in the algebraic loop {self.name} follows an input without a step, and none is "
                "declared to; its outputs are those after a step with the inputs of the step's start. If a step shows "
                f"feedthrough, state it (components.{name}.feedthrough: [{', '.join(inputs)}])"
            ]
        if is_silent and not can_repeat:
            member.late = f"{name} answers only after a step and cannot save its state"
        elif missing.any() and not can_repeat:
            j, k = (int(each[0]) for each in np.nonzero(missing))
            cure = "no cure: with values of the step before, they grow"
            more = ". The loop needs an FMU that saves and restores its state, or one without direct feedthrough"
            if gain < 1.0:
                cure, more = "a cure: they leave it open, with values of the step before, which settle", ""
            raise SimulationError(
                name,
                self.start,
                f"{self._columns[member.outputs[j]]} follows {self._columns[member.inputs[k]]} only after a step, "
                f"which cannot be repeated, because the FMU saves no state; so the algebraic loop {self.name} cannot "
                f"be solved. order: [...] or algorithm: jacobi is {cure} (the loop gain is {gain:.3g}){more}",
            )
        return []


def is_lost(component: Any) -> bool:
    """Return whether a component is an FMU that is lost after Fatal."""
    return isinstance(component, FmuBlock) and component.instance.fmu is None


def members_of(loop: Loop, master: Master) -> list[Member]:
    """Return the components of a loop in their order."""
    return [Member(master, component, loop) for component in master.components if component.name in loop.members]
