"""Units as they stand in the header of a log, and their factor to the model's unit."""

from __future__ import annotations

import re

from fmus.units import SYMBOLS, parse

STANDARD_GRAVITY = 9.80665  # [m/s²]


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


def alternatives(wanted: str) -> list[str]:
    """Units that can stand in place of `wanted`: itself, and its first part in other sizes (`mm/s2` for `m/s2`)."""
    head = re.match(r"[A-Za-z%°µΩ]+", wanted)
    found = [wanted]
    if head and head[0] in SYMBOLS:
        exponents = SYMBOLS[head[0]].exponents
        found += [s + wanted[head.end() :] for s, u in SYMBOLS.items() if u.exponents == exponents and s != head[0]]
    return [unit for unit in (*found, "g") if unit == wanted or factor(unit, wanted) is not None]
