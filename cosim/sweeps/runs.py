"""A single run of a sweep: request to a worker, execution, and result.

Requests and results are plain data, so that workers can be on any machine.
"""

from __future__ import annotations

import tempfile
import threading
import time
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cosim.blocks.component import GET
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.shared_code import SharedCode
from cosim.core.arrays import Array
from cosim.core.errors import CosimError, Crashed, InputError, TimedOut
from cosim.core.scratch import process_folder
from cosim.credibility.validity import validities
from cosim.files.archive import unpack
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
UNKEPT = 1  # runs of a system before its libraries stay loaded
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
    """Request for a run: number, overrides, start values by component, and seed.

    Attributes:
        own_copies: True if the run must load copies of all libraries that no earlier run has used.
    """

    run: int
    overrides: tuple[str, ...] = ()
    starts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    seed: int | None = None
    own_copies: bool = False


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
    """Let `make_run_apart` in this thread use a worker."""
    _of_thread.worker, _of_thread.runs, _of_thread.own_copies = worker, 0, False


def make_run_apart(job: Job, request: RunRequest) -> RunResult:
    """Execute a run in this thread's worker process, so that a crash or an exceeded limit fails only this run."""
    if not hasattr(_of_thread, "worker"):
        work_in(Worker(*SWEEP_MODULES))
    worker: Worker = _of_thread.worker
    own_copies = request.own_copies or _of_thread.own_copies
    try:
        watch = replace(job.watch, spent=[0.0])
        result: RunResult = worker.call(make_run, job, replace(request, own_copies=own_copies), watch=watch)
        _of_thread.runs += 1
    except CosimError as error:
        runs, _of_thread.runs = _of_thread.runs, 0
        if own_copies or runs < UNKEPT or not isinstance(error, Crashed | TimedOut):
            return _failed(job, request, error)
        result = make_run_apart(job, replace(request, own_copies=True))  # libraries that stayed loaded may be the cause
        _of_thread.own_copies = result.status == "ok"
    return result


def make_run(job: Job, request: RunRequest) -> RunResult:
    """Execute a run in this process; the result of a failed run contains the reason."""
    try:
        swept = assemble(job.scenario, (*job.overrides, *request.overrides))
        swept.keeps &= not request.own_copies
        results = swept.simulate(request, job.watch.limits)
    except StoppedRun as stop:
        if _is_stop(stop):
            raise KeyboardInterrupt from None
        return _failed(job, request, stop.error)
    except CosimError as error:
        if isinstance(error, SharedCode) and hasattr(here, "progress"):
            raise  # another process repeats the run
        return _failed(job, request, error)
    scenario = swept.scenario
    if len(results.time) <= scenario.steps:
        return _failed(job, request, f"it ended at t = {results.time[-1]:g} s")
    validity = validities((stage.component for stage in swept.system.stages), results)
    criteria = evaluate(scenario, results, validity)
    values = [np.nan if c["value"] is None else float(c["value"]) for c in criteria]
    columns = [results.columns.index(name) for name in job.signals]
    signals = np.ascontiguousarray(results.values[np.ix_(sampled_rows(scenario.steps, job.samples), columns)].T)
    shares = {name: entry["share"] for name, entry in validity.items() if entry.get("share") is not None}
    return RunResult(request.run, "ok", values, [bool(c["met"]) for c in criteria], signals, shares)


class SweptSystem:
    """A system that a process simulates many times.

    Loading may take longer than a run, so libraries stay loaded from the second run on. Each run has new instances, but
    a library may keep state of earlier runs. The third run is therefore repeated with new copies of the libraries: if a
    number differs, or if a run with loaded libraries fails, each run loads new copies.

    Attributes:
        keeps: True if libraries stay loaded.
    """

    def __init__(self, path: Path, overrides: tuple[str, ...]) -> None:
        file = ScenarioFile(path, overrides, option="")
        self.scenario, self.system = file.scenario, build_system(file)
        blocks = [s.component for s in self.system.stages if isinstance(s.component, FmuBlock)]
        # FMUs of FMI 1.0, and FMUs that allow one instance per process, cannot be instantiated again.
        single = any(getattr(b.instance.about, "canBeInstantiatedOnlyOncePerProcess", False) for b in blocks)
        self.keeps = not single and not self.system.apart and all(b.instance.version > 1 for b in blocks)
        self._uses = 0
        self._is_checked = False
        self._kept: dict[str, FmuBlock] = {}
        weakref.finalize(self, _unload, self._kept).atexit = False

    def simulate(self, request: RunRequest, limits: Limits) -> Results:
        """Simulate one run.

        Raises:
            StoppedRun: A component failed.
            CosimError: An FMU does not load.
        """
        self._uses += 1
        begin, has_kept = time.perf_counter(), bool(self._kept)
        try:
            results = self._simulate(request, limits)
        except (StoppedRun, CosimError) as error:
            _unload(self._kept)
            if not has_kept or _is_stop(error):
                raise
            self.keeps = False
            return self.simulate(request, limits)
        if self._uses == UNKEPT and limits.total is not None:  # the limit applies to a run, including its repetition
            self.keeps &= 4.0 * (time.perf_counter() - begin) < limits.total
        if not has_kept or self._is_checked:
            return results
        self._is_checked, self.keeps = True, False
        again = self._simulate(request, limits, own_copies=True)
        self.keeps = again.values.tobytes() == results.values.tobytes() and again.exact == results.exact
        if not self.keeps:
            _unload(self._kept)
        return again

    def _simulate(self, request: RunRequest, limits: Limits, *, own_copies: bool = False) -> Results:
        system, scenario = self.system, self.scenario
        stages = []
        for stage in system.stages:
            component = stage.component
            if isinstance(component, FmuBlock):
                starts = {**component.start_values, **request.starts.get(component.name, {})}
                if component.name in self._kept and not own_copies:
                    component = self._kept[component.name]
                    component.start_values = starts
                    component.log.restore(NO_MESSAGES)
                else:
                    # Instances in Python share only code; other libraries may keep state of an earlier run.
                    place = _unpack_once(component.path) if component.nominal_step else None
                    component = component.with_start_values(starts, place)
                    if self.keeps and self._uses > UNKEPT and not own_copies:
                        component.instance.keeps_library = True
                        self._kept[component.name] = component
            stages.append(replace(stage, component=component))
        system = replace(system, stages=tuple(stages), seed=system.seed if request.seed is None else request.seed)
        rows = Rows.in_memory(scenario.steps + 1, len(system.columns))
        progress = getattr(here, "progress", None)
        if progress is not None:
            progress.made[0] = 0  # resets the count of the previous run
            rows = replace(rows, made=progress.made, doing=progress.doing)
            system = in_own_processes(system, limits)
            for stage in system.stages:
                here.share_log(stage.component)
        return simulate(system, scenario.steps, scenario.step, rows=rows)


def _is_stop(error: StoppedRun | CosimError) -> bool:
    """Return True if a run was stopped from the keyboard."""
    return (error.error if isinstance(error, StoppedRun) else error).exit_code == 130


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


@cache
def _unpack_once(path: Path) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="fmu-", dir=process_folder()))
    unpack(path, folder)
    return folder


def _failed(job: Job, request: RunRequest, reason: CosimError | str) -> RunResult:
    """Return the result of a failed run, with the first of several faults."""
    text = " ".join(str(reason.faults[0] if isinstance(reason, InputError) else reason).split())
    return RunResult(request.run, text, [np.nan] * job.criteria, [False] * job.criteria, np.empty((0, 0)))


@cache
def sampled_rows(steps: int, samples: int) -> list[int]:
    """Return the numbers of evenly spaced rows to record, including the first and the last."""
    count = min(samples, steps + 1)
    return np.unique(np.rint(np.linspace(0, steps, count)).astype(int)).tolist()  # type: ignore[no-any-return]
