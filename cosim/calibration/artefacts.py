"""Kinds of files of this room."""

from __future__ import annotations

from cosim.files.artefact import FIT_STUDY, Artefact

ARTEFACTS = (
    Artefact(
        FIT_STUDY,
        "`cosim fit {file}` estimates the parameters of its FMU",
        keys=(frozenset({"logs", "vary"}), frozenset({"logs", "start"})),
        without=frozenset({"components", "connections"}),
        schema="cosim.calibration.fit_study:FitStudyFile",
        schema_name="fit",
        title="cosim study of a fit",
        check="cosim.calibration.workflow:check_fit_study",
    ),
    Artefact(
        "a result of `cosim fit`",
        "`cosim.read` reads its folder; `cosim fit LOG.csv --fmu X.fmu` writes one",
        keys=(frozenset({"schema_version", "parameters", "simulations"}),),
        verb="cosim fit",
        marks=("fit.json",),
        files=("fit.json", "fitted.ssv", "fitted.fmu", "report.html"),
        folder="the folder of a fit",
        folder_step="open its report.html in a browser; its fitted.ssv has the values",
        reader="cosim.calibration.fitted:read_fitted",
    ),
)
