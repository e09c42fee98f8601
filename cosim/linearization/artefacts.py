"""File kinds of this room."""

from __future__ import annotations

from cosim.files.artefact import Artefact

ARTEFACTS = (
    Artefact(
        "an answer of `cosim linearize`",
        "the linear.py beside it loads it in Python; `cosim linearize MODEL` makes one",
        keys=(frozenset({"schema_version", "states", "models"}),),
        verb="cosim linearize",
        marks=("linear.json",),
        files=("linear.json", "linear.mat", "linear.py", "report.html"),
        folder="the folder of a linearisation",
        folder_step="its report.html opens in a browser, its linear.py loads it in Python",
    ),
)
