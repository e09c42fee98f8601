"""Kinds of files of this room."""

from __future__ import annotations

from cosim.storage.artefact import Artefact
from cosim.storage.kinds import CODE, MODEL

ARTEFACTS = (
    Artefact(
        MODEL,
        "`cosim build --model {file}` builds its FMU, a study names it as model:",
        keys=(frozenset({"parameters"}), frozenset({"sensors"})),
        without=frozenset({"components", "connections", "vary", "logs"}),
        schema="cosim.loading.file:ModelFile",
        schema_name="model",
        title="cosim model file",
        check="cosim.loading.model_check:check_model_file",
    ),
    Artefact(
        CODE,
        "`cosim build --model {file}:Class` builds its FMU, a study names it as model:",
        endings=(".py",),
        check="cosim.loading.model_check:check_model_class",
    ),
)
