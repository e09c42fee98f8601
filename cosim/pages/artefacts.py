"""Kinds of files that the package `cosim.pages` declares."""

from __future__ import annotations

from cosim.files.artefact import Artefact

ARTEFACTS = (
    Artefact(
        "a file of layouts",
        "open it with `cosim view --layout {file}`",
        keys=(frozenset({"schema_version", "layouts"}),),
    ),
)
