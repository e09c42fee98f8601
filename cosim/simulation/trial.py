"""Trials: `cosim check` reads FMUs, scenarios, manifests and SSPs and tries a step; effect of halving the step."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim.blocks.compiling import FMU_COMPILE_LIMIT_S, permission
from cosim.blocks.summary import experiment_of
from cosim.core import errors
from cosim.core.errors import FmuError, InputError, Interrupted
from cosim.core.messages import CheckWarning, Note, with_severity
from cosim.core.scratch import temporary_folder
from cosim.credibility.found import read_credibility
from cosim.files.artefact import Checking
from cosim.files.files import FilePath
from cosim.files.results import Results
from cosim.fmi.description import read_description, validation
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.master.beforehand import with_feedthrough
from cosim.master.remote import RUN_MODULES, simulate_in
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.manifest import check_pinned
from cosim.simulation.packaged import lay_out
from cosim.system.system import System, build_system

MAX_CALL_TIME = 60.0  # allowed time [s] of a call during the trial of an FMU
TRIAL_STEP_S = 0.01  # without a default experiment
TRIAL_STEPS = 500  # in an experiment without step size


def check_fmu(path: Path, checking: Checking) -> list[str]:
    """Return messages on violations of FMI rules and, with a worker, warnings of a tried step.

    Raises:
        InputError: The FMU cannot be read or run. Violations of rules alone are not faults.
    """
    notes, worker = list[str](), checking.worker
    if not path.is_file():
        raise InputError.at(path, "no such file; give an FMU")
    try:
        description = read_description(path)
    except FmuError as error:
        raise InputError([error.fault(path, path)]) from None
    if worker is not None:
        from cosim.probing.misbehaviour import misbehaviour

        experiment = experiment_of(description)
        start, stop, step = (experiment.get(name, 0.0) for name in ("start", "stop", "step"))
        step = step if step > 0.0 else (stop - start) / TRIAL_STEPS if stop > start else TRIAL_STEP_S
        times = {"start_time": start, "duration": step, "step": step}
        content = {"name": path.stem, **times, "components": {"fmu": {"fmu": str(path.resolve())}}}
        worker.start()
        scenario = worker.folder / "check.json"
        scenario.write_text(json.dumps(content), encoding="utf-8")
        try:
            file = ScenarioFile(scenario)
            said = _run_once(file, build_system(file), path, worker)
        except InputError as error:
            raise InputError([replace(fault, file=path, line=0, column=0) for fault in error.faults]) from None
        notes += [with_severity(text.removeprefix("fmu: ")) for text in said if isinstance(text, CheckWarning)]
        notes += [f"warning: {sentence}" for sentence in misbehaviour(path)]
    if problem := read_credibility(path).problem:
        notes.append(f"warning: {problem}")
    # FMPy's findings concern an FMU that importing tools accept, so they are not faults.
    return notes + [f"warning: {problem}" for problem in validation(path, description)]


def check_scenario(path: Path, checking: Checking) -> list[str]:
    """Check a scenario or manifest; return warnings. With a worker, also try the first step.

    Raises:
        InputError: The file has faults.
    """
    file = ScenarioFile(path)
    check_pinned(file)
    return _check(file, path, checking.worker, file.warnings)


def check_ssp(path: Path, checking: Checking) -> list[str]:
    """Check an SSP; return warnings. With a worker, also try the first step.

    Raises:
        InputError: The SSP has faults.
    """
    with temporary_folder("check") as folder:
        file, warnings = lay_out(path, folder)
        try:
            return _check(file, path, checking.worker, warnings)
        except InputError as error:
            raise InputError(
                [replace(f, message=f.message.replace(f"{file.path.parent}/", "")) for f in error.faults]
            ) from None


def _check(file: ScenarioFile, path: Path, worker: Worker | None, warnings: Sequence[str]) -> list[str]:
    """Return `warnings`, warnings of the system and, with a worker, warnings of the first step."""
    system, said = build_system(file), list[str]()
    if worker is not None:
        system = with_feedthrough(file, system, worker)
        said = _run_once(file, system, path, worker)
    shown = [text for text in (*system.warnings, *said) if isinstance(text, CheckWarning)]
    return [*map(with_severity, (*warnings, *shown))]


def _run_once(file: ScenarioFile, system: System, path: Path, worker: Worker) -> list[str]:
    """Return the messages of the FMUs in the first step; raise InputError with a fault at `path` if it fails."""
    load_limit = MAX_CALL_TIME + (FMU_COMPILE_LIMIT_S if permission.get() else 0.0)
    system = replace(system, events={k: changes for k, changes in system.events.items() if k <= 1})
    limits = file.scenario.limits or Limits(step=MAX_CALL_TIME, load=load_limit)
    worker.start()
    try:
        stepped = simulate_in(worker, system, 1, file.scenario.step, limits)
    except FmuError as error:
        raise InputError([error.fault(path, path.resolve())]) from None
    except errors.DiskFull as error:
        raise InputError.at(
            path,
            f"the trial step failed: {error.reason}; --no-load checks the file without loading its FMUs",
            FmuError.exit_code,
        ) from None
    failure = stepped.failure
    if isinstance(failure, (Interrupted, errors.Signalled)):
        raise failure
    if failure is not None:
        code = failure.exit_code if isinstance(failure, errors.TimedOut) else FmuError.exit_code
        cure = "; add --no-load to check without FMUs" if isinstance(failure, (errors.Crashed, errors.TimedOut)) else ""
        raise InputError.at(path, f"does not run: {failure}{cure}", code)
    return [*stepped.log]


# -- effect of the communication step ---------------------------------------------------------------
# For a method of order p, the error of the run is 1/(1 − 2^−p) times the difference to half the step: about twice the
# difference for p = 1, the order of Gauss-Seidel and Jacobi with held inputs.


def coupling_error(
    scenario: FilePath, overrides: Sequence[str] = (), *, in_process: bool = False
) -> tuple[dict[str, float], str]:
    """Simulate a scenario without noise at full and at half step.

    FMUs run in a worker process within the limits of the scenario.

    Returns:
        Largest difference of each connected signal, in its unit, and a sentence on the result.

    Raises:
        InputError: The scenario is faulty.
        FmuError: An FMU does not load.
        Interrupted: The user stopped a run.
    """
    original = ScenarioFile(Path(scenario), overrides)
    if original.scenario.control is not None:
        reason = "uses variable steps, but --coupling-error needs a fixed step: add for example --set step=0.01"
        raise InputError([original.fault(("step",), reason)])
    runs, unknown = list[Results](), "coupling error not known: with half the step"
    with ExitStack() as stack:
        worker = None if in_process else stack.enter_context(Worker(*RUN_MODULES))
        for parts in (1, 2):
            step, steps = original.scenario.step / parts, original.scenario.steps * parts
            file = ScenarioFile(Path(scenario), (*overrides, "noise=off", f"step={step!r}"))
            try:
                system = with_feedthrough(file, build_system(file), worker)
            except InputError as error:
                if parts == 1:
                    raise
                reason = "; ".join(fault.message.partition(": set ")[0] for fault in error.faults)
                return {}, f"{unknown} it cannot be run: {reason}"
            stepped = simulate_in(worker, system, steps, step, original.scenario.limits)
            if isinstance(stepped.failure, Interrupted):
                raise stepped.failure
            if stepped.failure is not None:
                return {}, f"{unknown} {stepped.failure}"
            if len(stepped.results.time) <= steps:
                return {}, f"{unknown} the run ends early, at t = {stepped.results.time[-1]:g} s"
            runs.append(stepped.results)
    whole, halved = runs
    sources = dict.fromkeys(c.source for c in original.scenario.connections)
    columns = [c for name in sources for c in whole.columns if c == name or c.startswith(f"{name}[")]
    changes = {column: float(np.max(np.abs(whole[column] - halved[column][::2]))) for column in columns}
    sizes = ", ".join(f"{name} {value:.2g}" for name, value in changes.items())
    sentence = f"{sizes}; the coupling error is about twice that" if sizes else "none, because nothing is connected"
    return changes, Note(f"with half the step, the largest changes are: {sentence}")
