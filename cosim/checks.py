"""`cosim check`: every fault of every file."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from cosim import kinds
from cosim.blocks.fmu import read_description
from cosim.blocks.guard import validation
from cosim.errors import Fault, FmuError, InputError
from cosim.files import FilePath
from cosim.kinds import kind_by_keys, kind_by_name
from cosim.logs.gate import gate, refuse_faults
from cosim.logs.log import read_log
from cosim.models.file import load_model, only_model, read_model
from cosim.refinement.study import read_study
from cosim.registry import BASE
from cosim.simulation.design import designed_values
from cosim.simulation.manifest import check_pinned
from cosim.simulation.scenario_file import ScenarioFile
from cosim.simulation.system import build_system
from cosim.yaml_file import YamlFile
from plant.model import Model
from plant.traits import Traits


def check_files(files: FilePath | Iterable[FilePath], model: str = BASE) -> list[str]:
    """Check a file, or each of several, by what it is, logs as those of `model` (base, a model.yaml, file.py:Class).

    What is to be known and no fault, a line each; InputError with all faults of all files.
    """
    faults: list[Fault] = []
    said: list[str] = []
    for path in map(Path, [files] if isinstance(files, (str, os.PathLike)) else files):
        try:
            said += [f"{path}: {line}" for line in _check(path, model)]
        except InputError as error:
            faults += error.faults
    if faults:
        raise InputError(faults)
    return said


def _check(path: Path, model: str) -> list[str]:
    """What is to be known of a file, a line each; InputError with its faults."""
    if path.exists() and not path.is_file():
        raise InputError([Fault(path, 0, 0, "is no file")])  # a pipe would be waited for
    match kind_by_name(path):
        case kinds.FMU:
            if faults := check_fmu(path):
                raise InputError(faults)
            return fmu_warnings(path)
        case kinds.LOG:
            return log_findings(path, load_model(model, Path()).model)
        case kinds.CODE:
            only_model(path)
            return []
    if path.suffix.startswith(".py:"):  # FILE.py:Class
        text = str(path)
        only_model(Path(text.removesuffix(":"))) if text.endswith(":") else load_model(text, Path())
        return []
    root = YamlFile(path).root
    match kind_by_keys(root):
        case kinds.ANSWER:
            raise InputError([Fault(path, 1, 1, f"is {kinds.ANSWER}; check the study or model.yaml beside it")])
        case kinds.MODEL:
            read_model(path)
        case kinds.STUDY:
            return [f"warning: {text}" for text in read_study(path).warnings]
        case None if root.keys() & {"model", "candidates"} and "step" not in root:
            return [f"warning: {text}" for text in read_study(path).warnings]
        case _:
            check_scenario(path)
    return []


def log_findings(path: Path, model: Model) -> list[str]:
    """What the gate says of a log, a line each; InputError with its faults."""
    log = read_log(path, model.inputs, model.outputs, table=model.static)
    findings = gate(log, model.rate, traits=Traits.of(model))
    refuse_faults(log, findings)
    return [f.line for f in findings]


def check_fmu(path: Path) -> list[Fault]:
    """Why an FMU cannot be run; what only breaks a rule of FMI is told by `fmu_warnings`."""
    if not path.is_file():
        return [Fault(path, 0, 0, "no such file")]
    try:
        read_description(path)
    except FmuError as error:
        return [Fault(path, 0, 0, str(error).removeprefix(f"{path} "), FmuError.exit_code)]
    return []


def fmu_warnings(path: Path) -> list[str]:
    """What FMPy's validation says of an FMU that can be read, a line each: other hosts and the checker take it."""
    return [f"warning: {problem}" for problem in validation(path)]


def check_scenario(path: Path) -> None:
    """Read a scenario or manifest as a run would; InputError with its faults, those of its FMUs included."""
    file = ScenarioFile(path)
    check_pinned(file)
    build_system(file, designed_values(file))
