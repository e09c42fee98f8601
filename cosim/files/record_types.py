"""Types of the values in the records of commands, such as manifest.json, and their check."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import NoneType
from typing import Any, NamedTuple

LONGEST = 40  # characters of a value in a message
EACH = "*"  # key of a type of mappings, for all their values


class Number:
    """Type of a number or null."""


TITLES = {
    str: "text",
    int: "a whole number",
    float: "a number",
    Number: "a number",
    bool: "true or false",
    dict: "a mapping",
    list: "a list",
}
# A type is a key of TITLES, a list with the type of each element, or a mapping from keys, which may be absent, to types
CRITERION = {"kind": str, "of": str, "met": bool, "value": Number, "max": Number}
COMMON: Mapping[str, Any] = {
    **dict.fromkeys(("cosim_version", "version", "command", "status", "verdict", "sentence"), str),
    "schema_version": int,
}
TYPES: Mapping[str, Mapping[str, Any]] = {
    "manifest.json": {
        **dict.fromkeys(("source", "loop", "no_report"), str),
        **{key: [str] for key in ("order", "beside", "discrete", "texts", "warnings")},
        **dict.fromkeys(("items", "versions", "timings"), dict),
        "scenario": {"name": str, "components": {EACH: dict}},
        "rows": int,
        "criteria": [CRITERION],
        "units": {EACH: str},
        "unit_definitions": {EACH: [Number]},
        "fmus": {EACH: dict},
    },
    "replay.json": {"log": str, "fmu": str, "units": {EACH: str}, "start": dict},
    "sweep.json": {"runs": int, "failed": int, "criteria": [dict]},
    "comparison.json": {"signals": [dict], "criteria": [dict]},
}


class WrongValue(NamedTuple):
    """A value of a record that has another type than it should."""

    name: str
    value: Any
    wanted: str


def fault_of(value: Any, kind: Any, name: str) -> WrongValue | None:
    """Return the first wrong value within a value of this name, if any; true and false are no whole numbers."""
    outer = type(kind) if isinstance(kind, (list, dict)) else kind
    if type(value) not in ((float, int, NoneType) if outer is Number else (outer,)):
        return WrongValue(name, value, TITLES[outer])
    parts: Iterable[tuple[str, Any, Any]] = ()
    if isinstance(kind, list):
        parts = ((f"{name}[{k}]", each, kind[0]) for k, each in enumerate(value))
    elif isinstance(kind, dict) and not (kind.get(EACH) is str and {*map(type, value.values())} <= {str}):  # fast
        parts = ((f"{name}.{key}", each, kind.get(EACH, kind.get(key))) for key, each in value.items())
    faults = (fault_of(each, wanted, place) for place, each, wanted in parts if wanted is not None)
    return next(filter(None, faults), None)


def sound_part(file: Path, record: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return a record without the keys that hold a value of another type, and a warning for each of them."""
    sound, warnings = {**record}, list[str]()
    for key, kind in {**COMMON, **TYPES.get(file.name, {})}.items():
        if key in record and (fault := fault_of(record[key], kind, key)):
            text = json.dumps(fault.value, ensure_ascii=False)
            text = text if len(text) <= LONGEST else f"{text[:LONGEST]}…"
            said = f"{file}: {fault.name} is {text}, not {fault.wanted}; {key} is not used"
            warnings.append(f"{said}: run it again, or correct the file")
            del sound[key]
    return sound, tuple(warnings)
