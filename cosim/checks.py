"""`cosim check`: every fault of every file."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

from cosim import kinds
from cosim.blocks.fmu import read_description
from cosim.blocks.guard import validation
from cosim.errors import Crashed, DiskFull, Fault, FmuError, InputError, Interrupted, Signalled, TimedOut
from cosim.files import FilePath
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.kinds import kind_by_form, kind_by_keys, refuse_unreadable
from cosim.logs.gate import gate, refuse_faults
from cosim.logs.log import read_log
from cosim.models.file import load_model, only_model, read_model
from cosim.refinement.study import read_study
from cosim.registry import BASE
from cosim.simulation.apart import MODULES, simulate_apart
from cosim.simulation.design import designed_values
from cosim.simulation.manifest import check_pinned
from cosim.simulation.packaged import lay_out
from cosim.simulation.scenario_file import ScenarioFile
from cosim.simulation.system import System, build_system
from cosim.yaml_file import YamlFile
from plant.model import Model
from plant.traits import Traits

WANTED = "a scenario, study, sweep, protocol, model, log, SSP or FMU"
LONGEST = 60.0  # [s] that a call may take while an FMU is tried
STEP, STEPS = 0.01, 500  # [s] of an FMU that says nothing, steps in the experiment of one that says no step


def check_files(
    files: FilePath | Iterable[FilePath],
    model: str = BASE,
    *,
    load: bool = True,
    columns: Mapping[str, str] = MappingProxyType({}),
) -> list[str]:
    """Check a file, or each of several, by what it is, logs as those of `model` (base, a model.yaml, file.py:Class).

    load:    FMUs and scenarios are loaded and stepped once, in a worker process
    columns: name in the logs → name in their model, or `time`, where they differ
    What is to be known and no fault, a line each; InputError with all faults of all files.
    """
    faults: list[Fault] = []
    said: list[str] = []
    with Worker(*MODULES) if load else nullcontext() as worker:
        for path in map(Path, [files] if isinstance(files, (str, os.PathLike)) else files):
            try:
                said += [f"{path}: {line}" for line in _check(path, model, worker, columns)]
            except InputError as error:
                faults += error.faults
    if faults:
        raise InputError(faults)
    return said


def _check(path: Path, model: str, worker: Worker | None, columns: Mapping[str, str]) -> list[str]:
    """What is to be known of a file, a line each; InputError with its faults."""
    if not path.suffix.startswith(".py:"):
        refuse_unreadable(path, WANTED)
    match kind_by_form(path):
        case kinds.FMU:
            if faults := check_fmu(path, worker):
                raise InputError(faults)
            return fmu_warnings(path)
        case kinds.SSP:
            return check_ssp(path, worker)
        case kinds.LOG:
            return log_findings(path, load_model(model, Path()).model, columns)
        case kinds.CODE:
            only_model(path)
            return []
        case kinds.MODEL | kinds.PROTOCOL | kinds.SWEEP | kinds.STUDY | kinds.SCENARIO | kinds.MANIFEST:
            pass  # by its keys below
        case str() as other:
            _refuse_unchecked(path, other)
    if path.suffix.startswith(".py:"):  # FILE.py:Class
        text = str(path)
        only_model(Path(text.removesuffix(":"))) if text.endswith(":") else load_model(text, Path())
        return []
    root = YamlFile(path).root
    match kind_by_keys(root):
        case kinds.MODEL:
            read_model(path)
        case kinds.PROTOCOL:
            from cosim.identification.checking import check_protocol  # of the craft's bench: others do without

            return [f"warning: {text}" for text in check_protocol(path)]
        case kinds.SWEEP:
            from cosim.sweeps.reading import read_sweep

            return [f"warning: {text}" for text in read_sweep(path).warnings]
        case kinds.STUDY:
            return [f"warning: {text}" for text in read_study(path).warnings]
        case None if root.keys() & {"model", "candidates"} and "step" not in root:
            return [f"warning: {text}" for text in read_study(path).warnings]
        case None | kinds.SCENARIO | kinds.MANIFEST:
            return check_scenario(path, worker)
        case other:
            _refuse_unchecked(path, other)
    return []


def _refuse_unchecked(path: Path, kind: str) -> NoReturn:
    cure = kinds.READ_BY[kind].format(file=kinds.as_typed(path))
    raise InputError([Fault(path, 0, 0, f"is {kind}, in which there is nothing to check: {cure}")])


def log_findings(path: Path, model: Model, columns: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """What the gate says of a log, a line each; InputError with its faults."""
    log = read_log(path, model.inputs, model.outputs, table=model.static, columns=columns)
    findings = gate(log, model.rate, traits=Traits.of(model))
    refuse_faults(log, findings)
    return [f.line for f in findings]


def check_fmu(path: Path, worker: Worker | None = None) -> list[Fault]:
    """Why an FMU cannot be run, tried where a worker is given; what only breaks a rule of FMI: `fmu_warnings`."""
    if not path.is_file():
        return [Fault(path, 0, 0, "no such file")]
    try:
        description = read_description(path)
    except FmuError as error:
        return [Fault(path, 0, 0, str(error).removeprefix(f"{path} "), FmuError.exit_code)]
    if worker is None:
        return []
    start, step = _experiment(description)
    content = {
        "name": path.stem, "start_time": start, "duration": step, "step": step,
        "components": {"fmu": {"fmu": str(path.resolve())}},
    }  # fmt: skip
    worker.start()
    scenario = worker.folder / "check.json"
    scenario.write_text(json.dumps(content), encoding="utf-8")
    try:
        file = ScenarioFile(scenario)
        return _run_once(file, build_system(file), path, worker)
    except InputError as error:
        return [replace(fault, file=path, line=0, column=0) for fault in error.faults]


def fmu_warnings(path: Path) -> list[str]:
    """What FMPy's validation says of an FMU that can be read, a line each: other hosts and the checker take it."""
    return [f"warning: {problem}" for problem in validation(path)]


def _experiment(description: Any) -> tuple[float, float]:
    """Start time and step [s] that an FMU is made for."""
    experiment = description.defaultExperiment
    given = [getattr(experiment, name, None) for name in ("startTime", "stopTime", "stepSize")]
    start, stop, step = (0.0 if text is None else float(text) for text in given)
    return start, step if step > 0.0 else (stop - start) / STEPS if stop > start else STEP


def check_scenario(path: Path, worker: Worker | None = None) -> list[str]:
    """Read a scenario or manifest as a run would, step it once with a worker; what its design warns of.

    Raises InputError with its faults.
    """
    file = ScenarioFile(path)
    check_pinned(file)
    system = build_system(file, designed_values(file))
    if worker is not None and (faults := _run_once(file, system, path, worker)):
        raise InputError(faults)
    return [f"warning: {text}" for text in file.warnings]


def check_ssp(path: Path, worker: Worker | None = None) -> list[str]:
    """Read an SSP as a run would, step it once with a worker; what is to be known of it. InputError with its faults."""
    with tempfile.TemporaryDirectory(prefix="cosim-check-") as folder:
        file, warnings = lay_out(path, Path(folder))
        if worker is not None and (faults := _run_once(file, build_system(file), path, worker)):
            shown = (replace(f, message=f.message.replace(f"{file.path.parent}/", "")) for f in faults)
            raise InputError(list(shown))
        return [f"warning: {text}" for text in warnings]


def _run_once(file: ScenarioFile, system: System, path: Path, worker: Worker) -> list[Fault]:
    """Why the first step of a scenario fails; `path` is what it is told of."""
    limits = file.scenario.limits or Limits(step=LONGEST, load=LONGEST)
    worker.start()
    beside = Path(tempfile.gettempdir())
    try:
        made = simulate_apart(worker, system, 1, file.scenario.step, beside, limits)
    except FmuError as error:
        return [Fault(path, 0, 0, str(error).removeprefix(f"{path.resolve()} "), error.exit_code)]
    except DiskFull as error:
        return [Fault(path, 0, 0, f"cannot be tried: {error.reason}; --no-load checks it without", FmuError.exit_code)]
    if made.failure is None:
        return []
    if isinstance(made.failure, (Interrupted, Signalled)):
        raise made.failure
    code = made.failure.exit_code if isinstance(made.failure, TimedOut) else FmuError.exit_code
    cure = "; --no-load checks it without" if isinstance(made.failure, (Crashed, TimedOut)) else ""
    return [Fault(path, 0, 0, f"does not run: {made.failure}{cure}", code)]
