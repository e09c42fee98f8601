"""What kind of file one is, so that a command given another kind can say which reads it."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

from cosim.errors import Fault, InputError
from cosim.yaml_file import YamlFile

SWEEP = "a sweep"
LOG, FMU, SSP, SCENARIO, MANIFEST, STUDY, MODEL, ANSWER, CODE, PROTOCOL = (
    "a log", "an FMU", "an SSP", "a scenario", "a manifest", "a study", "a model file", "an answer of `cosim refine`",
    "a model's Python file", "a protocol of a testing bench",
)  # fmt: skip
READ_BY = {
    LOG: "`cosim check {file}` checks it, `cosim replay {file}` drives an FMU with it",
    FMU: "`cosim info {file}` lists what it has, `cosim simulate {file}` runs it, `cosim check {file}` checks it, "
    "a scenario names it as fmu:, `cosim replay LOG.csv --plant {file}` drives it",
    SSP: "`cosim run {file}` runs it",
    SCENARIO: "`cosim run {file}` runs it",
    MANIFEST: "`cosim run {file}` repeats its run",
    PROTOCOL: "`cosim identify {file}` identifies from it",
    SWEEP: "`cosim sweep {file}` runs it",
    STUDY: "`cosim refine {file}` refines its model",
    MODEL: "`cosim build --model {file}` builds its FMU, a study names it as model:",
    ANSWER: "`cosim excite {file}` seeks the experiment that decides; check the study or model.yaml beside it",
    CODE: "`cosim build --model {file}:Class` builds its FMU, a study names it as model:",
}


def kind_by_name(path: Path) -> str | None:
    """The kind of a file by its ending, whatever its case, or as an archive; None of one that is text to be read."""
    ending = path.suffix.lower()
    if ending == ".csv":
        return LOG
    if ending == ".py":
        return CODE
    if ending in {".ssp", ".ssd"}:
        return SSP
    try:
        return FMU if ending == ".fmu" or (path.is_file() and zipfile.is_zipfile(path)) else None
    except (OSError, ValueError):
        return None


def kind_by_keys(root: Any) -> str | None:
    """The kind of a YAML or JSON file by its keys; None where they do not say."""
    keys = set(root) if isinstance(root, dict) else set()
    if keys >= {"verdict", "candidates"}:
        return ANSWER
    if keys >= {"scenario", "schema_version"}:
        return MANIFEST
    if keys >= {"cells", "tests"} or (keys & {"rest", "distance"} and "logs" not in keys):
        return PROTOCOL
    if "components" in keys or "connections" in keys:
        return SCENARIO
    if "vary" in keys:
        return SWEEP
    if "logs" in keys:
        return STUDY
    return MODEL if keys & {"parameters", "sensors"} else None


def kind_of(path: Path) -> str | None:
    """The kind of a file by its name, or of a YAML or JSON file by its keys; None where neither says."""
    if (kind := kind_by_name(path)) is not None or path.suffix.lower() not in {".yaml", ".yml", ".json"}:
        return kind
    try:
        return kind_by_keys(YamlFile(path).root)
    except InputError:
        return None


def refuse_other(path: Path, kind: str | None, *wanted: str) -> None:
    """InputError where a file is of another kind than is wanted, with the command that reads it."""
    if kind is not None and kind not in wanted and path.is_file():
        cure = READ_BY[kind].format(file=path)
        raise InputError([Fault(path, 0, 0, f"is {kind}, not {' or '.join(wanted)}: {cure}")])


def check_given(path: Path, *wanted: str) -> None:
    """InputError where what is given is missing, a folder, empty, or a file of another kind than is wanted."""
    what = " or ".join(wanted)
    if path.is_dir():
        left = [name for name in ("manifest.json", "refine.json", "residual.csv") if (path / name).is_file()]
        cure = f"; `cosim report {path}` makes its page again, `cosim compare` holds it against another" if left else ""
        raise InputError([Fault(path, 0, 0, f"is a folder{' of results' if left else ''}, not {what}{cure}")])
    if not path.exists():
        raise InputError([Fault(path, 0, 0, f"no such file; give {what}")])
    if not path.is_file():
        raise InputError([Fault(path, 0, 0, "is no file")])  # a pipe would be waited for
    if not path.stat().st_size:
        raise InputError([Fault(path, 0, 0, f"is empty; give {what}")])
    refuse_other(path, kind_of(path), *wanted)
