"""Workflow of `cosim run`: scenario → design → system → master → results → manifest → report."""

from __future__ import annotations

import copy
import json
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cosim.base.drafts import is_full
from cosim.base.errors import CosimError, DiskFull, Interrupted, Signalled, SimulationError, Terminated, stop_error
from cosim.blocks.compiling import compiling, permission
from cosim.isolation.component_times import RUN, Slower
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import allocate
from cosim.master.beforehand import without_ended_states
from cosim.master.checkpoint import Continuation, Keeping
from cosim.master.inbox import Change, with_changes
from cosim.master.live_values import check_hosts
from cosim.master.observer import InputFunctions, NamedFunctions, Observer, ProgressObserver
from cosim.master.remote import MODULES, SteppedRun, simulate_apart, simulate_here
from cosim.scenario.controller_design import designed_apart
from cosim.scenario.nearest_models import take_nearest
from cosim.scenario.pinned import sha256
from cosim.scenario.scenario import Scenario
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation import messages
from cosim.simulation.criteria import evaluate, missed_tolerance
from cosim.simulation.manifest import add_changes, check_pinned, manifest, software_versions
from cosim.simulation.packaged import is_ssp, lay_out
from cosim.simulation.row_stops import RowStops
from cosim.simulation.stopped_run import (
    MANIFEST,
    StoppedRun,
    begin_keeping,
    end_keeping,
    keep_state,
    open_stopped,
    unsaved_names,
    write_run,
)
from cosim.simulation.undeclared import with_feedthrough
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
from cosim.storage.folder_lock import folder_locks, release_early
from cosim.storage.folders import (
    begin,
    check_run_folder,
    drafts_of_killed,
    folder_named,
    keep_earlier,
    new_earlier,
    rows_of_killed,
)
from cosim.storage.kinds import check_form, shell_path
from cosim.storage.results import Results, remove_rows, rows_name
from cosim.storage.started import KILLED, STARTED, STATUS
from cosim.system.real_time import real_time_of
from cosim.system.recording import take_signals
from cosim.system.system import System, build_system

MANY_ROWS = 1_000_000  # rows of CSV, beyond which a note offers Parquet
COMPILED = "compile"  # key of a manifest: sources of FMUs may be compiled when the run goes on
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


@dataclass
class _Prepared:
    """A run before its steps.

    Attributes:
        record: Manifest without timings and outcome; None until it is needed.
        changes: Changes by observers before the run was stopped.
        start: Where a stopped run goes on; None for a new run.
        keep: Whether an earlier run in the folder moves to `runs`.
        bring_back: Function that brings the checkpoint of a finished run back, which this one extends; None for others.
        command: Command that made the scenario, if it is not `cosim run`.
    """

    file: ScenarioFile
    place: Path
    system: System
    designed: Mapping[str, Mapping[str, Any]]
    rows_file: str
    software: Future[dict[str, Any]]
    warnings: list[str] = field(default_factory=list)
    ssp: Path | None = None
    keep: bool = False
    start: Continuation | None = None
    record: dict[str, Any] | None = None
    changes: Sequence[Change] = ()
    bring_back: Callable[[], None] | None = None
    command: str = ""

    @property
    def interval(self) -> float | None:
        """Return the wall time between two checkpoints [s]."""
        return self.file.scenario.checkpoint

    @property
    def rows(self) -> int:
        """Return the number of rows of a complete run."""
        count, part = self.file.scenario.steps + 1, self.system.recording
        return count if part is None else len(part.rows(count))

    def base(self) -> dict[str, Any]:
        """Return the manifest without timings and outcome."""
        if self.record is None:
            self.record = self._first_record()
        if self.record.get("versions") == {}:
            self.record |= self.software.result()
        return copy.deepcopy(self.record)

    def _first_record(self) -> dict[str, Any]:
        """Return the manifest without versions, which take a while."""
        record = manifest(self.file, self.designed, self.system, self.command)
        if self.ssp is not None:
            record["ssp"] = {"path": str(self.ssp.resolve()), "sha256": sha256(self.ssp)}
        record["warnings"] += self.warnings
        if permission.get():
            record[COMPILED] = True
        return record

    def begin(self) -> None:
        """Write the record of a run without checkpoints."""
        if self.interval is None and self.start is None:
            self.record = self._first_record()
            begin(self.place, "cosim run", MANIFEST, {**self.record, STATUS: KILLED}, read=self.file.files)

    def keeping(self) -> Keeping:
        """Return the settings of the checkpoints."""
        if self.interval is None:
            return Keeping(start=self.start)
        if self.start is not None:
            folder = write_run(self.place, self.base(), self.rows_file, self.warnings)
            return Keeping(folder, self.interval, self.start)
        if self.keep:
            keep_earlier(self.place, "cosim run", read=self.file.files)
            self.keep = False
        return Keeping(begin_keeping(self.place, self.base(), self.rows_file, self.warnings), self.interval)


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
    inputs: NamedFunctions | None = None,
    resume: bool = False,
    until: float | None = None,
    tell: Callable[[str], None] = lambda text: None,
    command: str = "",
) -> Outcome:
    """Run a scenario or an SSP, repeat a manifest, or go on with a stopped run.

    Writes results.csv, manifest.json and report.html. After a failure the rows so far are written before the error is
    raised.

    Args:
        scenario: File; with `resume` or `until` the folder of a run.
        folder: Output folder, by default results/NAME. An earlier run in it moves to `runs`. An SSP's generated
            scenario and FMUs go to `system`.
        force: Whether to overwrite the run of a different scenario.
        nearest: Whether to use the nearest FMUs and model of a refine instead of its refined ones.
        inputs: Input → function that returns its value while the run goes on.
        observers: Receive rows during the run; `progress`, a function of (steps done, total), is added to them.
        format_: Format of the rows, e.g. parquet for results.parquet instead of results.csv.
        in_process: Load FMUs into this process, for a debugger; a crash of an FMU then loses all rows.
        resume: Whether to go on with the stopped run in a folder.
        until: End [s] of a longer run that goes on with the run in a folder.
        tell: Function that shows a note before the steps.
        command: Command that made the scenario, if it is not `cosim run`.

    Raises:
        InputError: The input is faulty.
        FmuError: An FMU does not load.
        SimulationError: The simulation stopped early.
    """
    observers = [*observers, *([] if progress is None else [ProgressObserver(progress)])]
    begin, path = time.perf_counter(), Path(scenario)
    goes_on = resume or until is not None
    if not goes_on and not is_ssp(path):
        check_form(path, kinds.SCENARIO, kinds.MANIFEST)  # before the worker is started
    with ExitStack() as stack:
        worker = None if in_process else stack.enter_context(Worker(*MODULES))
        if worker is not None:
            worker.start()  # The worker starts up while files are read.
        software = stack.enter_context(ThreadPoolExecutor(1)).submit(software_versions)  # parallel to the loading
        if goes_on:
            prepared = _prepare_stopped(path, until, software, worker, tell, stack)
        else:
            options = force, nearest, rows_name("results", format_)
            prepared = _prepare_new(path, folder, overrides, options, software, worker, tell=tell)
            prepared.command = command
            _tell_size(prepared, tell)
        if inputs:
            functions = InputFunctions(inputs)
            functions.check(prepared.system)
            observers.append(functions)
        prepared.begin()
        loaded = time.perf_counter()
        stepped = _step(prepared, worker, observers, tell)
        stepping = time.perf_counter() - loaded
        words = prepared.system.texts & {*stepped.results.exact}
        stepped = replace(stepped, results=replace(stepped.results, words=words))
        prepared = _apart_from_finished(prepared, stepped, tell)
        record, limits = prepared.base(), prepared.file.scenario.limits
        record["loop"] = stepped.results.loop
        speed = _simulated(prepared) / stepping
        record["timings"] = {"load": loaded - begin, "simulate": stepping, "real_time_factor": speed, **stepped.times}
        add_changes(record, prepared.file.scenario, [*prepared.changes, *stepped.changes])
        _add_outcome(record, prepared.file.scenario, stepped)
        if (part := prepared.system.recording) is not None:
            stepped = replace(stepped, results=part.thin(stepped.results))
        if worker is None and limits is not None:
            record["warnings"].append(messages.LIMITS_NOT_WATCHED())
        files = _Files(prepared, stepped, record, tell, is_kept=worker is not None and prepared.interval is not None)
        failure = files.write(report=report, figures=figures)
    if failure is not None:
        failure.left = files.prepared.place
        raise failure
    return Outcome(stepped.results, record, files.rows)


def _apart_from_finished(prepared: _Prepared, stepped: SteppedRun, tell: Callable[[str], None]) -> _Prepared:
    """Return a run, among the earlier ones of its folder if it failed to extend a finished run, which stays as it was.

    A run that was stopped on request stays in the folder, where it goes on.

    Raises:
        SimulationError: The run failed before its first new row, so that nothing is to be written.
    """
    failure, bring_back, before = stepped.failure, prepared.bring_back, prepared.start
    if failure is None or bring_back is None:
        return prepared
    is_longer = before is None or len(stepped.results.time) > before.count
    if is_longer and isinstance(failure, (Interrupted, Signalled)):
        return prepared
    bring_back()
    if not is_longer:
        failure.left = prepared.place
        tell(messages.FINISHED_RUN_KEPT(folder=prepared.place, rows=""))
        raise failure
    place = new_earlier(prepared.place)
    rows = messages.FAILED_ROWS(folder=place)
    tell(messages.FINISHED_RUN_KEPT(folder=prepared.place, rows=rows))
    return replace(prepared, place=place, bring_back=None)


def _tell_size(prepared: _Prepared, tell: Callable[[str], None]) -> None:
    """Offer another format for many rows."""
    if prepared.rows > MANY_ROWS and prepared.rows_file.endswith(".csv"):
        tell(messages.MANY_ROWS(rows=prepared.rows))


def _prepare_new(
    path: Path,
    folder: FilePath | None,
    overrides: Sequence[str],
    options: tuple[bool, bool, str],
    software: Future[dict[str, Any]],
    worker: Worker | None,
    *,
    tell: Callable[[str], None],
) -> _Prepared:
    """Return a new run.

    Args:
        options: Whether to overwrite another run, whether to use the nearest models, and the name of the rows file.
    """
    force, nearest, rows_file = options
    is_package = is_ssp(path)
    file, place, warnings = _read(path, folder, overrides, force=force)
    if nearest:
        take_nearest(file)
    check_pinned(file)
    designed = designed_apart(file, worker)
    system = build_system(file, designed)
    if not is_package:
        check_run_folder(place, file.scenario.name, force=force)
    if (rows := rows_of_killed(place, "results")) is not None:
        tell(messages.ROWS_OF_KILLED_RUN(folder=place, size=rows.stat().st_size / 1e6))
    for draft in drafts_of_killed(place, "results"):
        if draft.stem.endswith(".csv"):
            continue  # without a row
        tell(messages.DRAFT_OF_KILLED_RUN(file=draft, size=draft.stat().st_size / 1e6))
        draft.unlink()
    check_writable(place, (rows_file, MANIFEST, "report.html"), file.files)
    real_time = real_time_of(file)
    check_hosts(real_time)
    system = replace(with_feedthrough(file, designed, system, worker, tell), real_time=real_time)
    ssp = path if is_package else None
    return _Prepared(file, place, system, designed, rows_file, software, warnings, ssp, keep=ssp is None)


def _prepare_stopped(
    path: Path,
    until: float | None,
    software: Future[dict[str, Any]],
    worker: Worker | None,
    tell: Callable[[str], None],
    stack: ExitStack,
) -> _Prepared:
    """Return a stopped run; tell how it goes on.

    Args:
        stack: Keeps the permission to compile sources, if the run began with it.
    """
    stopped = open_stopped(path)
    stopped.check_end(until)
    file = stopped.scenario(until)
    check_pinned(file)
    stack.enter_context(compiling(permission.get() or stopped.record.get(COMPILED) is True))
    system = build_system(file)
    steps = {} if until is None else stopped.solver_steps(system)
    if steps:
        file = stopped.scenario(until, steps)
        system = build_system(file)
    system = with_feedthrough(file, {}, system, worker, tell)
    start = stopped.start(system, file.scenario)
    if until is not None and start is not None:
        grid, limits = (file.scenario.steps, file.scenario.step), file.scenario.limits or Limits()
        start, ended = without_ended_states(system, grid, start, stopped.end, worker, limits)
        if ended:
            time_ = file.scenario.start_time + stopped.end * file.scenario.step
            tell(messages.STATE_ENDS(names=", ".join(ended), time=time_))
    check_writable(stopped.folder, (stopped.rows_file, MANIFEST, "report.html"), file.files)
    if changes := stopped.changes:
        system = replace(system, events=with_changes(system.events, changes))
        start = start and replace(start, changes=changes)
    record = stopped.base(system.warnings if until is not None or stopped.has_outcome else None)
    record["scenario"]["duration"] = file.scenario.duration
    for name, longest in steps.items():
        record["scenario"]["components"][name]["solver_step"] = longest
    tell(_how_it_goes_on(stopped, system, start, file.scenario))
    files, extra = stopped.rows_file, stopped.warnings
    prepared = _Prepared(file, stopped.folder, system, {}, files, software, extra, start=start, record=record)
    return replace(prepared, changes=changes, bring_back=stopped.protect() if stopped.is_finished else None)


def _how_it_goes_on(stopped: StoppedRun, system: System, start: Continuation | None, scenario: Scenario) -> str:
    """Return the note on start and cost."""
    if start is None:
        return messages.BEGINS_AGAIN(time=scenario.start_time)
    time = scenario.start_time + (start.count - 1) * scenario.step
    names = start.unsaved(system)
    cost = messages.REPLAY_COST(names=", ".join(names), seconds=stopped.lasted) if names else ""
    return messages.GOES_ON(time=time, row=start.count, rows=scenario.steps + 1, replay=cost)


def _step(
    prepared: _Prepared, worker: Worker | None, observers: Sequence[Observer], tell: Callable[[str], None]
) -> SteppedRun:
    """Make the steps of a run."""
    scenario, system, place = prepared.file.scenario, prepared.system, prepared.place
    if worker is None:
        if prepared.interval is not None:
            tell(messages.NO_CHECKPOINT_IN_PROCESS())
        stepped = simulate_here(system, scenario.steps, scenario.step, observers, start=prepared.start)
        return replace(stepped, results=take_signals(system.recording, stepped.results))
    keeping = prepared.keeping()
    if keeping.folder is not None and prepared.start is None and (names := unsaved_names(system)):
        tell(messages.REPLAY_ON_RESUME(names=", ".join(names)))
    limits = scenario.limits
    try:
        stepped = simulate_apart(
            worker,
            system,
            scenario.steps,
            scenario.step,
            place,
            limits,
            observers=observers,
            keeping=keeping,
            warn=lambda slower: tell(_slower(slower)),
            recording=system.recording,
        )
    except CosimError:
        if prepared.bring_back is not None:
            prepared.bring_back()
        raise
    worker.finish()
    return stepped


def _slower(slower: Slower) -> str:
    """Return the warning of slower steps."""
    if slower.component == RUN:
        return messages.RUN_GETS_SLOWER(factor=slower.factor, since=slower.since)
    return messages.GETS_SLOWER(**vars(slower))


def _simulated(prepared: _Prepared) -> float:
    """Return the simulated time [s] that this command makes."""
    scenario, start = prepared.file.scenario, prepared.start
    return scenario.duration if start is None else (scenario.steps + 1 - start.count) * scenario.step


def _read(
    path: Path, folder: FilePath | None, overrides: Sequence[str], *, force: bool
) -> tuple[ScenarioFile, Path, list[str]]:
    """Return scenario, output folder and warnings."""
    if not is_ssp(path):
        file = ScenarioFile(path, overrides)
        return file, folder_named(file.scenario.name) if folder is None else named_path(folder), []
    place = folder_named(path.stem) if folder is None else named_path(folder)
    check_run_folder(place, ssp=path, force=force)
    file, warnings = lay_out(path, place, overrides)
    return file, place, warnings


def _add_outcome(record: dict[str, Any], scenario: Scenario, stepped: SteppedRun) -> None:
    """Add the outcome of the steps to the manifest."""
    record |= stepped.results.details
    if stepped.failure is None:
        record["criteria"] = [*evaluate(scenario, stepped.results), *missed_tolerance(stepped.results)]
    else:
        record["status"] = f"failed: {stepped.failure}"
    record["warnings"] += [*stepped.results.notes, *stepped.log]
    if stepped.results.event_counts:
        record["event_counts"] = stepped.results.event_counts
        record["first_events"] = [list(event) for event in stepped.results.events]


@dataclass
class _Files:
    """Files of a run.

    Attributes:
        is_kept: Whether the folder has checkpoints of the run.
        written: Names of complete files.
    """

    prepared: _Prepared
    stepped: SteppedRun
    record: dict[str, Any]
    tell: Callable[[str], None]
    is_kept: bool
    written: list[str] = field(default_factory=list)

    @property
    def rows(self) -> Path:
        """Return the file of the rows."""
        return self.prepared.place / self.prepared.rows_file

    @property
    def scenario(self) -> Scenario:
        """Return the scenario."""
        return self.prepared.file.scenario

    def write(self, *, report: bool, figures: bool) -> SimulationError | None:
        """Write all files of a run, or as many as fit.

        Returns:
            The failure of the run or of the disk, if any.
        """
        failure, time = self.stepped.failure, self.stepped.results.time
        started = self.prepared.place / STARTED
        hold_stops()  # also where no worker made the steps
        try:
            if self.prepared.keep:
                self._keep_earlier()
                record = {**self.prepared.base(), "status": f"failed: {messages.ROWS_NOT_COMPLETE()}"}
                write_json(self.rows.with_name(MANIFEST), record)  # what is known if the command is killed
            release_early(started)
            count = self._write_rows()
            release_stops()
            if count == len(time):
                self._draw(report=report, figures=figures)
        except OSError as error:
            if not is_full(error):
                raise
            return self._write_what_fits()
        except (KeyboardInterrupt, Terminated) as stop:  # All files but the report are written.
            hold_stops()
            return failure or self._stopped(stop)
        finally:
            hold_stops()  # The end must still be reported.
        return failure

    def _keep_earlier(self) -> None:
        """Move an earlier run to `runs`; if the disk is too full for that, take another folder for this run."""
        folder = self.prepared.place
        try:
            keep_earlier(folder, "cosim run", read=self.prepared.file.files)
        except OSError as error:
            if not is_full(error):
                raise
            place = Path(tempfile.mkdtemp(prefix=f"{folder.resolve().name}-", dir=tempfile.gettempdir()))
            self.prepared = replace(self.prepared, place=place)
            self.tell(messages.NO_ROOM_BESIDE_EARLIER(folder=folder, place=place))

    def _stopped(self, stop: BaseException) -> SimulationError:
        """Return the error of a run stopped after its steps; say in the manifest that there is no report."""
        time, count = self.stepped.results.time, self.record["rows"]
        end = float(time[count - 1]) if count else self.scenario.start_time
        if count < len(time):
            return stop_error(stop, end, "the rows of the run")
        error = stop_error(stop, end, "the report of the run")
        self.record["no_report"] = error.reason
        self.record["warnings"].append(messages.NO_REPORT(reason=error.reason, folder=shell_path(self.rows.parent)))
        write_json(self.rows.with_name(MANIFEST), self.record)
        return error

    def _write_rows(self) -> int:
        """Write a complete or failed run's rows and manifest; return the number of rows."""
        if self.prepared.bring_back is None:
            self.rows.with_name("report.html").unlink(missing_ok=True)  # An earlier report belongs to another run.
        results, failure = self.stepped.results, self.stepped.failure
        stops = RowStops(results, self.rows, self.tell, can_end=self.prepared.start is None)
        with delay_stops(stops.receive):  # A second stop signal must not destroy the rows.
            if isinstance(failure, (Interrupted, Signalled)):
                stops.receive()
            results.write(self.rows, stops.go_on)
            self.rows.with_name("report.html").unlink(missing_ok=True)
            remove_rows(self.rows.parent, self.rows.stem, besides=self.rows.name)  # They belong to another run.
            self.written.append(self.rows.name)
            self.record["rows"] = count = stops.count
            is_whole = count == len(results.time)
            if not is_whole:
                before = "" if failure is None else f"{failure}; "
                reason = messages.ROWS_ENDED(reason=before, count=count, rows=len(results.time), file=self.rows.name)
                self.record |= {"status": f"failed: {reason}", "criteria": []}
            write_json(self.rows.with_name(MANIFEST), self.record)
            self.written.append(MANIFEST)
            is_part = self.prepared.system.recording is not None
            if is_whole or not self.is_kept:  # otherwise the checkpoint has all rows
                end_keeping(self.rows.parent, is_kept=self.is_kept, keeps_rows=is_part)
            if self.stepped.state is not None and failure is not None and is_whole and not is_part:
                keep_state(self.rows, self.prepared.base(), self.prepared.warnings, self.stepped.state)
        return count

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
        if (bring_back := self.prepared.bring_back) is not None and self.rows.name not in self.written:
            bring_back()  # The rows of the finished run matter more than some more of them.
            start, rows = self.prepared.start, self.prepared.rows
            count = 0 if start is None else start.count
            at = self.scenario.start_time + max(0, count - 1) * self.scenario.step
            fields = {"count": count, "rows": rows, "file": self.rows.name, "missing": "", "before": ""}
            return DiskFull("the run", at, messages.DISK_FULL(**fields))
        self.rows.with_name("report.html").unlink(missing_ok=True)
        failure, time, manifest = self.stepped.failure, self.stepped.results.time, self.rows.with_name(MANIFEST)
        count = len(time) if self.rows.name in self.written else self._rows_that_fit(2 * len(json.dumps(self.record)))
        rows = self.prepared.rows if isinstance(failure, DiskFull) else len(time)
        before = "" if failure is None or isinstance(failure, DiskFull) else f"; before that {failure}"
        at = time[max(0, count - 1)].item() if len(time) else 0.0

        def full(missing: str) -> DiskFull:
            fields = {"count": count, "rows": rows, "file": self.rows.name, "missing": missing, "before": before}
            return DiskFull("the run", at, messages.DISK_FULL(**fields))

        missing = ", there is no report" if count == rows else ""
        self.record |= {"status": f"failed: {full(missing)}", "rows": count}
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
