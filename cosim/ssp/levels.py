"""Levels of nested systems, with their elements and connections."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from cosim.ssp.elements import Element
from cosim.ssp.structure import LinearTransformation, SspComponent, SspConnection, SspSystem


@dataclass
class FmuPart:
    """An FMU of the system; `name` is its scenario name, `path` its SSP path."""

    name: str
    path: str
    component: SspComponent
    description: Any
    variables: dict[str, Any]
    start: dict[str, tuple[Any, Element]] = field(default_factory=dict)


@dataclass(frozen=True)
class SignalLink:
    """A connection between an output and an input, each `name.variable`.

    Attributes:
        linear: Conversion of the value; None if only units are converted.
    """

    source: str
    target: str
    linear: LinearTransformation | None
    element: Element


@dataclass(frozen=True)
class Flat:
    """A system without nested systems."""

    parts: tuple[FmuPart, ...]
    links: tuple[SignalLink, ...]


@dataclass
class Level:
    """A system in the hierarchy of systems.

    Attributes:
        systems: Its nested systems by name.
        parts: Its FMUs by name.
    """

    system: SspSystem
    parent: Level | None
    systems: dict[str, Level] = field(default_factory=dict)
    parts: dict[str, FmuPart] = field(default_factory=dict)

    @cached_property
    def into(self) -> dict[tuple[str | None, str], SspConnection]:
        """Return the connections by end: (element, None for the system itself; connector)."""
        return {connection.end: connection for connection in reversed(self.system.connections)}


def direct_connections(system: SspSystem) -> SspSystem:
    """Return a system with connections from source to target.

    The order of the ends in a file has no meaning; a transformation acts from source to target.
    """

    def sends(end: tuple[str | None, str]) -> bool | None:
        name, connector_name = end
        holder = system if name is None else system.elements.get(name)
        connector = None if holder is None else holder.connectors.get(connector_name)
        if connector is None or connector.kind not in {"input", "output", "parameter", "calculatedParameter"}:
            return None
        return (connector.kind in {"output", "calculatedParameter"}) != (name is None)

    connections = [
        replace(c, start=c.end, end=c.start) if sends(c.start) is False and sends(c.end) is True else c
        for c in system.connections
    ]
    elements = {name: direct_connections(e) if isinstance(e, SspSystem) else e for name, e in system.elements.items()}
    return replace(system, connections=tuple(connections), elements=elements)


def levels(level: Level) -> Iterator[Level]:
    """Yield a level and all nested levels."""
    yield level
    for inner in level.systems.values():
        yield from levels(inner)
