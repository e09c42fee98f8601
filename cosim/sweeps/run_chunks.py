"""Runs of a sweep as a worker makes them: at once on arrays, or one after the other through the FMUs.

What is asked and what comes back is plain data, so that a worker may be anywhere.
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
MOST_ROWS = 2000  # of a run that are compared with another's
DESIGN = "design."
SYSTEMS = 16  # that a worker keeps put together


@dataclass(frozen=True)
class Watched:
    """Names of the components in order, FMI's names of their calls; start and step [s], bytes of a row."""

    components: tuple[str, ...] = ()
    calls: tuple[tuple[str, ...], ...] = ()
    start: float = 0.0
    step: float = 0.0
    width: int = 0

    @classmethod
    def of(cls, system: System, step: float) -> Watched:
        """A system."""
        blocks = [stage.component for stage in system.stages]
        calls = tuple(tuple(fmi_calls(getattr(b, "description", None))) for b in blocks)
        return cls(tuple(b.name for b in blocks), calls, system.start, step, 8 * len(system.columns))

    def watch(self, limits: Limits | None) -> Watch:
        """For a call that makes runs one after the other."""
        return Watch(self.components, self.calls, self.time, limits or Limits(), self.width)

    def time(self, made: int, call: int) -> float:
        """Simulated time [s] of the run that is being made."""
        return self.start + self.step * (max(0, made - 1) + (call == GET and made > 0))


@dataclass(frozen=True)
class Job:
    """What is the same for all runs: the scenario, what is set over it, signals kept and how many times of each.

    whole:    every signal is kept, at more times: to compare runs made in two ways
    compiled: equations on arrays are compiled, where they can be
    watched:  what the caller of a worker must know to say what a run was doing
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
    """A run: its number, what of the scenario it changes, its start values by component, its seed."""

    run: int
    overrides: tuple[str, ...] = ()
    starts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    seed: int | None = None


@dataclass(frozen=True)
class Made:
    """What is kept of a run.

    status:  "ok", or why it failed
    values:  of each criterion; NaN where there is none (of a settling time: never)
    met:     of each criterion
    signals: shape (signals, samples); NaN where it failed before
    through: how it was made
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
        """The system of one run."""
        stages = []
        for stage in self.system.stages:
            component, own = stage.component, asked.starts.get(stage.component.name)
            if isinstance(component, FmuBlock):  # each run has an instance of its own
                # those in Python share nothing but their code; of others a library may keep what a run left in it
                place = unpacked(component.path) if component.nominal_step else None
                component = component.started_from({**component.start_values, **(own or {})}, place)
            stages.append(replace(stage, component=component))
        return replace(self.system, stages=tuple(stages), seed=self._seed(asked))

    def _seed(self, asked: Asked) -> int:
        return self.system.seed if asked.seed is None else asked.seed

    def designed(self, overrides: tuple[str, ...], path: Path) -> Starts | None:
        """Start values of another design of this scenario, but those that it gives itself; None where it has a fault.

        overrides: of the scenario, its design among them
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
        """Every start value of a run, by component."""
        blocks = (s.component for s in self.system.stages)
        return {b.name: {**b.start_values, **asked.starts.get(b.name, {})} for b in blocks if isinstance(b, FmuBlock)}


@lru_cache(maxsize=SYSTEMS)
def prepared(path: Path, overrides: tuple[str, ...]) -> _Prepared:
    """A scenario put together; InputError."""
    file = ScenarioFile(path, overrides, option="")
    system = build_system(file, designed_values(file))
    return _Prepared(file.scenario, system)


def sampled_rows(steps: int, samples: int) -> list[int]:
    """Which rows are kept of a run of so many steps: evenly spaced, the first and the last among them."""
    count = min(samples, steps + 1)
    return np.unique(np.rint(np.linspace(0, steps, count)).astype(int)).tolist()  # type: ignore[no-any-return]


def made(job: Job, asked: Sequence[Asked], way: Way) -> list[Made]:
    """Make runs; one that fails says why, and no other is touched by it."""
    found: list[Made] = []
    groups: dict[tuple[str, ...], list[Asked]] = {}
    for one in _designed(job, asked) if way == "arrays" else asked:  # through the FMUs each by its own scenario
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
    """Runs that differ in their `design:` as runs that differ in start values, so that they are made at once."""
    found, known = [], dict[tuple[str, ...], Starts | None]()
    for one in asked:
        design = tuple(o for o in one.overrides if o.startswith(DESIGN))
        rest = tuple(o for o in one.overrides if not o.startswith(DESIGN))
        if design and not any(o.startswith(f"{DESIGN}component=") for o in design):
            if one.overrides not in known:
                try:
                    base = prepared(job.scenario, (*job.overrides, *rest))
                    known[one.overrides] = base.designed((*job.overrides, *one.overrides), job.scenario)
                except CosimError:  # told of each run by itself
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
    """On arrays; those that arrays cannot make, or in which values are no numbers, through the FMUs, which say why."""
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
        except Exception:  # whatever a model of somebody's does on arrays
            found += [_by_fmus(job, prepared, one) for one in some]
            continue
        time = prepared.system.start + h * np.arange(steps + 1, dtype=np.float64)
        finite = [bool(np.isfinite(table[:, :, k]).all()) for k in range(len(some))]
        for k, one in enumerate(some):
            if finite[k]:
                values = np.ascontiguousarray(table[:, :, k])
                results = Results(time, columns, values, prepared.system.units)
                found.append(_made(job, prepared, one, results, "arrays"))
            else:
                found.append(_by_fmus(job, prepared, one))
    return found


def _by_fmus(job: Job, prepared: _Prepared, one: Asked) -> Made:
    """Through the FMUs, in this process."""
    system = prepared.with_changes(one)
    steps, h = prepared.scenario.steps, prepared.scenario.step
    progress = getattr(here, "progress", None)
    rows = Rows.in_memory(steps + 1, len(system.columns))
    if progress is not None:
        progress.made[0] = 0  # of the run before
        rows = replace(rows, made=progress.made, doing=progress.doing)
        for stage in system.stages:
            here.overheard(stage.component)
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
    return _made(job, prepared, one, results, "fmus")


def _needed(job: Job, prepared: _Prepared) -> tuple[str, ...]:
    """Columns that are kept, and those at which criteria look."""
    if job.whole:
        return prepared.system.columns
    ends = (end for _, _, c in prepared.scenario.goals for end in (c.of, c.to) if isinstance(end, str))
    return tuple(dict.fromkeys((*job.signals, *ends)))


def _made(job: Job, prepared: _Prepared, one: Asked, results: Results, way: Way) -> Made:
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
    """A run of which nothing is left but why."""
    return Made(run, " ".join(why.split()), (np.nan,) * goals, (False,) * goals, np.empty((0, 0)), way)


def error_of(error: BaseException) -> str:
    """What is told of a run whose process ended."""
    return str(error) if isinstance(error, SimulationError) else f"{type(error).__name__}: {error}"
