"""`cosim check` of FMUs, scenarios, manifests and SSPs: read, and stepped once."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cosim.blocks.compiling import LIMIT, permission
from cosim.core import errors
from cosim.core.errors import Fault, FmuError, InputError, refuse
from cosim.core.messages import CheckWarning, with_severity
from cosim.core.scratch import temporary_folder
from cosim.files.artefact import Checking
from cosim.fmi.description import read_description, takes_any_step
from cosim.fmi.guard import validation
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.master.remote import simulate_in
from cosim.probing.misbehaviour import misbehaviour
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.manifest import check_pinned
from cosim.simulation.packaged import lay_out
from cosim.simulation.undeclared import with_feedthrough
from cosim.system.recording import recording_notes
from cosim.system.system import System, build_system

MAX_CALL_TIME = 60.0  # allowed time [s] of a call during the trial of an FMU
MOST_INNER_STEPS = 10_000  # of an FMU with a fixed internal step, so that the trial is short
STEP, STEPS = 0.01, 500  # step [s] without a default experiment, and steps in an experiment without step size


def check_loaded_fmu(path: Path, checking: Checking) -> list[str]:
    """Return violations of FMI rules; raise InputError if the FMU cannot be run."""
    notes: list[str] = []
    refuse(check_fmu(path, checking.worker, notes))
    if checking.worker is not None:
        notes += [f"warning: {sentence}" for sentence in misbehaviour(path)]
    # FMPy's findings are about a readable FMU, as accepted by importing tools.
    return notes + [f"warning: {problem}" for problem in validation(path)]


def check_fmu(path: Path, worker: Worker | None = None, notes: list[str] | None = None) -> Sequence[Fault]:
    """Return faults of an FMU; with a worker, try a step and add its warnings to `notes`.

    Mere violations of FMI rules are no faults.
    """
    if not path.is_file():
        return [Fault(path, 0, 0, "no such file; give an FMU")]
    try:
        description = read_description(path)
    except FmuError as error:
        return [error.fault(path, path)]
    if worker is None:
        return []
    experiment = description.defaultExperiment
    start, stop, step = (
        float(getattr(experiment, name, None) or 0.0) for name in ("startTime", "stopTime", "stepSize")
    )
    step = step if step > 0.0 else (stop - start) / STEPS if stop > start else STEP
    inner = float(getattr(description.coSimulation, "fixedInternalStepSize", None) or 0.0)
    if inner and takes_any_step(description):
        step = min(step, MOST_INNER_STEPS * inner)
    times = {"start_time": start, "duration": step, "step": step}
    content = {"name": path.stem, **times, "components": {"fmu": {"fmu": str(path.resolve())}}}
    worker.start()
    scenario = worker.folder / "check.json"
    scenario.write_text(json.dumps(content), encoding="utf-8")
    try:
        file = ScenarioFile(scenario)
        faults, said = _run_once(file, build_system(file), path, worker)
        if notes is not None:
            notes += [with_severity(text.removeprefix("fmu: ")) for text in said if isinstance(text, CheckWarning)]
        return faults
    except InputError as error:
        return [replace(fault, file=path, line=0, column=0) for fault in error.faults]


def check_scenario(path: Path, checking: Checking) -> list[str]:
    """Check a scenario or manifest; return warnings.

    With a worker, the first step is tried too.

    Raises:
        InputError: The file has faults.
    """
    file, worker = ScenarioFile(path), checking.worker
    check_pinned(file)
    said: Sequence[str] = ()
    system = build_system(file)
    if worker is not None:
        system = with_feedthrough(file, system, worker)
        faults, said = _run_once(file, system, path, worker)
        refuse(faults)
    shown = [text for text in (*system.warnings, *said) if isinstance(text, CheckWarning)]
    notes = recording_notes(file.scenario, system.columns, system.recording)
    return [*map(with_severity, (*file.warnings, *shown, *notes))]


def check_ssp(path: Path, checking: Checking) -> list[str]:
    """Check an SSP; return warnings.

    With a worker, the first step is tried too.

    Raises:
        InputError: The SSP has faults.
    """
    with temporary_folder("check") as folder:
        file, warnings = lay_out(path, folder)
        system = build_system(file)
        said: Sequence[str] = ()
        if checking.worker is not None:
            faults, said = _run_once(file, system, path, checking.worker)
            refuse(replace(f, message=f.message.replace(f"{file.path.parent}/", "")) for f in faults)
    shown = [text for text in (*system.warnings, *said) if isinstance(text, CheckWarning)]
    return [*map(with_severity, (*warnings, *shown))]


def _run_once(file: ScenarioFile, system: System, path: Path, worker: Worker) -> tuple[Sequence[Fault], Sequence[str]]:
    """Return the fault of a failed first step, located at `path`, and the messages of the FMUs."""
    load_limit = MAX_CALL_TIME + (LIMIT if permission.get() else 0.0)
    system = replace(system, events={k: changes for k, changes in system.events.items() if k <= 1})
    limits = file.scenario.limits or Limits(step=MAX_CALL_TIME, load=load_limit)
    worker.start()
    try:
        stepped = simulate_in(worker, system, 1, file.scenario.step, limits)
    except FmuError as error:
        return [error.fault(path, path.resolve())], ()
    except errors.DiskFull as error:
        message = f"cannot be tried: {error.reason}; --no-load checks it without"
        return [Fault(path, 0, 0, message, FmuError.exit_code)], ()
    if (failure := stepped.failure) is None:
        return [], stepped.log
    if isinstance(failure, (errors.Interrupted, errors.Signalled)):
        raise failure
    code = failure.exit_code if isinstance(failure, errors.TimedOut) else FmuError.exit_code
    cure = "; --no-load checks it without" if isinstance(failure, (errors.Crashed, errors.TimedOut)) else ""
    return [Fault(path, 0, 0, f"does not run: {failure}{cure}", code)], ()
