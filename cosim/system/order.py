"""Order of components under Gauss-Seidel.

A component whose outputs depend directly on an input must step after the source of that input and sees
its new value. Any other input is held: it sees the value of the step's start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from graphlib import CycleError, TopologicalSorter

from cosim.blocks.component import Component

Edge = tuple[str, str, str, str]  # source component, target component, target input, source output


class AlgebraicLoop(Exception):
    """Components that need each other's value of the same time; `cycle` begins and ends with the same one."""

    def __init__(self, cycle: Sequence[str]) -> None:
        self.cycle = tuple(cycle)
        super().__init__(" → ".join(cycle))


def stages(
    components: Mapping[str, Component], edges: Sequence[Edge], order: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[bool, ...], tuple[str, ...]]:
    """Order of the components, whether each edge is immediate, and notes on what was assumed.

    An order given by the user is kept: edges that run along it are immediate, all others held.
    """
    if order is not None:
        rest = [name for name in components if name not in order]  # sources without inputs
        place = {name: k for k, name in enumerate((*rest, *order))}
        immediate = tuple(
            place[source] < place[target] and components[target].depends_on(name) is not False
            for source, target, name, _ in edges
        )
        return tuple(place), immediate, ()
    held: set[str] = set()
    freed: set[tuple[str, str]] = set()
    notes: list[str] = []
    used = {name: {output for source, _, _, output in edges if source == name} for name in components}
    while True:
        immediate = tuple(
            target not in held and (target, name) not in freed and components[target].depends_on(name) is not False
            for _, target, name, _ in edges
        )
        try:
            return _sorted(components, edges, immediate), immediate, tuple(notes)
        except CycleError as error:
            cycle = list(reversed(error.args[1]))
            within = [(target, name) for source, target, name, _ in edges if source in cycle and target in cycle]
            # in a loop only those outputs count that go on
            unneeded = {(c, n) for c, n in {*within} - freed if components[c].depends_on(n, used[c]) is False}
            if unneeded:
                freed |= unneeded
                continue
            silent = {component for component, name in within if components[component].depends_on(name) is None}
            undeclared = next((component for component in components if component in silent), None)
            if undeclared is None or undeclared in held:
                raise AlgebraicLoop(cycle) from None
            held.add(undeclared)
            notes.append(
                f"{undeclared} does not declare which outputs depend directly on its inputs; "
                "taken as none, so that it steps first. State order: if that is wrong"
            )


def _sorted(components: Mapping[str, Component], edges: Sequence[Edge], immediate: Sequence[bool]) -> tuple[str, ...]:
    sorter: TopologicalSorter[str] = TopologicalSorter({name: set() for name in components})
    for (source, target, *_), now in zip(edges, immediate, strict=True):
        if now:
            sorter.add(target, source)
    return tuple(sorter.static_order())
