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
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import NotFinite, SimulationError
from cosim.base.messages import Note
from cosim.base.times import first_point
from cosim.blocks.component import EarlyEnd
from cosim.blocks.coupling import torn
from cosim.blocks.fmu import FmuBlock
from cosim.isolation.rows import ADVANCE, CALLS, GET, OTHER, PUT
from cosim.master.copying import Copying, copy_values
from cosim.master.root_finding import NotDefined, Outcome, RootFinding
from cosim.scenario.scenario import LoopSettings
from cosim.system.schedule import Loop
from cosim.system.system import System
from cosim.system.wiring import Transfer

OPEN_SETTLES = (
    "order: [...] or algorithm: jacobi leaves it open, with values of the step before, which settle (the loop "
    "gain is {gain:.3g})"
)
OPEN_GROWS = (
    "order: [...] or algorithm: jacobi is no cure: with values of the step before, they grow (the loop gain is "
    "{gain:.3g}). The loop needs an FMU that saves and restores its state, or one without direct feedthrough"
)
SHIFT = 1e-5  # displacement of an input for differences, relative to its magnitude
PROBES = (1e-3, -1e-3, 0.5, -0.5)  # displacements that show whether an output depends on an input
REACTION = 1e-9  # smallest relative change of an output that counts
ROUNDED = 1e-13  # residual of rounding, relative to the magnitude
PROPOSED = 1e-8  # tolerance that a message proposes for a smaller one
UNIT_GAIN = 1e-8  # smallest singular value of I − ∂g/∂z that counts
UNIT_GAIN_POINTS = 0.0, 1.0, -0.37  # displacements in magnitudes of the unknowns
RANGE = -3, 5  # exponents of 2 of other first points, where a component refuses the inputs
MOST_DIFFERENCES = 50  # inputs of a loop without derivatives, beyond which Newton's method costs too much

DOUBLINGS = 12  # of the residual, for the judgement whether it grows without bound
EVEN = 1.5  # ratio of the steps that the second and the first half of these doublings take
LARGE = 1e9  # residual in nominal values from which on such growth ends a run


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
        self.reason, self.places, self._names, self._nominal = reason, tuple(places), names, np.array(nominal)
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
        return self._grows(size)

    def _grows(self, size: float) -> bool:
        """Return whether a residual grows without bound."""
        if size <= 0.0 or (self._doublings and size < 2.0 * self._doublings[-1][1]):
            return False
        self._doublings.append((len(self._shares), size))
        steps = [step for step, _ in self._doublings[-DOUBLINGS - 1 :]]
        if size < LARGE or len(steps) <= DOUBLINGS:
            return False
        middle = steps[DOUBLINGS // 2]
        return steps[-1] - middle <= EVEN * (middle - steps[0])

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
        repeats: Whether its outputs follow its inputs only after a step, which is therefore repeated.
        late: Why its inputs act only in the next step, "" if they do not.
        reacts: Whether an output (row) followed an input (column) in initialization.
        promised: Whether its last slopes were its own directional derivatives.
    """

    def __init__(self, component: Any, number: int, inputs: Sequence[int], outputs: Sequence[int], row: Any) -> None:
        self.component, self.number, self.row = component, number, row
        self.inputs, self.outputs = tuple(inputs), tuple(outputs)
        self.repeats, self.promised, self.late = False, False, ""
        self.reacts = np.zeros((len(self.outputs), len(self.inputs)), bool)
        self._state: Any = None
        self._is_stepped = True
        self._step: tuple[float, float] = (0.0, 0.0)

    def begin_step(self, doing: Any, t: float, h: float) -> None:
        """Step, or save the state for repeated steps."""
        if self.repeats:
            doing[0] = CALLS * self.number + OTHER
            self._state, self._is_stepped, self._step = self.component.instance.save_state(), False, (t, h)
            return
        doing[0] = CALLS * self.number + PUT
        self.component.put()
        doing[0] = CALLS * self.number + ADVANCE
        self.component.advance(t, h)

    def evaluate(self, doing: Any) -> None:
        """Write the outputs to the current inputs."""
        if self._state is not None and self._is_stepped:
            doing[0] = CALLS * self.number + OTHER
            self.component.instance.restore_state(self._state, keep=True)
        doing[0] = CALLS * self.number + PUT
        getattr(self.component, "try_inputs", self.component.put)()
        if self._state is not None:
            doing[0] = CALLS * self.number + ADVANCE
            self._is_stepped = True
            self.component.advance(*self._step)
        doing[0] = CALLS * self.number + GET
        self.component.get()

    def end_step(self, doing: Any) -> None:
        """Make the event of changed inputs; free the state."""
        if self._state is not None:
            state, self._state = self._state, None
            doing[0] = CALLS * self.number + OTHER
            self.component.instance.free_state(state)
        elif getattr(self.component, "changes_by_events", False):
            doing[0] = CALLS * self.number + PUT
            self.component.put()
            doing[0] = CALLS * self.number + GET
            self.component.get()

    def try_at(self, doing: Any, place: int, value: float) -> Array | None:
        """Return the outputs to another input, None if refused."""
        before, self.row[place] = self.row[place], value
        try:
            self.evaluate(doing)
        except EarlyEnd:
            raise
        except SimulationError:
            return None
        finally:
            self.row[place] = before
        return self.values()

    def values(self) -> Array:
        """Return the current outputs."""
        return np.array([self.row[k] for k in self.outputs])


class LoopSolver:
    """Solver of an algebraic loop of a run.

    Attributes:
        name: Components of the loop in a message.
        names: Their names; that of the last one is `last`.
    """

    def __init__(self, loop: Loop, copying: Copying, doing: Any) -> None:
        system, row = copying.system, copying.row
        self.row, self.doing, self.start, self._h = row, doing, system.start, copying.h
        self.settings = system.solving or LoopSettings()
        self.name, self.names, self.last = loop.name, loop.members, loop.members[-1]
        owners = [column.partition(".")[0] for column in system.columns]
        ends = [(owners[t.source], owners[t.target]) for t in loop.transfers]
        marked = list(zip(loop.transfers, torn(loop.members, ends), strict=True))
        self.back = [t for t, is_back in marked if is_back]
        self.unknowns = [t.target for t in self.back]
        self._transfers, self._columns = loop.transfers, system.columns
        self._forward = {n: [t for t, is_back in marked if owners[t.target] == n and not is_back] for n in loop.members}
        self._into = {name: copying.of(transfers) for name, transfers in self._forward.items()}
        self._to_back = copying.of(self.back)
        self._known_into = {
            s.component.name: copying.of(s.late) for s in system.stages if s.component.name in loop.members
        }
        self._one = {t.name: copying.of([t]) for t in loop.transfers}
        self.members = members_of(loop, system, row)
        self._nominal: dict[int, float] = {}  # place of an input → nominal value
        self._declared: set[int] = set()  # places of inputs that declare it
        for member in self.members:
            for place in member.inputs:
                variable = self._columns[place].partition(".")[2]
                self._nominal[place] = nominal_of(member.component, variable)
                if isinstance(member.component, FmuBlock) and member.component.nominal(variable, default=0.0) > 0.0:
                    self._declared.add(place)
        scale = np.array([self._nominal[place] for place in self.unknowns])
        is_assumed = np.array([place not in self._declared for place in self.unknowns])
        self._roots = RootFinding(self.settings.tolerance, self.settings.iterations, scale, is_assumed)
        self._seen: dict[int, float] = {}  # place of a signal → its largest magnitude
        self._rough: list[tuple[float, float, float, str]] = []  # time, residual, value and signal of rough solutions
        self._point, self._is_probed = 0, False
        self._iterations: list[int] = []
        self._at_start = 0
        self._guesses: list[Array] = []
        self._refusal: SimulationError | None = None
        self._delayed: DelayedLoop | None = None  # if the loop is not solved
        self._is_warned = False  # of that, before the first step

    # -- solutions ----------------------------------------------------------------------------------

    def solve_start(self) -> None:
        """Solve the loop in initialization."""
        if not self._is_probed:
            self._probe_start()
        self._at_start += self._solve(self.start)

    def begin(self) -> list[str]:
        """Find components that answer only after a step.

        Returns:
            Warnings.

        Raises:
            SimulationError: The steps of such a component cannot be repeated.
        """
        gain = self._gain_at_start()
        self._roots.slopes = None
        members = [m for m in self.members if m.inputs and not getattr(m.component, "changes_by_events", False)]
        warnings = [warning for member in members for warning in self._find_repeats(member, gain)]
        if late := [member for member in self.members if member.late]:
            places = sorted({place for member in late for place in member.inputs})
            names, nominal = [self._columns[k] for k in places], [self._nominal[k] for k in places]
            self._delayed = DelayedLoop("; ".join(member.late for member in late), places, names, nominal)
        return warnings

    def step(self, t: float, h: float) -> None:
        """Step from t to t + h [s] and solve the loop there.

        Raises:
            SimulationError: A component failed, the iterations do not converge, or values grow without bound.
        """
        self._point = first_point(t + h, self.start, self._h)
        if self._delayed is None:
            self._solved_step(t, h)
            return
        delayed, assumed = self._delayed, self._values(self._delayed.places)
        try:
            self._solved_step(t, h)
        except SimulationError as error:
            if not isinstance(error, NotFinite) or not delayed.last:
                raise
            residual = (
                "{loop} is an algebraic loop that is not solved: {reason}; at t = {time:.6g} s {signal} "
                "was {value:.3g} and the loop returned {residual:+.3g} more"
            ).format(loop=self.name, reason=delayed.reason, **delayed.last)
            message = f"{error.reason}. {residual}"
            raise SimulationError(error.component, error.time, message) from None
        if delayed.note(t + h, assumed, self._values(delayed.places)):
            grown = (
                "{loop} is not solved ({reason}) and grows without bound: {signal} is {value:.3g} in the "
                "last step, and the loop returns {residual:+.3g} more, a residual that doubles in equal "
                "times. It needs an FMU that saves and restores its state, or one without direct "
                "feedthrough; a shorter step if the growth is of motion; order: [...] runs it without "
                "this judgement"
            ).format(loop=self.name, reason=delayed.reason, **delayed.last)
            raise SimulationError("algebraic loop", t + h, grown)

    def _solved_step(self, t: float, h: float) -> None:
        for member in self.members:
            member.begin_step(self.doing, t, h)
        self._set_late(repeats=False)
        self._iterations.append(self._solve(t + h))
        for member in self.members:
            member.end_step(self.doing)
        self._set_late(repeats=True)

    def _set_late(self, *, repeats: bool) -> None:
        """Copy known values of the end of a step, to components whose step is repeated after the last repetition."""
        for member in self.members:
            if member.repeats == repeats:
                copy_values(self.row, self._known_into[member.component.name], self._point)

    def _values(self, places: Sequence[int]) -> Array:
        return np.array([self.row[k] for k in places])

    def _write(self, places: Sequence[int], values: Array) -> None:
        for place, value in zip(places, values.tolist(), strict=True):
            self.row[place] = value

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
            relative = self._delayed.record()["relative"]
            fields = self._delayed.worst | {"median": relative["median"], "last": relative["last"]}
            notes.append(
                (
                    "the algebraic loop {loop} is not solved: {reason}. Each step has the inputs of its "
                    "start; at its end the loop returns others, by {median:.2g} of the signal at half of the "
                    "points and {last:.2g} at the last; the largest residual is {residual:+.3g} of {signal} "
                    "at t = {time:.6g} s. A shorter step makes a residual of motion smaller"
                ).format(loop=self.name, reason=self._delayed.reason, **fields)
            )
        if self._rough:
            t, residual, value, signal = self._rough[0]
            fields = {"count": len(self._rough), "time": t, "residual": abs(residual), "value": value, "signal": signal}
            notes.append(
                (
                    "the algebraic loop {loop} is solved less exactly than to {tolerance:g} of its signals "
                    "at {count} points: first at t = {time:.6g} s, where {signal} is {value:.3g} and the "
                    "loop returns {residual:.2g} more or less, which no iteration makes smaller. A nominal "
                    "value of this input in its FMU states the size that counts"
                ).format(loop=self.name, tolerance=self.settings.tolerance, **fields)
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
        z = self._values(self.unknowns)
        outcome = self._outcome(z)
        worst = int(np.argmax(np.abs(outcome.residual) / np.maximum(np.abs(outcome.z), self._roots.scale)))
        if outcome.converged:
            self._write(self.unknowns, outcome.z)
            if outcome.is_rough:
                self._rough.append((t, outcome.residual[worst], outcome.z[worst], self.back[worst].name))
            return outcome.iterations
        signals = ", ".join(t.name for t in self._transfers)
        fields: dict[str, Any] = {"signal": self.back[worst].name, "value": float(outcome.z[worst])}
        fields |= {"residual": float(outcome.residual[worst]), "loop": self.name, "count": outcome.iterations}
        gave_up = outcome.iterations < self.settings.iterations  # because no step leads nearer
        more = f", or more iterations (loops: {{iterations: {5 * self.settings.iterations}}})"
        fields |= {"more": "" if gave_up else more}
        least = ROUNDED * max(abs(outcome.z[worst]), self._roots.scale[worst])
        if abs(outcome.residual[worst]) <= least and self.settings.tolerance < PROPOSED:
            fields["more"] = Note(
                f", or a larger tolerance: this residual is rounding (loops: {{tolerance: {PROPOSED:g}}})"
            )
        if self._has_unit_gain(z):
            message = (
                "{loop} has no solution, or no unique one: its gain is 1, so that the loop returns "
                "{residual:+.3g} more than {signal}, whatever its value. Signals of the loop: {signals}. "
                "No start value, tolerance, order or algorithm is a cure; change its equations (a "
                "parameter of an FMU), or put an FMU without direct feedthrough into it"
            ).format(signals=signals, **fields)
        else:
            message = (
                "{loop} does not converge: after {count} iterations {signal} is {value:.6g}, and the "
                "loop returns {residual:+.3g} more (relative tolerance {tolerance:g}). Signals of the "
                "loop: {signals}. If it has a solution, start values near it help{more}; order: [...] or "
                "algorithm: jacobi do not solve it"
            ).format(signals=signals, tolerance=self.settings.tolerance, **fields)
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
        shifts = (z + s * self._roots.scale for k in range(*RANGE) for s in (2.0**k, -(2.0**k)))
        for start in (z, *self._guesses, *shifts):
            try:
                if self.method == "newton":
                    return self._roots.newton(self._sweep, start, self._slopes)
                return self._roots.anderson(self._sweep, start)
            except NotDefined:
                self._roots.slopes = None
        assert self._refusal is not None
        raise self._refusal

    def _sweep(self, z: Array) -> Array | None:
        """Return g(z), None where a component refuses its inputs."""
        self._write(self.unknowns, z)
        try:
            for member in self.members:
                copy_values(self.row, self._into[member.component.name], self._point)
                member.evaluate(self.doing)
        except EarlyEnd:
            raise
        except SimulationError as error:
            if any(is_lost(member.component) for member in self.members):
                raise
            self._refusal = error
            return None
        copy_values(self.row, self._to_back, self._point)
        for transfer in self._transfers:
            for place in (transfer.source, transfer.target):
                self._seen[place] = max(self._seen.get(place, 0.0), abs(self.row[place]))
        self._roots.largest = max(self._seen.values())
        returned = self._values(self.unknowns)
        self._write(self.unknowns, z)
        return returned

    def _slopes(self, z: Array, g: Array, *, fresh: bool) -> Array:
        """Return ∂g/∂z, chained from components and transfers."""
        self._write(self.unknowns, z)
        along = dict(zip(self.unknowns, np.eye(z.size), strict=True))
        for member in self.members:
            for t in self._forward[member.component.name]:
                along[t.target] = self._gain(t) * along[t.source]
            slopes = self._member_slopes(member, fresh=fresh)
            for place, row in zip(member.outputs, slopes, strict=True):
                along[place] = sum((s * along[k] for s, k in zip(row, member.inputs, strict=True)), np.zeros(z.size))
        return np.array([self._gain(t) * along[t.source] for t in self.back])

    def _member_slopes(self, member: Member, *, fresh: bool) -> Array:
        """Return the slopes of a component's outputs."""
        shape = len(member.outputs), len(member.inputs)
        variables = [[self._columns[k].partition(".")[2] for k in ends] for ends in (member.outputs, member.inputs)]
        promise = getattr(member.component, "slopes", None)
        member.promised = False
        if promise is not None and not fresh and all(shape):
            try:
                promised = promise(*variables)
            except SimulationError:
                promised = None
            if promised is not None and np.isfinite(promised).all():
                member.promised = True
                return np.array(promised).reshape(shape)
        base, slopes = member.values(), np.zeros(shape)
        for j, place in enumerate(member.inputs):
            shift, seen = SHIFT * max(abs(self.row[place]), self._nominal[place]), self._seen.get(place, 0.0)
            if fresh and seen > 0.0 and place not in self._declared:
                shift = min(shift, SHIFT * seen)
            for step in (shift, -shift):
                values = member.try_at(self.doing, place, self.row[place] + step)
                if values is not None:
                    slopes[:, j] = (values - base) / step
                    break
        self._write(member.outputs, base)
        return slopes

    def _gain(self, transfer: Transfer) -> float:
        """Return the slope of a transfer."""
        value, at = self.row[transfer.source], self.row[transfer.target]
        results = []
        for shifted in (value + 1.0, value):  # The last one leaves the memory of faults as it was.
            self.row[transfer.source] = shifted
            copy_values(self.row, self._one[transfer.name], self._point)
            results.append(self.row[transfer.target])
        self.row[transfer.target] = at
        return float(results[0] - results[1])

    # -- outputs that follow inputs only after a step ------------------------------------------------

    def _probe_start(self) -> None:
        """Set `reacts` of each member: an output that changes with an input in initialization."""
        self._is_probed = True
        before = list(self.row)
        for member in self.members:
            try:
                member.evaluate(self.doing)
            except EarlyEnd:
                raise
            except SimulationError:
                continue
            member.reacts = self._reactions(member)
        copy_values(self.row, self._to_back, 0)
        self._guesses = [self._values(self.unknowns)]
        for place in self.unknowns:
            self.row[place] = before[place]

    def _reactions(self, member: Member) -> Any:
        """Return whether outputs follow inputs without a step."""
        base = member.values()
        reacts = np.zeros((len(member.outputs), len(member.inputs)), bool)
        least = REACTION * np.maximum(np.abs(base), 1e-300)
        for j, place in enumerate(member.inputs):
            size = max(abs(self.row[place]), self._nominal[place])
            for share in PROBES:
                values = member.try_at(self.doing, place, self.row[place] + share * size)
                if values is not None:
                    reacts[:, j] |= np.abs(values - base) > least
        return reacts

    def _gain_at_start(self) -> float:
        """Return the loop gain in initialization: the largest growth of a deviation around the loop."""
        z = self._values(self.unknowns)
        slopes = self._roots.slopes if self._roots.slopes is not None else self._slopes(z, z, fresh=False)
        return float(np.max(np.abs(np.linalg.eigvals(slopes)), initial=0.0)) if np.isfinite(slopes).all() else math.inf

    def _find_repeats(self, member: Member, gain: float) -> list[str]:
        """Note whether steps must be repeated; return warnings.

        Args:
            gain: Loop gain in initialization.
        """
        member.evaluate(self.doing)
        reacts = self._reactions(member)
        member.evaluate(self.doing)
        missing = member.reacts & ~reacts
        is_declared = any(member.component.depends_on(self._columns[k].partition(".")[2]) for k in member.inputs)
        is_silent = is_declared and not (member.reacts.any() or reacts.any())
        can_repeat = isinstance(member.component, FmuBlock) and member.component.instance.rolls_back
        member.repeats = can_repeat and bool(missing.any() or is_silent)
        if not (is_declared or reacts.any() or member.reacts.any()):
            member.late, self._is_warned = (
                Note(f"{member.component.name} answers no input without a step, and none is declared to act"),
                True,
            )
            inputs = ", ".join(self._columns[k].partition(".")[2] for k in member.inputs)
            return [
                (
                    f"{member.component.name}: no output in the algebraic loop {self.name} follows an input "
                    "without a step, and none is declared to; its outputs are those after a step with the "
                    "inputs of the step's start. If a step shows feedthrough, state it "
                    f"(components.{member.component.name}.feedthrough: [{inputs}])"
                )
            ]
        if can_repeat or not (missing.any() or is_silent):
            return []
        if is_silent:
            member.late = Note(f"{member.component.name} answers only after a step and cannot save its state")
            return []
        j, k = (int(each[0]) for each in np.nonzero(missing))
        ends = {"output": self._columns[member.outputs[j]], "input": self._columns[member.inputs[k]]}
        cure = (OPEN_SETTLES if gain < 1.0 else OPEN_GROWS).format(gain=gain)
        message = (
            "{output} follows {input} only after a step, which cannot be repeated, because the FMU "
            "saves no state; so the algebraic loop {loop} cannot be solved. {cure}"
        ).format(loop=self.name, cure=cure, **ends)
        raise SimulationError(member.component.name, self.start, message)


def nominal_of(component: Any, variable: str) -> float:
    """Return the nominal value of a component's variable."""
    return component.nominal(variable) if isinstance(component, FmuBlock) else 1.0


def is_lost(component: Any) -> bool:
    """Return whether a component is an FMU that is lost after Fatal."""
    return isinstance(component, FmuBlock) and component.instance.fmu is None


def members_of(loop: Loop, system: System, row: Any) -> list[Member]:
    """Return the components of a loop in their order."""
    owners = [column.partition(".")[0] for column in system.columns]
    members = []
    for k, stage in enumerate(system.stages):
        name = stage.component.name
        if name in loop.members:
            inputs = sorted({t.target for t in loop.transfers if not t.beside[1] and owners[t.target] == name})
            outputs = sorted({t.source for t in loop.transfers if not t.beside[0] and owners[t.source] == name})
            members.append(Member(stage.component, k, inputs, outputs, row))
    return members
