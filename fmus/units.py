"""Units as engineers write them: their SI exponents and factor, and the unit definitions of FMI made of them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement


class Unit(NamedTuple):
    """Exponents of SI base units, and value in SI = factor·value."""

    exponents: Mapping[str, int]
    factor: float = 1.0


def _sizes(exponents: Mapping[str, int], factors: Mapping[str, float]) -> dict[str, Unit]:
    """Symbols of one dimension."""
    return {symbol: Unit(exponents, factor) for symbol, factor in factors.items()}


def _prefixed(symbol: str, prefixes: str, exponents: Mapping[str, int]) -> dict[str, Unit]:
    """A symbol, alone and with each of the prefixes."""
    sizes = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6}
    return {symbol: Unit(exponents)} | {p + symbol: Unit(exponents, sizes[p]) for p in prefixes}


LENGTH, TIME, MASS, ANGLE = {"m": 1}, {"s": 1}, {"kg": 1}, {"rad": 1}
FORCE = {"kg": 1, "m": 1, "s": -2}
PRESSURE = {"kg": 1, "m": -1, "s": -2}
VOLTAGE = {"kg": 1, "m": 2, "s": -3, "A": -1}
RESISTANCE = {"kg": 1, "m": 2, "s": -3, "A": -2}

# The order within a dimension is that in which sizes are offered to who has written none of them.
SYMBOLS: dict[str, Unit] = {
    "1": Unit({}),
    "%": Unit({}, 0.01),
    **_sizes(LENGTH, {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "um": 1e-6, "µm": 1e-6, "in": 0.0254}),
    **_sizes(TIME, {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}),
    **_sizes(MASS, {"kg": 1.0, "g": 1e-3}),
    **_sizes(ANGLE, {"deg": math.pi / 180.0, "°": math.pi / 180.0, "rad": 1.0, "mrad": 1e-3, "rev": 2.0 * math.pi}),
    "rpm": Unit({"rad": 1, "s": -1}, math.pi / 30.0),
    **_prefixed("Hz", "kM", {"s": -1}),
    **_sizes(FORCE, {"N": 1.0, "mN": 1e-3, "kN": 1e3, "gf": 0.00980665, "kgf": 9.80665}),
    **_prefixed("Pa", "kM", PRESSURE),
    "bar": Unit(PRESSURE, 1e5),
    **_prefixed("J", "mkM", {"kg": 1, "m": 2, "s": -2}),
    **_prefixed("W", "mkM", {"kg": 1, "m": 2, "s": -3}),
    **_prefixed("A", "uµmk", {"A": 1}),
    **_prefixed("C", "uµm", {"A": 1, "s": 1}),
    **_prefixed("V", "uµmk", VOLTAGE),
    **_prefixed("ohm", "mkM", RESISTANCE),
    **_prefixed("Ω", "mkM", RESISTANCE),
    **_prefixed("S", "m", {"kg": -1, "m": -2, "s": 3, "A": 2}),
    **_prefixed("H", "uµm", {"kg": 1, "m": 2, "s": -2, "A": -2}),
    **_prefixed("F", "nuµm", {"kg": -1, "m": -2, "s": 4, "A": 2}),
    **_prefixed("Wb", "m", {"kg": 1, "m": 2, "s": -2, "A": -1}),
    **_prefixed("T", "m", {"kg": 1, "s": -2, "A": -1}),
    **_prefixed("K", "m", {"K": 1}),
    **_prefixed("mol", "m", {"mol": 1}),
    "cd": Unit({"cd": 1}),
    **_sizes({"m": 3}, {"l": 1e-3, "L": 1e-3, "ml": 1e-6, "mL": 1e-6}),
}
# Other ways to write a symbol: superscripts, the signs for ohm and micro that look like the Greek letters.
ONE_WAY = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻\u2126\u03bc", "0123456789-\u03a9\u00b5")
TOKEN = re.compile(r"(1|%|°|[A-Za-zµΩ]+)(?:\^?(-?\d))?")
STANDARD_GRAVITY = 9.80665  # [m/s²]
# What people are shown: unit → display unit, and display value per value.
DEGREE = 180.0 / math.pi
DISPLAY = {"rad": ("deg", DEGREE), "rad/s": ("deg/s", DEGREE)}


def parse(text: str) -> Unit | None:
    """The unit written as `m/s2`, `m/s^2`, `m·s⁻²`, `deg/s` or `N.m.s/rad`; None where it is none."""
    words = _words(text)
    if words is None:
        return None
    size, exponents = 1.0, dict[str, int]()
    for symbol, power in words:
        unit = SYMBOLS[symbol]
        size *= unit.factor**power
        for name, count in unit.exponents.items():
            exponents[name] = exponents.get(name, 0) + power * count
    return Unit({name: count for name, count in exponents.items() if count}, size)


def _words(text: str) -> list[tuple[str, int]] | None:
    """Symbols of a unit with their powers, as they are written; None where one is unknown."""
    found = []
    for place, part in enumerate(text.translate(ONE_WAY).split("/")):
        sign = 1 if place == 0 else -1
        for word in re.split(r"[.·*\s]+", part.strip()):
            token = TOKEN.fullmatch(word)
            if token is None or token[1] not in SYMBOLS:
                return None
            found.append((token[1], sign * int(token[2] or 1)))
    return found


def factor(written: str, wanted: str) -> float | None:
    """What a value in the unit `written` is multiplied by to be in `wanted`; None where that makes no sense."""
    if not written or not wanted or written == wanted:
        return 1.0
    here, there = parse(written), parse(wanted)
    if written == "g" and there is not None and there.exponents == {"m": 1, "s": -2}:
        return STANDARD_GRAVITY / there.factor  # of an accelerometer, never gram
    if here is None or there is None or here.exponents != there.exponents:
        return None
    return here.factor / there.factor


class Taken(NamedTuple):
    """How numbers in a written unit are taken where they go to a signal that declares none.

    unit:     in which they are then; factor: what each is multiplied by
    sentence: what is to be said of the signal, "" where the numbers stay and nobody can be mistaken
    """

    unit: str
    factor: float = 1.0
    sentence: str = ""


def taken(written: str, of: str = "the model", cure: str = "leave the unit out of the header") -> Taken:
    """A signal without a unit is in SI units: `rpm` become rad/s; a unit that is none known here changes nothing.

    g alone changes nothing either: gram, or of an accelerometer 9.81 m/s². of: what declares none; cure: if it should.
    """
    unit = parse(written)
    if unit is None or written == "g":
        why = f'"{written}" is no unit known here' if unit is None else '"g" may be gram or standard gravity'
        other = "" if unit is None else "; write kg, or m/s2"
        return Taken(written, 1.0, f"has no unit in {of}, and {why}: its numbers are taken as they are{other}")
    if unit.factor == 1.0:
        return Taken(written)
    wanted = coherent(written)
    told = (
        f"has no unit in {of}: it is taken as {wanted}, so {written} are converted; {cure} if it is in {written} itself"
    )
    return Taken(wanted, unit.factor, told)


def coherent(written: str) -> str:
    """The SI unit without a factor in place of one that can be parsed: rad/s for rpm, V for mV, m3/s for l/min."""
    powers: dict[str, int] = {}
    for symbol, power in _words(written) or ():
        unit = SYMBOLS[symbol]
        sizes = (s for s, u in SYMBOLS.items() if u.factor == 1.0 and u.exponents == unit.exponents)
        same = symbol if unit.factor == 1.0 else next(sizes, "")
        for name, count in {same: 1}.items() if same else unit.exponents.items():
            powers[name] = powers.get(name, 0) + power * count
    above, below = ([_power(n, abs(p)) for n, p in powers.items() if n != "1" and p * s > 0] for s in (1, -1))
    return ".".join(above or ["1"]) + "".join(f"/{name}" for name in below)


def _power(name: str, power: int) -> str:
    return name if power == 1 else f"{name}{power}"


def computed_in(displayed: str) -> tuple[str, float]:
    """The unit in which what is displayed in this one is computed, and value there per value here: rad for deg."""
    for unit, (display, _) in DISPLAY.items():
        if display == displayed:
            return unit, factor(displayed, unit) or 1.0
    return displayed, 1.0


def alternatives(wanted: str) -> list[str]:
    """Units that can stand in place of `wanted`: itself, and its first part in other sizes (`mm/s2` for `m/s2`)."""
    head = re.match(r"[A-Za-z%°µΩ]+", wanted)
    found = [wanted]
    if head and head[0] in SYMBOLS:
        exponents = SYMBOLS[head[0]].exponents
        found += [s + wanted[head.end() :] for s, u in SYMBOLS.items() if u.exponents == exponents and s != head[0]]
    return [unit for unit in (*found, "g") if unit == wanted or factor(unit, wanted) is not None]


def unit_definitions(names: set[str]) -> Element:
    """The `UnitDefinitions` element for the units in use; ValueError where one is none."""
    root = Element("UnitDefinitions")
    for name in sorted(names):
        unit = parse(name)
        if unit is None:
            raise ValueError(f'unknown unit "{name}"')
        node = SubElement(root, "Unit", name=name)
        base = {k: str(v) for k, v in unit.exponents.items()}
        if unit.factor != 1.0:
            base["factor"] = repr(unit.factor)
        SubElement(node, "BaseUnit", base)
        if name in DISPLAY:
            display, factor = DISPLAY[name]
            SubElement(node, "DisplayUnit", name=display, factor=repr(factor))
    return root
