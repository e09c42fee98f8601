"""A run, in order: scenario → design → system → master → results → manifest → report."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.base.drafts import is_full
from cosim.base.errors import DiskFull, SimulationError, Terminated, stopped
from cosim.isolation.process import Worker
from cosim.isolation.rows import allocate
from cosim.master.observer import Observer, ProgressObserver
from cosim.master.remote import MODULES, Stepped, simulate_apart, simulate_here
from cosim.scenario.controller_design import designed_apart
from cosim.scenario.nearest_models import take_nearest
from cosim.scenario.pinned import sha256
from cosim.scenario.scenario import Scenario
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.criteria import evaluate
from cosim.simulation.manifest import check_pinned, made_with, manifest
from cosim.simulation.packaged import is_ssp, lay_out
from cosim.storage import kinds
from cosim.storage.files import (
    FilePath,
    check_writable,
    hold_stops,
    named_path,
    one_stop,
    release_stops,
    uninterrupted,
    write_json,
)
from cosim.storage.folder_lock import folder_locks
from cosim.storage.folders import check_ours, folder_named, keep_earlier
from cosim.storage.kinds import check_form
from cosim.storage.results import Results, remove_rows, rows_name
from cosim.system.system import System, build_system

MANIFEST = "manifest.json"
SPARE = 8192  # bytes beside a manifest's own


@dataclass(frozen=True)
class Outcome:
    """A run that is written down."""

    results: Results
    manifest: dict[str, Any]
    file: Path  # of the rows

    @property
    def folder(self) -> Path:
        """Where the rows, the manifest and the report are."""
        return self.file.parent

    @property
    def missed(self) -> list[dict[str, Any]]:
        """Criteria that are not met."""
        return [c for c in self.manifest["criteria"] if not c["met"]]


@one_stop()
@folder_locks()
def run(
    scenario: FilePath,
    folder: FilePath | None = None,
    overrides: Sequence[str] = (),
    *,
    force: bool = True,
    nearest: bool = False,
    report: bool = True,
    figures: bool = False,
    in_process: bool = False,
    format_: str = "csv",
    progress: Callable[[int, int], None] | None = None,
    observers: Sequence[Observer] = (),
) -> Outcome:
    """Run a scenario or an SSP, or repeat a manifest; results.csv, manifest.json and report.html are left in `folder`.

    folder:  results/NAME of the scenario without, whose earlier run moves to `runs` in it; of an SSP the scenario that
             it is run as, and its FMUs, are left in its `system`
    force:   also over what the run of another scenario left there
    nearest: FMUs and the model of the design that a refine left give way to those that came nearest in it.
    observers: get the rows while they are made; `progress`, a function of (steps done, of how many), is one.
    format_: of the rows, which are then in results.parquet or the like in place of results.csv.
    in_process: FMUs are loaded into this process, for a debugger: what they break ends the run with all its rows.
    Raises InputError, FmuError; and SimulationError after the rows so far are written.
    """
    watching = [*observers, *([] if progress is None else [ProgressObserver(progress)])]
    began, path, rows_file = time.perf_counter(), Path(scenario), rows_name("results", format_)
    if not is_ssp(path):
        check_form(path, kinds.SCENARIO, kinds.MANIFEST)  # before a worker is started
    with ExitStack() as stack:
        worker = None if in_process else stack.enter_context(Worker(*MODULES))
        if worker is not None:
            worker.start()  # it gets ready while files are read
        file, place, told_before = _read(path, folder, overrides, force=force)
        keep = folder is None and not is_ssp(path)  # of an SSP they were kept before its system was laid out
        if nearest:
            take_nearest(file)
        check_pinned(file)
        designed = designed_apart(file, worker)
        system = build_system(file, designed)
        if not is_ssp(path):
            check_ours(place, file.scenario.name, force=force, keep=keep)
        check_writable(place, (rows_file, MANIFEST, "report.html"), file.files)
        tools = stack.enter_context(ThreadPoolExecutor(1)).submit(made_with)  # asked while FMUs are loaded
        loaded = time.perf_counter()
        stepped = _stepped(file.scenario, system, worker, place, watching)
        times = began, loaded, time.perf_counter()
        record = manifest(file, designed, system, _timings(file.scenario, *times), tools.result(), stepped.results.loop)
        if is_ssp(path):
            record["ssp"] = {"path": str(path.resolve()), "sha256": sha256(path)}
        record["warnings"] += told_before
        _add_outcome(record, file.scenario, stepped, watched=worker is not None)
        failure = _left(place / rows_file, file.scenario, stepped, record, report=report, figures=figures, keep=keep)
    if failure is not None:
        failure.left = place
        raise failure
    return Outcome(stepped.results, record, place / rows_file)


def _read(
    path: Path, folder: FilePath | None, overrides: Sequence[str], *, force: bool
) -> tuple[ScenarioFile, Path, list[str]]:
    """A scenario, or that of an SSP, laid out; the folder for what is left, and warnings."""
    if not is_ssp(path):
        file = ScenarioFile(path, overrides)
        return file, folder_named(file.scenario.name) if folder is None else named_path(folder), []
    place = folder_named(path.stem) if folder is None else named_path(folder)
    check_ours(place, ssp=path, force=force, keep=folder is None)
    file, warnings = lay_out(path, place, overrides, keep=folder is None)
    return file, place, warnings


def _left(
    file: Path,
    scenario: Scenario,
    stepped: Stepped,
    record: dict[str, Any],
    *,
    report: bool,
    figures: bool,
    keep: bool,
) -> SimulationError | None:
    """Leave everything beside the file of rows, or what fits of it; the failure of the run, or of the disk."""
    written: list[str] = []
    try:
        if keep:
            keep_earlier(file.parent, "cosim run")
        _write(file, stepped.results, record, written)
        release_stops()
        _draw(file.parent, stepped.results, record, report=report, figures=figures)
    except OSError as error:
        if not is_full(error):
            raise
        rows = scenario.steps + 1 if isinstance(stepped.failure, DiskFull) else len(stepped.results.time)
        return _write_what_fits(file, stepped.results, record, written, rows, stepped.failure)
    except (KeyboardInterrupt, Terminated) as stop:  # all but the report is written
        end = float(stepped.results.time[-1]) if len(stepped.results.time) else scenario.start_time
        return stepped.failure or stopped(stop, end, "the report of the run")
    finally:
        hold_stops()  # the end is still to be told
    return stepped.failure


def _stepped(
    scenario: Scenario, system: System, worker: Worker | None, folder: Path, observers: Sequence[Observer]
) -> Stepped:
    """The steps, in the worker or without one in this process."""
    steps, h = scenario.steps, scenario.step
    if worker is None:
        return simulate_here(system, steps, h, observers)
    stepped = simulate_apart(worker, system, steps, h, folder, scenario.limits, observers=observers)
    worker.finish()
    return stepped


def _timings(scenario: Scenario, began: float, loaded: float, simulated: float) -> dict[str, float]:
    """How long it took [s], by a clock at three moments."""
    stepping = simulated - loaded
    return {"load": loaded - began, "simulate": stepping, "real_time_factor": scenario.duration / stepping}


def _add_outcome(record: dict[str, Any], scenario: Scenario, stepped: Stepped, *, watched: bool) -> None:
    """What came of the steps, into the manifest."""
    if stepped.failure is None:
        record["criteria"] = evaluate(scenario, stepped.results)
    else:
        record["status"] = f"failed: {stepped.failure}"
    record["warnings"] += [*stepped.results.notes, *stepped.said]
    if not watched and scenario.limits is not None:
        record["warnings"].append("limits are not watched where FMUs run in this process")


def _write(file: Path, results: Results, record: dict[str, Any], written: list[str]) -> None:
    """Write the rows and the manifest of a run, whether or not it came to its end; `written` gets their names."""
    folder = file.parent
    (folder / "report.html").unlink(missing_ok=True)  # an earlier one would be of another run
    with uninterrupted():  # or what was stopped once could be lost by stopping it again
        results.write(file)
        remove_rows(folder, file.stem, besides=file.name)  # they would be of another run
        written.append(file.name)
        write_json(folder / MANIFEST, record)
        written.append(MANIFEST)


def _draw(folder: Path, results: Results, record: dict[str, Any], *, report: bool, figures: bool) -> None:
    """Draw the report and the figures of a run that is written."""
    if report:
        from cosim.simulation.report import write_report

        write_report(folder / "report.html", results, record)
    if figures:
        from cosim.simulation.report import write_figures

        write_figures(folder / "figures", results, record)


def _write_what_fits(
    file: Path,
    results: Results,
    record: dict[str, Any],
    written: Sequence[str],
    rows: int,
    failure: SimulationError | None,
) -> SimulationError:
    """What a full disk has room for of the rows and the manifest of a run; what to tell of it."""
    folder = file.parent
    (folder / "report.html").unlink(missing_ok=True)
    count = len(results.time) if file.name in written else _rows_that_fit(file, results, 2 * len(json.dumps(record)))
    told = f"the disk is full: {count} of {rows} rows are in {file.name}"
    told += ", there is no report" if count == rows else ""
    before = "" if failure is None or isinstance(failure, DiskFull) else f"; before that {failure}"
    at = results.time[max(0, count - 1)].item() if len(results.time) else 0.0
    record["status"] = f"failed: {DiskFull('the run', at, told + before)}"
    try:
        write_json(folder / MANIFEST, record)
    except OSError:
        if MANIFEST not in written:
            (folder / MANIFEST).unlink(missing_ok=True)  # an earlier run's
            told += " and no manifest" if count == rows else ", there is no manifest"
    return DiskFull("the run", at, told + before)


def _rows_that_fit(file: Path, results: Results, manifest: int) -> int:
    """Write rows for which there is room, beside a manifest of this size [bytes] where there is that; their number."""
    remove_rows(file.parent, file.stem)  # of an earlier run, whose room is needed
    file.with_name(MANIFEST).unlink(missing_ok=True)
    spare = file.parent / ".spare"
    try:
        try:
            allocate(spare, manifest + SPARE)
        except OSError:
            spare.unlink(missing_ok=True)  # the rows before the manifest
        return results.write_what_fits(file)
    except OSError:
        return 0
    finally:
        spare.unlink(missing_ok=True)
