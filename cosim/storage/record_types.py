"""Types of the values in the records of commands, such as manifest.json, and their check."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

LONGEST = 40  # characters of a value in a message


@dataclass(frozen=True)
class Kind:
    """Type of a value in a record.

    Attributes:
        title: Noun phrase for messages.
        inner: Type of each element of a list and each value of a mapping, if all have the same.
        keys: Types of single keys of a mapping, which may be absent.
    """

    title: str
    type: type
    inner: Kind | None = None
    keys: Mapping[str, Kind] = field(default_factory=dict)

    def fault(self, value: Any, name: str) -> WrongValue | None:
        """Return the first wrong value within a value of this name, if any."""
        if not self.has_class(value):
            return WrongValue(name, value, self.title)
        if not self.is_deep:
            return None
        place = "{}.{}" if self.type is dict else "{}[{}]"
        pairs: Iterable[tuple[Any, Any]] = value.items() if self.type is dict else enumerate(value)
        for n, part in pairs:
            kind = self.inner or self.keys.get(n)
            if kind is not None and not kind.is_sound(part) and (fault := kind.fault(part, place.format(name, n))):
                return fault
        return None

    def has_class(self, value: Any) -> bool:
        """Return whether a value has the class of this type; true and false are no whole numbers."""
        return type(value) is self.type

    def is_sound(self, value: Any) -> bool:
        """Return whether classes show that a value is right; most values are judged so, and fast."""
        if type(value) is not self.type:
            return False
        if self.inner is None or self.keys or self.inner.is_deep:
            return not self.is_deep
        parts: Any = value.values() if isinstance(value, dict) else value
        return {*map(type, parts)} <= {self.inner.type}

    @cached_property
    def is_deep(self) -> bool:
        """Return whether the type says more than the class of a value."""
        return bool(self.inner or self.keys)


class _Number(Kind):
    """Type of a number, or of null."""

    def has_class(self, value: Any) -> bool:
        return type(value) in {int, float, type(None)}

    def is_sound(self, value: Any) -> bool:
        return self.has_class(value)


class WrongValue(NamedTuple):
    """A value of a record that has another type than it should."""

    name: str
    value: Any
    wanted: str


TEXT, WHOLE = Kind("text", str), Kind("a whole number", int)
MAPPING = Kind("a mapping", dict)
TEXTS, MAPPINGS = Kind("a list of texts", list, TEXT), Kind("a list of mappings", list, MAPPING)
NUMBER = _Number("a number", float)
CRITERION = Kind(
    "a mapping",
    dict,
    keys={"kind": TEXT, "of": TEXT, "met": Kind("true or false", bool), "value": NUMBER, "max": NUMBER},
)
SCENARIO = Kind("a mapping", dict, keys={"name": TEXT, "components": Kind("a mapping", dict, MAPPING)})
COMMON = {
    "schema_version": WHOLE,
    "cosim_version": TEXT,
    "version": TEXT,
    "command": TEXT,
    "status": TEXT,
    "verdict": TEXT,
    "sentence": TEXT,
}
TYPES: Mapping[str, Mapping[str, Kind]] = {
    "manifest.json": {
        "source": TEXT,
        "scenario": SCENARIO,
        "rows": WHOLE,
        "criteria": Kind("a list of criteria", list, CRITERION),
        "units": Kind("a mapping", dict, TEXT),
        "unit_definitions": Kind("a mapping", dict, Kind("a list of numbers", list, NUMBER)),
        "items": MAPPING,
        "fmus": Kind("a mapping", dict, MAPPING),
        "order": TEXTS,
        "beside": TEXTS,
        "discrete": TEXTS,
        "texts": TEXTS,
        "warnings": TEXTS,
        "versions": MAPPING,
        "timings": MAPPING,
        "loop": TEXT,
        "no_report": TEXT,
    },
    "replay.json": {"log": TEXT, "fmu": TEXT, "units": Kind("a mapping", dict, TEXT), "start": MAPPING},
    "sweep.json": {"runs": WHOLE, "failed": WHOLE, "criteria": MAPPINGS},
    "comparison.json": {"signals": MAPPINGS, "criteria": MAPPINGS},
}


ALL = {name: {**COMMON, **kinds} for name, kinds in TYPES.items()}


def _short(value: Any) -> str:
    """Return a value as JSON, cut to LONGEST characters."""
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"


def sound_part(file: Path, record: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return a record without the keys that hold a value of another type, and a warning for each of them."""
    kinds = ALL.get(file.name, COMMON)
    faults = {
        key: fault
        for key, kind in kinds.items()
        if key in record and not kind.is_sound(value := record[key]) and (fault := kind.fault(value, key))
    }
    if not faults:
        return {**record}, ()
    warnings = (
        (
            f"{file}: {fault.name} is {_short(fault.value)}, not {fault.wanted}; {key} is not used: run it "
            "again, or correct the file"
        )
        for key, fault in faults.items()
    )
    return {key: value for key, value in record.items() if key not in faults}, tuple(warnings)
