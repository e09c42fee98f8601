"""File kinds of this room."""

from __future__ import annotations

from cosim.files.artefact import Artefact

ARTEFACTS = (
    Artefact(
        "an input of `cosim excite`",
        "`cosim run` plays the excitation.yaml beside it",
        verb="cosim excite",
        marks=("excitation.csv", "excitation.yaml"),
        files=("excitation.csv", "excitation.yaml", "plant.fmu", "report.html"),
        folder="the folder of an excitation",
        folder_step="its report.html opens in a browser, `cosim run {file}/excitation.yaml` plays it",
    ),
)
