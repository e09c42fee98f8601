"""Units as engineers write them into the header of a log, and their factor to the model's unit."""

from __future__ import annotations

import math
import re

STANDARD_GRAVITY = 9.80665  # [m/s²]
FORCE = {"kg": 1, "m": 1, "s": -2}
# symbol → value in SI base units, exponents of base units
SYMBOLS: dict[str, tuple[float, dict[str, int]]] = {
    "1": (1.0, {}),
    "%": (0.01, {}),
    **{s: (f, {"m": 1}) for s, f in (("m", 1.0), ("mm", 1e-3), ("cm", 1e-2), ("km", 1e3), ("in", 0.0254))},
    **{s: (f, {"s": 1}) for s, f in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("µs", 1e-6), ("ns", 1e-9))},
    **{s: (f, {"s": 1}) for s, f in (("min", 60.0), ("h", 3600.0))},
    **{s: (f, {"kg": 1}) for s, f in (("kg", 1.0), ("g", 1e-3))},
    **{s: (math.pi / 180.0, {"rad": 1}) for s in ("deg", "°")},
    **{s: (f, {"rad": 1}) for s, f in (("rad", 1.0), ("mrad", 1e-3), ("rev", 2.0 * math.pi))},
    "rpm": (math.pi / 30.0, {"rad": 1, "s": -1}),
    "Hz": (1.0, {"s": -1}),
    **{s: (f, FORCE) for s, f in (("N", 1.0), ("mN", 1e-3), ("kN", 1e3), ("gf", 0.00980665), ("kgf", 9.80665))},
    **{s: (f, {"V": 1}) for s, f in (("V", 1.0), ("mV", 1e-3))},
    **{s: (f, {"A": 1}) for s, f in (("A", 1.0), ("mA", 1e-3))},
}
SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
TOKEN = re.compile(r"(1|%|°|[A-Za-zµ]+)(?:\^?(-?\d))?")


def factor(written: str, wanted: str) -> float | None:
    """What a value in the unit `written` is multiplied by to be in `wanted`; None where that makes no sense."""
    if not written or not wanted or written == wanted:
        return 1.0
    here, there = _parse(written), _parse(wanted)
    if written == "g" and there is not None and there[1] == {"m": 1, "s": -2}:
        return STANDARD_GRAVITY / there[0]  # of an accelerometer, never gram
    if here is None or there is None or here[1] != there[1]:
        return None
    return here[0] / there[0]


def alternatives(wanted: str) -> list[str]:
    """Units that can stand in place of `wanted`: itself, and its first part in other sizes (`mm/s2` for `m/s2`)."""
    head = re.match(r"[A-Za-z%°µ]+", wanted)
    found = [wanted]
    if head and head[0] in SYMBOLS:
        exponents = SYMBOLS[head[0]][1]
        found += [s + wanted[head.end() :] for s, (_, e) in SYMBOLS.items() if e == exponents and s != head[0]]
    return [unit for unit in (*found, "g") if unit == wanted or factor(unit, wanted) is not None]


def _parse(text: str) -> tuple[float, dict[str, int]] | None:
    """Value in base units and their exponents of `m/s2`, `m/s^2`, `m·s⁻²`, `deg/s`, `N.m.s/rad`."""
    value, exponents = 1.0, dict[str, int]()
    for place, part in enumerate(text.translate(SUPERSCRIPTS).split("/")):
        sign = 1 if place == 0 else -1
        for word in re.split(r"[.·*\s]+", part.strip()):
            token = TOKEN.fullmatch(word)
            if token is None or token[1] not in SYMBOLS:
                return None
            power = sign * int(token[2] or 1)
            size, base = SYMBOLS[token[1]]
            value *= size**power
            for name, count in base.items():
                exponents[name] = exponents.get(name, 0) + power * count
    return value, {name: count for name, count in exponents.items() if count}
