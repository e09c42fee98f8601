"""What `cosim identify` is given: a protocol of a bench, or logs of a craft and what they are to tell."""

from __future__ import annotations

from pathlib import Path

from cosim.errors import InputError
from cosim.folders import folder_named
from cosim.identification.cells import calibrated
from cosim.identification.craft import read_craft
from cosim.identification.prepared import prepare
from cosim.kinds import PROTOCOL, check_given
from cosim.yaml_file import YamlFile


def craft_file(path: Path) -> YamlFile | None:
    """The file where it is about logs of a craft in place of a bench."""
    check_given(path, PROTOCOL)
    yaml = YamlFile(path)
    return yaml if {"rest", "distance"} & set(yaml.root) and not {"cells", "tests"} & set(yaml.root) else None


def results_of(path: Path) -> Path:
    """results/NAME, of the name that the file gives, of its own where it has none."""
    try:
        named = YamlFile(path).root.get("name")
    except InputError:  # which is told when it is read
        named = None
    return folder_named(named if isinstance(named, str) else path.stem)


def check_protocol(path: Path) -> list[str]:
    """Return the warnings of a protocol; raise InputError with every fault of it, or of logs of a craft.

    Recordings that were measured are analysed, so that a number that cannot be is a fault here as in `identify`.
    """
    if (yaml := craft_file(path)) is not None:
        read_craft(yaml)
        return []
    from cosim.identification.workflow import checked_results

    ready = prepare(path)
    protocol, measured = ready.protocol, ready.measured
    if not measured or not all(cell.points for cell in protocol.file.cells.values()):
        return []
    results = checked_results(protocol, calibrated(protocol, {}), measured, draw=False)
    return [f"{r.test}: {text}" for r in results for text in r.warnings]
