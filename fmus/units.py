"""FMI unit definitions: SI exponents, factor to SI, and the display unit of angles."""

from __future__ import annotations

import math
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement


class Unit(NamedTuple):
    """Exponents of SI base units, and value in SI = factor·value."""

    exponents: dict[str, int]
    factor: float = 1.0
    display: tuple[str, float] | None = None  # (display unit, display value per value)


FORCE = {"kg": 1, "m": 1, "s": -2}
MOMENT = {"kg": 1, "m": 2, "s": -2}
GRAM_FORCE = 0.00980665
DEGREE = 180.0 / math.pi

UNITS: dict[str, Unit] = {
    "1": Unit({}),
    "%": Unit({}, 0.01),
    "s": Unit({"s": 1}),
    "m": Unit({"m": 1}),
    "m2": Unit({"m": 2}),
    "m/s": Unit({"m": 1, "s": -1}),
    "m2/s2": Unit({"m": 2, "s": -2}),
    "m/s2": Unit({"m": 1, "s": -2}),
    "m2/s4": Unit({"m": 2, "s": -4}),
    "s/m": Unit({"m": -1, "s": 1}),
    "kg": Unit({"kg": 1}),
    "kg.m2": Unit({"kg": 1, "m": 2}),
    "N": Unit(FORCE),
    "gf": Unit(FORCE, GRAM_FORCE),
    "gf/%": Unit(FORCE, GRAM_FORCE * 100),
    "N.s/m": Unit({"kg": 1, "s": -1}),
    "N.s2/m2": Unit({"kg": 1, "m": -1}),
    "N.m": Unit(MOMENT),
    "N.m/rad": Unit(MOMENT | {"rad": -1}),
    "N.m.s/rad": Unit({"kg": 1, "m": 2, "s": -1, "rad": -1}),
    "rad": Unit({"rad": 1}, display=("deg", DEGREE)),
    "rad2": Unit({"rad": 2}),
    "rad/s": Unit({"rad": 1, "s": -1}, display=("deg/s", DEGREE)),
    "rad2/s2": Unit({"rad": 2, "s": -2}),
    "rad/m": Unit({"rad": 1, "m": -1}),
    "rad.s/m": Unit({"rad": 1, "s": 1, "m": -1}),
    "rad.s2/m": Unit({"rad": 1, "s": 2, "m": -1}),
}


def unit_definitions(names: set[str]) -> Element:
    """The `UnitDefinitions` element for the units in use; KeyError where one is not in the table."""
    root = Element("UnitDefinitions")
    for name in sorted(names):
        unit = UNITS[name]
        node = SubElement(root, "Unit", name=name)
        base = {k: str(v) for k, v in unit.exponents.items()}
        if unit.factor != 1.0:
            base["factor"] = repr(unit.factor)
        SubElement(node, "BaseUnit", base)
        if unit.display:
            SubElement(node, "DisplayUnit", name=unit.display[0], factor=repr(unit.display[1]))
    return root
