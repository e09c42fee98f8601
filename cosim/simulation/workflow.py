"""Workflow of `cosim run`: scenario → design → system → master → results → manifest → report."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.base.drafts import is_full
from cosim.base.errors import DiskFull, SimulationError, Terminated, stop_error
from cosim.isolation.process import Worker
from cosim.isolation.rows import allocate
from cosim.master.observer import Observer, ProgressObserver
from cosim.master.remote import MODULES, SteppedRun, simulate_apart, simulate_here
from cosim.scenario.controller_design import designed_apart
from cosim.scenario.nearest_models import take_nearest
from cosim.scenario.pinned import sha256
from cosim.scenario.scenario import Scenario
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation import messages
from cosim.simulation.criteria import evaluate
from cosim.simulation.manifest import add_changes, check_pinned, manifest, software_versions
from cosim.simulation.packaged import is_ssp, lay_out
from cosim.storage import kinds
from cosim.storage.files import (
    FilePath,
    check_writable,
    delay_stops,
    hold_stops,
    named_path,
    one_stop,
    release_stops,
    write_json,
)
from cosim.storage.folder_lock import folder_locks
from cosim.storage.folders import check_run_folder, folder_named, keep_earlier
from cosim.storage.kinds import check_form
from cosim.storage.results import Results, remove_rows, rows_name
from cosim.system.system import build_system

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
    observers = [*observers, *([] if progress is None else [ProgressObserver(progress)])]
    begin, path, rows_file = time.perf_counter(), Path(scenario), rows_name("results", format_)
    is_package = is_ssp(path)
    if not is_package:
        check_form(path, kinds.SCENARIO, kinds.MANIFEST)  # before the worker is started
    with ExitStack() as stack:
        worker = None if in_process else stack.enter_context(Worker(*MODULES))
        if worker is not None:
            worker.start()  # The worker starts up while files are read.
        file, place, warnings = _read(path, folder, overrides, force=force)
        keep = folder is None and not is_package  # lay_out has already moved the earlier run of an SSP.
        if nearest:
            take_nearest(file)
        check_pinned(file)
        designed = designed_apart(file, worker)
        system = build_system(file, designed)
        if not is_package:
            check_run_folder(place, file.scenario.name, force=force, keep=keep)
        check_writable(place, (rows_file, MANIFEST, "report.html"), file.files)
        software = stack.enter_context(ThreadPoolExecutor(1)).submit(software_versions)  # parallel to the loading
        loaded, steps, h = time.perf_counter(), file.scenario.steps, file.scenario.step
        if worker is None:
            stepped = simulate_here(system, steps, h, observers)
        else:
            stepped = simulate_apart(worker, system, steps, h, place, file.scenario.limits, observers=observers)
            worker.finish()
        stepping = time.perf_counter() - loaded
        speed = file.scenario.duration / stepping
        timings = {"load": loaded - begin, "simulate": stepping, "real_time_factor": speed}
        record = manifest(file, designed, system, timings, software.result(), stepped.results.loop)
        if is_package:
            record["ssp"] = {"path": str(path.resolve()), "sha256": sha256(path)}
        record["warnings"] += warnings
        add_changes(record, file.scenario, stepped.changes)
        _add_outcome(record, file.scenario, stepped, watched=worker is not None)
        files = _Files(place / rows_file, file.scenario, stepped, record)
        failure = files.write(report=report, figures=figures, keep=keep)
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


def _add_outcome(record: dict[str, Any], scenario: Scenario, stepped: SteppedRun, *, watched: bool) -> None:
    """Add the outcome of the steps to the manifest."""
    record |= stepped.results.details
    if stepped.failure is None:
        record["criteria"] = evaluate(scenario, stepped.results)
    else:
        record["status"] = f"failed: {stepped.failure}"
    record["warnings"] += [*stepped.results.notes, *stepped.log]
    if stepped.results.event_counts:
        record["event_counts"] = stepped.results.event_counts
        record["first_events"] = [list(event) for event in stepped.results.events]
    if not watched and scenario.limits is not None:
        record["warnings"].append(messages.LIMITS_NOT_WATCHED())


@dataclass
class _Files:
    """Files of a run; `written` holds the names of complete files."""

    rows: Path
    scenario: Scenario
    stepped: SteppedRun
    record: dict[str, Any]
    written: list[str] = field(default_factory=list)

    def write(self, *, report: bool, figures: bool, keep: bool) -> SimulationError | None:
        """Write all files of a run, or as many as fit.

        Returns:
            The failure of the run or of the disk, if any.
        """
        failure, time = self.stepped.failure, self.stepped.results.time
        try:
            if keep:
                keep_earlier(self.rows.parent, "cosim run")
            self._write_rows()
            release_stops()
            self._draw(report=report, figures=figures)
        except OSError as error:
            if not is_full(error):
                raise
            return self._write_what_fits()
        except (KeyboardInterrupt, Terminated) as stop:  # All files but the report are written.
            end = float(time[-1]) if len(time) else self.scenario.start_time
            return failure or stop_error(stop, end, "the report of the run")
        finally:
            hold_stops()  # The end must still be reported.
        return failure

    def _write_rows(self) -> None:
        """Write a complete or failed run's rows and manifest."""
        self.rows.with_name("report.html").unlink(missing_ok=True)  # An earlier report belongs to another run.
        with delay_stops():  # A second stop signal must not destroy the rows.
            self.stepped.results.write(self.rows)
            remove_rows(self.rows.parent, self.rows.stem, besides=self.rows.name)  # They belong to another run.
            self.written.append(self.rows.name)
            write_json(self.rows.with_name(MANIFEST), self.record)
            self.written.append(MANIFEST)

    def _draw(self, *, report: bool, figures: bool) -> None:
        """Draw report and figures of a written run."""
        if report:
            from cosim.simulation.report import write_report

            write_report(self.rows.with_name("report.html"), self.stepped.results, self.record)
        if figures:
            from cosim.simulation.report import write_figures

            write_figures(self.rows.with_name("figures"), self.stepped.results, self.record)

    def _write_what_fits(self) -> DiskFull:
        """Write the rows and the manifest that fit on a full disk; return the failure to report."""
        self.rows.with_name("report.html").unlink(missing_ok=True)
        failure, time, manifest = self.stepped.failure, self.stepped.results.time, self.rows.with_name(MANIFEST)
        count = len(time) if self.rows.name in self.written else self._rows_that_fit(2 * len(json.dumps(self.record)))
        rows = self.scenario.steps + 1 if isinstance(failure, DiskFull) else len(time)
        before = "" if failure is None or isinstance(failure, DiskFull) else f"; before that {failure}"
        at = time[max(0, count - 1)].item() if len(time) else 0.0

        def full(missing: str) -> DiskFull:
            fields = {"count": count, "rows": rows, "file": self.rows.name, "missing": missing, "before": before}
            return DiskFull("the run", at, messages.DISK_FULL(**fields))

        missing = ", there is no report" if count == rows else ""
        self.record["status"] = f"failed: {full(missing)}"
        try:
            write_json(manifest, self.record)
        except OSError:
            if MANIFEST not in self.written:
                manifest.unlink(missing_ok=True)  # of an earlier run
                missing += " and no manifest" if count == rows else ", there is no manifest"
        return full(missing)

    def _rows_that_fit(self, manifest: int) -> int:
        """Write as many rows as fit; return their number.

        Args:
            manifest: Size [bytes] of the manifest, for which room is reserved if possible.
        """
        remove_rows(self.rows.parent, self.rows.stem)  # An earlier run's rows occupy needed room.
        self.rows.with_name(MANIFEST).unlink(missing_ok=True)
        spare = self.rows.with_name(".spare")
        try:
            try:
                allocate(spare, manifest + SPARE)
            except OSError:
                spare.unlink(missing_ok=True)  # Rows matter more than the manifest.
            return self.stepped.results.write_what_fits(self.rows)
        except OSError:
            return 0
        finally:
            spare.unlink(missing_ok=True)
