"""Kinds of files of this room."""

from __future__ import annotations

from cosim.files.artefact import CODE, MODEL, Artefact

SCENARIO_KEYS = frozenset({"components", "connections", "step", "vary"})
STUDY_KEYS = frozenset({"logs", "noise", "tolerance", "inputs", "candidates", "columns", "per_log", "groups"})

ARTEFACTS = (
    Artefact(
        MODEL,
        "`cosim build --model {file}` builds its FMU; a study names it under model:",
        keys=(frozenset({"model"}), frozenset({"parameters"}), frozenset({"parameters_from"}), frozenset({"sensors"})),
        without=SCENARIO_KEYS | STUDY_KEYS,
        schema="cosim.fmi.building.file:ModelFile",
        schema_name="model",
        title="cosim model file",
        check="cosim.fmi.building.substep:check_model",
    ),
    Artefact(
        CODE,
        "`cosim build --model {file}:Class` builds its FMU; a study names it under model:",
        endings=(".py",),
        check="cosim.fmi.building.substep:check_model",
    ),
)
