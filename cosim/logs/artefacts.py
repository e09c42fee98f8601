"""Kinds of files of this room."""

from __future__ import annotations

from cosim.files.artefact import LOG, Artefact

ARTEFACTS = (
    Artefact(
        LOG,
        "`cosim check {file}` checks it, `cosim replay {file}` runs an FMU with its inputs",
        endings=(".csv",),
        check="cosim.logs.log_check:check_log",
    ),
)
