"""`cosim check` of a protocol: what `cosim identify` would refuse or warn of, without playing a bench."""

from __future__ import annotations

from pathlib import Path

from cosim.storage.artefact import Checking
from plant.identification.cells import calibrated
from plant.identification.craft import read_craft
from plant.identification.input_kind import craft_file
from plant.identification.prepared import prepare
from plant.identification.workflow import checked_results


def check_protocol(path: Path, checking: Checking) -> list[str]:
    """Return the warnings of a protocol; raise InputError with every fault of it, or of logs of a craft.

    Recordings that were measured are analysed, so that a number that cannot be is a fault here as in `identify`.
    """
    if (yaml := craft_file(path)) is not None:
        read_craft(yaml)
        return []
    ready = prepare(path)
    protocol, measured = ready.protocol, ready.measured
    if not measured or not all(cell.points for cell in protocol.file.cells.values()):
        return []
    results = checked_results(protocol, calibrated(protocol, {}), measured, draw=False)
    return [f"warning: {r.test}: {text}" for r in results for text in r.warnings]
