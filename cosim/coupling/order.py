"""Order of components that step one after the other.

A component whose outputs depend directly on an input must step after the source of that input and sees
its new value. Any other input is held: it sees the value of the step's start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from typing import NamedTuple

from cosim.blocks.component import Component

Edge = tuple[str, str, str, str]  # source component, target component, target input, source output
Input = tuple[str, str]  # component, input


class Plan(NamedTuple):
    """A communication step: each component in order gets its immediate inputs and steps; then all others are copied.

    order:     names of all components
    immediate: whether the value of each edge is copied right before its target steps
    notes:     warnings that tell what was assumed
    """

    order: tuple[str, ...]
    immediate: tuple[bool, ...]
    notes: tuple[str, ...] = ()


class AlgebraicLoop(Exception):
    """Components that need each other's value of the same time; `cycle` begins and ends with the same one."""

    def __init__(self, cycle: Sequence[str]) -> None:
        self.cycle = tuple(cycle)
        super().__init__(" → ".join(cycle))


def order_by_dependencies(
    components: Mapping[str, Component], edges: Sequence[Edge], order: Sequence[str] | None
) -> Plan:
    """Return a plan in which direct dependencies see values of the same time; AlgebraicLoop if there is none.

    An order given by the user is kept: edges that run along it are immediate, all others held.
    """
    if order is not None:
        return _stated(components, edges, order)
    direct = {(target, name) for _, target, name, _ in edges if components[target].depends_on(name) is not False}
    notes: list[str] = []
    while True:
        immediate = tuple((target, name) in direct for _, target, name, _ in edges)
        try:
            return Plan(_sorted(components, edges, immediate), immediate, tuple(notes))
        except CycleError as error:
            cycle = list(reversed(error.args[1]))
        opened, note = _open(components, edges, direct, cycle)
        direct -= opened
        notes += [note] if note else []


def _open(
    components: Mapping[str, Component], edges: Sequence[Edge], direct: set[Input], cycle: Sequence[str]
) -> tuple[set[Input], str]:
    """Return inputs that need no value of the same time, so that they open a cycle, and what was assumed."""
    inputs = {(target, name) for source, target, name, _ in edges if {source, target} <= {*cycle}}
    # in a loop only those outputs count that go on
    unneeded = {(c, name) for c, name in inputs & direct if components[c].depends_on(name, _used(edges, c)) is False}
    if unneeded:
        return unneeded, ""
    silent = {component for component, name in inputs if components[component].depends_on(name) is None}
    undeclared = next((component for component in components if component in silent), None)
    if undeclared is None:
        raise AlgebraicLoop(cycle)
    note = (
        f"{undeclared} does not declare which outputs depend directly on its inputs; "
        "taken as none, so that it steps first. State order: if that is wrong"
    )
    return {(component, name) for component, name in direct if component == undeclared}, note


def _used(edges: Sequence[Edge], component: str) -> set[str]:
    """Return the outputs of a component that are connected."""
    return {output for source, _, _, output in edges if source == component}


def _stated(components: Mapping[str, Component], edges: Sequence[Edge], order: Sequence[str]) -> Plan:
    rest = [name for name in components if name not in order]  # sources without inputs
    place = {name: k for k, name in enumerate((*rest, *order))}
    immediate = tuple(
        place[source] < place[target] and components[target].depends_on(name) is not False
        for source, target, name, _ in edges
    )
    return Plan(tuple(place), immediate)


def _sorted(components: Mapping[str, Component], edges: Sequence[Edge], immediate: Sequence[bool]) -> tuple[str, ...]:
    sorter: TopologicalSorter[str] = TopologicalSorter({name: set() for name in components})
    for (source, target, *_), now in zip(edges, immediate, strict=True):
        if now:
            sorter.add(target, source)
    return tuple(sorter.static_order())
