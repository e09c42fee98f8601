"""`cosim check` of a protocol: faults and warnings of `cosim identify`, without simulation of a bench."""

from __future__ import annotations

from pathlib import Path

from cosim.storage.artefact import Checking
from plant.identification.cells import calibrate
from plant.identification.craft import read_craft
from plant.identification.input_kind import craft_file
from plant.identification.prepared import prepare
from plant.identification.workflow import checked_results


def check_protocol(path: Path, checking: Checking) -> list[str]:
    """Return the warnings of a protocol.

    Measured recordings are analysed, so that impossible numbers are faults as in `identify`.

    Raises:
        InputError: Every fault of the protocol, or of logs of a craft.
    """
    if (yaml := craft_file(path)) is not None:
        read_craft(yaml)
        return []
    ready = prepare(path)
    protocol, measured = ready.protocol, ready.measured
    if not measured or not all(cell.points for cell in protocol.file.cells.values()):
        return []
    results = checked_results(protocol, calibrate(protocol, {}), measured, draw=False)
    return [message.after(f"warning: {r.test}: ") for r in results for message in r.warnings]
