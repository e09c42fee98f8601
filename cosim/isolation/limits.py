"""Limits on time and memory of a run."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, ValidationError, WithJsonSchema

from cosim.core.errors import Fault, InputError
from cosim.core.settings import reason_of
from cosim.core.units import read_quantity, split_quantity
from cosim.files.yaml_file import Part

BYTES = {"": 1.0, "B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9, "KiB": 2.0**10, "MiB": 2.0**20, "GiB": 2.0**30}
LOADING = 60.0  # default limit of loading [s] with other time limits


def _above_zero(units: str, example: str, read_text: Callable[[str], float]) -> Any:
    """Return the type of numbers above 0, or texts of them with a unit."""

    def read(value: Any) -> float:
        with suppress(ValueError):
            number = read_text(value) if isinstance(value, str) else value
            if isinstance(number, (int, float)) and not isinstance(number, bool) and 0 < number < 1e300:
                return float(number)
        raise ValueError(f"it is a number above 0 with its unit ({units}), {example} for one")

    return Annotated[float, BeforeValidator(read), WithJsonSchema({"type": ["number", "string"]})]


def _bytes(text: str) -> float:
    number, unit = split_quantity(text) or (0.0, "")
    return number * BYTES.get(unit, 0.0)


Seconds = _above_zero("ms, s, min, h", "10 s", lambda text: read_quantity(text, "s"))
Bytes = _above_zero(", ".join(filter(None, BYTES)), "2 GB", _bytes)


class Limits(Part):
    """Limits of a run; by default none.

    step:   longest wall time of a communication step, or of a call of initialization or end [s]
    total:  longest wall time of the run without loading [s]
    load:   longest wall time to load an FMU [s]; 60 s if step or total is given
    memory: largest size of the process and of all that it starts, without the rows of results [bytes]
    """

    step: Seconds | None = None
    total: Seconds | None = None
    load: Seconds | None = None
    memory: Bytes | None = None

    @property
    def loading(self) -> float | None:
        """Return the time limit of loading [s]."""
        timed = self.step is not None or self.total is not None
        return self.load if self.load is not None or not timed else LOADING


def read_limits(text: str) -> Limits:
    """Return limits from text like `step: 10 s, memory: 2 GB`; raise InputError if invalid."""
    pairs = (part.partition(":") for part in text.strip().strip("{}").split(",") if part.strip())
    try:
        return Limits.model_validate({key.strip(): value.strip() for key, _, value in pairs})
    except ValidationError as error:
        known = f"no such limit (known: {', '.join(Limits.model_fields)})"
        texts = {
            ".".join(map(str, e["loc"])): known if e["type"] == "extra_forbidden" else reason_of(e)
            for e in error.errors()
        }
        raise InputError([Fault(Path("--limits"), 0, 0, f"{name}: {text}") for name, text in texts.items()]) from None
