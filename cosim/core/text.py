"""Numbers and sentences of reports, and suggestions for misspelt words."""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import chain, count, islice
from types import MappingProxyType
from typing import Any

DisplayUnits = Mapping[str, Sequence[Any]]  # unit → name of its display unit, factor and offset to its values
_display_units: ContextVar[DisplayUnits] = ContextVar("display units", default=MappingProxyType({}))
POWER = re.compile(r"(?<=[A-Za-z])\d")
DEGREE_WORD, TEMPERATURE = re.compile(r"\bdeg(?=[CF]?\b)"), re.compile("°[CF]")
RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
NOT_IN_YAML = re.compile(r"[\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff]")
MINUS = "\u2212"
MISSING = "\u2013"
MAX_SEARCHED_WORDS, MAX_WORD_CHARACTERS = 2000, 100  # searched words, and their length
MAX_NAMED = 3  # names in a sentence; a reader loses the thread of a longer chain


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


def amount(value: float, unit: str = "", digits: int | None = 3, *, difference: bool = False) -> str:
    """Return a value in its display unit.

    Args:
        difference: True for a difference, such as an error: the offset of a display unit is then not added.
    """
    symbol, factor = display(unit)
    if difference:
        return append_unit(plain(value * factor, digits), symbol)
    return append_unit(plain(displayed(value, unit), digits), shown_unit(unit))


def append_unit(number: str, unit: str) -> str:
    """Return a displayed number with its unit: `12°`, `3 m`."""
    if number == MISSING or not unit:
        return number
    return f"{number}{'' if unit.startswith('°') and not TEMPERATURE.match(unit) else chr(0xA0)}{unit}"


def is_difference(criterion: Mapping[str, Any]) -> bool:
    """Return True if the value of a criterion is a difference, as for all criteria except a peak without a target."""
    return criterion.get("kind") != "peak" or bool(criterion.get("to"))


def size(value: float, unit: str) -> str:
    """Return the size of a difference, such as an error, with two significant digits."""
    return amount(value, unit, 2, difference=True)


def percent(share: float) -> str:
    """Return a share (0 … 1) in percent. Only exactly 0 and 1 appear as `0 %` and `100 %`."""
    if not math.isfinite(share):
        return MISSING
    if 0 < share < 0.005:
        return "less than 1\u00a0%"
    if 0.995 <= share < 1:
        return "more than 99\u00a0%"
    return f"{100 * share:.0f}\u00a0%"


def counted(count: int, noun: str) -> str:
    """Return a count with its noun in singular or plural: `1 row`, `2 rows` or `3 criteria`."""
    plural = {"criterion": "criteria", "hypothesis": "hypotheses"}.get(noun, f"{noun}s")
    return f"{count} {noun if count == 1 else plural}"


def join_names(names: Sequence[str]) -> str:
    """Return names as a phrase: `a`, `a and b`, `a, b and c`; with more than three names `a, b, c and 7 more`."""
    items = [*names] if len(names) <= MAX_NAMED else [*names[:MAX_NAMED], f"{len(names) - MAX_NAMED} more"]
    return " and ".join(filter(None, (", ".join(items[:-1]), *items[-1:])))


def some(names: Sequence[str], most: int) -> str:
    """Return the first `most` names as a list, with an ellipsis for omitted names."""
    return ", ".join(names[:most]) + (", …" if len(names) > most else "")


def unique_name(name: str, taken: Container[str], ending: str = "") -> str:
    """Return an unused name; if necessary, a number is appended: `a`, `a_2`, `a_3`."""
    return next(n for n in chain([f"{name}{ending}"], (f"{name}_{k}{ending}" for k in count(2))) if n not in taken)


def split_assignment(text: str, names: Container[str]) -> tuple[str, str, str]:
    """Split `name=value` into name, equals sign and value. A name in `names` may itself contain equals signs."""
    pieces = text.split("=")
    known = (k for k in range(len(pieces), 0, -1) if "=".join(pieces[:k]).strip() in names)
    count = next(known, 1)
    return "=".join(pieces[:count]).strip(), "=" * (count < len(pieces)), "=".join(pieces[count:]).strip()


def split_sentence(text: str) -> tuple[str, str]:
    """Return the first sentence of a text and the rest."""
    first, stop, others = text.partition(". ")
    return f"{first}{stop}".strip(), others


@contextmanager
def showing(*records: Mapping[str, Any]) -> Iterator[None]:
    """Show values in the display units that records, such as manifests, have under the key `display`.

    A unit for which the records name different display units is shown unconverted.
    """
    found: dict[str, list[Any]] = {}
    for record in records:
        units = record.get("display")
        for unit, entry in units.items() if isinstance(units, Mapping) else ():
            if _is_display(entry) and [*entry] not in found.setdefault(unit, []):
                found[unit].append([*entry])
    token = _display_units.set({unit: entries[0] for unit, entries in found.items() if len(entries) == 1})
    try:
        yield
    finally:
        _display_units.reset(token)


def _is_display(entry: Any) -> bool:
    """Return True if an entry of a record is a display unit with factor and offset."""
    match entry:
        case [str(), int() | float() as factor, int() | float() as offset]:
            return 0.0 < factor < math.inf and math.isfinite(offset)
    return False


def display(unit: str) -> tuple[str, float]:
    """Return the display unit of differences and the factor to the display unit: `°` and 57.3 for `rad` shown in `deg`.

    Differences of temperatures stay in K.
    """
    name, factor, offset = _display_units.get().get(unit, (unit, 1.0, 0.0))
    return (written(unit, "\u00a0"), 1.0) if offset else (written(name, "\u00a0"), factor)


def shown_unit(unit: str) -> str:
    """Return the display unit of values: `°` for `rad` shown in `deg`."""
    return written(_display_units.get().get(unit, (unit,))[0], "\u00a0")


def displayed(values: Any, unit: str) -> Any:
    """Convert values from a unit to its display unit."""
    _, factor, offset = _display_units.get().get(unit, (unit, 1.0, 0.0))
    return values if factor == 1.0 and not offset else factor * values + offset


def written(unit: str, times: str = "·") -> str:
    """Return a unit in print: `N·s²/m²` for `N.s2/m2`, `°` for `deg`.

    Args:
        times: Sign between factors.
    """
    text = "" if unit == "1" else POWER.sub(lambda match: match[0].translate(RAISED), unit).replace(".", times)
    return DEGREE_WORD.sub("°", text)


def as_yaml(value: Any) -> str:
    """Return a value as JSON that YAML reads equally: line breaks and non-characters of YAML are escaped."""
    text = json.dumps(value, ensure_ascii=False)
    return NOT_IN_YAML.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def closest(word: str, words: Iterable[str], similarity: float = 0.6) -> str:
    """Return the most similar of some words; "" if none is similar enough.

    Args:
        similarity: Least similarity; 1 means equal.
    """
    if len(word) > MAX_WORD_CHARACTERS:
        return ""
    candidates = [w for w in islice(words, MAX_SEARCHED_WORDS) if len(w) <= MAX_WORD_CHARACTERS]
    return "".join(difflib.get_close_matches(word, candidates, n=1, cutoff=similarity))


def did_you_mean(word: str, words: Iterable[str]) -> str:
    """Return `; did you mean "…"?` for a close word, or ""."""
    match = closest(word, words)
    return f'; did you mean "{match}"?' if match else ""
