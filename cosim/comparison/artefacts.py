"""Kinds of files of this room."""

from __future__ import annotations

from cosim.files.artefact import Artefact

ARTEFACTS = (
    Artefact(
        "an answer of `cosim compare`",
        "scripts read it; `cosim compare A B` makes one",
        keys=(frozenset({"a", "b", "within", "signals"}),),
        verb="cosim compare",
        marks=("comparison.json",),
        files=("comparison.json", "report.html"),
        folder="the folder of a comparison",
        folder_step="its report.html opens in a browser, scripts read comparison.json",
    ),
)
