"""Numbers and sentences as shown in reports, and suggestions of a close word for one that is unknown."""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Container, Iterable, Sequence
from itertools import islice
from typing import Any

from cosim.core.units import DISPLAY

DEGREES = DISPLAY["rad"][1]  # displayed value per radian
ANGLE = re.compile(r"rad([./]s\d?)?")  # an angle, its rates and its time integral
POWER = re.compile(r"(?<=[A-Za-z])\d")
RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
NOT_IN_YAML = re.compile(r"[\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff]")
MINUS = "\u2212"
MISSING = "\u2013"
WORDS, LONGEST_WORD = 2000, 100  # searched words, and their length
MOST_NAMED = 3  # names in a sentence; a reader loses the thread of a longer chain


def plain(value: float, digits: int | None = 3) -> str:
    """Return a number as text for a report.

    Args:
        digits: Significant digits; None for up to four. Digits before the decimal point are never rounded away.
    """
    if not math.isfinite(value):
        return MISSING if math.isnan(value) else ("∞" if value > 0 else f"{MINUS}∞")
    if value == 0:
        return "0"
    if digits is None:
        return f"{value:.4g}".replace("-", MINUS)
    exponent = math.floor(math.log10(abs(value)))
    if not -4 <= exponent < 6:
        return f"{value:.{digits - 1}e}".replace("-", MINUS)
    decimals = max(0, digits - 1 - exponent)
    return f"{value:.{decimals}f}".replace("-", MINUS)


def amount(value: float, unit: str = "", digits: int | None = 3) -> str:
    """Return an SI value with its displayed unit."""
    symbol, factor = display(unit)
    return append_unit(plain(value * factor, digits), symbol)


def append_unit(number: str, unit: str) -> str:
    """Return a displayed number with its unit: `12°`, `3 m`."""
    if number == MISSING or not unit:
        return number
    return f"{number}{'' if unit.startswith('°') else chr(0xA0)}{unit}"


def length(value: float) -> str:
    """Return a distance [m] in a readable unit."""
    size = abs(value)
    if 0 < size < 1e-4:
        return "less than 0.1\u00a0mm"
    if size < 0.0095:
        return amount(value * 1000, "mm", 2)
    return amount(value * 100, "cm", 2) if size < 0.5 else amount(value, "m", 3)


def size(value: float, unit: str) -> str:
    """Return a size with two digits, lengths in mm, cm or m."""
    return length(value) if unit == "m" else amount(value, unit, 2)


def percent(share: float) -> str:
    """Return a share 0 … 1 in percent. `0 %` and `100 %` appear only for exact values."""
    if not math.isfinite(share):
        return MISSING
    if 0 < share < 0.005:
        return "less than 1\u00a0%"
    if 0.995 <= share < 1:
        return "more than 99\u00a0%"
    return f"{100 * share:.0f}\u00a0%"


def counted(count: int, noun: str) -> str:
    """Return `1 row`, `2 rows` or `3 criteria`."""
    plural = {"criterion": "criteria", "hypothesis": "hypotheses"}.get(noun, f"{noun}s")
    return f"{count} {noun if count == 1 else plural}"


def join_names(names: Sequence[str]) -> str:
    """Return names as a phrase: `a`, `a and b`, `a, b and c`; with more than three names `a, b, c and 7 more`."""
    items = [*names] if len(names) <= MOST_NAMED else [*names[:MOST_NAMED], f"{len(names) - MOST_NAMED} more"]
    return " and ".join(filter(None, (", ".join(items[:-1]), *items[-1:])))


def some(names: Sequence[str], most: int) -> str:
    """Return the first `most` names as a list, with an ellipsis for omitted names."""
    return ", ".join(names[:most]) + (", …" if len(names) > most else "")


def split_assignment(text: str, names: Container[str]) -> tuple[str, str, str]:
    """Return name, equals sign and value of `name=value`; a known name may have equals signs itself."""
    pieces = text.split("=")
    known = (k for k in range(len(pieces), 0, -1) if "=".join(pieces[:k]).strip() in names)
    count = next(known, 1)
    return "=".join(pieces[:count]).strip(), "=" * (count < len(pieces)), "=".join(pieces[count:]).strip()


def split_sentence(text: str) -> tuple[str, str]:
    """Return the first sentence of a text and the rest."""
    first, stop, others = text.partition(". ")
    return f"{first}{stop}".strip(), others


def display(unit: str) -> tuple[str, float]:
    """Return the displayed unit and the factor to its values. For example `°/s²` and 57.3 for `rad/s2`."""
    if ANGLE.fullmatch(unit):
        return written(unit, "\u00a0").replace("rad", "°"), DEGREES
    return written(unit, "\u00a0"), 1.0


def written(unit: str, times: str = "·") -> str:
    """Return a unit in print: `N·s²/m²` for `N.s2/m2`.

    Args:
        times: Sign between factors.
    """
    return "" if unit == "1" else POWER.sub(lambda match: match[0].translate(RAISED), unit).replace(".", times)


def finer(unit: str, size: float) -> tuple[str, float]:
    """Return a unit and a factor in which a small error has readable digits."""
    if unit == "m" and size < 1.0:
        return "mm", 1000.0
    if unit == "m/s" and size < 0.05:
        return "mm/s", 1000.0
    return display(unit)


def as_yaml(value: Any) -> str:
    """Return a value as JSON that YAML reads too: what it takes for a line break, or for no character, is escaped."""
    text = json.dumps(value, ensure_ascii=False)
    return NOT_IN_YAML.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def closest(word: str, words: Iterable[str], similarity: float = 0.6) -> str:
    """Return the closest of some words, or "".

    Args:
        similarity: Required similarity; 1 means equal.
    """
    if len(word) > LONGEST_WORD:
        return ""
    candidates = [w for w in islice(words, WORDS) if len(w) <= LONGEST_WORD]
    return "".join(difflib.get_close_matches(word, candidates, n=1, cutoff=similarity))


def did_you_mean(word: str, words: Iterable[str]) -> str:
    """Return `; did you mean "…"?` for a close word, or ""."""
    match = closest(word, words)
    return f'; did you mean "{match}"?' if match else ""
