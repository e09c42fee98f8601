"""Kinds of files of this room."""

from __future__ import annotations

from cosim.storage.artefact import Artefact
from cosim.storage.kind_names import FMU

ARTEFACTS = (
    Artefact(
        FMU,
        "`cosim info {file}` lists what it has, `cosim simulate {file}` runs it, `cosim check` checks it, "
        "a scenario names it as fmu:, `cosim replay LOG.csv --plant` drives it",
        endings=(".fmu",),
        member="modelDescription.xml",
        check="cosim.related.fmu_check:check_fmu_file",
    ),
)
