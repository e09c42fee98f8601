"""Computation of a sweep's runs in a worker: all at once on arrays, or one after the other through FMUs.

Requests and results are plain data, so that workers may run anywhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import CosimError, InputError
from cosim.base.messages import Message, code_of
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.shared_code import SharedCode
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.rows import GET, Rows
from cosim.isolation.watch import Watch, fmi_calls
from cosim.master.master import StoppedRun, simulate
from cosim.master.own_process import in_own_processes
from cosim.scenario.scenario import Scenario
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.criteria import evaluate
from cosim.storage.results import Results
from cosim.sweeps.batch import Batch, Starts, kinds_of, max_runs_at_once
from cosim.sweeps.twins import unpack_once
from cosim.system.system import System, build_system

Way = Literal["arrays", "fmus"]
MAX_COMPARED_ROWS = 2000  # compared rows of a run
CACHED_SYSTEMS = 16  # assembled systems cached per worker


@dataclass(frozen=True)
class WatchSettings:
    """Component names, FMI call names, start and step [s], and row size [bytes]."""

    components: tuple[str, ...] = ()
    calls: tuple[tuple[str, ...], ...] = ()
    start: float = 0.0
    step: float = 0.0
    width: int = 0

    @classmethod
    def of(cls, system: System, step: float) -> WatchSettings:
        """Return the settings for watching runs of a system with communication step `step` [s]."""
        blocks = [stage.component for stage in system.stages]
        calls = tuple(tuple(fmi_calls(getattr(b, "description", None))) for b in blocks)
        return cls(tuple(b.name for b in blocks), calls, system.start, step, 8 * len(system.columns))

    def watch(self, limits: Limits | None) -> Watch:
        """Return the watch for a call that makes runs in sequence."""
        return Watch(self.components, self.calls, self.time, limits or Limits(), self.width)

    def time(self, rows: int, call: int) -> float:
        """Return the simulated time [s] of the current run."""
        return self.start + self.step * (max(0, rows - 1) + (call == GET and rows > 0))


@dataclass(frozen=True)
class Job:
    """Common settings of all runs: scenario, overrides, and recorded signals with sample count.

    Attributes:
        whole: Whether all signals are recorded at more times, to compare two ways of running.
        compiled: Whether equations on arrays are compiled if possible.
        watched: Data for messages about a stopped worker.
    """

    scenario: Path
    overrides: tuple[str, ...]
    signals: tuple[str, ...]
    samples: int
    whole: bool = False
    compiled: bool = True
    watched: WatchSettings = field(default_factory=WatchSettings)


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
        status: "ok", or the reason of failure, a `Message`.
        values: Values of the criteria, NaN if undefined, e.g. for a settling time never reached.
        met: Outcomes of the criteria.
        signals: Shape (signals, samples), empty after a failure.
        through: Way of running.
    """

    run: int
    status: str
    values: tuple[float, ...]
    met: tuple[bool, ...]
    signals: Array
    through: Way


@dataclass(frozen=True)
class _AssembledScenario:
    scenario: Scenario
    system: System

    def with_changes(self, request: RunRequest) -> System:
        """Return the system with the start values and the seed of one run."""
        stages = []
        for stage in self.system.stages:
            component, own = stage.component, request.starts.get(stage.component.name)
            if isinstance(component, FmuBlock):  # Each run has its own instance.
                # Instances in Python share code only; other libraries may keep state of an earlier run.
                place = unpack_once(component.path) if component.nominal_step else None
                component = component.with_start_values({**component.start_values, **(own or {})}, place)
            stages.append(replace(stage, component=component))
        return replace(self.system, stages=tuple(stages), seed=self.seed_of(request))

    def seed_of(self, request: RunRequest) -> int:
        """Return the seed of a run."""
        return self.system.seed if request.seed is None else request.seed

    def starts(self, request: RunRequest) -> Starts:
        """Return all start values of a run by component."""
        blocks = [s.component for s in self.system.stages if isinstance(s.component, FmuBlock)]
        return {b.name: {**b.start_values, **request.starts.get(b.name, {})} for b in blocks}


@lru_cache(maxsize=CACHED_SYSTEMS)
def assemble(path: Path, overrides: tuple[str, ...]) -> _AssembledScenario:
    """Return an assembled scenario; raise InputError for faults."""
    file = ScenarioFile(path, overrides, option="")
    return _AssembledScenario(file.scenario, build_system(file))


def sampled_rows(steps: int, samples: int) -> list[int]:
    """Return evenly spaced rows to record, including both ends."""
    count = min(samples, steps + 1)
    return np.unique(np.rint(np.linspace(0, steps, count)).astype(int)).tolist()  # type: ignore[no-any-return]


def make_runs(job: Job, requests: Sequence[RunRequest], way: Way) -> list[RunResult]:
    """Make runs; a failed run reports its reason and affects no other."""
    results: list[RunResult] = []
    groups: dict[tuple[str, ...], list[RunRequest]] = {}
    for request in requests:
        groups.setdefault(request.overrides, []).append(request)
    for overrides, members in groups.items():
        try:
            assembled = assemble(job.scenario, (*job.overrides, *overrides))
        except CosimError as error:
            results += [failed_run(request.run, _first_reason(error), 0, way) for request in members]
            continue
        if way == "arrays":
            results += _run_arrays(job, assembled, members)
        else:
            results += [_run_fmus(job, assembled, request) for request in members]
    return sorted(results, key=lambda m: m.run)


def _run_arrays(job: Job, assembled: _AssembledScenario, requests: Sequence[RunRequest]) -> list[RunResult]:
    """Make runs on arrays, and unsuitable or non-finite runs through FMUs."""
    system, scenario = assembled.system, assembled.scenario
    kinds = kinds_of(system)
    if isinstance(kinds, str):
        return [_run_fmus(job, assembled, request) for request in requests]
    columns = _columns(job, assembled)
    places = [system.columns.index(c) for c in columns]
    batch = Batch(system, kinds, scenario.steps, scenario.step, job.compiled)
    size = max_runs_at_once(system, scenario.steps, len(columns))
    time = system.start + scenario.step * np.arange(scenario.steps + 1, dtype=np.float64)
    results: list[RunResult] = []
    for first in range(0, len(requests), size):
        part = requests[first : first + size]
        starts, seeds = [assembled.starts(r) for r in part], [assembled.seed_of(r) for r in part]
        try:
            table = batch.run(starts, seeds, places)
        except Exception:  # A user's model may raise any error on arrays.
            table = np.full((1, 1, len(part)), np.nan)
        for k, request in enumerate(part):
            values = np.ascontiguousarray(table[:, :, k])
            if np.isfinite(values).all():
                rows = Results(time, columns, values, system.units)
                results.append(_make_result(job, assembled, request, rows, "arrays"))
            else:
                results.append(_run_fmus(job, assembled, request))
    return results


def _run_fmus(job: Job, assembled: _AssembledScenario, request: RunRequest) -> RunResult:
    """Make one run through the FMUs in this process and return its result."""
    system, scenario = assembled.with_changes(request), assembled.scenario
    progress = getattr(here, "progress", None)
    rows = Rows.in_memory(scenario.steps + 1, len(system.columns))
    if progress is not None:
        progress.made[0] = 0  # clears the count of the previous run
        rows = replace(rows, made=progress.made, doing=progress.doing)
        system = in_own_processes(system, scenario.limits or Limits())
        for stage in system.stages:
            here.share_log(stage.component)
    try:
        results = simulate(system, scenario.steps, scenario.step, rows=rows)
    except StoppedRun as stop:
        if stop.error.exit_code == 130:
            raise KeyboardInterrupt from None
        reason = str(stop.error)
    except CosimError as error:
        if isinstance(error, SharedCode) and progress is not None:
            raise  # Another process makes the run.
        reason = str(error)
    else:
        if len(results.time) > scenario.steps:
            return _make_result(job, assembled, request, results, "fmus")
        reason = f"it ended at t = {results.time[-1]:g} s"
    return failed_run(request.run, reason, len(scenario.goals), "fmus")


def _columns(job: Job, assembled: _AssembledScenario) -> tuple[str, ...]:
    """Return the recorded columns and those used by criteria."""
    if job.whole:
        return assembled.system.columns
    ends = (end for _, _, c in assembled.scenario.goals for end in (c.of, c.to) if isinstance(end, str))
    return tuple(dict.fromkeys((*job.signals, *ends)))


def _make_result(job: Job, assembled: _AssembledScenario, request: RunRequest, results: Results, way: Way) -> RunResult:
    criteria = evaluate(assembled.scenario, results)
    values = tuple(np.nan if c["value"] is None else float(c["value"]) for c in criteria)
    rows = sampled_rows(len(results.time) - 1, MAX_COMPARED_ROWS if job.whole else job.samples)
    names = assembled.system.columns if job.whole else job.signals
    signals = np.array([results[name][rows] for name in names])
    return RunResult(request.run, "ok", values, tuple(bool(c["met"]) for c in criteria), signals, way)


def _first_reason(error: CosimError) -> str:
    """Return the message of an error, of several faults that of the first."""
    return str(error.faults[0] if isinstance(error, InputError) else error)


def failed_run(run: int, reason: str, criteria: int, way: Way) -> RunResult:
    """Return the result of a failed run; its status keeps the code of the reason."""
    status = Message(" ".join(reason.split()), code_of(reason))
    return RunResult(run, status, (np.nan,) * criteria, (False,) * criteria, np.empty((0, 0)), way)
