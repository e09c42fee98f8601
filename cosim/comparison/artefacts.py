"""Kinds of files of this room."""

from __future__ import annotations

from cosim.storage.artefact import Artefact

ARTEFACTS = (
    Artefact(
        "an answer of `cosim compare`",
        "scripts read it; `cosim compare A B` makes one",
        keys=(frozenset({"schema_version", "differences"}),),
        verb="cosim compare",
        marks=("comparison.json",),
        files=("comparison.json", "report.html"),
        folder="the folder of a comparison",
        folder_step="its report.html opens in a browser, scripts read comparison.json",
        sources=("a", "b"),
    ),
    Artefact(
        "an answer of `cosim rows`",
        "`cosim.read` reads its folder in Python; `cosim rows RUN` makes one",
        keys=(frozenset({"schema_version", "run", "row_count"}),),
        verb="cosim rows",
        marks=("rows.json",),
        files=("rows.json",),
        folder="the folder of a count of rows",
        folder_step="`cosim.read` reads it in Python",
        sources=("run",),
        reader="cosim.comparison.row_count:read_rows",
    ),
)
