"""An FMU of C for model exchange alone that decays, and does a deed on the way."""

from __future__ import annotations

from pathlib import Path

from tests.compiled import description, library, pack
from tests.corpus.inputs import FMU_SOURCES

DEEDS = (
    "nothing", "error of step", "error of update", "error of derivative", "discarded", "no number", "chatters",
    "due at once", "always due", "no bound",
)  # fmt: skip


def decay_library() -> Path:
    """Return its library."""
    return library(FMU_SOURCES / "decay.c")


def decay_fmu(path: Path) -> Path:
    """The FMU."""
    return pack(path, description("decay"), decay_library())
