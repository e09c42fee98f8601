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
from cosim.base.errors import DiskFull, SimulationError, Terminated, stop_error
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
from cosim.storage.folders import check_run_folder, folder_named, keep_earlier
from cosim.storage.kinds import check_form
from cosim.storage.results import Results, remove_rows, rows_name
from cosim.system.system import System, build_system

MANIFEST = "manifest.json"
SPARE = 8192  # room beyond the size of the manifest [bytes]


@dataclass(frozen=True)
class Outcome:
    """A run after writing its files."""

    results: Results
    manifest: dict[str, Any]
    file: Path  # file of the rows

    @property
    def folder(self) -> Path:
        """Return the folder of rows, manifest and report."""
        return self.file.parent

    @property
    def missed(self) -> list[dict[str, Any]]:
        """Return the missed criteria."""
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
    """Run a scenario or an SSP, or repeat a manifest.

    Writes results.csv, manifest.json and report.html. After a failure the rows so far are written before the error is
    raised.

    Args:
        folder: Output folder. The default is results/NAME, where an earlier run moves to `runs`. An SSP's generated
            scenario and FMUs go to `system` in the folder.
        force: Whether to overwrite the run of a different scenario.
        nearest: Whether to use the nearest FMUs and model of a refine instead of its refined ones.
        observers: Receive rows during the run; `progress`, a function of (steps done, total), is added to them.
        format_: Format of the rows, e.g. parquet for results.parquet instead of results.csv.
        in_process: Load FMUs into this process, for a debugger; a crash of an FMU then loses all rows.

    Raises:
        InputError: The input is faulty.
        FmuError: An FMU does not load.
        SimulationError: The simulation stopped early.
    """
    watching = [*observers, *([] if progress is None else [ProgressObserver(progress)])]
    began, path, rows_file = time.perf_counter(), Path(scenario), rows_name("results", format_)
    if not is_ssp(path):
        check_form(path, kinds.SCENARIO, kinds.MANIFEST)  # before the worker is started
    with ExitStack() as stack:
        worker = None if in_process else stack.enter_context(Worker(*MODULES))
        if worker is not None:
            worker.start()  # The worker starts up while files are read.
        file, place, told_before = _read(path, folder, overrides, force=force)
        keep = folder is None and not is_ssp(path)  # lay_out has already moved the earlier run of an SSP.
        if nearest:
            take_nearest(file)
        check_pinned(file)
        designed = designed_apart(file, worker)
        system = build_system(file, designed)
        if not is_ssp(path):
            check_run_folder(place, file.scenario.name, force=force, keep=keep)
        check_writable(place, (rows_file, MANIFEST, "report.html"), file.files)
        tools = stack.enter_context(ThreadPoolExecutor(1)).submit(made_with)  # runs in parallel to the loading of FMUs
        loaded = time.perf_counter()
        stepped = _stepped(file.scenario, system, worker, place, watching)
        times = began, loaded, time.perf_counter()
        record = manifest(file, designed, system, _timings(file.scenario, *times), tools.result(), stepped.results.loop)
        if is_ssp(path):
            record["ssp"] = {"path": str(path.resolve()), "sha256": sha256(path)}
        record["warnings"] += told_before
        _add_outcome(record, file.scenario, stepped, watched=worker is not None)
        failure = _keep_partial_results(
            place / rows_file, file.scenario, stepped, record, report=report, figures=figures, keep=keep
        )
    if failure is not None:
        failure.left = place
        raise failure
    return Outcome(stepped.results, record, place / rows_file)


def _read(
    path: Path, folder: FilePath | None, overrides: Sequence[str], *, force: bool
) -> tuple[ScenarioFile, Path, list[str]]:
    """Return scenario, output folder and warnings."""
    if not is_ssp(path):
        file = ScenarioFile(path, overrides)
        return file, folder_named(file.scenario.name) if folder is None else named_path(folder), []
    place = folder_named(path.stem) if folder is None else named_path(folder)
    check_run_folder(place, ssp=path, force=force, keep=folder is None)
    file, warnings = lay_out(path, place, overrides, keep=folder is None)
    return file, place, warnings


def _keep_partial_results(
    file: Path,
    scenario: Scenario,
    stepped: Stepped,
    record: dict[str, Any],
    *,
    report: bool,
    figures: bool,
    keep: bool,
) -> SimulationError | None:
    """Write all files of a run, or as many as fit.

    Returns:
        The failure of the run or of the disk, if any.
    """
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
    except (KeyboardInterrupt, Terminated) as stop:  # All files but the report are written.
        end = float(stepped.results.time[-1]) if len(stepped.results.time) else scenario.start_time
        return stepped.failure or stop_error(stop, end, "the report of the run")
    finally:
        hold_stops()  # The end must still be reported.
    return stepped.failure


def _stepped(
    scenario: Scenario, system: System, worker: Worker | None, folder: Path, observers: Sequence[Observer]
) -> Stepped:
    """Step the system in the worker, else in this process."""
    steps, h = scenario.steps, scenario.step
    if worker is None:
        return simulate_here(system, steps, h, observers)
    stepped = simulate_apart(worker, system, steps, h, folder, scenario.limits, observers=observers)
    worker.finish()
    return stepped


def _timings(scenario: Scenario, began: float, loaded: float, simulated: float) -> dict[str, float]:
    """Return durations [s] from clock readings at three moments."""
    stepping = simulated - loaded
    return {"load": loaded - began, "simulate": stepping, "real_time_factor": scenario.duration / stepping}


def _add_outcome(record: dict[str, Any], scenario: Scenario, stepped: Stepped, *, watched: bool) -> None:
    """Add the outcome of the steps to the manifest."""
    if stepped.failure is None:
        record["criteria"] = evaluate(scenario, stepped.results)
    else:
        record["status"] = f"failed: {stepped.failure}"
    record["warnings"] += [*stepped.results.notes, *stepped.said]
    if not watched and scenario.limits is not None:
        record["warnings"].append("limits are not watched where FMUs run in this process")


def _write(file: Path, results: Results, record: dict[str, Any], written: list[str]) -> None:
    """Write rows and manifest of a complete or failed run.

    Args:
        written: Receives the names of the files.
    """
    folder = file.parent
    (folder / "report.html").unlink(missing_ok=True)  # An earlier report belongs to another run.
    with uninterrupted():  # A second stop signal must not destroy the rows.
        results.write(file)
        remove_rows(folder, file.stem, besides=file.name)  # They belong to another run.
        written.append(file.name)
        write_json(folder / MANIFEST, record)
        written.append(MANIFEST)


def _draw(folder: Path, results: Results, record: dict[str, Any], *, report: bool, figures: bool) -> None:
    """Draw the report and the figures of a written run."""
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
    """Write the rows and the manifest that fit on a full disk.

    Returns:
        The failure to report.
    """
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
            (folder / MANIFEST).unlink(missing_ok=True)  # of an earlier run
            told += " and no manifest" if count == rows else ", there is no manifest"
    return DiskFull("the run", at, told + before)


def _rows_that_fit(file: Path, results: Results, manifest: int) -> int:
    """Write the rows that fit; return their number.

    Args:
        manifest: Size [bytes] of the manifest, for which room is reserved if possible.
    """
    remove_rows(file.parent, file.stem)  # An earlier run's rows occupy needed room.
    file.with_name(MANIFEST).unlink(missing_ok=True)
    spare = file.parent / ".spare"
    try:
        try:
            allocate(spare, manifest + SPARE)
        except OSError:
            spare.unlink(missing_ok=True)  # Rows matter more than the manifest.
        return results.write_what_fits(file)
    except OSError:
        return 0
    finally:
        spare.unlink(missing_ok=True)
