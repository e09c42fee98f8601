"""Kind of the input of `cosim identify`: protocol of a bench, or logs of a craft."""

from __future__ import annotations

from pathlib import Path

from cosim.base.errors import InputError
from cosim.storage.kinds import check_given
from cosim.storage.yaml_file import YamlFile
from plant.identification.artefacts import PROTOCOL


def craft_file(path: Path) -> YamlFile | None:
    """Return the content of a file about craft logs, None for a protocol of a bench."""
    check_given(path, PROTOCOL)
    yaml = YamlFile(path)
    return yaml if {"rest", "distance"} & set(yaml.root) and not {"cells", "tests"} & set(yaml.root) else None


def results_of(path: Path) -> str:
    """Return the name of the results of an input file: the file's key `name`, or else like the file."""
    try:
        name = YamlFile(path).root.get("name")
    except InputError:  # reported by the reader
        name = None
    return name if isinstance(name, str) else path.stem
