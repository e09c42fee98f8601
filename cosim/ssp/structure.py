"""What an SSD says: systems within systems, components, connectors, connections, parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.ssp.elements import Element

Definition = tuple[float, ...]  # exponents of kg, m, s, A, K, mol, cd, rad, then factor and offset
Units = Mapping[str, Definition]


@dataclass(frozen=True)
class Linear:
    """factor·value + offset; `exact`: in place of any conversion of units."""

    factor: float = 1.0
    offset: float = 0.0
    exact: bool = False


@dataclass(frozen=True)
class Connector:
    """Where a connection may begin or end; `unit` None where it says none."""

    name: str
    kind: str
    unit: str | None
    element: Element


@dataclass(frozen=True)
class Parameter:
    """A value by name: a number, true or false, or text."""

    name: str
    value: Any
    unit: str | None
    units: Units
    element: Element
    linear: Linear = Linear()


@dataclass(frozen=True)
class Component:
    """An FMU: where it lies, and how it is to be run."""

    name: str
    fmu: Path
    interface: str | None
    connectors: Mapping[str, Connector]
    parameters: tuple[Parameter, ...]
    element: Element


@dataclass(frozen=True)
class Connection:
    """From one end to another, each (element of the system or None for itself, connector)."""

    start: tuple[str | None, str]
    end: tuple[str | None, str]
    linear: Linear
    element: Element


@dataclass(frozen=True)
class System:
    """Elements by name, and the connections among them."""

    name: str
    connectors: Mapping[str, Connector]
    parameters: tuple[Parameter, ...]
    elements: Mapping[str, System | Component]
    connections: tuple[Connection, ...]
    element: Element


@dataclass(frozen=True)
class Structure:
    """A whole description; times [s], None where it does not say."""

    name: str
    description: str
    system: System
    units: Units
    start: float | None
    stop: float | None
    step: float | None
    experiment: Element
    warnings: list[str] = field(default_factory=list)
