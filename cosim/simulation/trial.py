"""`cosim check` of FMUs, scenarios, manifests and SSPs: read, and stepped once."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

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
from cosim.base.scratch import temporary_folder
from cosim.blocks.compiling import LIMIT, permission
from cosim.blocks.fmu import read_description
from cosim.blocks.guard import validation
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.master.remote import simulate_apart
from cosim.scenario.controller_design import designed_apart, designed_values
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.manifest import check_pinned
from cosim.simulation.packaged import lay_out
from cosim.storage.artefact import Checking
from cosim.system.system import System, build_system

LONGEST = 60.0  # allowed time [s] of a call during the trial of an FMU
STEP, STEPS = 0.01, 500  # step [s] without a default experiment, and steps in an experiment without step size


def check_fmu_file(path: Path, checking: Checking) -> list[str]:
    """Return violations of FMI rules; raise InputError if the FMU cannot be run."""
    if faults := check_fmu(path, checking.worker):
        raise InputError(faults)
    return fmu_warnings(path)


def check_fmu(path: Path, worker: Worker | None = None) -> list[Fault]:
    """Return faults of an FMU; with a worker, try a step. For mere violations of FMI rules see `fmu_warnings`."""
    if not path.is_file():
        return [Fault(path, 0, 0, "no such file")]
    try:
        description = read_description(path)
    except FmuError as error:
        return [Fault(path, 0, 0, str(error).removeprefix(f"{path} "), FmuError.exit_code)]
    if worker is None:
        return []
    start, step = _experiment(description)
    times = {"start_time": start, "duration": step, "step": step}
    content = {"name": path.stem, **times, "components": {"fmu": {"fmu": str(path.resolve())}}}
    worker.start()
    scenario = worker.folder / "check.json"
    scenario.write_text(json.dumps(content), encoding="utf-8")
    try:
        file = ScenarioFile(scenario)
        return _run_once(file, build_system(file), path, worker)
    except InputError as error:
        return [replace(fault, file=path, line=0, column=0) for fault in error.faults]


def fmu_warnings(path: Path) -> list[str]:
    """Return the findings of FMPy's validation as warnings.

    Each finding is about a readable FMU, as accepted by importing tools.
    """
    return [f"warning: {problem}" for problem in validation(path)]


def _experiment(description: Any) -> tuple[float, float]:
    """Return start time and step [s] of the default experiment."""
    experiment = description.defaultExperiment
    given = [getattr(experiment, name, None) for name in ("startTime", "stopTime", "stepSize")]
    start, stop, step = (0.0 if text is None else float(text) for text in given)
    return start, step if step > 0.0 else (stop - start) / STEPS if stop > start else STEP


def check_scenario(path: Path, checking: Checking) -> list[str]:
    """Check a scenario or manifest; return warnings of its design.

    With a worker, the first step is tried too.

    Raises:
        InputError: The file has faults.
    """
    file, worker = ScenarioFile(path), checking.worker
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


def check_ssp(path: Path, checking: Checking) -> list[str]:
    """Check an SSP; return warnings.

    With a worker, the first step is tried too.

    Raises:
        InputError: The SSP has faults.
    """
    worker = checking.worker
    with temporary_folder("check") as folder:
        file, warnings = lay_out(path, folder)
        if worker is not None and (faults := _run_once(file, build_system(file), path, worker)):
            shown = (replace(f, message=f.message.replace(f"{file.path.parent}/", "")) for f in faults)
            raise InputError(list(shown))
        return [f"warning: {text}" for text in warnings]


def _run_once(file: ScenarioFile, system: System, path: Path, worker: Worker) -> list[Fault]:
    """Return the fault of a failed first step, located at `path`."""
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
