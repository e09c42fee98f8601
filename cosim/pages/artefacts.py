"""Kinds of files of this room."""

from __future__ import annotations

from cosim.files.artefact import Artefact

ARTEFACTS = (
    Artefact(
        "a file of layouts",
        "`cosim view --layout {file}` opens it",
        keys=(frozenset({"schema_version", "layouts"}),),
    ),
)
