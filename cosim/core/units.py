"""Units as engineers write them, with SI exponents and factors, and FMI unit definitions."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, SubElement

SI = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


class Unit(NamedTuple):
    """A unit by the exponents of its SI base units: value in SI = factor·value + offset."""

    exponents: Mapping[str, int]
    factor: float = 1.0
    offset: float = 0.0

    @property
    def is_coherent(self) -> bool:
        """Return True if values in this unit are SI values."""
        return self.factor == 1.0 and self.offset == 0.0


# A line for each dimension in SI base units: symbols with their factors, and offsets of temperatures. Within a
# dimension, messages offer the units in this order; a symbol without a factor is the SI unit.
UNIT_TABLE = """
1: 1 %=0.01
m: m mm=1e-3 cm=1e-2 km=1e3 um=1e-6 µm=1e-6 in=0.0254
s: s ms=1e-3 us=1e-6 µs=1e-6 ns=1e-9 min=60 h=3600
kg: kg g=1e-3 mg=1e-6 t=1e3
rad: deg=0.017453292519943295 °=0.017453292519943295 rad mrad=1e-3 rev=6.283185307179586 U=6.283185307179586
rad/s: rpm=0.10471975511965977
1/s: Hz kHz=1e3 MHz=1e6
kg.m/s2: N mN=1e-3 kN=1e3 gf=0.00980665 kgf=9.80665
kg/m/s2: Pa kPa=1e3 MPa=1e6 bar=1e5 mbar=1e2 hPa=1e2
kg.m2/s2: J mJ=1e-3 kJ=1e3 MJ=1e6
kg.m2/s3: W mW=1e-3 kW=1e3 MW=1e6
A: A uA=1e-6 µA=1e-6 mA=1e-3 kA=1e3
A.s: C uC=1e-6 µC=1e-6 mC=1e-3
kg.m2/s3/A: V uV=1e-6 µV=1e-6 mV=1e-3 kV=1e3
kg.m2/s3/A2: ohm mohm=1e-3 kohm=1e3 Mohm=1e6 Ω mΩ=1e-3 kΩ=1e3 MΩ=1e6
s3.A2/kg/m2: S mS=1e-3
kg.m2/s2/A2: H uH=1e-6 µH=1e-6 mH=1e-3
s4.A2/kg/m2: F nF=1e-9 uF=1e-6 µF=1e-6 mF=1e-3
kg.m2/s2/A: Wb mWb=1e-3
kg/s2/A: T mT=1e-3
K: K mK=1e-3 degC=1+273.15 °C=1+273.15 degF=0.5555555555555556+255.3722222222222 °F=0.5555555555555556+255.3722222222222
mol: mol mmol=1e-3
cd: cd
m3: l=1e-3 L=1e-3 ml=1e-6 mL=1e-6
"""
# Alternative characters of symbols: superscripts, and lookalikes of the signs for ohm, micro and degrees.
ONE_WAY = str.maketrans(
    dict(zip("⁰¹²³⁴⁵⁶⁷⁸⁹⁻\u2126\u03bc", "0123456789-\u03a9\u00b5", strict=True)) | {"℃": "°C", "℉": "°F"}
)
TOKEN = re.compile(r"(1|%|°[CF]?|[A-Za-zµΩ]+)(?:\^?(-?\d))?")
NUMBER_PATTERN = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
# A unit that begins with a digit (1/min) needs a blank before it.
QUANTITY = re.compile(rf"({NUMBER_PATTERN})(?:\s*(?=[^\s\d.])|\s+)(\S.*)")
PER_TIME, ROTATION = {"s": -1}, {"rad": 1, "s": -1}  # `1/min` of a speed of rotation counts turns, as rpm does
NO_DEFINITIONS: Mapping[str, Sequence[float]] = MappingProxyType({})
AMBIGUOUS = "may be gram or standard gravity", "; write kg, or m/s2"  # of g
STANDARD_GRAVITY = 9.80665  # [m/s²]
DEGREES = 180.0 / math.pi  # per radian
# display units that the FMUs of models declare: unit → name of the display unit, factor and offset
DISPLAY = {"rad": ("deg", DEGREES, 0.0), "rad/s": ("deg/s", DEGREES, 0.0)}


def _words(text: str) -> list[tuple[str, int]] | None:
    """Return the symbols of a unit and their powers, or None if the text is not a unit."""
    words = []
    for place, part in enumerate(text.translate(ONE_WAY).split("/")):
        for word in re.split(r"[.·*\s]+", part.strip()):
            if (token := TOKEN.fullmatch(word)) is None:
                return None
            power = int(token[2] or 1)
            words.append((token[1], power if place == 0 else -power))
    return words


def _symbols() -> dict[str, Unit]:
    symbols: dict[str, Unit] = {}
    for line in UNIT_TABLE.strip().splitlines():
        dimension, _, units = line.partition(": ")
        exponents = {name: power for name, power in _words(dimension) or () if name != "1"}
        for text in units.split():
            symbol, _, size = text.partition("=")
            factor, _, offset = size.partition("+")
            symbols[symbol] = Unit(exponents, float(factor or 1.0), float(offset or 0.0))
    return symbols


SYMBOLS = _symbols()


def parse(text: str) -> Unit | None:
    """Return the unit of a text; None if unknown. Accepted forms: `m/s2`, `m/s^2`, `m·s⁻²`, `deg/s`, `N.m.s/rad`."""
    words = _words(text)
    if words is None or any(symbol not in SYMBOLS for symbol, _ in words):
        return None
    if len(words) == 1 and words[0][1] == 1:
        return SYMBOLS[words[0][0]]  # Within a compound unit like W/degC, a temperature is a difference.
    size, exponents = 1.0, Counter[str]()
    for symbol, power in words:
        size *= SYMBOLS[symbol].factor ** power
        for name, count in SYMBOLS[symbol].exponents.items():
            exponents[name] += power * count
    return Unit({name: count for name, count in exponents.items() if count}, size)


def definition_of(text: str) -> tuple[float, ...] | None:
    """Return the SI exponents, the factor and the offset of a unit; None for an unknown unit."""
    unit = parse(text)
    return None if unit is None else (*(float(unit.exponents.get(n, 0)) for n in SI), unit.factor, unit.offset)


def is_as_known(text: str, definition: Sequence[float]) -> bool:
    """Return True if an FMU's definition of a unit equals the usual one, apart from rounding and from rad in angles."""
    known, rad = definition_of(text), SI.index("rad")
    pairs = () if known is None else zip(known, definition, strict=True)
    return known is not None and all(k == rad or math.isclose(x, y, rel_tol=1e-9) for k, (x, y) in enumerate(pairs))


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
    """Return the conversion from the unit `written` to the unit `wanted`; None if they have different dimensions.

    Args:
        difference: True for a difference, e.g. a standard deviation, a tolerance or a step. The offset of degC is then
            ignored.
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
        return Conversion(STANDARD_GRAVITY / there.factor)  # g of an acceleration: standard gravity, not gram
    if here is None or there is None:
        return None
    if sorted((here.exponents, there.exponents), key=len) == [PER_TIME, ROTATION]:
        (per_time,) = (unit for unit in (here, there) if unit.exponents == PER_TIME)
        if not math.isclose(per_time.factor, 1.0 / 60.0):
            return None
        return Conversion((2.0 * math.pi if here is per_time else 0.5 / math.pi) * here.factor / there.factor)
    if here.exponents != there.exponents:
        return None
    offset = 0.0 if difference else (here.offset - there.offset) / there.factor
    return Conversion(here.factor / there.factor, offset)


def factor(written: str, wanted: str) -> float | None:
    """Return the factor between two units; None if they are not convertible or differ by an offset."""
    by = conversion(written, wanted)
    return None if by is None or by.offset else by.factor


def split_quantity(text: str) -> tuple[float, str] | None:
    """Split text like `-15 degC` into number and unit.

    The unit of a number alone is ""; the result is None for text without a number.
    """
    whole = text.strip()
    if re.fullmatch(NUMBER_PATTERN, whole):
        return float(whole), ""
    match = QUANTITY.fullmatch(whole)
    return None if match is None else (float(match[1]), match[2].strip())


def has_unit(text: str) -> bool:
    """Return True if a text is a number with a unit."""
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


def number_in(value: Any, unit: str, *, difference: bool = False) -> Any:
    """Return a text with a unit as a number, other values unchanged; raise ValueError for a text without a unit."""
    if not isinstance(value, str):
        return value
    if not has_unit(value):
        raise ValueError(allowed_quantity(unit))
    return read_quantity(value, unit, difference=difference)


def allowed_quantity(unit: str, more: Iterable[str] = ()) -> str:
    """Return a sentence that says how a number with this unit can be written.

    Args:
        more: Allowed units besides those of the dimension.
    """
    if not unit:
        return "write a number without a unit, because the signal has no declared unit"
    offered = dict.fromkeys((unit, *more, *(alternatives(unit) if parse(unit) else ())))
    return f"write a number [{unit}], or text with a unit: {', '.join(f'3 {u}' for u in offered)}"


class UnitAssumption(NamedTuple):
    """Assumed conversion of the numbers of a signal that has a unit in a file but none in its model.

    Attributes:
        unit: Unit of the converted numbers.
        factor: Factor of the conversion.
        sentence: Note for the user; "" if the numbers stay unchanged and the unit is clear.
        offset: Offset added after the factor.
    """

    unit: str
    factor: float = 1.0
    sentence: str = ""
    offset: float = 0.0


def assume_si(written: str, of: str = "the model", cure: str = "leave the unit out of the header") -> UnitAssumption:
    """Return the conversion to SI units of numbers in the unit `written`, for a signal without a declared unit.

    For example, `rpm` is converted to rad/s. An unknown unit is not converted, nor is g (gram or 9.81 m/s²).

    Args:
        of: Owner of the signal, for the note.
        cure: Remedy in the note for numbers that must stay unchanged.
    """
    unit = parse(written)
    if unit is None or written == "g":
        meaning, cure = ("is not a known unit", "") if unit is None else AMBIGUOUS
        taken = f'has no unit in {of}, and "{written}" {meaning}: its numbers are not converted{cure}'
        return UnitAssumption(written, 1.0, taken)
    if unit.is_coherent:
        return UnitAssumption(written)
    wanted = coherent(written)
    note = f"has no unit in {of}: assumed {wanted}, converted from {written}. If {of} itself uses {written}, {cure}"
    return UnitAssumption(wanted, unit.factor, note, unit.offset)


def coherent(written: str) -> str:
    """Return the SI unit of the same dimension. For example rad/s for rpm, V for mV, m3/s for l/min."""
    si = Counter[str]()
    for symbol, power in _words(written) or ():
        unit = SYMBOLS[symbol]
        of_dimension = (s for s, u in SYMBOLS.items() if u.is_coherent and u.exponents == unit.exponents)
        same = symbol if unit.is_coherent else next(of_dimension, None)
        for name, count in {same: 1}.items() if same else unit.exponents.items():
            si[name] += power * count
    return _unit_text(si) or "1"


def _unit_text(powers: Mapping[str, int]) -> str:
    """Return the text of a unit from its symbols and their powers; "" for no symbols."""

    def side(sign: int, before: str) -> str:
        factors = ((n, sign * power) for n, power in powers.items() if n != "1" and sign * power > 0)
        return before.join(f"{name}{power if power > 1 else ''}" for name, power in factors)

    above, below = side(1, "."), side(-1, "/")
    return f"{above or '1'}/{below}" if below else above


def square_unit(unit: str) -> str:
    """Return the square of a unit: `rad2/s2` for `rad/s`."""
    return unit_product([(unit, 2)])


def unit_of_rate(unit: str) -> str:
    """Return the unit of a derivative by time: `rad/s` for `rad`."""
    return unit_product([(unit, 1), ("s", -1)])


def unit_product(factors: Iterable[tuple[str, int]]) -> str:
    """Return the unit of a product of powers of units; "" for a pure number or with an unknown unit."""
    product = Counter[str]()
    for unit, exponent in factors:
        words = _words(unit or "1")
        if words is None or any(symbol not in SYMBOLS for symbol, _ in words):
            return ""
        for symbol, power in words:
            product[symbol] += exponent * power
    return _unit_text(product)


def computed_in(displayed: str) -> tuple[str, float]:
    """Return the SI unit of a display unit, and the factor from the display unit to SI. For example rad for deg."""
    for unit, (display, *_) in DISPLAY.items():
        if display == displayed:
            return unit, factor(displayed, unit) or 1.0
    return displayed, 1.0


def alternatives(wanted: str) -> list[str]:
    """Return units convertible to `wanted`, which comes first.

    Only the first symbol of the unit varies, e.g. `mm/s2` for `m/s2`; `g` is added for accelerations.
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
            display, factor, _ = DISPLAY[name]
            SubElement(node, "DisplayUnit", name=display, factor=repr(factor))
    return root
