"""Coupling algorithms: names, and plans of a communication step.

An algorithm is a subclass of `Algorithm` with an object in `OWN_ALGORITHMS`, or registered by a package in the group
`cosim.algorithms`; docs/extending.md shows an example. The loops in Python and C, sweeps, export, drafts and diagrams
follow the plan and never compare names.

In a sequential algorithm, a component steps after the sources of its inputs with direct feedthrough, and gets their new
values. All other inputs are held: they have the values from the start of the step. Components that need each other's
outputs at the same time form an algebraic loop.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from itertools import permutations
from typing import Any, NamedTuple, TypeVar

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticKnownError
from pydantic_core.core_schema import no_info_plain_validator_function, str_schema

from cosim.blocks.component import Component
from cosim.core.messages import CheckWarning
from cosim.core.registry import ALGORITHMS, registered

Edge = tuple[str, str, str, str]  # source component, target component, target input, source output
T = TypeVar("T")
Components = Mapping[str, Component]
Order = Sequence[str] | None
MOST_PERMUTED = 6  # components of a loop whose best order is searched; larger loops keep the order of the file


class Plan(NamedTuple):
    """Plan of a communication step.

    Components step in this order. Immediate values are copied just before their target steps, all others at the end.

    Attributes:
        order: Names of all components.
        immediate: One truth value per connection: True if the value is copied just before the target steps.
        notes: Warnings about assumptions.
        loops: Components of each algebraic loop, consecutive in `order`. The values of immediate connections within a
            loop are solved for at each communication point.
    """

    order: tuple[str, ...]
    immediate: tuple[bool, ...]
    notes: tuple[str, ...] = ()
    loops: tuple[tuple[str, ...], ...] = ()


class Assumption(CheckWarning):
    """A warning that cosim assumes a component to have no direct feedthrough."""


class AlgebraicLoop(Exception):
    """Error: components need each other's outputs at the same time.

    The attribute `cycle` contains the names of the components; it begins and ends with the same name.
    """

    def __init__(self, cycle: Sequence[str]) -> None:
        self.cycle = tuple(cycle)
        super().__init__(" → ".join(cycle))


class Algorithm:
    """A coupling algorithm.

    Attributes:
        name: Value of the scenario's key `algorithm`.
        title: Name in reports and messages.
        about: Description that follows the name in a sentence, e.g. "steps one after the other".
        sequential: True if a component gets the new values of components stepped before it. The order then matters and
            can be set in the scenario by `order`; for an algebraic loop there is no valid order.
        solves_loops: True if `plan_with_loops` can return algebraic loops to be solved.
    """

    name = ""
    title = ""
    about = ""
    sequential = True
    solves_loops = False

    def plan(self, components: Components, edges: Sequence[Edge], order: Order) -> Plan:
        """Return the plan of a communication step.

        Args:
            order: Components with inputs in the user's order; None if the user sets none, or if the algorithm is not
                sequential.

        Raises:
            AlgebraicLoop: The components form a loop, for which there is no order.
        """
        raise NotImplementedError

    def plan_with_loops(self, components: Components, edges: Sequence[Edge], order: Order, *, undeclared: bool) -> Plan:
        """Return the plan, with algebraic loops if the algorithm supports them.

        Args:
            undeclared: Allow inputs without declared dependencies to be part of a loop.

        Raises:
            AlgebraicLoop: The components form a loop, for which there is no order.
        """
        return self.plan(components, edges, order)


class GaussSeidel(Algorithm):
    """Gauss-Seidel: components step in sequence; inputs with direct feedthrough get new values."""

    name = "gauss-seidel"
    title = "Gauss-Seidel"
    about = "steps one after the other"
    solves_loops = True

    def plan(self, components: Components, edges: Sequence[Edge], order: Order) -> Plan:
        """Return a plan with the user's order or, by default, an order along direct feedthrough."""
        return self.plan_with_loops(components, edges, order, undeclared=False, loops=False)

    def plan_with_loops(
        self, components: Components, edges: Sequence[Edge], order: Order, *, undeclared: bool, loops: bool = True
    ) -> Plan:
        """Return a plan that gives inputs with direct feedthrough new values.

        With an order of the user, connections along this order are immediate and all others are held.

        Args:
            undeclared: Allow inputs without declared dependencies to be part of a loop. Otherwise such inputs are
                assumed to have no direct feedthrough if this avoids a loop.
            loops: Put components without a valid order into algebraic loops of the plan.

        Raises:
            AlgebraicLoop: There is no valid order, and `loops` is False.
        """
        if order is not None:
            rest = [name for name in components if name not in order]  # sources without inputs
            place = {name: k for k, name in enumerate((*rest, *order))}
            ahead = ((place[source] < place[target], target, name) for source, target, name, _ in edges)
            immediate = tuple(is_ahead and components[c].depends_on(name) is not False for is_ahead, c, name in ahead)
            return Plan(tuple(place), immediate)
        direct = {(target, name) for _, target, name, _ in edges if components[target].depends_on(name) is not False}
        notes: list[str] = []
        while True:
            immediate = tuple((target, name) in direct for _, target, name, _ in edges)
            ends = [(source, target) for source, target, name, _ in edges if (target, name) in direct]
            try:
                return Plan(_sort(components, ends), immediate, tuple(notes))
            except CycleError as error:
                cycle = list(reversed(error.args[1]))
            inputs = direct & {(target, name) for source, target, name, _ in edges if {source, target} <= {*cycle}}
            # Only outputs that are connected within the loop matter.
            used = {c: {output for source, _, _, output in edges if source == c} for c in cycle}
            removed = {(c, name) for c, name in inputs if components[c].depends_on(name, used[c]) is False}
            if not removed:
                unknown = {c for c, name in inputs if components[c].depends_on(name) is None}
                if undeclared or not unknown:
                    break
                assumed = min(unknown, key=[*components].index)
                removed = {(c, name) for c, name in direct if c == assumed and components[c].depends_on(name) is None}
                if getattr(components[assumed], "feedthrough", None) is None:
                    notes.append(
                        Assumption(
                            f"{assumed} does not declare its direct feedthrough; cosim assumes none, so {assumed} "
                            f"steps first. To change this, list the inputs with direct feedthrough in `feedthrough` of "
                            f"{assumed}, [] for none, or set `order`"
                        )
                    )
            direct -= removed
        if not loops:
            raise AlgebraicLoop(cycle)
        groups = sort_groups(list(components), ends)
        selfish = {source for source, target in ends if source == target}
        found = tuple(group for group in groups if len(group) > 1 or group[0] in selfish)
        return Plan(tuple(name for group in groups for name in group), immediate, tuple(notes), found)


class Jacobi(Algorithm):
    """Jacobi: all components step with the input values from the start of the step."""

    name = "jacobi"
    title = "Jacobi"
    about = "all from the values of the step's start"
    sequential = False

    def plan(self, components: Components, edges: Sequence[Edge], order: Order) -> Plan:
        """Return a plan that steps components in file order and copies all values at the end."""
        return Plan(tuple(components), (False,) * len(edges))


OWN_ALGORITHMS: tuple[Algorithm, ...] = (GaussSeidel(), Jacobi())
DEFAULT = OWN_ALGORITHMS[0]
WITHOUT_ORDER = OWN_ALGORITHMS[1]  # for components in an algebraic loop, which have no order


def algorithms() -> dict[str, Algorithm]:
    """Return all available algorithms by name: cosim's own, then algorithms of installed packages."""
    by_name = {algorithm.name: algorithm for algorithm in OWN_ALGORITHMS}
    for _, algorithm in registered(ALGORITHMS, Algorithm):
        by_name.setdefault(algorithm.name, algorithm)
    return by_name


class AlgorithmKey:
    """Type of the scenario's key `algorithm`: the name of an available coupling algorithm."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return no_info_plain_validator_function(self.validate)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        by_name = algorithms()
        about = ", ".join(f"{name} {algorithm.about}" for name, algorithm in by_name.items())
        return {**handler(str_schema()), "enum": list(by_name), "description": about}

    @staticmethod
    def validate(value: Any) -> str:
        """Return the name of an available algorithm; raise ValueError for other names."""
        allowed = list(algorithms())
        if isinstance(value, str) and value in allowed:
            return value
        *others, last = map(repr, allowed)
        raise PydanticKnownError("literal_error", {"expected": f"{', '.join(others)} or {last}"})


def _sort(names: Iterable[T], ends: Iterable[tuple[T, T]]) -> tuple[T, ...]:
    """Return names sorted so that each source is before its targets; raise CycleError for a cycle."""
    sorter: TopologicalSorter[T] = TopologicalSorter({name: set() for name in names})
    for source, target in ends:
        sorter.add(target, source)
    return tuple(sorter.static_order())


def sort_groups(names: Sequence[str], ends: Sequence[tuple[str, str]]) -> list[tuple[str, ...]]:
    """Return groups of names that are connected in a cycle, sorted so that sources are before targets.

    The order within a group has few connections from a later to an earlier name.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    place = {name: k for k, name in enumerate(names)}
    rows, columns = [place[source] for source, _ in ends], [place[target] for _, target in ends]
    graph = csr_array(([1] * len(rows), (rows, columns)), shape=(len(names), len(names)))
    _, labels = connected_components(graph, directed=True, connection="strong")
    label_of, groups = dict(zip(names, labels.tolist(), strict=True)), dict[int, tuple[str, ...]]()
    for name, label in label_of.items():
        groups[label] = (*groups.get(label, ()), name)
    between = [(label_of[source], label_of[target]) for source, target in ends]
    ordered = [groups[label] for label in _sort(groups, (pair for pair in between if pair[0] != pair[1]))]
    for k, group in enumerate(ordered):
        if 1 < len(group) <= MOST_PERMUTED:
            inner = [end for end in ends if set(end) <= set(group)]
            _, _, ordered[k] = min((sum(torn(order, inner)), n, order) for n, order in enumerate(permutations(group)))
    return ordered


def torn(group: Sequence[str], ends: Iterable[tuple[str, str]]) -> list[bool]:
    """Return for each connection whether it leads from a later to an earlier (or the same) name of the group."""
    place = {name: k for k, name in enumerate(group)}
    return [place[source] >= place[target] for source, target in ends]
