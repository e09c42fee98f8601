"""`cosim sweep`, in order: file → design → check of arrays against FMUs → runs → sweep.parquet, sweep.json, report."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.errors import Fault, InputError, SweepFailed, SweepStopped, Terminated
from cosim.base.extras import optional
from cosim.base.settings import Count
from cosim.base.text import counted, plain
from cosim.base.version import __version__
from cosim.scenario.scenario import Criterion
from cosim.storage.files import FilePath, atomic_write, check_writable, hold_stops, named_path, one_stop, uninterrupted
from cosim.storage.folder_lock import folder_locks
from cosim.storage.folders import check_left, content_of, folder_named, keep_earlier
from cosim.sweeps.batch import why_not_on_arrays
from cosim.sweeps.reading import Sweep, read_sweep
from cosim.sweeps.run_chunks import MOST_ROWS, Job, Way, sampled_rows
from cosim.sweeps.run_statistics import share
from cosim.sweeps.store import CHECKED, DATABASE, MADE, TABLE, Database, read_table, write_table
from cosim.sweeps.sweep_result import Swept, criterion_names
from cosim.sweeps.sweep_result import apart as apart_of
from cosim.sweeps.workers import AHEAD, Makers, dask_client, fault_of, makers

RECORD, REPORT = "sweep.json", "report.html"
REPEATED = 20  # random runs repeated through FMUs
EQUAL = 1e-9  # largest allowed difference relative to max(1, largest value)
# runs per job; fixed, so that results do not depend on the workers
CHUNK: Mapping[Way, int] = {"arrays": 512, "fmus": 8}
TOLD = 20  # listed failures
SCHEMA_VERSION = 1
Progress = Callable[[int, int], None]


@one_stop()
@folder_locks()
def sweep(
    path: FilePath,
    out: FilePath | None = None,
    *,
    workers: Count | None = None,
    dask: str | None = None,
    report: bool = True,
    force: bool = False,
    in_process: bool = False,
    progress: Progress | None = None,
) -> Swept:
    """Run a scenario many times with varied values.

    The same call resumes a sweep that was stopped.

    Args:
        path: Sweep file.
        out: Folder for sweep.parquet, sweep.json and report.html; None means results/NAME.
        workers: Number of worker processes; None means one per core.
        dask: Address of a Dask scheduler; replaces that of the file.
        report: Write report.html.
        force: Start again. In results/NAME the files of the earlier sweep move to `runs`.
        in_process: Load FMUs into this process, for a debugger.
        progress: Function of (completed runs, all runs).

    Returns:
        Content of sweep.json, sentences and the folder.

    Raises:
        InputError: Every fault, before the first run.
        FmuError: An FMU cannot be read or loaded.
        SweepStopped: The sweep was stopped from the keyboard; the same call resumes it.
        SweepFailed: No run was completed.
    """
    study = read_sweep(Path(path))
    folder = folder_named(study.name) if out is None else named_path(out)
    read = [study.yaml.path, study.job.scenario, *(fmu for fmu, _ in study.system.fmus.values())]
    check_left(folder, "cosim sweep", force=force, keep=out is None)
    check_writable(folder, (TABLE, RECORD, REPORT, DATABASE), read)
    address = study.file.dask if dask is None else dask
    for library in ("pyarrow", "SALib"):  # missing libraries are reported before any run
        optional(library, "cosim sweep")
    with ExitStack() as stack:
        client = stack.enter_context(dask_client(address, fault_of(study.yaml, dask)))
        if force and out is None:
            keep_earlier(folder, "cosim sweep")
        if force:
            for name in (DATABASE, TABLE, RECORD, REPORT):
                (folder / name).unlink(missing_ok=True)
        left = _read_completed(folder, study.key)
        count = 0
        if left is None:
            base = stack.enter_context(Database(folder, study.key))
            one = _Sweep(study, folder, base, progress)
            left, count = one.make_runs(workers, client, in_process=in_process)
    swept = Swept(study, folder, left, count)
    if report:
        from cosim.sweeps.report import page

        with atomic_write(folder / REPORT) as stream:
            stream.write(page(swept))
    if left["failed"] == left["runs"]:
        raise SweepFailed(f"all {counted(study.count, 'run')} failed; run 0: {left['failures'][0]['why']}")
    return swept


def _read_completed(folder: Path, key: str) -> dict[str, Any] | None:
    """Return the record of a completed equal sweep; raise InputError for a different sweep."""
    try:
        _, about = read_table(folder / TABLE)
    except (OSError, ValueError):
        return None
    if not (record := content_of(folder / RECORD)):
        return None
    if about.get("key") != key:
        message = "holds another sweep, or one of other FMUs; give another folder as --out, or begin anew by --force"
        raise InputError([Fault(folder / TABLE, 0, 0, message)])
    return record


class _Sweep:
    """State of a call: finished and pending runs."""

    def __init__(self, study: Sweep, folder: Path, base: Database, progress: Progress | None) -> None:
        self.study, self.folder, self.base, self.progress = study, folder, base, progress
        self.goals = [g for _, _, g in study.scenario.goals]
        self.seconds = 0.0
        self.count = 0

    def make_runs(self, workers: int | None, client: Any, *, in_process: bool) -> tuple[dict[str, Any], int]:
        """Return the record and the number of new runs."""
        try:
            with makers(workers, client, in_process=in_process) as who:
                way, why = self._way(who)
                there, begun = len(self.base.there()), time.perf_counter()
                for made in self._make(who, range(self.study.count), way, self.study.job, MADE):
                    self.count += made
                    if self.progress is not None:
                        self.progress(there + self.count, self.study.count)
                self.seconds = time.perf_counter() - begun
                hold_stops()  # The table must still be written.
        except (KeyboardInterrupt, Terminated) as stop:
            there = len(self.base.there())
            message = f"{there} of {counted(self.study.count, 'run')} are kept in {self.base.path}"
            error = SweepStopped(f"stopped: {message}; the same command goes on with them")
            if isinstance(stop, Terminated):
                error.exit_code = Terminated.exit_code
            raise error from None
        record = self._record(way, why)
        names, signals = [c["name"] for c in record["criteria"]], self.study.job.signals
        about = {"key": self.study.key, "times": record["times"], "units": record["units"], "signals": signals}
        write_table(self.folder / TABLE, self.base.runs(), self.study.columns, names, signals, about)
        with atomic_write(self.folder / RECORD) as stream:
            json.dump(record, stream, indent=1, ensure_ascii=False, allow_nan=False)
            stream.write("\n")
        self.base.remove()
        return record, self.count

    def _way(self, who: Makers) -> tuple[Way, str]:
        """Return the way of running, and the reason against arrays.

        Arrays are used if random runs agree with FMU runs.
        """
        known = self.base.get("way")
        if known is not None:
            kept: tuple[Way, str] = tuple(json.loads(known))
            return kept
        why = str(who.ask(why_not_on_arrays, self.study.system))
        way: Way = "fmus" if why else "arrays"
        if way == "arrays":
            repeated, job = self._repeated(), replace(self.study.job, whole=True)
            for _ in self._make(who, repeated, "fmus", job, CHECKED):
                pass
            future = who.submit(job, [self.study.request_run(k) for k in repeated], "arrays", None, len(self.goals))
            on_arrays = who.runs(next(iter(who.done({future})[0])))
            apart = max((apart_of(a, b) for a, b in zip(on_arrays, self.base.runs(CHECKED), strict=True)), default=0.0)
            if not apart <= EQUAL:
                way, why = "fmus", f"on arrays runs are {plain(apart, 2)} apart from those through the FMUs"
        self.base.put("way", json.dumps([way, why]))
        return way, why

    def _repeated(self) -> list[int]:
        """Return random runs to repeat through FMUs."""
        rng = np.random.default_rng([self.study.file.seed, 0xC4EC])
        found = rng.choice(self.study.count, min(REPEATED, self.study.count), replace=False)
        return sorted(int(k) for k in found)

    def _make(self, who: Makers, runs: Iterable[int], way: Way, job: Job, table: str) -> Iterator[int]:
        """Make the missing runs of a table in chunks. Yields the number of stored runs after each wait."""
        there = self.base.there(table)
        limits = self.study.scenario.limits if way == "fmus" else None
        size = 1 if limits is not None else CHUNK[way]
        chunks = itertools.groupby((run for run in runs if run not in there), lambda run: run // size)
        waiting, pending = [[*chunk] for _, chunk in chunks][::-1], set[Any]()
        while waiting or pending:
            while waiting and len(pending) < who.count + AHEAD:
                asked = [self.study.request_run(run) for run in waiting.pop()]
                pending.add(who.submit(job, asked, way, limits, len(self.goals)))
            finished, pending = who.done(pending)
            kept = 0
            for future in finished:
                found = who.runs(future)
                with uninterrupted():
                    self.base.add(found, table)
                kept += len(found)
            yield kept

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
                failures += [{"run": m.run, "why": m.status}] if failed <= TOLD else []
        shares = [share(int(hits), count - failed) for hits in met]
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
            "check": self._checked(count, way, why),
            "warnings": list(study.warnings),
            "times": [scenario.start_time + scenario.step * k for k in rows],
            "units": {name: study.system.units.get(name, "") for name in study.job.signals},
            "criteria": [
                {
                    "name": name,
                    "max": goal.max,
                    "unit": _unit(kind, goal, study),
                    "met": s.hits,
                    "of": s.of,
                    "ci95": [s.low, s.high],
                }
                for name, (kind, _, goal), s in zip(criterion_names(study), scenario.goals, shares, strict=True)
            ],
        }

    def _checked(self, count: int, way: Way, why: str) -> dict[str, Any]:
        """Return the comparison of array runs with FMU runs."""
        if way == "fmus":
            because = f": {why}" if why else ""
            return {"runs": count, "apart": 0.0, "sentence": f"every run was made through the FMUs{because}"}
        checked, steps = {m.run: m for m in self.base.runs(CHECKED)}, self.study.scenario.steps
        columns = [self.study.system.columns.index(name) for name in self.study.job.signals]
        mine, theirs = sampled_rows(steps, self.study.job.samples), sampled_rows(steps, MOST_ROWS)
        both = sorted({*mine} & {*theirs})
        at = [mine.index(k) for k in both], [theirs.index(k) for k in both]
        apart, compared = 0.0, 0
        for kept in (m for m in self.base.runs() if m.run in checked and m.through == "arrays"):
            compared += 1
            other = checked[kept.run]
            if kept.status == other.status == "ok":
                other = replace(other, signals=other.signals[np.ix_(columns, at[1])])
                kept = replace(kept, signals=kept.signals[:, at[0]])
            apart = max(apart, apart_of(kept, other))
        agree = "agree" if apart <= EQUAL else "DO NOT AGREE"
        repeated = f"{counted(compared, 'random run')} repeated through the FMUs {agree}"
        sentence = f"{repeated}: at most {plain(apart, 2)} of max(1, largest value) apart; {plain(EQUAL, 1)} is allowed"
        return {"runs": compared, "apart": apart if np.isfinite(apart) else None, "sentence": sentence}


def _unit(kind: str, goal: Criterion, study: Sweep) -> str:
    unit = study.system.units.get(goal.of, "")
    return {"settling_time": "s", "effort": f"{unit}.s".lstrip(".")}.get(kind, unit)
