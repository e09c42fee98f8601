"""Kinds of files of this room."""

from __future__ import annotations

from cosim.storage.artefact import Artefact
from cosim.storage.kinds import SSP

ARTEFACTS = (Artefact(SSP, "`cosim run {file}` runs it"),)
