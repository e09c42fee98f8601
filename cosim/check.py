"""`cosim check`: every fault of every file."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

from cosim.blocks.fmu import read_description
from cosim.design import designed_values
from cosim.errors import Fault, FmuError, InputError
from cosim.manifest import check_pinned
from cosim.refine.gate import gate, gate_faults
from cosim.refine.log import read_log
from cosim.refine.model_file import read_model
from cosim.refine.study import read_study
from cosim.refine.words import finding_line
from cosim.scenario_file import ScenarioFile
from cosim.system import build_system
from cosim.yaml_file import YamlFile
from plant.hovercraft import Hovercraft


def check_files(files: Sequence[Path]) -> None:
    """Check each file by what it is; InputError with all faults of all files."""
    faults: list[Fault] = []
    for path in files:
        faults += _check(path)
    if faults:
        raise InputError(faults)


def _check(path: Path) -> list[Fault]:
    if path.suffix == ".fmu" or zipfile.is_zipfile(path):
        return check_fmu(path)
    if path.suffix == ".csv":
        return check_log(path)
    try:
        root = YamlFile(path).root
    except InputError as error:
        return list(error.faults)
    if "logs" in root:
        return _faults_of(read_study, path)
    if "components" not in root and "scenario" not in root and root.keys() & {"parameters", "sensors"}:
        return _faults_of(read_model, path)
    return _faults_of(check_scenario, path)


def _faults_of(read: Callable[[Path], object], path: Path) -> list[Fault]:
    try:
        read(path)
    except InputError as error:
        return list(error.faults)
    return []


def check_log(path: Path) -> list[Fault]:
    """Faults of a log of the hovercraft, those its gate finds included."""
    craft = Hovercraft()
    try:
        log = read_log(path, craft.inputs, craft.outputs)
    except InputError as error:
        return list(error.faults)
    return gate_faults(log, gate(log, craft.rate))


def log_findings(path: Path) -> list[str]:
    """What the gate says of a log that is no fault, a line each."""
    craft = Hovercraft()
    log = read_log(path, craft.inputs, craft.outputs)
    return [finding_line(f) for f in gate(log, craft.rate) if f.severity != "fault"]


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


def check_scenario(path: Path) -> None:
    """Read a scenario or manifest as a run would; InputError with its faults, those of its FMUs included."""
    file = ScenarioFile(path)
    check_pinned(file)
    build_system(file, designed_values(file))
