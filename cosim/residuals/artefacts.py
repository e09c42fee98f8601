"""Kinds of files of this room."""

from __future__ import annotations

from cosim.files.artefact import Artefact

ARTEFACTS = (
    Artefact(
        "an answer of `cosim replay`",
        "read it with a script; `cosim replay LOG.csv` writes one",
        keys=(frozenset({"schema_version", "units"}),),
        without=frozenset({"scenario", "estimates"}),
        verb="cosim replay",
        marks=("replay.json", "residual.csv"),
        files=("replay.json", "study.yaml", "report.html"),
        tables=("results", "residual"),
        folder="the folder of a replay",
        folder_step="`cosim compare {file} OTHER` compares it with another",
        reader="cosim.residuals.replay_signals:read_replay",
    ),
)
