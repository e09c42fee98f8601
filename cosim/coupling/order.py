"""Order of components stepped in sequence.

A component with direct feedthrough from an input steps after the source of the input and sees its new value. All other
inputs are held: they see the value from the step's start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from typing import NamedTuple

from cosim.base.messages import CheckWarning
from cosim.blocks.component import Component
from cosim.coupling.strong_components import Edge, order_with_loops

Input = tuple[str, str]  # component, input


class Plan(NamedTuple):
    """Plan of a communication step.

    Components step in order. Immediate values are copied right before their target steps, all others at the end.

    Attributes:
        order: Names of all components.
        immediate: For each connection, whether its value is copied right before the target steps.
        notes: Warnings about assumptions.
        loops: Components of each algebraic loop, consecutive in `order`. Immediate connections within a loop are
            solved at each communication point.
    """

    order: tuple[str, ...]
    immediate: tuple[bool, ...]
    notes: tuple[str, ...] = ()
    loops: tuple[tuple[str, ...], ...] = ()


class Assumption(CheckWarning):
    """A warning that a component is taken to have no direct feedthrough."""


class AlgebraicLoop(Exception):
    """Error: components need each other's outputs of the same time.

    The attribute `cycle` holds their names; it begins and ends with the same name.
    """

    def __init__(self, cycle: Sequence[str]) -> None:
        self.cycle = tuple(cycle)
        super().__init__(" → ".join(cycle))


def order_by_dependencies(
    components: Mapping[str, Component],
    edges: Sequence[Edge],
    order: Sequence[str] | None,
    *,
    loops: bool = False,
    undeclared: bool = False,
) -> Plan:
    """Return a plan with values of the same time for inputs with direct feedthrough.

    An order stated by the user is kept: connections along this order are immediate, all others are held.

    Args:
        loops: Whether components without an order become algebraic loops of the plan.
        undeclared: Whether inputs without declared dependencies may be part of a loop. Otherwise they are assumed to
            have no direct feedthrough where a loop would need it.

    Raises:
        AlgebraicLoop: No order exists, and the plan must not have loops.
    """
    if order is not None:
        return _plan_in_order(components, edges, order)
    direct = {(target, name) for _, target, name, _ in edges if components[target].depends_on(name) is not False}
    notes: list[str] = []
    while True:
        immediate = tuple((target, name) in direct for _, target, name, _ in edges)
        try:
            return Plan(_sort(components, edges, immediate), immediate, tuple(notes))
        except CycleError as error:
            cycle = list(reversed(error.args[1]))
        try:
            removed, note = _open_cycle(components, edges, direct, cycle, undeclared=undeclared)
        except AlgebraicLoop:
            if not loops:
                raise
            order_of_all, groups = order_with_loops(components, edges, immediate)
            return Plan(order_of_all, immediate, tuple(notes), groups)
        direct -= removed
        notes += [note] if note else []


def _open_cycle(
    components: Mapping[str, Component],
    edges: Sequence[Edge],
    direct: set[Input],
    cycle: Sequence[str],
    *,
    undeclared: bool,
) -> tuple[set[Input], str]:
    """Return inputs of a cycle without direct feedthrough, which open the cycle, and a note.

    The note states an assumption about undeclared feedthrough; "" if none was necessary.
    """
    inputs = {(target, name) for source, target, name, _ in edges if {source, target} <= {*cycle}}
    # Only outputs used within the loop count.
    unneeded = {
        (c, name) for c, name in inputs & direct if components[c].depends_on(name, _find_connected(edges, c)) is False
    }
    if unneeded:
        return unneeded, ""
    unknown = {component for component, name in inputs & direct if components[component].depends_on(name) is None}
    if undeclared or not unknown:
        raise AlgebraicLoop(cycle)
    assumed = min(unknown, key=[*components].index)
    removed = {(c, name) for c, name in direct if c == assumed and components[c].depends_on(name) is None}
    is_stated = getattr(components[assumed], "feedthrough", None) is not None
    return removed, "" if is_stated else Assumption(
        f"{assumed} does not declare which outputs depend directly on its inputs; cosim assumes that none does, "
        f"so {assumed} steps first. feedthrough: [...] of {assumed} names the inputs that an output follows at "
        "once, [] for none; order: [...] states the order instead"
    )


def _find_connected(edges: Sequence[Edge], component: str) -> set[str]:
    """Return the outputs of a component that are connected to inputs."""
    return {output for source, _, _, output in edges if source == component}


def _plan_in_order(components: Mapping[str, Component], edges: Sequence[Edge], order: Sequence[str]) -> Plan:
    rest = [name for name in components if name not in order]  # sources without inputs
    place = {name: k for k, name in enumerate((*rest, *order))}
    immediate = tuple(
        place[source] < place[target] and components[target].depends_on(name) is not False
        for source, target, name, _ in edges
    )
    return Plan(tuple(place), immediate)


def _sort(components: Mapping[str, Component], edges: Sequence[Edge], immediate: Sequence[bool]) -> tuple[str, ...]:
    sorter: TopologicalSorter[str] = TopologicalSorter({name: set() for name in components})
    for (source, target, *_), now in zip(edges, immediate, strict=True):
        if now:
            sorter.add(target, source)
    return tuple(sorter.static_order())
