"""One run of a sweep: what a worker is sent, what it returns, and the run itself.

Requests and results are plain data, so that workers may run anywhere.
"""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cosim.blocks.fmu import FmuBlock
from cosim.blocks.shared_code import SharedCode
from cosim.core.errors import CosimError, InputError
from cosim.core.scratch import process_folder
from cosim.credibility.validity import validities
from cosim.files.archive import unpack
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import GET, Rows
from cosim.isolation.watch import Watch
from cosim.master.master import StoppedRun, simulate
from cosim.master.own_process import in_own_processes
from cosim.scenario.scenario import Scenario
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.criteria import evaluate
from cosim.system.system import System, build_system

MODULES = ("cosim.sweeps.runs", "fmpy.fmi2", "fmpy.logging")
CACHED_SYSTEMS = 16  # assembled systems cached per worker


@dataclass(frozen=True)
class Job:
    """Common settings of all runs: scenario, overrides, recorded signals with sample count, limits of a run.

    Attributes:
        criteria: Number of criteria.
        components: Names of the components, for messages about a stopped worker.
        calls: Names of their FMI calls.
        start: Start time [s].
        step: Communication step [s].
        width: Size of a row [bytes].
    """

    scenario: Path
    overrides: tuple[str, ...]
    signals: tuple[str, ...]
    samples: int
    criteria: int
    limits: Limits
    components: tuple[str, ...]
    calls: tuple[tuple[str, ...], ...]
    start: float
    step: float
    width: int

    def time(self, rows: int, call: int) -> float:
        """Return the simulated time [s] of a run."""
        return self.start + self.step * (max(0, rows - 1) + (call == GET and rows > 0))


@dataclass(frozen=True)
class RunRequest:
    """Request for a run: number, overrides, start values by component, and seed."""

    run: int
    overrides: tuple[str, ...] = ()
    starts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    seed: int | None = None


@dataclass(frozen=True)
class RunResult:
    """Result of a run.

    Attributes:
        status: "ok", or the reason of failure.
        values: Values of the criteria, NaN if undefined, e.g. for a settling time never reached.
        met: Outcomes of the criteria.
        signals: Samples of each signal, empty after a failure.
        valid: Component → share of the time in the region of its logs, for FMUs with a record of credibility.
    """

    run: int
    status: str
    values: Sequence[float]
    met: Sequence[bool]
    signals: Sequence[Sequence[float]]
    valid: Mapping[str, float] = field(default_factory=dict)


_of_thread = threading.local()


def make_run_apart(job: Job, request: RunRequest) -> RunResult:
    """Make a run in a process of this thread, so that a crash or an exceeded limit fails this run only."""
    worker: Worker | None = getattr(_of_thread, "worker", None)
    if worker is None:
        worker = _of_thread.worker = Worker(*MODULES)
    try:
        watch = Watch(job.components, job.calls, job.time, job.limits, job.width)
        result: RunResult = worker.call(make_run, job, request, watch=watch)
    except CosimError as error:
        return _failed(job, request, error)
    return result


def end_process(*, kill: bool) -> None:
    """End the process of this thread, if any."""
    if (worker := vars(_of_thread).pop("worker", None)) is not None:
        worker.end(kill=kill)


def make_run(job: Job, request: RunRequest) -> RunResult:
    """Make a run in this process; a failed run reports its reason."""
    try:
        scenario, system = assemble(job.scenario, (*job.overrides, *request.overrides))
    except CosimError as error:
        return _failed(job, request, error)
    stages = []
    for stage in system.stages:
        component = stage.component
        if isinstance(component, FmuBlock):  # Each run has its own instance.
            # Instances in Python share code only; other libraries may keep state of an earlier run.
            place = _unpack_once(component.path) if component.nominal_step else None
            starts = {**component.start_values, **request.starts.get(component.name, {})}
            component = component.with_start_values(starts, place)
        stages.append(replace(stage, component=component))
    system = replace(system, stages=tuple(stages), seed=system.seed if request.seed is None else request.seed)
    progress = getattr(here, "progress", None)
    rows = Rows.in_memory(scenario.steps + 1, len(system.columns))
    if progress is not None:
        progress.made[0] = 0  # clears the count of the previous run
        rows = replace(rows, made=progress.made, doing=progress.doing)
        system = in_own_processes(system, job.limits)
        for stage in system.stages:
            here.share_log(stage.component)
    try:
        results = simulate(system, scenario.steps, scenario.step, rows=rows)
    except StoppedRun as stop:
        if stop.error.exit_code == 130:
            raise KeyboardInterrupt from None
        return _failed(job, request, stop.error)
    except CosimError as error:
        if isinstance(error, SharedCode) and progress is not None:
            raise  # Another process makes the run.
        return _failed(job, request, error)
    if len(results.time) <= scenario.steps:
        return _failed(job, request, f"it ended at t = {results.time[-1]:g} s")
    validity = validities((stage.component for stage in system.stages), results)
    criteria = evaluate(scenario, results, validity)
    values = [np.nan if c["value"] is None else float(c["value"]) for c in criteria]
    places = sampled_rows(scenario.steps, job.samples)
    signals = [results[name][places].tolist() for name in job.signals]
    shares = {name: entry["share"] for name, entry in validity.items() if entry.get("share") is not None}
    return RunResult(request.run, "ok", values, [bool(c["met"]) for c in criteria], signals, shares)


@lru_cache(maxsize=CACHED_SYSTEMS)
def assemble(path: Path, overrides: tuple[str, ...]) -> tuple[Scenario, System]:
    """Return a scenario and its system; raise InputError for faults."""
    file = ScenarioFile(path, overrides, option="")
    return file.scenario, build_system(file)


@cache
def _unpack_once(path: Path) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="fmu-", dir=process_folder()))
    unpack(path, folder)
    return folder


def _failed(job: Job, request: RunRequest, reason: CosimError | str) -> RunResult:
    """Return the result of a failed run, with the first of several faults."""
    text = " ".join(str(reason.faults[0] if isinstance(reason, InputError) else reason).split())
    return RunResult(request.run, text, [np.nan] * job.criteria, [False] * job.criteria, [])


def sampled_rows(steps: int, samples: int) -> list[int]:
    """Return evenly spaced rows to record, including both ends."""
    count = min(samples, steps + 1)
    return np.unique(np.rint(np.linspace(0, steps, count)).astype(int)).tolist()  # type: ignore[no-any-return]
