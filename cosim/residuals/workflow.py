"""Workflow of a replay: log → gate → drive → free run → comparison → results → page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.base.arrays import Array, far_beyond
from cosim.base.drafts import is_full
from cosim.base.errors import DiskFull, Terminated, stop_error
from cosim.base.registry import BASE
from cosim.base.scratch import temporary_folder
from cosim.base.text import join_names
from cosim.fmi.fmu_build import build as build_fmu
from cosim.fmi.sampled import AUTHOR
from cosim.isolation.limits import Limits, read_limits
from cosim.isolation.process import Worker
from cosim.loading.file import load_model
from cosim.logs.finding import SENSORS, Finding
from cosim.logs.gate import gate, outliers, refuse_faults
from cosim.logs.log import Log, read_column_names
from cosim.logs.spikes import find_spikes
from cosim.logs.unit_mistakes import input_unit_findings
from cosim.report.template import render
from cosim.residuals.compare import Comparison, compare, steps_of
from cosim.residuals.drive import PLANT, Drive, StoppedReplay, as_columns, check_files, log_of_fmu
from cosim.residuals.next_study import NEXT_STUDY, claimed_sensor_errors, lacks_something, next_study
from cosim.residuals.remote_drive import MODULES, DriveApart
from cosim.residuals.replay_sentences import verdict
from cosim.residuals.replay_settings import start_values
from cosim.residuals.report import TEMPLATE, context
from cosim.residuals.residual_statistics import FREE_RUN
from cosim.residuals.windows import Replay, free_run
from cosim.storage.files import (
    FilePath,
    check_writable,
    hold_stops,
    named_path,
    one_stop,
    release_stops,
    write_json,
    write_text,
)
from cosim.storage.folders import REPLAY, SCHEMA_VERSION, describe_run, remove_earlier
from cosim.storage.results import Results, rows_name

MEASURED = "log"  # component name of measurements, beside PLANT


@one_stop()
def replay(
    log: FilePath,
    folder: FilePath,
    fmu: FilePath | None = None,
    *,
    start: Sequence[str] = (),
    columns: Sequence[str] = (),
    report: bool = True,
    in_process: bool = False,
    limits: str = "",
    format_: str = "csv",
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """Replay a log file through an FMU, by default through the base model's FMU.

    Writes results.csv, residual.csv, replay.json and report.html to `folder`, and study.yaml if a named FMU lacks
    something.

    Args:
        start: Start values and parameters of the FMU as NAME=VALUE, `gain=0.9`, `angle=12 deg`.
        columns: Log columns with other names than in the FMU, `measured_speed=motor.w`.
        in_process: Load the FMU into this process, for a debugger.
        limits: Limits of the FMU, such as `step: 10 s, memory: 2 GB`; default: none.

    Raises:
        InputError: The log or an argument has faults.
        FmuError: The FMU cannot be used.
        SimulationError: The FMU fails.
    """
    most = read_limits(limits)
    rows_name("results", format_)  # An unavailable format must fail before the replay.
    check_files(Path(log), None if fmu is None else Path(fmu))
    place = named_path(folder)
    with ExitStack() as stack:
        worker = None if in_process else stack.enter_context(Worker(*MODULES))
        if worker is not None:
            worker.start()  # The worker starts while files are read.
        scratch = stack.enter_context(temporary_folder("replay"))
        driven = Path(fmu) if fmu else build_fmu(load_model(BASE, Path()).recipe(), scratch / "plant.fmu")
        names = read_column_names(columns, Path(log))
        read = log_of_fmu(Path(log), driven, names)
        goes_on = fmu is not None and not claimed_sensor_errors(driven)
        proposed = next_study(place, driven, Path(log), names, start) if goes_on else ""
        return write_replay(
            place,
            read,
            driven,
            given=start_values(driven, start),
            report=report,
            passing=fmu is None,
            proposed=proposed,
            worker=worker,
            limits=most,
            format_=format_,
            progress=progress,
        )


@far_beyond
def write_replay(
    folder: Path,
    log: Log,
    fmu: Path,
    *,
    start: Mapping[str, Any] | None = None,
    given: Mapping[str, Any] = MappingProxyType({}),
    rate: float | None = None,
    report: bool = True,
    passing: bool = False,
    proposed: str = "",
    worker: Worker | None = None,
    limits: Limits | None = None,
    format_: str = "csv",
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """Replay a log through an FMU and write results and report to `folder`.

    Args:
        start: Start of the free run, instead of an estimate from its first rows.
        given: Start values and parameters of every run.
        passing: True if the FMU was built for this replay only.
        proposed: Study to write if the FMU lacks something.
        rate: Required step of the log [s]; by default the FMU's own step only causes a warning.
        worker: Process of the FMU, within limits; default: this process.

    Raises:
        InputError: The log has faults, gate included.
        FmuError: The FMU cannot be used.
        StoppedReplay: The FMU fails; finished rows are written before.
    """
    total = steps_of(log)
    rows_file, residual_file = folder / rows_name("results", format_), folder / rows_name("residual", format_)

    report_step = None if progress is None else lambda done: progress(min(done, total), total)
    remote = None if worker is None else DriveApart(worker, log, fmu, report_step, limits=limits, given=given)
    with remote or Drive(log, fmu, report_step, given=given) as drive:
        findings = _findings(drive, log, rate)
        written = "report.html", REPLAY, NEXT_STUDY
        check_writable(folder, (rows_file.name, residual_file.name, *written), (log.path, fmu))
        remove_earlier(folder, read=(log.path, fmu))
        sources = {"log": str(log.path), "fmu": "" if passing else str(fmu)}
        chosen = {"start": dict(given)} if given else {}
        describe_run(folder, {**sources, **chosen})
        free = _free_run(drive, start, rows_file)
        try:
            release_stops()
            findings += outliers(log, find_spikes(log, lambda _: free.outputs))
            comparison = compare(drive, free, findings)
            errors = residuals(comparison)
            errors.write(residual_file)
            units = {**results(drive, comparison.replays[FREE_RUN].outputs).units, **errors.units}
            _record(folder, {**sources, **chosen, "sentence": verdict(comparison), "units": units})
            if proposed and lacks_something(comparison):
                write_text(folder / NEXT_STUDY, proposed)
            if report:
                write_text(folder / "report.html", render(TEMPLATE, context(comparison, passing=passing)))
        except OSError as error:
            if not is_full(error):
                raise
            raise _full(rows_file, residual_file, log) from None
        except (KeyboardInterrupt, Terminated) as stop:  # all rows of the free run are written
            ended = stop_error(stop, float(log.time[-1]), "the comparison")
            ended.left = folder
            raise ended from None
    return comparison


def _findings(drive: Drive, log: Log, rate: float | None) -> list[Finding]:
    """Return the findings of the gate; raise InputError if the log has faults."""
    findings = gate(log, rate or drive.rate, strict=rate is not None, traits=drive.traits, spikes={})
    findings += [*_version_findings(drive), *_sensor_findings(drive)]
    findings += input_unit_findings(log, drive.starts, drive.traits.bounds if drive.traits else {})
    refuse_faults(log, findings)
    return findings


def _free_run(drive: Drive, start: Mapping[str, Any] | None, file: Path) -> Replay:
    """Run the FMU over the whole log and write its rows. After a failure, write the finished rows."""
    try:
        free = free_run(drive, start)
        hold_stops()  # From here, rows exist that must not be lost.
    except StoppedReplay as failed:
        _write_rows(results(drive, as_columns(failed.done, drive.outputs)), file)
        failed.left = file.parent
        raise
    except (KeyboardInterrupt, Terminated) as stop:
        if drive.left is None:
            raise
        rows = results(drive, as_columns(drive.left, drive.outputs))
        _write_rows(rows, file)
        error = stop_error(stop, rows.time[-1] if rows.time.size else drive.log.time[0], "the replay")
        error.left = file.parent
        raise error from None
    _write_rows(results(drive, free.outputs), file)
    return free


def _full(file: Path, residual: Path, log: Log) -> DiskFull:
    """Return the error of a full disk."""
    missing = "no report" if residual.exists() else f"no {residual.name} and no report"
    reason = f"the disk is full: all {log.rows} rows are in {file.name}, there is {missing}"
    return DiskFull("the replay", float(log.time[-1]), reason)


def _write_rows(rows: Results, file: Path) -> None:
    """Write the rows, with units in replay.json; raise DiskFull after a partial write."""
    try:
        _record(file.parent, {"status": "stopped", "units": dict(rows.units)})  # rewritten at the end
        rows.write(file)
    except OSError as error:
        if not is_full(error):
            raise
        try:
            file.unlink(missing_ok=True)  # an earlier file, whose space is needed
            count = rows.write_what_fits(file)
        except OSError:
            count = 0
        reason = f"the disk is full: {count} of {len(rows.time)} rows are in {file.name}"
        raise DiskFull("the replay", rows.time[max(0, count - 1)].item(), reason) from None


def _record(folder: Path, content: Mapping[str, Any]) -> None:
    """Write replay.json with data beside the rows."""
    write_json(folder / REPLAY, {"schema_version": SCHEMA_VERSION, **content}, indent=1)


def _version_findings(drive: Drive) -> Iterator[Finding]:
    """Yield a warning for an FMU built by an earlier version, treated as a foreign one."""
    if drive.traits is None and drive.description.author == AUTHOR:
        yield Finding(
            "warning",
            "older",
            "",
            (
                f"{drive.fmu.name} was built by an earlier version, which says nothing of frame, limits and state: "
                "the log is checked less and windows start worse; build it again"
            ),
        )


def _sensor_findings(drive: Drive) -> Iterator[Finding]:
    """Yield a warning for the FMU of a refine that claims errors of sensors, which the log has and the FMU has not."""
    if names := claimed_sensor_errors(drive.fmu):
        yield Finding(
            "warning",
            SENSORS,
            "",
            (
                f"the readings have {join_names(names)}, which the refine beside {drive.fmu.name} claims and an FMU "
                "does not hold; correct the readings, or see error.after in its refine.json"
            ),
        )


def results(drive: Drive, outputs: Mapping[str, Array]) -> Results:
    """Return commands and FMU outputs as `plant.variable`, measurements as `log.variable`."""
    log, rows = drive.log, len(next(iter(outputs.values())))
    columns = {f"{PLANT}.{n}": v[:rows] for n, v in (*log.inputs.items(), *outputs.items())}
    columns |= {f"{MEASURED}.{n}": v[:rows] for n, v in log.outputs.items()}
    declared = drive.units | dict(log.units)  # the log's units where the FMU declares none
    units = {name: declared.get(name.partition(".")[2], "") for name in columns}
    return Results(log.time[:rows], tuple(columns), np.column_stack(list(columns.values())), units)


def residuals(comparison: Comparison) -> Results:
    """Return measured − model by horizon, such as `free_run.angle`."""
    columns: dict[str, Array] = {}
    units: dict[str, str] = {}
    for horizon, replayed in sorted(comparison.replays.items(), reverse=True):
        size = f"{horizon:g}s" if float(horizon).is_integer() else f"{1000 * horizon:g}ms"
        label = "free_run" if horizon == FREE_RUN else f"within_{size}"
        columns |= {f"{label}.{n}": e for n, e in replayed.errors(comparison.log).items()}
        units |= {f"{label}.{n}": comparison.log.units[n] for n in comparison.log.outputs}
    return Results(comparison.log.time, tuple(columns), np.column_stack(list(columns.values())), units)
