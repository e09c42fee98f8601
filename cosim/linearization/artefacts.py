"""Kinds of files of this room."""

from __future__ import annotations

from cosim.files.artefact import Artefact

ARTEFACTS = (
    Artefact(
        "a result of `cosim linearize`",
        "import linear.py of its folder in Python; `cosim linearize MODEL` writes one",
        keys=(frozenset({"schema_version", "states", "models"}),),
        verb="cosim linearize",
        marks=("linear.json",),
        files=("linear.json", "linear.mat", "linear.py", "report.html"),
        folder="the folder of a linearisation",
        folder_step="open its report.html in a browser, or import its linear.py in Python",
    ),
)
