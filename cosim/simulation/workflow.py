"""Workflow of `cosim run`: scenario → system → master → results → manifest → report."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from json import dumps
from pathlib import Path
from typing import Any

from cosim.blocks.compiling import compiling, permission
from cosim.core.drafts import is_full
from cosim.core.errors import DiskFull, InputError, SimulationError, Terminated, stop_error
from cosim.core.messages import Note
from cosim.core.scratch import temporary_folder
from cosim.core.settings import Given, Seconds, Seed, Values, texts
from cosim.credibility.validity import validities, validity_warnings
from cosim.files import artefact
from cosim.files.files import (
    FilePath,
    check_writable,
    hold_stops,
    one_stop,
    release_stops,
    write_json,
)
from cosim.files.folders import (
    COMMAND_KEY,
    NUMBERED,
    STARTED,
    content_of,
    remove_earlier,
    results_in,
)
from cosim.files.kinds import check_form, shell_path
from cosim.files.results import Results, rows_in, rows_name
from cosim.files.state_file import write_durable
from cosim.isolation.process import Worker
from cosim.master.beforehand import with_feedthrough
from cosim.master.checkpoint import STATE_FILE, Keeping
from cosim.master.observer import InputFunctions, NamedFunctions, Observers, ProgressObserver
from cosim.master.remote import RUN_MODULES, simulate_in
from cosim.scenario.scenario_file import ScenarioFile, from_here, sha256
from cosim.simulation.criteria import evaluate
from cosim.simulation.manifest import add_changes, check_pinned, manifest, software_versions
from cosim.simulation.packaged import is_ssp, lay_out
from cosim.simulation.run_signals import Run, run_of
from cosim.simulation.stopped_run import (
    COMPILED,
    MANIFEST_FILE,
    Prepared,
    end_keeping,
    prepare_stopped,
    remove_checkpoints,
    write_run,
)
from cosim.system.system import build_system

VERB = "cosim run"
MANY_VALUES = 10_000_000  # values in a CSV file above which a note proposes Parquet


@one_stop()
def run(
    scenario: FilePath | Values,
    out: FilePath | None = None,
    set: Given | None = None,
    *,
    seed: Seed | None = None,
    pace: float | None = None,
    report: bool = True,
    force: bool = False,
    in_process: bool = False,
    compile: bool = False,
    format: str = "csv",
    progress: Callable[[int, int], None] | None = None,
    observers: Observers = (),
    inputs: NamedFunctions | None = None,
    resume: bool = False,
    until: Seconds | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> Run:
    """Simulate a scenario or an SSP.

    A criterion that is not met is not an error: see `Run.missed`.

    Args:
        scenario: File, manifest.json, or the content as a mapping with paths relative to the current folder. With
            `resume` or `until`: the folder of a run.
        out: Folder for results.csv, manifest.json and report.html; None writes nothing.
        set: Path → value, for example {"noise": False, "components.plant.start.mass": 2}, or texts "path=value".
        seed: Seed for all random numbers (default: the seed of the scenario).
        pace (NUMBER): Simulated seconds per second: 1 for real time (default: that of the scenario).
        report: Write report.html.
        force: Write even if the folder is not empty; results in it are replaced.
        in_process: Load FMUs into this process, for a debugger; limits do not apply.
        compile: Compile and execute the sources of FMUs that have no library for this machine.
        format: File format of the rows: "csv", "parquet", "mat", "hdf5", or a format of an installed package.
        progress (in Python): Function of (completed steps, all steps).
        observers (in Python): Objects that receive the rows during the run (`cosim.master.observer.Observer`).
        inputs (in Python): Input → function of time and signals that returns its value during the run, None to hold it.
        resume: Continue the stopped run in a folder; its rows become identical to those of an uninterrupted run.
        until (TIME): Continue the run in a folder to this simulated time, in seconds or with a unit.
        tell (in Python): Function that shows a note before the steps.

    Returns:
        The signals, the manifest and the criteria.

    Raises:
        InputError: The input is wrong; the error names all faults.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The simulation failed; the rows so far are in `out`.
    """
    goes_on = (resume or until is not None) and not isinstance(scenario, Mapping)
    is_given = [set, seed is not None, pace is not None, format != "csv", out not in {None, NUMBERED}]
    if goes_on and any(is_given):
        text = "a resumed run keeps its settings, so --out, --set, --seed, --pace and --format are not allowed"
        raise InputError.at(Path(str(scenario)), f"{text}; remove them")
    observers = [*observers, *([] if progress is None else [ProgressObserver(progress)])]
    begin, overrides = time.perf_counter(), overrides_of(set, seed, pace)
    with ExitStack() as stack:
        stack.enter_context(compiling(compile or permission.get()))
        path = stack.enter_context(_scenario_file(scenario))
        if not goes_on and not is_ssp(path):
            check_form(path, artefact.SCENARIO, artefact.MANIFEST)  # before the worker is started
        worker = None if in_process else stack.enter_context(Worker(*RUN_MODULES))
        if worker is not None:
            worker.start()  # starts in parallel to the reading of files
        software = stack.enter_context(ThreadPoolExecutor(1)).submit(software_versions)  # parallel to the loading
        if goes_on:
            prepared = prepare_stopped(path, until, worker, tell, stack)
        else:
            is_package, warnings = is_ssp(path), list[str]()
            if is_package:
                place = stack.enter_context(results_in(out, VERB, path.stem, force=force))
                file, warnings = lay_out(path, place, overrides)
            else:
                file = ScenarioFile(path, overrides)
                place = stack.enter_context(results_in(out, VERB, file.scenario.name, force=force))
            check_pinned(file)
            system, rows_file = build_system(file), rows_name("results", format)
            if not is_package:
                remove_earlier(place, read=file.files)
            check_writable(place, (rows_file, MANIFEST_FILE, "report.html"), file.files)
            system = replace(with_feedthrough(file, system, worker), pace=file.scenario.pace)
            command = content_of(place / STARTED).get(COMMAND_KEY, VERB)
            record = manifest(file, system, "" if command == VERB else command) | software.result()
            if is_package:
                record["ssp"] = {"path": str(path.resolve()), "sha256": sha256(path)}
            record["warnings"] += warnings
            if permission.get():
                record[COMPILED] = True
            prepared = Prepared(file, place, system, rows_file, record, warnings)
            count, part = file.scenario.steps + 1, system.recording
            values = (count if part is None else len(part.rows(count))) * len(system.columns)
            if values > MANY_VALUES and rows_file.endswith(".csv"):
                cure = "--format parquet is much faster and smaller than CSV"
                tell(Note(f"the results have {values} values; {cure}"))
        if inputs:
            functions = InputFunctions(inputs)
            functions.check(prepared.system)
            observers.append(functions)
        place, start, scenario_, system = prepared.place, prepared.start, prepared.file.scenario, prepared.system
        loaded = time.perf_counter()
        keeping = Keeping(start=start)
        if scenario_.checkpoint is not None and worker is None:
            tell("no checkpoints are stored, because FMUs run in this process (--in-process)")
        elif scenario_.checkpoint is not None:
            if start is None:
                remove_checkpoints(place)
            kept = write_run(place, prepared.record, prepared.rows_file, prepared.warnings)
            keeping = Keeping(kept, scenario_.checkpoint, start)
        stepped = simulate_in(
            worker,
            system,
            scenario_.steps,
            scenario_.step,
            folder=place,
            limits=scenario_.limits,
            observers=observers,
            keeping=keeping,
            measure_times=True,
            recording=system.recording,
        )
        stepping = time.perf_counter() - loaded
        results, failure = stepped.results, stepped.failure
        results = replace(results, words=system.texts & {*results.exact})
        is_longer = start is None or len(results.time) > start.count
        if failure is not None and not is_longer and rows_in(place) is not None:
            failure.left = place
            raise failure  # files that are already written stay
        record = copy.deepcopy(prepared.record)
        record["loop"] = results.loop
        simulated = (scenario_.steps + 1 - (1 if start is None else start.count)) * scenario_.step
        speed = simulated / stepping
        record["timings"] = {"load": loaded - begin, "simulate": stepping, "real_time_factor": speed, **stepped.times}
        add_changes(record, scenario_, [*prepared.changes, *stepped.changes])
        record |= results.details
        if validity := validities((stage.component for stage in system.stages), results):
            record["validity"] = validity
            record["warnings"] += validity_warnings(validity)
        if failure is None:
            record["criteria"] = evaluate(scenario_, results, validity)
            steps = results.details.get("steps", {})
            if missed := steps.get("missed"):  # some steps of the least length have too large an error
                limits = {"value": missed["error"], "max": steps["tolerance"], "unit": ""}
                record["criteria"].append({"kind": "step_error", "of": missed["signal"], **limits, "met": False})
        else:
            record["status"] = f"failed: {failure}"
        record["warnings"] += [*results.notes, *stepped.log]
        if results.event_counts:
            record["event_counts"] = results.event_counts
            record["first_events"] = [list(event) for event in results.events]
        if (part := system.recording) is not None:
            rows = part.rows(len(results.time))
            exact = {name: [column[k] for k in rows] for name, column in results.exact.items()}
            results = replace(results, time=results.time[rows], values=results.values[rows], exact=exact)
        if worker is None and scenario_.limits is not None:
            record["warnings"].append("limits are not checked, because FMUs run in this process (--in-process)")
        is_written = goes_on or out is not None
        state, is_kept = None if failure is None else stepped.state, keeping.folder is not None
        failure = _write_files(prepared, results, failure, state, record, report and is_written, is_kept=is_kept)
    if failure is not None:
        failure.left = place
        raise failure
    return run_of(results, record, place if is_written else None)


def overrides_of(settings: Given | None, seed: int | None, pace: float | None) -> list[str]:
    """Return overrides of a scenario as `path=value` texts."""
    options = {"seed": seed, "pace": pace}
    return [*texts(settings), *(f"{key}={value}" for key, value in options.items() if value is not None)]


@contextmanager
def _scenario_file(scenario: FilePath | Mapping[str, Any]) -> Iterator[Path]:
    """Yield the file of a scenario; a mapping is written to a temporary file."""
    if not isinstance(scenario, Mapping):
        yield Path(scenario)
        return
    label = Path("scenario")
    with temporary_folder("scenario") as scratch:
        path = scratch / "scenario.json"
        try:
            path.write_text(dumps(from_here((), scenario)), encoding="utf-8")
        except (TypeError, ValueError) as error:
            raise InputError.at(label, f"has a value that no file can store: {error!s}") from None
        try:
            yield path
        except InputError as error:
            faults = [replace(f, file=label, line=0, column=0) if f.file == path else f for f in error.faults]
            raise InputError(faults) from None


def _write_files(
    prepared: Prepared,
    results: Results,
    failure: SimulationError | None,
    state: bytes | None,
    record: dict[str, Any],
    report: bool,
    *,
    is_kept: bool,
) -> SimulationError | None:
    """Write all files of a run, without the rows if the disk is full.

    Args:
        failure: Error because of which the run stopped, if any.
        state: Content of the checkpoint of a stopped run, if any.
        record: Manifest.
        is_kept: True if the folder contains checkpoints of the run.

    Returns:
        The error of the run, or of a full disk, if any.
    """
    rows, has_rows = prepared.place / prepared.rows_file, False
    record["rows"] = len(results.time)
    hold_stops()  # needed if no worker made the steps
    try:
        results.write(rows)
        has_rows = True
        rows.with_name("report.html").unlink(missing_ok=True)  # of the run before it went on
        write_json(rows.with_name(MANIFEST_FILE), record)
        is_part = prepared.system.recording is not None
        end_keeping(rows.parent, is_kept=is_kept, keeps_rows=is_part)
        if state is not None and not is_part:
            kept = write_run(rows.parent, prepared.record, rows.name, prepared.warnings)
            write_durable(kept / STATE_FILE, state)
        release_stops()
        if report:
            from cosim.simulation.report.run_page import write_report

            write_report(rows.with_name("report.html"), results, record)
    except OSError as error:
        if not is_full(error):
            raise
        rows.with_name("report.html").unlink(missing_ok=True)
        record["status"] = f"failed: {failure or 'the disk is full'}"
        if not has_rows:
            del record["rows"]
        with suppress(OSError):
            write_json(rows.with_name(MANIFEST_FILE), record)
        at = results.time[-1].item() if len(results.time) else 0.0
        before = "" if failure is None or isinstance(failure, DiskFull) else f"; before that {failure}"
        reason = f"the disk is full: {len(results.time) if has_rows else 0} rows are in {rows.name}{before}"
        return DiskFull("the run", at, reason)
    except (KeyboardInterrupt, Terminated) as stop:  # all files except the report are written
        hold_stops()
        if failure is not None:
            return failure
        end = float(results.time[-1]) if len(results.time) else prepared.file.scenario.start_time
        stopped = stop_error(stop, end, "the report of the run")
        record["no_report"] = stopped.reason
        cure = f"`cosim report {shell_path(rows.parent)}` writes it"
        record["warnings"].append(f"there is no report: {stopped.reason}; {cure}")
        write_json(rows.with_name(MANIFEST_FILE), record)
        return stopped
    finally:
        hold_stops()  # the end of the run must still be reported
    return failure
