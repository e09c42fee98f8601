"""File kinds of this room."""

from __future__ import annotations

from cosim.storage.artefact import Artefact

ARTEFACTS = (
    Artefact(
        "an answer of `cosim fit`",
        "`cosim.read` reads its folder; `cosim fit LOG.csv --fmu X.fmu` makes one",
        keys=(frozenset({"schema_version", "parameters", "simulations"}),),
        verb="cosim fit",
        marks=("fit.json",),
        files=("fit.json", "fitted.ssv", "fitted.fmu", "report.html"),
        folder="the folder of a fit",
        folder_step="its report.html opens in a browser, its fitted.ssv holds the values",
        sources=("fmu",),
        reader="cosim.calibration.fitted:read_fitted",
    ),
)
