"""Coupling algorithms: their names, and the plan of a communication step that each makes.

An algorithm is a subclass of `Algorithm` with one object in `OWN`, or registered by a package in the group
`cosim.algorithms`; docs/extending.md shows one. The loops in Python and in C, sweeps, export, drafts and pictures
follow the plan; none of them compares names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticKnownError
from pydantic_core.core_schema import no_info_plain_validator_function, str_schema

from cosim.base.registry import ALGORITHMS, load, names
from cosim.blocks.component import Component
from cosim.coupling.order import Edge, Plan, order_by_dependencies


class Algorithm:
    """A coupling algorithm.

    name:       value of the scenario's key `algorithm`
    title:      its name in reports and messages
    about:      the rest of a sentence that begins with its name: what it does
    sequential: components see new values of those that step before them, so that their order matters: the scenario's
                key `order` may state it, and components in an algebraic loop have none
    """

    name = ""
    title = ""
    about = ""
    sequential = True

    def plan(self, components: Mapping[str, Component], edges: Sequence[Edge], order: Sequence[str] | None) -> Plan:
        """Return the plan of a communication step; AlgebraicLoop if no order of the components satisfies it.

        order: components with inputs in the order that the user states; None if the user states none, and always None
               for an algorithm that is not sequential
        """
        raise NotImplementedError


class GaussSeidel(Algorithm):
    """Components step one after the other; inputs on which outputs depend directly see values of the same time."""

    name = "gauss-seidel"
    title = "Gauss-Seidel"
    about = "steps one after the other"

    def plan(self, components: Mapping[str, Component], edges: Sequence[Edge], order: Sequence[str] | None) -> Plan:
        """Return a plan in the order of the user, or else in that of the dependencies."""
        return order_by_dependencies(components, edges, order)


class Jacobi(Algorithm):
    """All components step from the values of the step's start."""

    name = "jacobi"
    title = "Jacobi"
    about = "all from the values of the step's start"
    sequential = False

    def plan(self, components: Mapping[str, Component], edges: Sequence[Edge], order: Sequence[str] | None) -> Plan:
        """Return a plan in the order of the file, all of whose copies are made after the last component has stepped."""
        return Plan(tuple(components), (False,) * len(edges))


OWN: tuple[Algorithm, ...] = (GaussSeidel(), Jacobi())
DEFAULT = OWN[0]
WITHOUT_ORDER = OWN[1]  # runs components that have no order, those in an algebraic loop


def algorithms() -> dict[str, Algorithm]:
    """Return the algorithms by name: cosim's own, then those of installed packages."""
    added = [found for name in names(ALGORITHMS) if isinstance(found := load(ALGORITHMS, name), Algorithm)]
    own = {algorithm.name: algorithm for algorithm in OWN}
    return own | {algorithm.name: algorithm for algorithm in added if algorithm.name not in own}


class AlgorithmKey:
    """The key of a file that names an algorithm: one of those that are there when the file is read."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return no_info_plain_validator_function(self.validate)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        known = algorithms()
        about = ", ".join(f"{name} {algorithm.about}" for name, algorithm in known.items())
        return {**handler(str_schema()), "enum": list(known), "description": about}

    @staticmethod
    def validate(value: Any) -> str:
        """Return the name of an algorithm; refuse any other value."""
        known = list(algorithms())
        if isinstance(value, str) and value in known:
            return value
        *others, last = map(repr, known)
        raise PydanticKnownError("literal_error", {"expected": f"{', '.join(others)} or {last}"})
