"""Measurement of direct feedthrough where FMUs declare no dependencies, in instances of its own.

An order of components may assume that an undeclared input has no direct feedthrough. Here the components are opened
once before the run. Each such input is displaced, by small and large amounts about two points, in initialization and
after it, and the outputs that follow are noted: integers by one, Booleans to their other value, enumerations to other
items. FMUs in event mode stay in the event mode after initialization. The instances of the run itself are not touched.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.base.arrays import Array, far_beyond
from cosim.base.errors import SimulationError
from cosim.blocks.component import EarlyEnd
from cosim.blocks.event_mode import EventFmu
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import Rows
from cosim.isolation.watch import Watch, fmi_calls
from cosim.master.initialization import Initialization
from cosim.master.loops import PROBES, Member, is_lost, members_of, nominal_of
from cosim.master.master import Master
from cosim.master.own_process import in_own_processes
from cosim.system.system import System

SWEEPS = 3  # exchanges of values before the measurement
LEAST = 1e-7  # change of an output that counts, relative to its value
NOISE = 10.0  # the same relative to differences between equal calls
IRREGULAR = 0.37  # displacement of the second point, in sizes of an input
OTHERS = -0.37, -0.9, 0.9  # displacements of further points, for a component that refuses the first two
MOST_ITEMS = 4  # tried items of an enumeration

Pair = tuple[str, str]  # output, input


@dataclass(frozen=True)
class Feedthrough:
    """Measured feedthrough of inputs without declared dependencies.

    Attributes:
        pairs: Outputs that follow an input after initialization.
        at_start: Outputs that follow an input in initialization only.
        inputs: Inputs that were measured.
        failure: Why something could not be measured.
    """

    pairs: tuple[Pair, ...] = ()
    at_start: tuple[Pair, ...] = ()
    inputs: frozenset[str] = frozenset()
    failure: str = ""


def undeclared_inputs(system: System) -> dict[str, frozenset[str]]:
    """Return component → inputs within open loops that have no declared dependencies.

    Inputs of FMUs in event mode whose values settle at each instant need none.
    """
    undeclared = {}
    transfers = [transfer.name.partition(".") for loop in system.opened for transfer in loop.transfers]
    for component in (stage.component for stage in system.stages):
        inputs = [name for owner, _, name in transfers if owner == component.name]
        if isinstance(component, EventFmu):
            inputs = [name for name in inputs if not component.settles(name)]
        if names := frozenset(f"{component.name}.{n}" for n in inputs if component.depends_on(n) is None):
            undeclared[component.name] = names
    return undeclared


def measure_feedthrough(
    system: System, h: float, worker: Worker | None, limits: Limits, spent: list[float]
) -> Feedthrough:
    """Return the feedthrough of undeclared inputs in the open loops of a system.

    Args:
        h: Step of the run [s].
        worker: Process for the FMUs; None for this one, without limits.
        spent: Time [s] without loading, increased by the measurement.

    Raises:
        FmuError: An FMU does not load.
        SimulationError: A component failed.
    """
    if worker is None:
        return measure(system, h, None)
    calls = [fmi_calls(getattr(stage.component, "description", None)) for stage in system.stages]
    watch = Watch(system.names, calls, limits=limits, spent=spent)
    measured: Feedthrough = worker.call(measure, system, h, limits, watch=watch)
    return measured


@far_beyond
def measure(system: System, h: float, limits: Limits | None) -> Feedthrough:
    """Return the feedthrough, measured in this process."""
    if limits is not None:
        system = in_own_processes(system, limits)
    rows = Rows.in_memory(2, len(system.columns))
    if limits is not None:
        rows = replace(rows, doing=here.progress.doing)
    return _Measurement(system, 1, h, None, rows).result()


class _Measurement(Master):
    """A master that ends after its initialization."""

    def result(self) -> Feedthrough:
        """Return the measured feedthrough."""
        try:
            self._open()
            failure = self._exchange()
            members = [m for loop in self.system.opened for m in members_of(loop, self.system, self.row)]
            undeclared = frozenset[str]().union(*undeclared_inputs(self.system).values())
            places = [[k for k in m.inputs if self.system.columns[k] in undeclared] for m in members]
            asked = [(member, each) for member, each in zip(members, places, strict=True) if each]
            first = self._measure(asked)
            for component in self.components:
                self.announce(component)
                component.start()
            for component in self.components:
                with suppress(SimulationError):  # It may refuse the start values.
                    component.get()
            later = self._measure(asked)
        finally:
            for component in self.components:
                self.announce(component)
                component.close()
        inputs = first.inputs & later.inputs
        at_start = tuple(pair for pair in first.pairs if pair not in later.pairs and pair[1] in inputs)
        return Feedthrough(later.pairs, at_start, inputs, failure)

    def _exchange(self) -> str:
        """Exchange values a few times, as long as all components accept them; return the first refusal.

        A component of a loop may refuse the start values of the others. It is then measured at its own.
        """
        data = self.system, self.components, self.row, self.beside, self.pulls, self.held
        exchange = Initialization(*data, self.doing)
        for sweep in range(SWEEPS):
            before = list(self.row)
            try:
                exchange.sweep()
            except SimulationError as error:
                if isinstance(error, EarlyEnd) or any(is_lost(component) for component in self.components):
                    raise
                self.row[:] = before
                return "" if sweep else f": {error}"
        return ""

    def _measure(self, asked: Sequence[tuple[Member, list[int]]]) -> Feedthrough:
        """Return the outputs that follow inputs now."""
        names = self.system.columns
        pairs: list[Pair] = []
        measured: set[str] = set()
        for member, places in asked:
            before = list(self.row)
            follows = np.zeros((len(member.outputs), len(places)), bool)
            accepts = np.zeros(len(places), bool)
            for k, share in enumerate((0.0, IRREGULAR, *OTHERS)):
                if k > 1 and accepts.any():
                    break
                for j, place in enumerate(places):
                    if not self.system.signals[names[place]].is_whole:
                        self.row[place] = before[place] + share * (1.0 + 0.1 * j) * self._size(member, place)
                with suppress(SimulationError):
                    member.evaluate(self.doing)
                    answers = self._follow(member, places)
                    follows |= answers[0]
                    accepts |= answers[1]
            measured |= {names[places[j]] for j in np.flatnonzero(accepts)}
            self.row[:] = before
            with suppress(SimulationError):
                member.evaluate(self.doing)
            pairs += [(names[member.outputs[i]], names[places[j]]) for i, j in zip(*np.nonzero(follows), strict=True)]
        return Feedthrough(tuple(pairs), (), frozenset(measured))

    def _follow(self, member: Member, places: Sequence[int]) -> tuple[Any, Any]:
        """Return two arrays of flags: output (row) follows input (column); input accepts another value."""
        base = member.values()
        member.evaluate(self.doing)
        noise = NOISE * np.abs(member.values() - base)
        follows, accepts = np.zeros((len(member.outputs), len(places)), bool), np.zeros(len(places), bool)
        for j, place in enumerate(places):
            for value in self._displaced(member, place):
                values: Array | None = member.try_at(self.doing, place, value)
                if values is not None:
                    accepts[j] = True
                    least = np.maximum(noise, LEAST * np.maximum(np.abs(base), np.abs(values)))
                    follows[:, j] |= np.abs(values - base) > least
        return follows, accepts

    def _displaced(self, member: Member, place: int) -> list[float]:
        """Return other values of an input."""
        value, signal = self.row[place], self.system.signals[self.system.columns[place]]
        if signal.kind == "Boolean":
            return [1.0 - value]
        if signal.items:
            return [float(item) for item in signal.items.values() if item != value][:MOST_ITEMS]
        if signal.is_whole:
            return [value + 1.0, value - 1.0]
        return [value + share * self._size(member, place) for share in PROBES]

    def _size(self, member: Member, place: int) -> float:
        variable = self.system.columns[place].partition(".")[2]
        return max(abs(self.row[place]), nominal_of(member.component, variable))
