"""Types of the values in the records of commands, such as manifest.json, and their check."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

LONGEST = 40  # characters of a value in a message


class WrongValue(NamedTuple):
    """A value of a record that has another type than it should."""

    name: str
    value: Any
    wanted: str


@dataclass(frozen=True)
class Kind:
    """Type of a value in a record.

    Attributes:
        title: Noun phrase for messages.
        type: Class, or a tuple of classes; true and false are no whole numbers.
        inner: Type of each element of a list and each value of a mapping, if all have the same.
        keys: Types of single keys of a mapping, which may be absent.
    """

    title: str
    type: Any
    inner: Kind | None = None
    keys: Mapping[str, Kind] = field(default_factory=dict)

    def fault(self, value: Any, name: str) -> WrongValue | None:
        """Return the first wrong value within a value of this name, if any."""
        if type(value) is not self.type and not (isinstance(self.type, tuple) and type(value) in self.type):
            return WrongValue(name, value, self.title)
        if not (self.inner or self.keys):
            return None
        pairs: Iterable[tuple[Any, Any]] = value.items() if self.type is dict else enumerate(value)
        for key, part in pairs:
            kind = self.inner or self.keys.get(key)
            if kind is not None and (wrong := kind.fault(part, "")) is not None:
                place = f"{name}.{key}" if self.type is dict else f"{name}[{key}]"
                return wrong._replace(name=place + wrong.name)
        return None


TEXT, WHOLE = Kind("text", str), Kind("a whole number", int)
MAPPING = Kind("a mapping", dict)
TEXTS, MAPPINGS = Kind("a list of texts", list, TEXT), Kind("a list of mappings", list, MAPPING)
NUMBER = Kind("a number", (int, float, type(None)))
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


def sound_part(file: Path, record: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return a record without the keys that hold a value of another type, and a warning for each of them."""
    sound, warnings = {**record}, list[str]()
    for key, kind in {**COMMON, **TYPES.get(file.name, {})}.items():
        if key in record and (wrong := kind.fault(record[key], key)) is not None:
            del sound[key]
            value = json.dumps(wrong.value, ensure_ascii=False)
            value = value if len(value) <= LONGEST else f"{value[:LONGEST]}…"
            fields = {"file": file, "field": wrong.name, "value": value, "wanted": wrong.wanted, "key": key}
            warnings.append(
                "{file}: {field} is {value}, not {wanted}; {key} is not used: run it again, or correct the file".format(
                    **fields
                )
            )
    return sound, tuple(warnings)
