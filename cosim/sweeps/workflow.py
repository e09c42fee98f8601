"""`cosim sweep`, in order: file → design → check of arrays against FMUs → runs → sweep.parquet, sweep.json, report."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.drafts import is_full
from cosim.base.errors import DiskFull, InputError, SweepFailed, SweepStopped, Terminated
from cosim.base.extras import optional
from cosim.base.messages import Message, Note, code_of
from cosim.base.settings import Count
from cosim.base.text import counted, plain
from cosim.base.version import __version__
from cosim.isolation.limits import Limits
from cosim.scenario.scenario import Criterion
from cosim.storage.files import FilePath, atomic_write, check_writable, delay_stops, hold_stops, one_stop
from cosim.storage.folders import SCHEMA_VERSION, content_of, new_run, newest_run, remove_earlier, runs_named
from cosim.sweeps import messages
from cosim.sweeps.batch import obstacle_to_arrays
from cosim.sweeps.reading import Sweep, read_sweep
from cosim.sweeps.run_chunks import MAX_COMPARED_ROWS, Job, RunResult, Way, sampled_rows
from cosim.sweeps.run_statistics import share_interval
from cosim.sweeps.store import CHECKS, DATABASE, RUNS, TABLE, Database, read_table, write_table
from cosim.sweeps.sweep_result import EQUAL, Swept, criterion_names, largest_difference
from cosim.sweeps.workers import AHEAD, Chunk, Executor, dask_client, executor, fault_maker

RECORD, REPORT = "sweep.json", "report.html"
REPEATED = 20  # random runs repeated through FMUs
# runs per job; fixed, so that results do not depend on the workers
CHUNK: Mapping[Way, int] = {"arrays": 512, "fmus": 8}
MAX_LISTED_FAILURES = 20
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class CriterionLimit:
    """Name of a criterion, its largest allowed value and the unit."""

    name: str
    max: float
    unit: str


class RunsObserver:
    """Base class of observers that receive the finished runs of a sweep; methods are optional."""

    def begin(self, title: str, count: int, limits: Sequence[CriterionLimit], earlier: Iterable[RunResult]) -> None:
        """Prepare for `count` runs, some of which an earlier call has made."""

    def add(self, results: Sequence[RunResult]) -> None:
        """Take finished runs."""


@one_stop()
def sweep(
    path: FilePath,
    out: FilePath | None = None,
    *,
    workers: Count | None = None,
    dask: str | None = None,
    report: bool = True,
    force: bool = False,
    resume: bool = False,
    in_process: bool = False,
    progress: Progress | None = None,
    observers: Sequence[RunsObserver] = (),
) -> Swept:
    """Run a scenario many times with varied values.

    Args:
        path: Sweep file.
        out: Folder for sweep.parquet, sweep.json and report.html; None means a new number in results/NAME.
        workers: Number of worker processes; None means one per core.
        dask: Address of a Dask scheduler; replaces that of the file.
        report: Write report.html.
        force: Start again, even if `out` has files; those of an earlier sweep are replaced.
        resume: Go on with the sweep that was stopped in `out`, by default the newest in results/NAME.
        in_process: Load FMUs into this process, for a debugger.
        progress: Function of (completed runs, all runs).
        observers: Objects that receive the finished runs.

    Returns:
        Content of sweep.json, sentences and the folder.

    Raises:
        InputError: Every fault, before the first run.
        FmuError: An FMU cannot be read or loaded.
        SweepStopped: The sweep was stopped from the keyboard; `resume` goes on with it.
        SweepFailed: No run was completed.
    """
    study = read_sweep(Path(path), loads=True)
    if resume:
        out = newest_run(runs_named(study.name)) if out is None else newest_run(Path(out))
    inputs = [study.yaml.path, study.job.scenario, *(fmu for fmu, _ in study.system.fmus.values())]
    address = study.file.dask if dask is None else dask
    for library in ("pyarrow", "SALib"):  # missing libraries are reported before any run
        optional(library, "cosim sweep")
    with ExitStack() as stack:
        folder = stack.enter_context(new_run(out, study.name, "cosim sweep", force=force, goes_on=resume))
        check_writable(folder, (TABLE, RECORD, REPORT, DATABASE), inputs)
        client = stack.enter_context(dask_client(address, fault_maker(study.yaml, dask)))
        if not resume:
            remove_earlier(folder, "cosim sweep", read=inputs)
        record, count = _read_completed(folder, study.key), 0
        if record is None:
            base = stack.enter_context(Database(folder, study.key))
            state = _Sweep(study, folder, base, progress, observers)
            record, count = state.make_runs(workers, client, in_process=in_process)
        swept = Swept(study, folder, record, count)
        if report:
            from cosim.sweeps.report import page

            with atomic_write(folder / REPORT) as stream:
                stream.write(page(swept))
    if record["failed"] == record["runs"]:
        first = record["failures"][0]
        reason = Message(first["why"], first.get("code", ""))
        raise SweepFailed(f"all {counted(study.count, 'run')} failed; run 0: {reason}")
    return swept


def _read_completed(folder: Path, key: str) -> dict[str, Any] | None:
    """Return the record of the same sweep if it is complete in this folder; raise InputError for a different sweep."""
    try:
        _, about = read_table(folder / TABLE)
    except (OSError, ValueError):
        return None
    if not (record := content_of(folder / RECORD)):
        return None
    if about.get("key") != key:
        raise InputError.at(
            folder / TABLE,
            "holds another sweep, or one of other FMUs; give another folder as --out, or begin anew by --force",
        )
    return record


class _Sweep:
    """State of a call: finished and pending runs."""

    def __init__(
        self,
        study: Sweep,
        folder: Path,
        base: Database,
        progress: Progress | None,
        observers: Sequence[RunsObserver] = (),
    ) -> None:
        self.study, self.folder, self.base, self.progress = study, folder, base, progress
        self.observers = observers
        self.seconds = 0.0
        self.count = 0

    def make_runs(self, workers: int | None, client: Any, *, in_process: bool) -> tuple[dict[str, Any], int]:
        """Return the record and the number of new runs."""
        for observer in self.observers:
            observer.begin(self.study.name, self.study.count, self._limits(), self.base.runs())
        try:
            with executor(workers, client, in_process=in_process) as pool:
                way, why = self._choose_way(pool)
                earlier, begin = len(self.base.numbers()), time.perf_counter()
                for count in self._store_runs(pool, range(self.study.count), way, self.study.job, RUNS):
                    self.count += count
                    if self.progress is not None:
                        self.progress(earlier + self.count, self.study.count)
                self.seconds = time.perf_counter() - begin
                hold_stops()  # The table must still be written.
        except (KeyboardInterrupt, Terminated) as stop:
            stored, runs = len(self.base.numbers()), counted(self.study.count, "run")
            error = SweepStopped(
                f"stopped: {stored} of {runs} are kept in {self.base.path}; `--resume` goes on with them"
            )
            if isinstance(stop, Terminated):
                error.exit_code = Terminated.exit_code
            raise error from None
        except OSError as error:
            if not is_full(error):
                raise
            stored, runs = len(self.base.numbers()), counted(self.study.count, "run")
            full = SweepStopped(
                f"the disk is full: {stored} of {runs} are kept in {self.base.path}; make room, and the same "
                "command goes on with them"
            )
            full.exit_code = DiskFull.exit_code
            raise full from None
        record = self._record(way, why)
        names, signals = [c["name"] for c in record["criteria"]], self.study.job.signals
        about = {"key": self.study.key, "times": record["times"], "units": record["units"], "signals": signals}
        write_table(self.folder / TABLE, self.base.runs(), self.study.columns, names, signals, about)
        with atomic_write(self.folder / RECORD) as stream:
            json.dump(record, stream, indent=1, ensure_ascii=False, allow_nan=False)
            stream.write("\n")
        self.base.remove()
        return record, self.count

    def _choose_way(self, pool: Executor) -> tuple[Way, str]:
        """Return the way of running, and why not arrays.

        Arrays are used if random runs agree with FMU runs.
        """
        way: Way
        if (stored := self.base.get("way")) is not None:
            way, why = json.loads(stored)
            return way, why
        why = str(pool.ask(obstacle_to_arrays, self.study.system))
        way = "fmus" if why else "arrays"
        if way == "arrays":
            rng = np.random.default_rng([self.study.file.seed, 0xC4EC])
            chosen = rng.choice(self.study.count, min(REPEATED, self.study.count), replace=False)
            repeated, job = sorted(chosen.tolist()), replace(self.study.job, whole=True)
            for _ in self._store_runs(pool, repeated, "fmus", job, CHECKS):
                pass
            future = pool.submit(self._chunk(job, repeated, "arrays"))
            pairs = zip(pool.runs(next(iter(pool.wait({future})[0]))), self.base.runs(CHECKS), strict=True)
            difference = max((largest_difference(a, b) for a, b in pairs), default=0.0)
            if not difference <= EQUAL:
                way, why = (
                    "fmus",
                    f"runs from the FMUs' equations are {plain(difference, 2)} apart from those through the FMUs",
                )
        self.base.put("way", json.dumps([way, why]))
        return way, why

    def _chunk(self, job: Job, runs: Iterable[int], way: Way, limits: Limits | None = None) -> Chunk:
        requests = [self.study.request_run(run) for run in runs]
        return Chunk(job, requests, way, limits, len(self.study.scenario.goals))

    def _store_runs(self, pool: Executor, runs: Iterable[int], way: Way, job: Job, table: str) -> Iterator[int]:
        """Make the missing runs of a table in chunks. Yields the number of stored runs after each wait."""
        stored = self.base.numbers(table)
        limits = self.study.scenario.limits if way == "fmus" else None
        size = 1 if limits is not None else CHUNK[way]
        chunks = itertools.groupby((run for run in runs if run not in stored), lambda run: run // size)
        waiting, pending = [[*chunk] for _, chunk in chunks][::-1], set[Any]()
        while waiting or pending:
            while waiting and len(pending) < pool.count + AHEAD:
                pending.add(pool.submit(self._chunk(job, waiting.pop(), way, limits)))
            finished, pending = pool.wait(pending)
            count = 0
            for future in finished:
                results = pool.runs(future)
                with delay_stops():
                    self.base.add(results, table)
                for observer in self.observers if table == RUNS else ():
                    observer.add(results)
                count += len(results)
            yield count

    def _limits(self) -> list[CriterionLimit]:
        """Return the limits of all criteria."""
        names, goals = criterion_names(self.study), self.study.scenario.goals
        return [
            CriterionLimit(name, goal.max, _unit(kind, goal, self.study))
            for name, (kind, _, goal) in zip(names, goals, strict=True)
        ]

    def _record(self, way: Way, why: str) -> dict[str, Any]:
        study, scenario = self.study, self.study.scenario
        count = through = failed = met_all = 0
        failures: list[dict[str, Any]] = []
        met = np.zeros(len(scenario.goals), int)
        for m in self.base.runs():
            count, through = count + 1, through + (m.through == "fmus")
            if m.status == "ok":
                met += np.array(m.met, int)
                met_all += all(m.met)
            else:
                failed += 1
                if failed <= MAX_LISTED_FAILURES:
                    failures.append({"run": m.run, "why": m.status, "code": code_of(m.status)})
        rows = sampled_rows(scenario.steps, study.job.samples)
        return {
            "schema_version": SCHEMA_VERSION,
            "cosim_version": __version__,
            "name": study.name,
            "key": study.key,
            "sweep": json.loads(study.file.model_dump_json(by_alias=True, exclude_none=True)),
            "scenario": study.resolved,
            "runs": count,
            "failed": failed,
            "met_all": met_all,
            "failures": failures,
            "way": way,
            "why": why,
            "through_fmus": through,
            "runs_a_second": float(f"{self.count / self.seconds:.3g}") if self.count else None,
            "check": self._compare_ways(count, way, why),
            "warnings": list(study.warnings),
            "times": [scenario.start_time + scenario.step * k for k in rows],
            "units": {name: study.system.units.get(name, "") for name in study.job.signals},
            "criteria": [
                {
                    "name": limit.name,
                    "max": limit.max,
                    "unit": limit.unit,
                    "met": hits,
                    "of": count - failed,
                    "ci95": [*share_interval(hits, count - failed)],
                }
                for limit, hits in zip(self._limits(), met.tolist(), strict=True)
            ],
        }

    def _compare_ways(self, count: int, way: Way, why: str) -> dict[str, Any]:
        """Return the comparison of array runs with FMU runs."""
        if way == "fmus":
            sentence = Note(f"every run was made through the FMUs{f': {why}' if why else ''}")
            return {"runs": count, "apart": 0.0, "agrees": True, "sentence": sentence}
        checks, steps = {m.run: m for m in self.base.runs(CHECKS)}, self.study.scenario.steps
        columns = [self.study.system.columns.index(name) for name in self.study.job.signals]
        own, others = sampled_rows(steps, self.study.job.samples), sampled_rows(steps, MAX_COMPARED_ROWS)
        common = sorted({*own} & {*others})
        own_rows, other_rows = [own.index(k) for k in common], [others.index(k) for k in common]
        differences = []
        for run in (m for m in self.base.runs() if m.run in checks and m.through == "arrays"):
            other = checks[run.run]
            if run.status == other.status == "ok":
                other = replace(other, signals=other.signals[np.ix_(columns, other_rows)])
                run = replace(run, signals=run.signals[:, own_rows])
            differences.append(largest_difference(run, other))
        difference = max(differences, default=0.0)
        agrees = bool(difference <= EQUAL)
        template = messages.ARRAYS_AGREE if agrees else messages.ARRAYS_DISAGREE
        runs = counted(len(differences), "random run")
        sentence = template(runs=runs, difference=plain(difference, 2), allowed=plain(EQUAL, 1))
        apart = difference if np.isfinite(difference) else None
        return {"runs": len(differences), "apart": apart, "agrees": agrees, "sentence": sentence}


def _unit(kind: str, goal: Criterion, study: Sweep) -> str:
    unit = study.system.units.get(goal.of, "")
    return {"settling_time": "s", "effort": f"{unit}.s".lstrip(".")}.get(kind, unit)
