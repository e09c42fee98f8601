"""Kinds of files of this room."""

from __future__ import annotations

from cosim.files.artefact import Artefact

ARTEFACTS = (
    Artefact(
        "a result of `cosim compare`",
        "read it with a script; `cosim compare A B` writes one",
        keys=(frozenset({"a", "b", "within", "signals"}),),
        verb="cosim compare",
        marks=("comparison.json",),
        files=("comparison.json", "report.html"),
        folder="the folder of a comparison",
        folder_step="open its report.html in a browser; comparison.json is for scripts",
    ),
)
