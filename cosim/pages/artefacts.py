"""Kinds of files of this room."""

from __future__ import annotations

from cosim.files.artefact import Artefact

ARTEFACTS = (
    Artefact(
        "a file of layouts",
        "open it with `cosim view --layout {file}`",
        keys=(frozenset({"schema_version", "layouts"}),),
    ),
)
