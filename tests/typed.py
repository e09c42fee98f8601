"""FMUs of C that pass every type through."""

from __future__ import annotations

import re
from pathlib import Path

from tests.compiled import description, library, pack
from tests.corpus.inputs import FMU_SOURCES


def typed_text(version: int = 2, units: tuple[str, str] = ("", "")) -> str:
    """Return the description, with units of r_in and r_out."""
    text = description(f"typed{version}")
    for real, mark, unit in zip(('<Real start="0"', "<Real"), ("rpm", "rad/s"), units, strict=True):
        text = text.replace(f'{real} unit="{mark}"/>', f'{real} unit="{unit}"/>' if unit else f"{real}/>")
    return text


def typed_fmu(
    folder: Path, version: int = 2, name: str = "typed", *, units: tuple[str, str] = ("", ""), **replaced: str
) -> Path:
    """The FMU; `units` of r_in and r_out, and further texts of the description replaced."""
    text = typed_text(version, units)
    for old, new in replaced.items():
        assert old in text
        text = text.replace(old, new)
    return pack(folder / f"{name}.fmu", text, library(FMU_SOURCES / f"typed{version}.c"))


def numbers_fmu(folder: Path) -> Path:
    """Return an FMU of FMI 3.0 without variables outside the row of doubles."""
    others = r'<(Int64|String|Binary)\b([^>]*/>|.*?</\1>)|<Output valueReference="(4|8|10)"[^>]*>'
    text = re.sub(others, "", description("typed3"), flags=re.DOTALL)
    return pack(folder / "typed.fmu", text, library(FMU_SOURCES / "typed3.c"))
