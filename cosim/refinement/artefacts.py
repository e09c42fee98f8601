"""Kinds of files of this room."""

from __future__ import annotations

from cosim.files.artefact import ANSWER, STUDY, Artefact

ARTEFACTS = (
    Artefact(
        STUDY,
        "`cosim refine {file}` refines its model; for an FMU, `cosim fit {file}` estimates its parameters",
        keys=(frozenset({"logs"}),),
        without=frozenset({"components", "connections"}),
        schema="cosim.refinement.study:StudyFile",
        schema_name="study",
        title="cosim study",
        check="cosim.refinement.study:check_study",
    ),
    Artefact(
        ANSWER,
        "`cosim excite {file}` designs an experiment that decides; `cosim check` takes its study or model.yaml",
        keys=(frozenset({"verdict", "candidates"}), frozenset({"finished", "candidates"})),
        verb="cosim refine",
        marks=("refine.json",),
        files=(
            "refine.json",
            "model.yaml",
            "plant.fmu",
            "nearest.yaml",
            "nearest.fmu",
            "report.html",
        ),
        folder="the folder of a refine",
        folder_step="`cosim build --model {file}` builds its model, `cosim excite {file}` designs an experiment "
        "that decides",
        reader="cosim.refinement.refinement:read_refined",
    ),
)
