"""`cosim sweep`, steps: file → design → runs → sweep.parquet, sweep.json, report."""

from __future__ import annotations

import heapq
import json
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.drafts import is_full
from cosim.core.errors import DiskFull, Fault, InputError, SweepFailed, SweepStopped, Terminated
from cosim.core.extras import check_installed
from cosim.core.settings import Count
from cosim.core.text import counted, showing
from cosim.core.version import __version__
from cosim.files.files import (
    FilePath,
    check_writable,
    delay_stops,
    hold_stops,
    named_path,
    one_stop,
    write_json,
    write_text,
)
from cosim.files.folders import SCHEMA_VERSION, content_of, new_run, newest_run, remove_earlier, runs_named
from cosim.simulation.criteria import OUTSIDE
from cosim.sweeps.pool import MakeRuns, dask_cluster, make_runs_here
from cosim.sweeps.reading import Sweep, Swept, read_sweep
from cosim.sweeps.runs import RunResult, assemble, make_run, sampled_rows
from cosim.sweeps.sampling import share_interval
from cosim.sweeps.store import DATABASE, SWEEP_RECORD, SWEEP_TABLE, Database, read_table, write_table

PARTS_FOLDER = "parts"  # folder of the parts made by --part, as parts/17-of-200
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
        """Prepare for `count` runs; `earlier` are the results of runs that an earlier call has executed."""

    def add(self, results: Sequence[RunResult]) -> None:
        """Receive the results of finished runs."""


@one_stop()
def sweep(
    path: FilePath,
    out: FilePath | None = None,
    *,
    workers: Count | None = None,
    dask: str | None = None,
    resume: bool = False,
    part: str | None = None,
    report: bool = True,
    force: bool = False,
    in_process: bool = False,
    progress: Progress | None = None,
    observers: Sequence[RunsObserver] = (),
) -> Swept:
    """Run a scenario many times with varied values.

    Args:
        path: Sweep file.
        out: Folder for sweep.parquet, sweep.json and report.html; None means a new number in results/NAME.
        workers: Number of worker processes (default: one per core).
        dask: Address of a Dask scheduler; replaces that of the file.
        resume: Continue the sweep in `out`, which may consist of parts; by default the newest in results/NAME.
        part: K/N makes every N-th run from the K-th, and nothing but these runs; K is 1 … N.
        report: Write report.html.
        force: Start again, even if the folder has files; those of an earlier sweep are replaced.
        in_process: Load FMUs into this process, for a debugger.
        progress (in Python): Function of (completed runs, all runs).
        observers (in Python): Objects that receive the finished runs.

    Returns:
        Content of sweep.json, sentences and the folder.

    Raises:
        InputError: The input is wrong; the error names all faults, before the first run.
        FmuError: An FMU cannot be read or loaded.
        SweepStopped: The sweep was stopped from the keyboard; `resume` continues it.
        SweepFailed: No run was completed.
    """
    study = read_sweep(Path(path), loads=True)
    if resume + (part is not None) + force > 1:
        raise InputError.at(Path("cosim sweep"), "give only one of --resume, --part and --force")
    if part is not None and out is None:
        raise InputError.at(Path("--out"), "name the folder of all parts, such as --out results/parts")
    folder = None if out is None else named_path(out)
    if resume:
        folder = newest_run(runs_named(study.name) if folder is None else folder)
    runs, home = range(study.count), folder
    if part is not None and folder is not None:  # parts run at the same time, each in a folder of its own
        match = re.fullmatch(r"(\d{1,7})/(\d{1,7})", part.strip())
        k, of = map(int, match.groups()) if match else (0, 0)
        if not 1 <= k <= of:
            raise InputError.at(Path("--part"), f"{part!r} is no part; give K/N with K from 1 to N, such as 17/200")
        runs, home = runs[k - 1 :: of], folder / PARTS_FOLDER / f"{k}-of-{of}"
    inputs = [study.yaml.path, study.job.scenario, *study.files]
    check_installed("SALib", "cosim sweep")  # imported for the report only
    goes_on = resume or part is not None
    with ExitStack() as stack:
        home = stack.enter_context(new_run(home, study.name, "cosim sweep", force=force or goes_on))
        check_writable(home, (SWEEP_TABLE, SWEEP_RECORD, "report.html", DATABASE), inputs)
        folder = home if part is None or folder is None else folder
        stored = [*folder.glob(DATABASE), *sorted(folder.glob(f"{PARTS_FOLDER}/*/{DATABASE}"))]
        if not goes_on:
            remove_earlier(folder, read=inputs)
            for file in stored:
                file.unlink(missing_ok=True)
            stored = []
        made, record = 0, _read_completed(folder, study.key)
        if record is None:
            address = study.file.dask if dask is None else dask
            make_runs: MakeRuns = partial(make_runs_here, study.job, workers)
            if in_process:
                assemble.cache_clear()  # Files may have changed since an earlier call.
                make_runs = partial(map, lambda request: (make_run(study.job, request),))
            elif address is not None:
                place = partial(study.yaml.fault, ("dask",)) if dask is None else partial(Fault, Path("--dask"), 0, 0)
                make_runs = stack.enter_context(dask_cluster(study, address, place))
            others = [] if part else [path for path in stored if path.parent != home]
            databases = [Database(path, study.key) for path in (home / DATABASE, *others)]
            for database in databases:
                stack.callback(database.close)
            done = {number for database in databases for number in database.numbers()}
            missing = [run for run in runs if run not in done]
            limits = _limits(study)
            for observer in observers:
                observer.begin(study.name, len(runs), limits, _all_runs(databases))
            begin = time.perf_counter()
            try:
                requests = (study.request_run(run) for run in missing)
                for results in make_runs(requests) if missing else ():
                    if not results:
                        databases[0].store()
                        continue
                    with delay_stops():
                        for result in results:
                            databases[0].add(result)
                    made += len(results)
                    for observer in observers:
                        observer.add(results)
                    if progress is not None:
                        progress(len(runs) - len(missing) + made, len(runs))
                databases[0].store()
                hold_stops()  # the table must still be written
            except (KeyboardInterrupt, Terminated, OSError) as stop:
                full = isinstance(stop, OSError)
                if full and not is_full(stop):
                    raise
                with suppress(OSError):  # the disk may be full
                    databases[0].store()
                kept = f"{sum(len(d.numbers()) for d in databases)} of {counted(study.count, 'run')} are stored"
                why, cure = ("the disk is full", "make room, and ") if full else ("stopped", "")
                cure += "the same command" if part else "--resume"
                stopped = SweepStopped(f"{why}: {kept} in {databases[0].path}; {cure} continues the sweep")
                stopped.exit_code = DiskFull.exit_code if full else getattr(stop, "exit_code", 130)
                raise stopped from None
            seconds = time.perf_counter() - begin
            record = _record(study, limits, _all_runs(databases))
            record["runs_a_second"] = float(f"{made / seconds:.3g}") if made else None
            if part:
                record["part"] = part
                return Swept(record, home, study, made)
            names, signals = [limit.name for limit in limits], study.job.signals
            about = {"key": study.key, "times": record["times"], "units": record["units"], "signals": signals}
            write_table(folder / SWEEP_TABLE, _all_runs(databases), study.columns, names, signals, about)
            write_json(folder / SWEEP_RECORD, record, indent=1, allow_nan=False)
            for database in databases:
                database.remove()
        swept = Swept(record, folder, study, made)
        if report:
            from cosim.sweeps.report import page

            with showing(record):
                write_text(folder / "report.html", page(swept))
    if record["failed"] == record["runs"]:
        first = record["failures"][0]
        raise SweepFailed(f"all {counted(study.count, 'run')} failed; run {first['run']}: {first['why']}")
    return swept


def _read_completed(folder: Path, key: str) -> dict[str, Any] | None:
    """Return the record of the same sweep if it is complete in this folder; raise InputError for a different sweep."""
    if not (folder / SWEEP_TABLE).is_file() or not (record := content_of(folder / SWEEP_RECORD)):
        return None
    try:
        _, about = read_table(folder / SWEEP_TABLE)
    except (OSError, ValueError):
        return None
    if about.get("key") != key:
        cure = "give another folder as --out, or use --force to start again"
        raise InputError.at(folder / SWEEP_TABLE, f"is of another sweep, or of other FMUs; {cure}")
    return record


def _all_runs(databases: Sequence[Database]) -> Iterator[RunResult]:
    """Yield the runs of all databases in the order of numbers, each once."""
    last = -1
    for run in heapq.merge(*(database.runs() for database in databases), key=lambda run: run.run):
        if run.run != last:
            yield run
        last = run.run


def _limits(study: Sweep) -> list[CriterionLimit]:
    """Return the limits of the criteria, with unique names for table columns."""
    limits: list[CriterionLimit] = []
    for kind, _, goal in study.scenario.goals:
        ends = (("after", goal.after), ("until", goal.until))
        window = "".join(f" {word} {at:g} s" for word, at in ends if at)
        name = f"{kind.replace('_', ' ')} of {goal.of}{window}"
        same = sum(limit.name == name or limit.name.startswith(f"{name} (") for limit in limits)
        unit = study.system.units.get(goal.of, "")
        unit = {"settling_time": "s", "effort": f"{unit}.s".lstrip(".")}.get(kind, unit)
        limits.append(CriterionLimit(f"{name} ({same + 1})" if same else name, goal.max, unit))
    for _, _, valid in study.scenario.valid_goals:
        limits.append(CriterionLimit(f"{OUTSIDE.replace('_', ' ')} of {valid.of}", 100.0 * (1.0 - valid.min), "%"))
    return limits


def _record(study: Sweep, limits: Sequence[CriterionLimit], runs: Iterable[RunResult]) -> dict[str, Any]:
    """Return the content of sweep.json."""
    count = met_all = 0
    failures: list[dict[str, Any]] = []
    met, shares = np.zeros(len(limits), int), dict[str, list[float]]()
    for run in runs:
        count += 1
        if run.status == "ok":
            met += np.array(run.met, int)
            for name, share in run.valid.items():
                shares.setdefault(name, []).append(share)
            met_all += all(run.met)
        else:
            failures.append({"run": run.run, "why": run.status})
    completed = count - len(failures)
    scenario = study.scenario
    return {
        "schema_version": SCHEMA_VERSION,
        "cosim_version": __version__,
        "name": study.name,
        "key": study.key,
        "sweep": json.loads(study.file.model_dump_json(by_alias=True, exclude_none=True)),
        "scenario": study.resolved,
        "runs": count,
        "failed": len(failures),
        "met_all": met_all,
        "failures": failures[:MAX_LISTED_FAILURES],
        "warnings": list(study.warnings),
        **({"valid": {name: [min(of), max(of)] for name, of in shares.items()}} if shares else {}),
        "times": [scenario.start_time + scenario.step * k for k in sampled_rows(scenario.steps, study.job.samples)],
        "units": {name: study.system.units.get(name, "") for name in study.job.signals},
        "display": {unit: [*shown] for unit, shown in study.system.display.items()},
        "criteria": [
            {
                "name": limit.name,
                "max": limit.max,
                "unit": limit.unit,
                "met": hits,
                "of": completed,
                "ci95": [*share_interval(hits, completed)],
            }
            for limit, hits in zip(limits, met.tolist(), strict=True)
        ],
    }
