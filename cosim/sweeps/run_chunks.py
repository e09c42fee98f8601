"""Runs of a sweep inside a worker: on arrays at once, or through FMUs in sequence.

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
from cosim.base.errors import CosimError, SimulationError
from cosim.blocks.fmu import FmuBlock
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.rows import GET, Rows
from cosim.isolation.watch import Watch, fmi_calls
from cosim.master.master import StoppedRun, simulate
from cosim.scenario.controller_design import designed_values
from cosim.scenario.scenario import Scenario
from cosim.scenario.scenario_file import ScenarioFile
from cosim.scenario.start_values import Misfit, typed
from cosim.simulation.criteria import evaluate
from cosim.storage.results import Results
from cosim.sweeps.batch import Batch, Starts, kinds_of, most_at_once
from cosim.sweeps.twins import unpacked
from cosim.system.system import System, build_system

Way = Literal["arrays", "fmus"]
MOST_ROWS = 2000  # compared rows of a run
DESIGN = "design."
SYSTEMS = 16  # assembled systems cached per worker


@dataclass(frozen=True)
class Watched:
    """Component names, FMI call names, start and step [s], and row size [bytes]."""

    components: tuple[str, ...] = ()
    calls: tuple[tuple[str, ...], ...] = ()
    start: float = 0.0
    step: float = 0.0
    width: int = 0

    @classmethod
    def of(cls, system: System, step: float) -> Watched:
        """Return the description of a system."""
        blocks = [stage.component for stage in system.stages]
        calls = tuple(tuple(fmi_calls(getattr(b, "description", None))) for b in blocks)
        return cls(tuple(b.name for b in blocks), calls, system.start, step, 8 * len(system.columns))

    def watch(self, limits: Limits | None) -> Watch:
        """Return the watch for a call that makes runs in sequence."""
        return Watch(self.components, self.calls, self.time, limits or Limits(), self.width)

    def time(self, made: int, call: int) -> float:
        """Return the simulated time [s] of the current run."""
        return self.start + self.step * (max(0, made - 1) + (call == GET and made > 0))


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
    watched: Watched = field(default_factory=lambda: Watched())


@dataclass(frozen=True)
class Asked:
    """Request for a run: number, overrides, start values by component, and seed."""

    run: int
    overrides: tuple[str, ...] = ()
    starts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    seed: int | None = None


@dataclass(frozen=True)
class Made:
    """Result of a run.

    Attributes:
        status: "ok", or the reason of failure.
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
class _Prepared:
    scenario: Scenario
    system: System

    def with_changes(self, asked: Asked) -> System:
        """Return the system of a run."""
        stages = []
        for stage in self.system.stages:
            component, own = stage.component, asked.starts.get(stage.component.name)
            if isinstance(component, FmuBlock):  # Each run has its own instance.
                # Instances in Python share code only; other libraries may keep state of an earlier run.
                place = unpacked(component.path) if component.nominal_step else None
                component = component.started_from({**component.start_values, **(own or {})}, place)
            stages.append(replace(stage, component=component))
        return replace(self.system, stages=tuple(stages), seed=self._seed(asked))

    def _seed(self, asked: Asked) -> int:
        return self.system.seed if asked.seed is None else asked.seed

    def designed(self, overrides: tuple[str, ...], path: Path) -> Starts | None:
        """Return start values of another design; None if faulty.

        Start values given by the scenario are omitted.

        Args:
            overrides: Overrides of the scenario, including the design.
        """
        file = ScenarioFile(path, overrides, option="")
        values = designed_values(file)
        if file.faults:
            return None
        blocks = {s.component.name: s.component for s in self.system.stages}
        found: dict[str, dict[str, Any]] = {}
        for name, given in values.items():
            block = blocks.get(name)
            own = getattr(file.scenario.components[name], "start", None) or {}
            if not isinstance(block, FmuBlock) or any("[" in variable for variable in own):
                return None
            variables, found[name] = {v.name: v for v in block.description.modelVariables}, {}
            for variable in (v for v in given if v not in own):
                if variable not in variables:
                    return None
                value = typed(block.description, variables[variable], given[variable])
                if isinstance(value, Misfit):
                    return None
                found[name][variable] = value
        return found

    def starts(self, asked: Asked) -> Starts:
        """Return all start values of a run by component."""
        blocks = (s.component for s in self.system.stages)
        return {b.name: {**b.start_values, **asked.starts.get(b.name, {})} for b in blocks if isinstance(b, FmuBlock)}


@lru_cache(maxsize=SYSTEMS)
def prepared(path: Path, overrides: tuple[str, ...]) -> _Prepared:
    """Return an assembled scenario; raise InputError for faults."""
    file = ScenarioFile(path, overrides, option="")
    system = build_system(file, designed_values(file))
    return _Prepared(file.scenario, system)


def sampled_rows(steps: int, samples: int) -> list[int]:
    """Return evenly spaced rows to record, including both ends."""
    count = min(samples, steps + 1)
    return np.unique(np.rint(np.linspace(0, steps, count)).astype(int)).tolist()  # type: ignore[no-any-return]


def make_runs(job: Job, asked: Sequence[Asked], way: Way) -> list[Made]:
    """Make runs; a failed run reports its reason and affects no other."""
    found: list[Made] = []
    groups: dict[tuple[str, ...], list[Asked]] = {}
    for one in _designed(job, asked) if way == "arrays" else asked:  # FMUs run with the scenario of each request.
        groups.setdefault(one.overrides, []).append(one)
    for overrides, members in groups.items():
        try:
            system = prepared(job.scenario, (*job.overrides, *overrides))
        except CosimError as error:
            found += [_failed(job, None, one, str(error).splitlines()[0], way) for one in members]
            continue
        found += _at_once(job, system, members) if way == "arrays" else [_by_fmus(job, system, one) for one in members]
    return sorted(found, key=lambda m: m.run)


def _designed(job: Job, asked: Sequence[Asked]) -> list[Asked]:
    """Return requests with designs converted to start values.

    Runs that differ only in start values are made at once.
    """
    found, known = [], dict[tuple[str, ...], Starts | None]()
    for one in asked:
        design = tuple(o for o in one.overrides if o.startswith(DESIGN))
        rest = tuple(o for o in one.overrides if not o.startswith(DESIGN))
        if design and not any(o.startswith(f"{DESIGN}component=") for o in design):
            if one.overrides not in known:
                try:
                    base = prepared(job.scenario, (*job.overrides, *rest))
                    known[one.overrides] = base.designed((*job.overrides, *one.overrides), job.scenario)
                except CosimError:  # Each run reports the error itself.
                    known[one.overrides] = None
            designed = known[one.overrides]
            if designed is not None:
                starts = {
                    name: {**designed.get(name, {}), **one.starts.get(name, {})} for name in (*designed, *one.starts)
                }
                one = replace(one, overrides=rest, starts=starts)
        found.append(one)
    return found


def _at_once(job: Job, prepared: _Prepared, asked: Sequence[Asked]) -> list[Made]:
    """Make runs on arrays, and unsuitable or non-finite runs through FMUs."""
    kinds = kinds_of(prepared.system)
    if isinstance(kinds, str):
        return [_by_fmus(job, prepared, one) for one in asked]
    columns = _needed(job, prepared)
    places = [prepared.system.columns.index(c) for c in columns]
    steps, h = prepared.scenario.steps, prepared.scenario.step
    batch = Batch(prepared.system, kinds, steps, h, job.compiled)
    most = most_at_once(prepared.system, steps, len(columns))
    found: list[Made] = []
    for first in range(0, len(asked), most):
        some = asked[first : first + most]
        starts, seeds = [prepared.starts(one) for one in some], [prepared._seed(one) for one in some]
        try:
            table = batch.run(starts, seeds, places)
        except Exception:  # A user's model may raise any error on arrays.
            found += [_by_fmus(job, prepared, one) for one in some]
            continue
        time = prepared.system.start + h * np.arange(steps + 1, dtype=np.float64)
        finite = [bool(np.isfinite(table[:, :, k]).all()) for k in range(len(some))]
        for k, one in enumerate(some):
            if finite[k]:
                values = np.ascontiguousarray(table[:, :, k])
                results = Results(time, columns, values, prepared.system.units)
                found.append(_make_row(job, prepared, one, results, "arrays"))
            else:
                found.append(_by_fmus(job, prepared, one))
    return found


def _by_fmus(job: Job, prepared: _Prepared, one: Asked) -> Made:
    """Make a run through the FMUs in this process."""
    system = prepared.with_changes(one)
    steps, h = prepared.scenario.steps, prepared.scenario.step
    progress = getattr(here, "progress", None)
    rows = Rows.in_memory(steps + 1, len(system.columns))
    if progress is not None:
        progress.made[0] = 0  # clears the count of the previous run
        rows = replace(rows, made=progress.made, doing=progress.doing)
        for stage in system.stages:
            here.share_log(stage.component)
    try:
        results = simulate(system, steps, h, rows=rows)
    except StoppedRun as stopped:
        if stopped.error.exit_code == 130:
            raise KeyboardInterrupt from None
        return _failed(job, prepared, one, str(stopped.error), "fmus")
    except CosimError as error:
        return _failed(job, prepared, one, str(error), "fmus")
    if len(results.time) <= steps:
        return _failed(job, prepared, one, f"it ended at t = {results.time[-1]:g} s", "fmus")
    return _make_row(job, prepared, one, results, "fmus")


def _needed(job: Job, prepared: _Prepared) -> tuple[str, ...]:
    """Return the recorded columns and those used by criteria."""
    if job.whole:
        return prepared.system.columns
    ends = (end for _, _, c in prepared.scenario.goals for end in (c.of, c.to) if isinstance(end, str))
    return tuple(dict.fromkeys((*job.signals, *ends)))


def _make_row(job: Job, prepared: _Prepared, one: Asked, results: Results, way: Way) -> Made:
    judged = evaluate(prepared.scenario, results)
    values = tuple(np.nan if c["value"] is None else float(c["value"]) for c in judged)
    rows = sampled_rows(len(results.time) - 1, MOST_ROWS if job.whole else job.samples)
    names = prepared.system.columns if job.whole else job.signals
    signals = np.array([results[name][rows] for name in names])
    return Made(one.run, "ok", values, tuple(bool(c["met"]) for c in judged), signals, way)


def _failed(job: Job, prepared: _Prepared | None, one: Asked, why: str, way: Way) -> Made:
    goals = 0 if prepared is None else len(prepared.scenario.goals)
    return failed(one.run, why, goals, way)


def failed(run: int, why: str, goals: int, way: Way) -> Made:
    """Return the result of a failed run."""
    return Made(run, " ".join(why.split()), (np.nan,) * goals, (False,) * goals, np.empty((0, 0)), way)


def error_of(error: BaseException) -> str:
    """Return the message of an error that ended a run's process."""
    return str(error) if isinstance(error, SimulationError) else f"{type(error).__name__}: {error}"
