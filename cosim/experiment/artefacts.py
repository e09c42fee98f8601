"""Kinds of files of this room."""

from __future__ import annotations

from cosim.files.artefact import Artefact

ARTEFACTS = (
    Artefact(
        "an input signal from `cosim excite`",
        "`cosim run` simulates the excitation.yaml in its folder",
        verb="cosim excite",
        marks=("excitation.csv", "excitation.yaml"),
        files=("excitation.csv", "excitation.yaml", "plant.fmu", "report.html"),
        folder="the folder of an excitation",
        folder_step="open its report.html in a browser; `cosim run {file}/excitation.yaml` simulates it",
    ),
)
