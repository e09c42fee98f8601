"""Algebraic loops of a run: inputs and outputs that depend on each other at the same time.

The unknowns z are the inputs whose connections come from a later component in the order of the loop. Evaluating the
components in order gives g(z), the values at the sources of these connections; the solution is g(z) = z. The Jacobian
of g is a product of the components' Jacobians, which are directional derivatives or differences.

At a communication point, the components have stepped with the inputs of the previous point. Their outputs for other
inputs are then computed without a step. If outputs of an FMU react only after a step, each trial repeats the step from
the saved state, so that the trial input acts during the whole step. If the FMU cannot save its state, the loop is not
solved, but coupled with a delay: each step uses the inputs of its start.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.blocks.component import ADVANCE, GET, PUT, EarlyEnd
from cosim.blocks.coupling import torn
from cosim.blocks.fmu import FmuBlock
from cosim.core.arrays import Array, Flags
from cosim.core.errors import SimulationError
from cosim.core.times import first_point
from cosim.master.root_finding import RootFinding
from cosim.scenario.scenario import LoopSettings
from cosim.system.schedule import Loop
from cosim.system.wiring import Transfer

if TYPE_CHECKING:
    from cosim.master.master import Master

SHIFT = 1e-5  # change of an input for differences, relative to its magnitude
PROBES = (1e-3, -1e-3, 0.5, -0.5)  # relative changes of an input, to test whether an output depends on it
MOST_ITEMS = 4  # tried items of an enumeration
REACTION = 1e-9  # smallest relative change of an output that counts
RETRY_EXPONENTS = -3, 5  # exponents of 2 of other first points, where a component refuses the inputs
MOST_DIFFERENCES = 50  # inputs of a loop without derivatives, beyond which Newton's method costs too much


class Member:
    """A component of a loop, with the indices in the row of its inputs and outputs within the loop.

    Attributes:
        nominal: Input → nominal value; 1 for an input that is not in `declared`.
        repeats: True if outputs react to inputs only after a step, which is therefore repeated.
        reacts: True where an output (row) reacted to an input (column) during initialization.
        has_directional: True if the last Jacobian consisted of directional derivatives of the FMU.
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
        self.repeats, self.has_directional = False, False
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
        self._unsolved: list[str] = []  # reasons why the loop is not solved

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
        if self._roots.slopes is None:  # the method depends on which FMUs have directional derivatives
            z = self.signals[self.unknowns]
            self._slopes(z, z, fresh=False)
        self._roots.slopes = None
        for member in self.members:
            if member.inputs and not member.changes_by_events:
                self._find_repeats(member)
        return [
            f"the algebraic loop {self.name} is not solved: {reason}. Each step uses the inputs of its start; a "
            "shorter step may reduce the error"
            for reason in self._unsolved
        ]

    def step(self, t: float, h: float) -> None:
        """Step the components from t to t + h [s], and solve the loop at the end.

        Raises:
            SimulationError: A component failed, or the iterations do not converge.
        """
        self._point = first_point(t + h, self.start, self._h)
        for member in self.members:
            member.begin_step(t, h)
        self._set_late(repeats=False)
        self._iterations.append(self._solve(t + h))
        for member in self.members:
            member.end_step()
        self._set_late(repeats=True)

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
                m.component.name: "directional" if m.has_directional else "differences"
                for m in self.members
                if m.inputs
            },
            "repeated": [m.component.name for m in self.members if m.repeats],
            "iterations": {"start": self._at_start, "most": max(counts, default=0), "total": sum(counts)},
            "points": len(counts),
            **({"not_solved": {"reason": "; ".join(self._unsolved)}} if self._unsolved else {}),
        }

    def notes(self) -> list[str]:
        """Return a warning about inexact solutions."""
        if not self._rough:
            return []
        t, residual, value, signal = self._rough[0]
        return [
            f"the algebraic loop {self.name} is not solved to the relative tolerance {self.settings.tolerance:g} at "
            f"{len(self._rough)} points: first at t = {t:.6g} s, where {signal} is {value:.3g} with a residual of "
            f"±{abs(residual):.2g} that no iteration reduces. Declare the size of this input as its nominal value in "
            "the FMU"
        ]

    @property
    def method(self) -> str:
        """Return a phrase for the method of solution."""
        if self.settings.method is not None:
            return self.settings.method
        differences = sum(len(m.inputs) for m in self.members if not m.has_directional)
        return "anderson" if differences > MOST_DIFFERENCES else "newton"

    # -- internal -------------------------------------------------------------------------------

    def _solve(self, t: float) -> int:
        """Solve the loop; return the number of iterations.

        Raises:
            SimulationError: The iterations do not converge.
        """
        z, outcome = self.signals[self.unknowns], None
        shifts = (z + s * self._roots.scale for k in range(*RETRY_EXPONENTS) for s in (2.0**k, -(2.0**k)))
        for start in (z, *self._guesses, *shifts):
            if self.method == "newton":
                outcome = self._roots.newton(self._sweep, start, self._slopes)
            else:
                outcome = self._roots.anderson(self._sweep, start)
            if outcome is not None:
                break
            self._roots.slopes = None
        if outcome is None:
            assert self._refusal is not None
            raise self._refusal
        worst = int(np.argmax(np.abs(outcome.residual) / np.maximum(np.abs(outcome.z), self._roots.scale)))
        value, residual = float(outcome.z[worst]), float(outcome.residual[worst])
        signal, count = self.back[worst].name, outcome.iterations
        if outcome.converged:
            self.signals[self.unknowns] = outcome.z
            if outcome.is_rough:
                self._rough.append((t, residual, value, signal))
            return count
        raise SimulationError(
            "algebraic loop",
            t,
            f"{self.name} does not converge: after {count} iterations {signal} is {value:.6g} with the residual "
            f"{residual:+.3g} (relative tolerance {self.settings.tolerance:g}). Signals of the loop: "
            f"{', '.join(t.name for t in self._transfers)}. Use start values near the solution, a larger tolerance or "
            f"more iterations (loops: {{iterations: {5 * self.settings.iterations}}}), or an FMU without direct "
            "feedthrough; a loop of gain 1 has no unique solution",
        )

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
        """Return the Jacobian of a component, from its directional derivatives or differences.

        A component that refuses an input on both sides counts as unaffected by it.

        Args:
            fresh: Use differences, after derivatives of the FMU have failed.
        """
        shape = len(member.outputs), len(member.inputs)
        directional = getattr(member.component, "slopes", None)
        member.has_directional = False
        if directional is not None and not fresh and all(shape):
            with suppress(SimulationError):
                derivatives = directional(*member.variables)
                if derivatives is not None and np.isfinite(derivatives).all():
                    member.has_directional = True
                    return np.array(derivatives).reshape(shape)
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

    def _find_repeats(self, member: Member) -> None:
        """Determine if steps must be repeated, because outputs react to inputs only after a step."""
        member.evaluate()
        reacts, _ = member.reactions(member.inputs)
        member.evaluate()
        name, fmu, missing = member.component.name, member.component, member.reacts & ~reacts
        is_declared = any(map(fmu.depends_on, member.variables[1]))
        is_silent = is_declared and not (reacts.any() or member.reacts.any())
        can_repeat = isinstance(fmu, FmuBlock) and fmu.rolls_back
        member.repeats = can_repeat and bool(missing.any() or is_silent)
        if not (is_declared or reacts.any() or member.reacts.any()):
            self._unsolved.append(
                f"{name} neither declares nor shows direct feedthrough; if it has, declare it "
                f"(components.{name}.feedthrough: [{', '.join(member.variables[1])}])"
            )
        elif is_silent and not can_repeat:
            self._unsolved.append(f"{name} responds to inputs only after a step and cannot save its state")
        elif missing.any() and not can_repeat:
            j, k = (int(each[0]) for each in np.nonzero(missing))
            raise SimulationError(
                name,
                self.start,
                f"{self._columns[member.outputs[j]]} follows {self._columns[member.inputs[k]]} only after a step, "
                f"which cannot be repeated, because the FMU saves no state; so the algebraic loop {self.name} cannot "
                "be solved. Use an FMU that saves and restores its state, or values of the previous step (order: "
                "[...] or algorithm: jacobi), with which the signals settle if the loop gain is below 1",
            )


def is_lost(component: Any) -> bool:
    """Return True for an FMU that cannot be called any more after a fatal error."""
    return isinstance(component, FmuBlock) and component.instance.fmu is None


def members_of(loop: Loop, master: Master) -> list[Member]:
    """Return the components of a loop in their order."""
    return [Member(master, component, loop) for component in master.components if component.name in loop.members]
