"""Levels of nested systems, with their elements and connections."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from cosim.ssp.elements import Element
from cosim.ssp.structure import Component, Connection, Linear, System


@dataclass
class Part:
    """An FMU of the system; `name` is its scenario name, `path` its SSP path."""

    name: str
    path: str
    component: Component
    description: Any
    variables: dict[str, Any]
    start: dict[str, tuple[Any, Element]] = field(default_factory=dict)


@dataclass(frozen=True)
class Link:
    """A connection between an output and an input, each `name.variable`.

    Attributes:
        linear: Conversion of the value; None if only units are converted.
    """

    source: str
    target: str
    linear: Linear | None
    element: Element


@dataclass(frozen=True)
class Flat:
    """A system without nested systems."""

    parts: tuple[Part, ...]
    links: tuple[Link, ...]


@dataclass
class Level:
    """A system in the hierarchy of systems.

    Attributes:
        systems: Its nested systems by name.
        parts: Its FMUs by name.
    """

    system: System
    parent: Level | None
    systems: dict[str, Level] = field(default_factory=dict)
    parts: dict[str, Part] = field(default_factory=dict)

    @cached_property
    def into(self) -> dict[tuple[str | None, str], Connection]:
        """Return the connections by end: (element, None for the system itself; connector)."""
        return {connection.end: connection for connection in reversed(self.system.connections)}


def direct_connections(system: System) -> System:
    """Return a system whose connections lead from source to target.

    FMPy and OMSimulator accept both directions in a file.
    """

    def sends(end: tuple[str | None, str]) -> bool | None:
        name, connector_name = end
        holder = system if name is None else system.elements.get(name)
        connector = None if holder is None else holder.connectors.get(connector_name)
        if connector is None or connector.kind not in {"input", "output", "parameter", "calculatedParameter"}:
            return None
        return (connector.kind in {"output", "calculatedParameter"}) != (name is None)

    connections = [
        replace(c, start=c.end, end=c.start)
        if c.linear == Linear() and sends(c.start) is False and sends(c.end) is True
        else c
        for c in system.connections
    ]
    elements = {name: direct_connections(e) if isinstance(e, System) else e for name, e in system.elements.items()}
    return replace(system, connections=tuple(connections), elements=elements)


def levels(level: Level) -> Iterator[Level]:
    """Yield a level and all nested levels."""
    yield level
    for inner in level.systems.values():
        yield from levels(inner)
