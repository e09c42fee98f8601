"""`cosim check`: every fault of every file."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

from cosim.base.errors import (
    Crashed,
    DiskFull,
    Fault,
    FmuError,
    InputError,
    Interrupted,
    NotExecuted,
    Signalled,
    TimedOut,
)
from cosim.base.registry import BASE, is_model, resolve
from cosim.base.scratch import temporary_folder
from cosim.blocks.compiling import LIMIT, permission
from cosim.blocks.fmu import read_description
from cosim.blocks.guard import validation
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.loading.file import LoadedModel, load_model, only_model, read_model, without_execution
from cosim.loading.own_run import predicted_outputs
from cosim.loading.substep import with_substep
from cosim.logs.alone import findings_alone
from cosim.logs.gate import gate, refuse_faults
from cosim.logs.log import Log, read_log
from cosim.logs.spikes import find_spikes, without
from cosim.master.remote import MODULES, simulate_apart
from cosim.model.traits import Traits
from cosim.refinement.study import read_study
from cosim.scenario.controller_design import designed_apart, designed_values, ended
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.manifest import check_pinned
from cosim.simulation.packaged import lay_out
from cosim.storage import kinds
from cosim.storage.artefact import of_kind
from cosim.storage.files import FilePath
from cosim.storage.kinds import kind_by_form, kind_by_keys, refuse_unreadable
from cosim.storage.table import read_header
from cosim.storage.yaml_file import YamlFile
from cosim.system.system import System, build_system

WANTED = "a scenario, study, sweep, protocol, model, log, SSP or FMU"
LONGEST = 60.0  # [s] that a call may take while an FMU is tried
STEP, STEPS = 0.01, 500  # [s] of an FMU that says nothing, steps in the experiment of one that says no step


def check_files(
    files: FilePath | Iterable[FilePath],
    model: str | None = None,
    *,
    load: bool = True,
    columns: Mapping[str, str] = MappingProxyType({}),
) -> list[str]:
    """Check a file, or each of several, by what it is, logs as those of `model` (base, a model.yaml, file.py:Class).

    Without a model a log that has an input of base is one of base; another is checked by itself.
    load:    FMUs and scenarios are loaded and stepped once, and Python that a file names is executed, in a worker
             process; without, nothing that a file names is executed
    columns: name in the logs → name in their model, or `time`, where they differ
    What is to be known and no fault, a line each; InputError with all faults of all files.
    """
    if permission.get() and not load:
        told = "is to load FMUs, which --no-load (in Python load=False) forbids; leave one of them out"
        raise InputError([Fault(Path("--compile"), 0, 0, told)])
    faults: list[Fault] = []
    said: list[str] = []
    with Worker(*MODULES) if load else nullcontext() as worker:
        for path in map(Path, [files] if isinstance(files, (str, os.PathLike)) else files):
            try:
                said += [f"{path}: {line}" for line in _checked(path, model, worker, columns)]
            except InputError as error:
                faults += error.faults
    if faults:
        raise InputError(faults)
    return said


def _checked(path: Path, model: str | None, worker: Worker | None, columns: Mapping[str, str]) -> list[str]:
    """Check a file; Python that it names is executed in the worker, without one not at all."""
    with without_execution() as skipped:
        try:
            return _check(path, model, worker, columns)
        except NotExecuted as code:
            if worker is None:
                return [f"warning: {code} (--no-load); neither it nor what depends on it is checked"]
        except InputError:
            if worker is None or not skipped:  # else there may be more faults
                raise
    try:
        lines: list[str] = worker.call(_check, path, model, None, dict(columns))
    except Crashed as crash:
        raise InputError([ended(skipped[0], crash)]) from None
    return lines


def _check(path: Path, model: str | None, worker: Worker | None, columns: Mapping[str, str]) -> list[str]:
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
            return _of_log(path, model, columns)
        case kinds.CODE:
            kind = type(only_model(path)).__name__
            return _substep_of(load_model(f"{path}:{kind}", Path()))
        case kinds.MODEL | kinds.SWEEP | kinds.STUDY | kinds.SCENARIO | kinds.MANIFEST:
            pass  # by its keys below
        case str() as other:
            _refuse_unchecked(path, other)
    if path.suffix.startswith(".py:"):  # FILE.py:Class
        text = str(path)
        if text.endswith(":"):
            only_model(Path(text.removesuffix(":")))
            return []
        return _substep_of(load_model(text, Path()))
    root = YamlFile(path).root
    by_keys = kind_by_keys(root)
    if by_keys is not None and by_keys not in kinds.OTHERS and (check := of_kind(by_keys).check):
        return [f"warning: {text}" for text in resolve(check)(path)]
    match by_keys:
        case kinds.MODEL:
            return _substep_of(read_model(path))
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
    message = f"is {kind}, in which there is nothing to check: {kinds.next_step(kind, path)}"
    raise InputError([Fault(path, 0, 0, message)])


def _of_log(path: Path, model: str | None, columns: Mapping[str, str]) -> list[str]:
    """What is to be known of a log: of the model that is named, of base if it has an input of base, else by itself."""
    if model is None and not is_model(BASE):
        return findings_alone(path, columns)
    meant = load_model(BASE if model is None else model, Path())
    if model is None:
        names = {columns.get(name, name) for name in read_header(path)}
        if names and names.isdisjoint(q.name for q in meant.model.inputs):
            return findings_alone(path, columns)
    return log_findings(path, meant, columns)


def log_findings(path: Path, loaded: LoadedModel, columns: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """What the gate says of a log, a line each; InputError with its faults."""
    model = loaded.model
    log = read_log(path, model.inputs, model.outputs, table=model.static, columns=columns)
    stepping = with_substep(loaded)[0].model
    spikes = {} if log.table else find_spikes(log, partial(predicted_outputs, stepping, log))
    findings = gate(log, model.rate, traits=Traits.of(model), spikes=spikes)
    refuse_faults(log, findings)
    return [*(f.line for f in findings), *_substep_of(loaded, [without(log, spikes)])]


def _substep_of(loaded: LoadedModel, logs: Sequence[Log] = ()) -> list[str]:
    """What substep is chosen for a model, where it is not its own; InputError where none suits it."""
    return [f"note: {text}" for text in with_substep(loaded, logs)[1]]


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
    not_executed = ""
    try:
        designed = designed_apart(file, worker) if worker is not None else designed_values(file)
    except NotExecuted as code:
        designed, not_executed = {}, f"{code} (--no-load); the design is not checked"
    system = build_system(file, designed)
    if worker is not None and (faults := _run_once(file, system, path, worker)):
        raise InputError(faults)
    return [f"warning: {text}" for text in (*file.warnings, *filter(None, [not_executed]))]


def check_ssp(path: Path, worker: Worker | None = None) -> list[str]:
    """Read an SSP as a run would, step it once with a worker; what is to be known of it. InputError with its faults."""
    with temporary_folder("check") as folder:
        file, warnings = lay_out(path, folder)
        if worker is not None and (faults := _run_once(file, build_system(file), path, worker)):
            shown = (replace(f, message=f.message.replace(f"{file.path.parent}/", "")) for f in faults)
            raise InputError(list(shown))
        return [f"warning: {text}" for text in warnings]


def _run_once(file: ScenarioFile, system: System, path: Path, worker: Worker) -> list[Fault]:
    """Why the first step of a scenario fails; `path` is what it is told of."""
    to_load = LONGEST + (LIMIT if permission.get() else 0.0)
    limits = file.scenario.limits or Limits(step=LONGEST, load=to_load)
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
