"""Content of an SSD: nested systems, components, connectors, connections, parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.ssp.elements import Element

Definition = tuple[float, ...]  # exponents of kg, m, s, A, K, mol, cd, rad, then factor and offset
Units = Mapping[str, Definition]


@dataclass(frozen=True)
class LinearTransformation:
    """Transformation factor·value + offset of a connection; `exact` replaces any unit conversion."""

    factor: float = 1.0
    offset: float = 0.0
    exact: bool = False


@dataclass(frozen=True)
class Connector:
    """A connector: a possible end of a connection. Its `unit` is None if the file states none."""

    name: str
    kind: str
    unit: str | None
    element: Element


@dataclass(frozen=True)
class SspParameter:
    """A named value: a number, true or false, or text."""

    name: str
    value: Any
    unit: str | None
    units: Units
    element: Element
    linear: LinearTransformation = LinearTransformation()


@dataclass(frozen=True)
class SspComponent:
    """An FMU in a system, with its file and its FMI interface."""

    name: str
    fmu: Path
    interface: str | None
    connectors: Mapping[str, Connector]
    parameters: tuple[SspParameter, ...]
    element: Element


@dataclass(frozen=True)
class SspConnection:
    """A connection; each end is (element, or None for the system itself; connector)."""

    start: tuple[str | None, str]
    end: tuple[str | None, str]
    linear: LinearTransformation
    element: Element


@dataclass(frozen=True)
class SspSystem:
    """A system: its elements (FMUs and nested systems) by name, and their connections."""

    name: str
    connectors: Mapping[str, Connector]
    parameters: tuple[SspParameter, ...]
    elements: Mapping[str, SspSystem | SspComponent]
    connections: tuple[SspConnection, ...]
    element: Element


@dataclass(frozen=True)
class SspStructure:
    """A complete description; times [s] are None if absent."""

    name: str
    description: str
    system: SspSystem
    units: Units
    start: float | None
    stop: float | None
    step: float | None
    experiment: Element
