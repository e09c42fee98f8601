"""A single run of a sweep: request to a worker, execution, and result.

Requests and results are plain data, so that workers can be on any machine.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cosim.blocks.component import GET
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.shared_code import SharedCode, code_of
from cosim.core.arrays import Array
from cosim.core.errors import CosimError, Crashed, InputError, TimedOut
from cosim.credibility.validity import validities
from cosim.files.archive import unpack_once
from cosim.files.results import Results
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import Rows
from cosim.isolation.watch import Watch
from cosim.master.master import StoppedRun, simulate
from cosim.master.own_process import in_own_processes
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.criteria import evaluate
from cosim.system.system import build_system

SWEEP_MODULES = ("cosim.sweeps.runs", "fmpy.fmi2", "fmpy.logging")
CACHED_SYSTEMS = 16  # assembled systems cached per worker
NO_MESSAGES: Mapping[str, Any] = {"first": (), "last": (), "omitted": 0}


@dataclass(frozen=True)
class Job:
    """Settings common to all runs: scenario, overrides, recorded signals, number of samples and of criteria.

    Attributes:
        watch: Limits of a run, and names of components for messages about a stopped worker.
    """

    scenario: Path
    overrides: tuple[str, ...]
    signals: tuple[str, ...]
    samples: int
    criteria: int
    watch: Watch


def time_reached(start: float, step: float, rows: int, call: int) -> float:
    """Return the simulated time [s] from start time [s], communication step [s], rows so far and current call."""
    return start + step * (max(0, rows - 1) + (call == GET and rows > 0))


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
        values: Values of the criteria; NaN if undefined, e.g. for a signal that never settles.
        met: For each criterion, True if it is met.
        signals: Samples, shape (signals, times); empty if the run failed.
        valid: Component → share of the time in the region of its logs, for FMUs with a record of credibility.
    """

    run: int
    status: str
    values: Sequence[float]
    met: Sequence[bool]
    signals: Array
    valid: Mapping[str, float] = field(default_factory=dict)


_of_thread = threading.local()


def work_in(worker: Worker) -> None:
    """Let `make_runs_apart` use this worker in this thread."""
    _of_thread.worker, _of_thread.runs = worker, 0


def make_runs_apart(job: Job, requests: Sequence[RunRequest]) -> list[RunResult]:
    """Make runs in a process of this thread by one message, so that a crash or an exceeded limit fails no other run.

    If the process ends or a limit is exceeded, each run is made again by a message of its own, and fails if it is the
    first one of its process.
    """
    if not hasattr(_of_thread, "worker"):
        work_in(Worker(*SWEEP_MODULES))
    try:
        watch = replace(job.watch, spent=[0.0])
        results: list[RunResult] = _of_thread.worker.call(make_runs, job, requests, watch=watch)
    except CosimError as error:
        earlier, _of_thread.runs = _of_thread.runs, 0
        if len(requests) == 1 and not (earlier and isinstance(error, Crashed | TimedOut)):
            return [_failed(job, requests[0], error)]
        return [make_runs_apart(job, [request])[0] for request in requests]
    _of_thread.runs += len(results)
    return results


def make_runs(job: Job, requests: Sequence[RunRequest]) -> list[RunResult]:
    """Execute runs in this process, in sequence; return their results."""
    return [make_run(job, request) for request in requests]


def make_run(job: Job, request: RunRequest) -> RunResult:
    """Execute a run in this process; the result of a failed run contains the reason."""
    try:
        swept = assemble(job.scenario, (*job.overrides, *request.overrides))
        results = swept.simulate(request, job.watch.limits)
    except StoppedRun as stop:
        if stop.error.exit_code == 130:  # from the keyboard
            raise KeyboardInterrupt from None
        return _failed(job, request, stop.error)
    except CosimError as error:
        if isinstance(error, SharedCode) and hasattr(here, "progress"):
            raise  # another process repeats the run
        return _failed(job, request, error)
    scenario = swept.scenario
    if len(results.time) <= scenario.steps:
        return _failed(
            job, request, f"an FMU ended the simulation at t = {results.time[-1]:g} s, before the end of the run"
        )
    validity = validities((stage.component for stage in swept.system.stages), results)
    criteria = evaluate(scenario, results, validity)
    values = [np.nan if c["value"] is None else float(c["value"]) for c in criteria]
    columns = [results.columns.index(name) for name in job.signals]
    signals = np.ascontiguousarray(results.values[np.ix_(sampled_rows(scenario.steps, job.samples), columns)].T)
    shares = {name: entry["share"] for name, entry in validity.items() if entry.get("share") is not None}
    return RunResult(request.run, "ok", values, [bool(c["met"]) for c in criteria], signals, shares)


class SweptSystem:
    """A system that a process simulates again and again, each time with new instances of its FMUs.

    Loading takes longer than many a run. Libraries stay loaded if they have no variables; others may keep state of an
    earlier run, so each run loads its own copies.
    """

    def __init__(self, path: Path, overrides: tuple[str, ...]) -> None:
        file = ScenarioFile(path, overrides, option="")
        self.scenario, self.system = file.scenario, build_system(file)
        blocks = [s.component for s in self.system.stages if isinstance(s.component, FmuBlock)]
        self._starts = {block.name: block.start_values for block in blocks}
        # In FMI 1.0, and where a process may have one instance, it cannot be made again.
        single = any(getattr(b.instance.about, "canBeInstantiatedOnlyOncePerProcess", False) for b in blocks)
        is_constant = all(b.instance.version > 1 and not code_of(b.path).has_variables for b in blocks)
        self._keeps = is_constant and not single and not self.system.apart
        self._kept: dict[str, FmuBlock] = {}
        weakref.finalize(self, _unload, self._kept).atexit = False

    def simulate(self, request: RunRequest, limits: Limits) -> Results:
        """Simulate one run.

        Raises:
            StoppedRun: A component failed.
            CosimError: An FMU does not load.
        """
        scenario = self.scenario
        starts = {name: {**values, **request.starts.get(name, {})} for name, values in self._starts.items()}
        if not self._kept:
            self._make_fmus(starts)
        for name, block in self._kept.items():
            block.start_values = starts[name]
            block.log.restore(NO_MESSAGES)
        system = self._system if request.seed is None else replace(self._system, seed=request.seed)
        rows = Rows.in_memory(scenario.steps + 1, len(system.columns))
        progress = getattr(here, "progress", None)
        if progress is not None:
            progress.made[0] = 0  # resets the count of the previous run
            rows = replace(rows, made=progress.made, doing=progress.doing)
            system = system if self._kept else in_own_processes(system, limits)
            for stage in system.stages:
                here.share_log(stage.component)
        try:
            return simulate(system, scenario.steps, scenario.step, rows=rows)
        except (StoppedRun, CosimError):
            _unload(self._kept)
            raise

    def _make_fmus(self, starts: Mapping[str, Mapping[str, Any]]) -> None:
        """Set the system with new FMUs."""
        stages = []
        for stage in self.system.stages:
            component = stage.component
            if isinstance(component, FmuBlock):
                # Instances in Python share code only; other libraries may keep state of an earlier run.
                place = unpack_once(component.path) if component.nominal_step else None
                component = component.with_start_values(starts[component.name], place)
                if self._keeps:
                    component.instance.keeps_library = True
                    self._kept[component.name] = component
            stages.append(replace(stage, component=component))
        self._system = replace(self.system, stages=tuple(stages))


def _unload(kept: dict[str, FmuBlock]) -> None:
    """Unload libraries that have stayed loaded, and delete their folders."""
    while kept:
        _, block = kept.popitem()
        block.instance.keeps_library = False
        block.close()


@lru_cache(maxsize=CACHED_SYSTEMS)
def assemble(path: Path, overrides: tuple[str, ...]) -> SweptSystem:
    """Return the system of a scenario; raise InputError for faults."""
    return SweptSystem(path, overrides)


def _failed(job: Job, request: RunRequest, reason: CosimError | str) -> RunResult:
    """Return the result of a failed run, with the first of several faults."""
    text = " ".join(str(reason.faults[0] if isinstance(reason, InputError) else reason).split())
    return RunResult(request.run, text, [np.nan] * job.criteria, [False] * job.criteria, np.empty((0, 0)))


@cache
def sampled_rows(steps: int, samples: int) -> list[int]:
    """Return the numbers of evenly spaced rows to record, including the first and the last."""
    count = min(samples, steps + 1)
    return np.unique(np.rint(np.linspace(0, steps, count)).astype(int)).tolist()  # type: ignore[no-any-return]
