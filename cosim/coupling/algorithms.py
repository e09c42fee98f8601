"""Coupling algorithms: names, and plans of a communication step.

An algorithm is a subclass of `Algorithm` with an object in `OWN`, or registered by a package in the group
`cosim.algorithms`; docs/extending.md shows an example. The loops in Python and C, sweeps, export, drafts and diagrams
follow the plan and never compare names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticKnownError
from pydantic_core.core_schema import no_info_plain_validator_function, str_schema

from cosim.base.registry import ALGORITHMS, load, names
from cosim.blocks.component import Component
from cosim.coupling.order import Plan, order_by_dependencies
from cosim.coupling.strong_components import Edge


class Algorithm:
    """A coupling algorithm.

    Attributes:
        name: Value of the scenario's key `algorithm`.
        title: Name in reports and messages.
        about: Description that follows the name in a sentence, e.g. "steps one after the other".
        sequential: True if a component sees the new values of components stepped before it. The order then matters, the
            scenario may state it by `order`, and an algebraic loop has no order.
        solves_loops: Whether `plan_with_loops` returns algebraic loops to be solved.
    """

    name = ""
    title = ""
    about = ""
    sequential = True
    solves_loops = False

    def plan(self, components: Mapping[str, Component], edges: Sequence[Edge], order: Sequence[str] | None) -> Plan:
        """Return the plan of a communication step.

        Args:
            order: Components with inputs in the user's order; None if not stated or not sequential.

        Raises:
            AlgebraicLoop: No order of the components satisfies the plan.
        """
        raise NotImplementedError

    def plan_with_loops(
        self,
        components: Mapping[str, Component],
        edges: Sequence[Edge],
        order: Sequence[str] | None,
        *,
        undeclared: bool,
    ) -> Plan:
        """Return the plan, with algebraic loops if supported.

        Args:
            undeclared: Whether inputs without declared dependencies may be part of a loop.

        Raises:
            AlgebraicLoop: No order of the components satisfies the plan.
        """
        return self.plan(components, edges, order)


class GaussSeidel(Algorithm):
    """Gauss-Seidel: components step in sequence; inputs with direct feedthrough get values of the same time."""

    name = "gauss-seidel"
    title = "Gauss-Seidel"
    about = "steps one after the other"
    solves_loops = True

    def plan(self, components: Mapping[str, Component], edges: Sequence[Edge], order: Sequence[str] | None) -> Plan:
        """Return a plan in the user's order, by default in the order of direct feedthrough."""
        return order_by_dependencies(components, edges, order)

    def plan_with_loops(
        self,
        components: Mapping[str, Component],
        edges: Sequence[Edge],
        order: Sequence[str] | None,
        *,
        undeclared: bool,
    ) -> Plan:
        """Return the plan; components without an order become loops."""
        return order_by_dependencies(components, edges, order, loops=True, undeclared=undeclared)


class Jacobi(Algorithm):
    """Jacobi: all components step with the input values from the start of the step."""

    name = "jacobi"
    title = "Jacobi"
    about = "all from the values of the step's start"
    sequential = False

    def plan(self, components: Mapping[str, Component], edges: Sequence[Edge], order: Sequence[str] | None) -> Plan:
        """Return a plan that steps components in file order and copies all values at the end."""
        return Plan(tuple(components), (False,) * len(edges))


OWN: tuple[Algorithm, ...] = (GaussSeidel(), Jacobi())
DEFAULT = OWN[0]
WITHOUT_ORDER = OWN[1]  # for components in an algebraic loop, which have no order


def algorithms() -> dict[str, Algorithm]:
    """Return all available algorithms by name: cosim's own, then algorithms of installed packages."""
    by_name = {algorithm.name: algorithm for algorithm in OWN}
    for algorithm in (load(ALGORITHMS, name) for name in names(ALGORITHMS)):
        if isinstance(algorithm, Algorithm):
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
        """Return the name of an algorithm; reject unknown names."""
        allowed = list(algorithms())
        if isinstance(value, str) and value in allowed:
            return value
        *others, last = map(repr, allowed)
        raise PydanticKnownError("literal_error", {"expected": f"{', '.join(others)} or {last}"})
