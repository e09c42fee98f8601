"""`cosim check`: every fault of every file."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

from cosim.blocks.fmu import read_description
from cosim.design import designed_values
from cosim.errors import Fault, FmuError, InputError
from cosim.manifest import check_pinned
from cosim.scenario_file import ScenarioFile
from cosim.system import build_system


def check_files(files: Sequence[Path]) -> None:
    """Check each file by what it is; InputError with all faults of all files."""
    faults: list[Fault] = []
    for path in files:
        faults += check_fmu(path) if path.suffix == ".fmu" or zipfile.is_zipfile(path) else check_scenario(path)
    if faults:
        raise InputError(faults)


def check_fmu(path: Path) -> list[Fault]:
    """Faults FMPy's validation finds in an FMU."""
    if not path.is_file():
        return [Fault(path, 0, 0, "no such file")]
    try:
        read_description(path)
    except FmuError as error:
        return [Fault(path, 0, 0, str(error).removeprefix(f"{path} "), FmuError.exit_code)]
    from fmpy.validation import validate_fmu

    return [Fault(path, 0, 0, problem, FmuError.exit_code) for problem in validate_fmu(str(path))]


def check_scenario(path: Path) -> list[Fault]:
    """Faults of a scenario or manifest, those of its FMUs' descriptions included."""
    try:
        file = ScenarioFile(path)
        check_pinned(file)
        build_system(file, designed_values(file))
    except InputError as error:
        return list(error.faults)
    return []
