"""An FMU of C for model exchange of FMI 1.0, with its source inside where it is asked for."""

from __future__ import annotations

from pathlib import Path

from tests.compiled import description, library, pack
from tests.corpus.inputs import FMU_SOURCES

SOURCE = FMU_SOURCES / "bounce1.c"


def bounce_fmu(path: Path, *, compiled: bool = True, source: bool = False) -> Path:
    """The FMU, with its library, its source, or both."""
    members = {"sources/bounce1.c": SOURCE.read_bytes()} if source else {}
    return pack(path, description("bounce1"), library(SOURCE) if compiled else None, members)
