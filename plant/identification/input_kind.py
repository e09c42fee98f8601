"""What `cosim identify` is given: a protocol of a bench, or logs of a craft and what they are to tell."""

from __future__ import annotations

from pathlib import Path

from cosim.base.errors import InputError
from cosim.storage.folders import folder_named
from cosim.storage.kinds import check_given
from cosim.storage.yaml_file import YamlFile
from plant.identification.artefacts import PROTOCOL


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
