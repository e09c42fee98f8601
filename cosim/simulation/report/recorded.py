"""A run as the page reads it: results and manifest, names looked up tolerantly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from cosim.base.arrays import Array
from cosim.coupling.algorithms import DEFAULT
from cosim.storage.results import Results


def mapping(value: Any) -> Mapping[str, Any]:
    """`value` if it is a mapping, else an empty one: a manifest may lack anything."""
    return value if isinstance(value, Mapping) else {}


def mappings(value: Any) -> list[Mapping[str, Any]]:
    """The mappings in a list that may be missing or hold other things."""
    return [item for item in value if isinstance(item, Mapping)] if isinstance(value, list | tuple) else []


def texts(value: Any) -> list[str]:
    """The items of a list as text; one text stands for itself."""
    return (
        [value] if isinstance(value, str) else [str(item) for item in value] if isinstance(value, list | tuple) else []
    )


def number(value: Any, default: float = float("nan")) -> float:
    """`value` as a float, or `default` where it is none."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return default


@dataclass(frozen=True)
class Run:
    """Results and manifest of one run, with names looked up tolerantly."""

    results: Results
    manifest: Mapping[str, Any]

    @property
    def time(self) -> Array:
        """Communication points [s]."""
        return self.results.time

    @property
    def scenario(self) -> Mapping[str, Any]:
        """The scenario as the manifest keeps it."""
        return mapping(self.manifest.get("scenario"))

    @property
    def algorithm(self) -> str:
        """Name of the coupling algorithm; the default if the scenario states none."""
        return str(self.scenario.get("algorithm") or (DEFAULT.name if self.links else ""))

    @cached_property
    def variables(self) -> dict[str, set[str]]:
        """Component → its variables, in the order of the columns."""
        found: dict[str, set[str]] = {}
        for column in self.results.columns:
            component, _, variable = column.partition(".")
            found.setdefault(component, set()).add(variable)
        return found

    @cached_property
    def links(self) -> list[tuple[str, str]]:
        """Connections as pairs of `component.variable`."""
        pairs = ((link.get("from"), link.get("to")) for link in mappings(self.scenario.get("connections")))
        return [(source, target) for source, target in pairs if isinstance(source, str) and isinstance(target, str)]

    def signal(self, column: str) -> Array | None:
        """A column of the results, None where it was not recorded."""
        if column not in self.results:
            return None
        return self.results[column]

    def unit(self, column: str) -> str:
        """Unit of a column, "" where the results carry none."""
        return self.results.units.get(column, "")

    def start(self, component: str | None) -> Mapping[str, Any]:
        """Start values the scenario gave a component."""
        if component is None:
            return {}
        return mapping(mapping(mapping(self.scenario.get("components")).get(component)).get("start"))

    def source(self, target: str) -> str | None:
        """What is connected to the input `target`."""
        return next((source for source, end in self.links if end == target), None)
