"""Limits on time and memory of a run."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, ValidationError, WithJsonSchema

from cosim.core.errors import Fault, InputError
from cosim.core.settings import reason_of
from cosim.core.units import split_quantity
from cosim.files.yaml_file import Part, Positive, PositiveSeconds

BYTES_PER_UNIT = {"": 1.0, "B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9, "KiB": 2.0**10, "MiB": 2.0**20, "GiB": 2.0**30}
LOADING = 60.0  # default limit of loading [s] with other time limits


def _bytes(value: Any) -> Any:
    """Convert text with a unit to a number of bytes; pydantic checks other values."""
    if not isinstance(value, str):
        return value
    number, unit = split_quantity(value) or (0.0, None)
    if unit not in BYTES_PER_UNIT:
        raise ValueError(f"give a number with a unit ({', '.join(filter(None, BYTES_PER_UNIT))}), for example 2 GB")
    return number * BYTES_PER_UNIT[unit]


Bytes = Annotated[Positive, BeforeValidator(_bytes), WithJsonSchema({"type": ["number", "string"]})]


class Limits(Part):
    """Limits of a run; by default none.

    step:   longest wall time of a communication step, or of a call of initialization or end [s]
    total:  longest wall time of the run without loading [s]
    load:   longest wall time to load an FMU [s]; 60 s if step or total is given
    memory: largest size of the process and of all that it starts, without the rows of results [bytes]
    """

    step: PositiveSeconds | None = None
    total: PositiveSeconds | None = None
    load: PositiveSeconds | None = None
    memory: Bytes | None = None

    @property
    def loading(self) -> float | None:
        """Return the time limit for loading an FMU [s]; None if there is none."""
        timed = self.step is not None or self.total is not None
        return self.load if self.load is not None or not timed else LOADING


def read_limits(text: str) -> Limits:
    """Return limits from text like `step: 10 s, memory: 2 GB`; raise InputError if invalid."""
    values: dict[str, str | float] = {}
    for key, _, value in (part.partition(":") for part in text.strip().strip("{}").split(",") if part.strip()):
        values[key.strip()] = value.strip()
        with suppress(ValueError):
            values[key.strip()] = float(value)
    try:
        return Limits.model_validate(values)
    except ValidationError as error:
        known = f"no such limit (known: {', '.join(Limits.model_fields)})"
        texts = {
            ".".join(map(str, e["loc"])): known if e["type"] == "extra_forbidden" else reason_of(e)
            for e in error.errors()
        }
        raise InputError([Fault(Path("--limits"), 0, 0, f"{name}: {text}") for name, text in texts.items()]) from None
