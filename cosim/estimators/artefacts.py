"""File kinds of this room."""

from __future__ import annotations

from cosim.storage.artefact import Artefact

ARTEFACTS = (
    Artefact(
        "an answer of `cosim consistency`",
        "scripts read it; `cosim consistency` makes one",
        keys=(frozenset({"runs", "steps", "seed", "rows"}),),
        verb="cosim consistency",
        marks=("consistency.json",),
        files=("consistency.json", "report.html"),
        folder="the folder of a consistency test",
        folder_step="its report.html opens in a browser, scripts read consistency.json",
    ),
)
