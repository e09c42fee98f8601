"""Units as engineers write them, with SI exponents and factors, and FMI unit definitions."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement

UNKNOWN_UNIT_TAKEN = 'has no unit in {owner}, and "{unit}" is no unit known here: its numbers are taken as they are'
AMBIGUOUS_UNIT_TAKEN = (
    'has no unit in {owner}, and "{unit}" may be gram or standard gravity: its numbers are taken as they are; '
    "write kg, or m/s2"
)

SI = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


class Unit(NamedTuple):
    """A unit by the exponents of its SI base units: value in SI = factor·value + offset."""

    exponents: Mapping[str, int]
    factor: float = 1.0
    offset: float = 0.0

    @property
    def is_coherent(self) -> bool:
        """Return whether values in this unit are SI values."""
        return self.factor == 1.0 and self.offset == 0.0


def _sizes(exponents: Mapping[str, int], factors: Mapping[str, float]) -> dict[str, Unit]:
    """Return the units of a dimension by symbol."""
    return {symbol: Unit(exponents, factor) for symbol, factor in factors.items()}


def _with_prefixes(symbol: str, prefixes: str, exponents: Mapping[str, int]) -> dict[str, Unit]:
    """Return a symbol's unit, alone and with each prefix."""
    sizes = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6}
    return {symbol: Unit(exponents)} | {p + symbol: Unit(exponents, sizes[p]) for p in prefixes}


ZERO_CELSIUS = 273.15  # [K]
ZERO_FAHRENHEIT = 459.67 * 5.0 / 9.0  # [K]
LENGTH, TIME, MASS, ANGLE = {"m": 1}, {"s": 1}, {"kg": 1}, {"rad": 1}
FORCE = {"kg": 1, "m": 1, "s": -2}
PRESSURE = {"kg": 1, "m": -1, "s": -2}
VOLTAGE = {"kg": 1, "m": 2, "s": -3, "A": -1}
RESISTANCE = {"kg": 1, "m": 2, "s": -3, "A": -2}

# Within a dimension, messages offer the units in this order.
SYMBOLS: dict[str, Unit] = {
    "1": Unit({}),
    "%": Unit({}, 0.01),
    **_sizes(LENGTH, {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "um": 1e-6, "µm": 1e-6, "in": 0.0254}),
    **_sizes(TIME, {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}),
    **_sizes(MASS, {"kg": 1.0, "g": 1e-3, "mg": 1e-6, "t": 1e3}),
    **_sizes(ANGLE, {"deg": math.pi / 180.0, "°": math.pi / 180.0, "rad": 1.0, "mrad": 1e-3, "rev": 2.0 * math.pi}),
    "rpm": Unit({"rad": 1, "s": -1}, math.pi / 30.0),
    **_with_prefixes("Hz", "kM", {"s": -1}),
    **_sizes(FORCE, {"N": 1.0, "mN": 1e-3, "kN": 1e3, "gf": 0.00980665, "kgf": 9.80665}),
    **_with_prefixes("Pa", "kM", PRESSURE),
    **_sizes(PRESSURE, {"bar": 1e5, "mbar": 1e2, "hPa": 1e2}),
    **_with_prefixes("J", "mkM", {"kg": 1, "m": 2, "s": -2}),
    **_with_prefixes("W", "mkM", {"kg": 1, "m": 2, "s": -3}),
    **_with_prefixes("A", "uµmk", {"A": 1}),
    **_with_prefixes("C", "uµm", {"A": 1, "s": 1}),
    **_with_prefixes("V", "uµmk", VOLTAGE),
    **_with_prefixes("ohm", "mkM", RESISTANCE),
    **_with_prefixes("Ω", "mkM", RESISTANCE),
    **_with_prefixes("S", "m", {"kg": -1, "m": -2, "s": 3, "A": 2}),
    **_with_prefixes("H", "uµm", {"kg": 1, "m": 2, "s": -2, "A": -2}),
    **_with_prefixes("F", "nuµm", {"kg": -1, "m": -2, "s": 4, "A": 2}),
    **_with_prefixes("Wb", "m", {"kg": 1, "m": 2, "s": -2, "A": -1}),
    **_with_prefixes("T", "m", {"kg": 1, "s": -2, "A": -1}),
    **_with_prefixes("K", "m", {"K": 1}),
    **{symbol: Unit({"K": 1}, 1.0, ZERO_CELSIUS) for symbol in ("degC", "°C")},
    **{symbol: Unit({"K": 1}, 5.0 / 9.0, ZERO_FAHRENHEIT) for symbol in ("degF", "°F")},
    **_with_prefixes("mol", "m", {"mol": 1}),
    "cd": Unit({"cd": 1}),
    **_sizes({"m": 3}, {"l": 1e-3, "L": 1e-3, "ml": 1e-6, "mL": 1e-6}),
}
# Alternative characters of symbols: superscripts, and lookalikes of the signs for ohm, micro and degrees.
ONE_WAY = str.maketrans(
    dict(zip("⁰¹²³⁴⁵⁶⁷⁸⁹⁻\u2126\u03bc", "0123456789-\u03a9\u00b5", strict=True)) | {"℃": "°C", "℉": "°F"}
)
TOKEN = re.compile(r"(1|%|°[CF]?|[A-Za-zµΩ]+)(?:\^?(-?\d))?")
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
# A unit that begins with a digit (1/min) needs a blank before it.
QUANTITY = re.compile(rf"({NUMBER})(?:\s*(?=[^\s\d.])|\s+)(\S.*)")
NO_DEFINITIONS: Mapping[str, Sequence[float]] = MappingProxyType({})
STANDARD_GRAVITY = 9.80665  # [m/s²]
# Displayed units: unit → display unit, and display value per value.
DEGREE = 180.0 / math.pi
DISPLAY = {"rad": ("deg", DEGREE), "rad/s": ("deg/s", DEGREE)}


def parse(text: str) -> Unit | None:
    """Return the unit of a text, if known. Accepted forms: `m/s2`, `m/s^2`, `m·s⁻²`, `deg/s`, `N.m.s/rad`."""
    words = _words(text)
    if words is None:
        return None
    if len(words) == 1 and words[0][1] == 1:
        return SYMBOLS[words[0][0]]  # Within a compound unit like W/degC, a temperature is a difference.
    size, exponents = 1.0, dict[str, int]()
    for symbol, power in words:
        unit = SYMBOLS[symbol]
        size *= unit.factor**power
        for name, count in unit.exponents.items():
            exponents[name] = exponents.get(name, 0) + power * count
    return Unit({name: count for name, count in exponents.items() if count}, size)


def definition_of(text: str) -> tuple[float, ...] | None:
    """Return a known unit's exponents of `SI`, factor and offset."""
    unit = parse(text)
    return None if unit is None else (*(float(unit.exponents.get(n, 0)) for n in SI), unit.factor, unit.offset)


def is_as_known(text: str, definition: Sequence[float]) -> bool:
    """Return whether a definition is that of the known unit, but for rounding and for angles with or without rad."""
    known, rad = definition_of(text), SI.index("rad")
    pairs = () if known is None else zip(known, definition, strict=True)
    return known is not None and all(k == rad or math.isclose(x, y, rel_tol=1e-9) for k, (x, y) in enumerate(pairs))


def _words(text: str) -> list[tuple[str, int]] | None:
    """Return the symbols of a unit and their powers, or None if a symbol is unknown."""
    words = []
    for place, part in enumerate(text.translate(ONE_WAY).split("/")):
        sign = 1 if place == 0 else -1
        for word in re.split(r"[.·*\s]+", part.strip()):
            token = TOKEN.fullmatch(word)
            if token is None or token[1] not in SYMBOLS:
                return None
            words.append((token[1], sign * int(token[2] or 1)))
    return words


class Conversion(NamedTuple):
    """A linear conversion of values between two units."""

    factor: float = 1.0
    offset: float = 0.0

    def __call__(self, value: float) -> float:
        """Return the converted value."""
        return self.factor * value + self.offset


def conversion(
    written: str, wanted: str, *, difference: bool = False, definitions: Mapping[str, Sequence[float]] = NO_DEFINITIONS
) -> Conversion | None:
    """Return the conversion between units of the same dimension.

    Args:
        difference: Whether the value is a difference, e.g. a standard deviation, a tolerance or a step. The offset of
            degC then does not count.
        definitions: Unit → exponents of `SI`, factor and offset, which take precedence over common units.
    """
    if not written or not wanted or written == wanted:
        return Conversion()
    here, there = (
        Unit({n: int(k) for n, k in zip(SI, definition, strict=False) if k}, *definition[-2:])
        if (definition := definitions.get(name))
        else parse(name)
        for name in (written, wanted)
    )
    if written == "g" and there is not None and there.exponents == {"m": 1, "s": -2}:
        return Conversion(STANDARD_GRAVITY / there.factor)  # of an accelerometer: standard gravity, never gram
    if here is None or there is None or here.exponents != there.exponents:
        return None
    offset = 0.0 if difference else (here.offset - there.offset) / there.factor
    return Conversion(here.factor / there.factor, offset)


def factor(written: str, wanted: str) -> float | None:
    """Return the factor between units, if a factor suffices."""
    by = conversion(written, wanted)
    return None if by is None or by.offset else by.factor


def split_quantity(text: str) -> tuple[float, str] | None:
    """Return number and unit of text like `-15 degC`.

    The unit of a number alone is ""; the result is None for text without a number.
    """
    whole = text.strip()
    if re.fullmatch(NUMBER, whole):
        return float(whole), ""
    match = QUANTITY.fullmatch(whole)
    return None if match is None else (float(match[1]), match[2].strip())


def has_unit(text: str) -> bool:
    """Return whether text is a number with a unit."""
    quantity = split_quantity(text)
    return quantity is not None and quantity[1] != ""


def read_quantity(text: str, unit: str, *, difference: bool = False) -> float:
    """Return the number of text like `4 min` in `unit`; raise ValueError with the allowed units."""
    quantity = split_quantity(text)
    by = None if quantity is None else conversion(quantity[1], unit, difference=difference)
    if quantity is None or by is None or (quantity[1] and not unit):
        raise ValueError(allowed_quantity(unit))
    number = by(quantity[0])
    if not math.isfinite(number):
        raise ValueError("it is not finite; write a finite number")
    return number


def allowed_quantity(unit: str, more: Iterable[str] = ()) -> str:
    """Return a sentence on the allowed forms of a number.

    Args:
        more: Allowed units besides those of the dimension.
    """
    if not unit:
        return "it is a number alone: no unit of it is declared"
    offered = dict.fromkeys((unit, *more, *(alternatives(unit) if parse(unit) else ())))
    return f"it is a number [{unit}], or text with a unit: {', '.join(f'3 {u}' for u in offered)}"


class UnitAssumption(NamedTuple):
    """The conversion of numbers in a written unit for a signal without a declared unit.

    Attributes:
        unit: Unit after the conversion.
        factor: Factor of the conversion.
        sentence: Note for the user; "" if the numbers stay unchanged and the unit is clear.
        offset: Offset added after the factor.
    """

    unit: str
    factor: float = 1.0
    sentence: str = ""
    offset: float = 0.0


def assume_si(written: str, of: str = "the model", cure: str = "leave the unit out of the header") -> UnitAssumption:
    """Return the conversion to SI for a unitless signal.

    For example, `rpm` become rad/s. An unknown unit changes nothing, nor does g alone: gram, or 9.81 m/s².

    Args:
        of: Owner of the signal, for the note.
        cure: Remedy named in the note if SI is wrong.
    """
    unit = parse(written)
    if unit is None or written == "g":
        template = UNKNOWN_UNIT_TAKEN if unit is None else AMBIGUOUS_UNIT_TAKEN
        return UnitAssumption(written, 1.0, template.format(owner=of, unit=written))
    if unit.is_coherent:
        return UnitAssumption(written)
    wanted = coherent(written)
    note = (
        f"has no unit in {of}: it is taken as {wanted}, so {written} are converted; {cure} if it is in {written} itself"
    )
    return UnitAssumption(wanted, unit.factor, note, unit.offset)


def coherent(written: str) -> str:
    """Return the SI unit of the same dimension. For example rad/s for rpm, V for mV, m3/s for l/min."""
    powers: dict[str, int] = {}
    for symbol, power in _words(written) or ():
        unit = SYMBOLS[symbol]
        same = symbol if unit.is_coherent else _symbol_of(unit.exponents)
        for name, count in {same: 1}.items() if same else unit.exponents.items():
            powers[name] = powers.get(name, 0) + power * count
    return _unit_text(powers)


def _unit_text(powers: Mapping[str, int]) -> str:
    """Return the text of symbols with powers."""
    above, below = ([_power(n, abs(p)) for n, p in powers.items() if n != "1" and p * s > 0] for s in (1, -1))
    return ".".join(above or ["1"]) + "".join(f"/{name}" for name in below)


def _power(name: str, power: int) -> str:
    return name if power == 1 else f"{name}{power}"


def square_unit(unit: str) -> str:
    """Return the square of a unit: `rad2/s2` for `rad/s`."""
    return unit_product([(unit, 2)])


def unit_of_rate(unit: str) -> str:
    """Return the unit of a derivative by time: `rad/s` for `rad`."""
    return unit_product([(unit, 1), ("s", -1)])


def unit_product(factors: Iterable[tuple[str, int]]) -> str:
    """Return a product of powers of units, "" without dimension or with an unknown unit: `N.s/m` for N over m/s."""
    powers: dict[str, int] = {}
    for unit, times in factors:
        words = [] if unit in ("", "1") else _words(unit)
        if words is None or any(symbol not in SYMBOLS for symbol, _ in words):
            return ""
        for symbol, power in words:
            powers[symbol] = powers.get(symbol, 0) + times * power
    powers = {symbol: power for symbol, power in powers.items() if power}
    return _unit_text(powers) if powers else ""


def _symbol_of(exponents: Mapping[str, int]) -> str:
    """Return the SI symbol of a dimension, "" without one."""
    return next((s for s, u in SYMBOLS.items() if u.is_coherent and u.exponents == exponents), "")


def computed_in(displayed: str) -> tuple[str, float]:
    """Return the unit behind a display unit, and the factor. For example rad for deg."""
    for unit, (display, _) in DISPLAY.items():
        if display == displayed:
            return unit, factor(displayed, unit) or 1.0
    return displayed, 1.0


def alternatives(wanted: str) -> list[str]:
    """Return units convertible to `wanted`, which comes first.

    Only the first symbol of the unit varies, e.g. `mm/s2` for `m/s2`.
    """
    head = re.match(r"[A-Za-z%°µΩ]+", wanted)
    units = [wanted]
    if head and head[0] in SYMBOLS:
        exponents = SYMBOLS[head[0]].exponents
        units += [s + wanted[head.end() :] for s, u in SYMBOLS.items() if u.exponents == exponents and s != head[0]]
    return [unit for unit in (*units, "g") if unit == wanted or conversion(unit, wanted) is not None]


def unit_definitions(names: set[str]) -> Element:
    """Return the FMI element `UnitDefinitions` for these units; raise ValueError for unknown units."""
    root = Element("UnitDefinitions")
    for name in sorted(names):
        unit = parse(name)
        if unit is None:
            raise ValueError(f'unknown unit "{name}"')
        node = SubElement(root, "Unit", name=name)
        base = {k: str(v) for k, v in unit.exponents.items()}
        if unit.factor != 1.0:
            base["factor"] = repr(unit.factor)
        if unit.offset:
            base["offset"] = repr(unit.offset)
        SubElement(node, "BaseUnit", base)
        if name in DISPLAY:
            display, factor = DISPLAY[name]
            SubElement(node, "DisplayUnit", name=display, factor=repr(factor))
    return root
