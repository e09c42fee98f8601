"""Workflow of a replay: log → checks of the log → free run → comparison → results → page."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.blocks.compiling import compiling
from cosim.core.arrays import Array, NamedArrays, far_beyond
from cosim.core.errors import InputError, SimulationError, Terminated, stop_error
from cosim.core.registry import BASE
from cosim.core.scratch import temporary_folder
from cosim.core.settings import Given, texts
from cosim.core.text import as_yaml, join_names, showing
from cosim.credibility.validity import validity_of
from cosim.files.artefact import LOG
from cosim.files.files import (
    FilePath,
    check_writable,
    hold_stops,
    named_path,
    one_stop,
    release_stops,
    write_json,
    write_text,
)
from cosim.files.folders import (
    REPLAY,
    SCHEMA_VERSION,
    content_of,
    name_of_file,
    remove_earlier,
    results_in,
)
from cosim.files.kinds import check_given
from cosim.files.results import Results, rows_name
from cosim.files.table import read_header, split_heading
from cosim.fmi.building.file import load_model
from cosim.fmi.building.refined import REFINE_RECORD, folder_of
from cosim.fmi.description import display_units, read_description
from cosim.fmi.fmu_build import build as build_fmu
from cosim.isolation.limits import read_limits
from cosim.isolation.process import Worker
from cosim.logs.gate import gate, outliers, refuse_faults
from cosim.logs.log import SENSOR_FINDING, Finding, read_column_names
from cosim.logs.spikes import find_spikes
from cosim.residuals.compare import Comparison, compare, sentence, steps_of, verdict
from cosim.residuals.drive import PLANT_COMPONENT, REPLAY_MODULES, Drive, as_columns, drive_in, log_of_fmu, start_values
from cosim.residuals.log_region import signals_along
from cosim.residuals.replay_signals import Replay, read_replay
from cosim.residuals.report import page
from cosim.residuals.residual_statistics import FREE_RUN
from cosim.residuals.windows import Replay as Replayed
from cosim.residuals.windows import free_run

LOG_COMPONENT = "log"  # component name of measurements, beside PLANT_COMPONENT
NEXT_STUDY = "study.yaml"
STUDY_HEAD = """\
# Written by `cosim replay`. In this folder:
#   cosim check study.yaml    print which effects these logs can show
#   cosim refine study.yaml   find the effects that the FMU lacks
#   cosim fit study.yaml      estimate the parameters of the FMU
"""


@far_beyond
def replay(
    log: FilePath,
    out: FilePath | None = None,
    fmu: FilePath | None = None,
    *,
    start: Given | None = None,
    columns: Given | None = None,
    report: bool = True,
    force: bool = False,
    in_process: bool = False,
    compile: bool = False,
    limits: str = "",
    format: str = "csv",
    progress: Callable[[int, int], None] | None = None,
) -> Replay:
    """Simulate an FMU with the recorded inputs of a log, and compare the outputs.

    Args:
        log: Measured log.
        out: Folder for results.csv, residual.csv, replay.json and report.html; None writes nothing.
        fmu: FMU to simulate; None takes the plant of the base model.
        start: Start value or parameter of the FMU → value.
        columns: Column of the log → variable, or "time".
        report: Write report.html.
        force: Write even if the folder is not empty; results in it are replaced.
        in_process: Load the FMU into this process, for a debugger; limits do not apply.
        compile: Compile and execute the sources of an FMU that has no library for this machine.
        limits: Limits of time and memory, for example "step: 10 s, total: 1 h, memory: 2 GB".
        format: File format of the rows: "csv", "parquet", "mat", "hdf5", or a format of an installed package.
        progress (in Python): Function of (completed steps, all steps).

    Returns:
        Signals of FMU and log, and the residual of each horizon.

    Raises:
        InputError: The input is wrong; the error names all faults.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The simulation failed; the rows so far are in `out`.
    """
    path, values, most = Path(log), texts(start), read_limits(limits)
    with ExitStack() as stack:
        stack.enter_context(compiling(compile))
        folder = stack.enter_context(results_in(out, "cosim replay", name_of_file(path), force=force))
        stack.enter_context(one_stop())
        place = named_path(folder)
        # an unavailable format is reported before the replay
        rows_file, residual_file = (place / rows_name(stem, format) for stem in ("results", "residual"))
        worker = None if in_process else stack.enter_context(Worker(*REPLAY_MODULES))
        if worker is not None:
            worker.start()  # starts in parallel to the reading of files
        scratch = stack.enter_context(temporary_folder("replay"))
        names = read_column_names(columns, path)
        driven = Path(fmu) if fmu else _plant_of(path, names, scratch)
        measured = log_of_fmu(path, driven, names)
        display = display_units([read_description(driven)])
        stack.enter_context(showing({"display": display}))
        given, total = start_values(driven, values), steps_of(measured)
        report_step = None if progress is None else lambda done: progress(min(done, total), total)
        settings: dict[str, Any] = {"progress": report_step, "limits": most, "given": given}
        drive = stack.enter_context(drive_in(worker, measured, driven, **settings))
        findings = gate(measured, drive.rate, drive.traits, {}, drive.starts)
        if claimed := _claimed_sensors(driven):
            message = (
                f"refine.json claims {join_names(claimed)}, but {driven.name} has no sensor errors; correct the "
                "readings"
            )
            findings.append(Finding("warning", SENSOR_FINDING, "", message))
        refuse_faults(measured, findings)
        written = rows_file.name, residual_file.name, "report.html", REPLAY, NEXT_STUDY
        check_writable(place, written, (path, driven))
        remove_earlier(place, read=(path, driven))
        sources: dict[str, Any] = {"log": str(path), "fmu": str(driven) if fmu else ""}
        sources |= {"start": dict(given)} if given else {}
        free = _free_run(drive, rows_file)
        try:
            release_stops()
            findings += outliers(measured, find_spikes(measured, lambda _: free.outputs))
            validity = validity_of(driven, measured.time, signals_along(drive, measured, free))
            if problem := validity.get("problem"):
                findings.append(Finding("warning", "credibility", "", problem))
            comparison = compare(drive, free, findings)
            errors = residuals(comparison)
            errors.write(residual_file)
            units = {**results(drive, free.outputs).units, **errors.units}
            answer = {"verdict": verdict(comparison), "sentence": sentence(comparison)}
            content = {"schema_version": SCHEMA_VERSION, **sources, **answer, "units": units}
            content |= {"validity": validity} if validity else {}
            write_json(place / REPLAY, {**content, "display": display}, indent=1)
            next_study = place / NEXT_STUDY
            if not claimed and answer["verdict"] != "explained":
                write_text(next_study, _next_study(place, driven if fmu else None, path, names, values))
            if report and out is not None:
                text = page(comparison, next_study, validity, passing=fmu is None)
                write_text(place / "report.html", text)
        except (KeyboardInterrupt, Terminated) as stop:  # all rows of the free run are already written
            ended = stop_error(stop, float(measured.time[-1]), "the comparison")
            ended.left = place
            raise ended from None
        result = read_replay(folder, kept=out is not None)
    assert result is not None  # else an error was raised
    return replace(result, comparison=comparison, validity=validity)


def _plant_of(log: Path, columns: Mapping[str, str], folder: Path) -> Path:
    """Build the FMU of the base model for a log with one of its signals; raise InputError for another log."""
    check_given(log, LOG)
    base = load_model(BASE, Path())
    known = {q.name for q in (*base.model.inputs, *base.model.outputs)}
    if known.isdisjoint({*columns.values(), *(split_heading(h)[0] for h in read_header(log))}):
        raise InputError.at(log, f"names no signal of a registered model; name its FMU: cosim replay {log} --fmu FMU")
    return build_fmu(base.recipe(), folder / "plant.fmu")


def _claimed_sensors(fmu: Path) -> list[str]:
    """Return the sensor errors that refine.json beside an FMU claims; FMUs do not contain them."""
    beside = folder_of(fmu)
    effects = content_of(beside / REFINE_RECORD).get("effects") if beside else None
    entries = effects if isinstance(effects, list) else []
    return [str(e.get("name")) for e in entries if isinstance(e, dict) and e.get("kind") == "sensor"]


def _free_run(drive: Drive, file: Path) -> Replayed:
    """Simulate the FMU over the log and write its rows, even after a failure; units are in replay.json."""
    error: SimulationError | None = None
    try:
        free = free_run(drive)
        hold_stops()  # rows that exist from here must not be lost
        rows = results(drive, free.outputs)
    except (SimulationError, KeyboardInterrupt, Terminated) as stop:
        if drive.left is None:
            raise
        rows = results(drive, as_columns(drive.left, drive.outputs))
        error = stop_error(stop, rows.time[-1] if rows.time.size else drive.log.time[0], "the replay")
        error.left = file.parent
    content = {"schema_version": SCHEMA_VERSION, "status": "stopped", "units": dict(rows.units)}
    write_json(file.with_name(REPLAY), content, indent=1)  # rewritten at the end
    rows.write(file)
    if error is not None:
        raise error from None
    return free


def _next_study(folder: Path, fmu: Path | None, log: Path, columns: Mapping[str, str], start: Sequence[str]) -> str:
    """Return the text of a study in `folder` with an FMU and a log, to which the user adds further logs.

    Args:
        fmu: FMU of the study; None for the base model.
        columns: Name in the log → name in the FMU.
        start: Start values of the replay, NAME=VALUE, which a study of `cosim refine` cannot contain.
    """

    def written(path: Path) -> str:
        try:
            name = os.path.relpath(path.resolve(), folder.resolve())
        except ValueError:  # the file is on another drive of Windows
            name = str(path.resolve())
        return as_yaml(Path(name).as_posix())

    lines = [STUDY_HEAD, f"model: {written(fmu) if fmu else BASE}", "logs:"]
    lines.append(f"  estimation: [{written(log)}] # add more logs; co-simulation needs two")
    lines.append("  validation: [] # sealed logs, used once to check the result")
    if columns:
        lines.append(f"columns: {as_yaml(dict(columns))}")
    if start:
        lines.append(f"# the replay used {', '.join(start)}; give these values to `cosim fit` as --start")
    return "\n".join(lines) + "\n"


def results(drive: Drive, outputs: NamedArrays) -> Results:
    """Return commands and FMU outputs as `plant.variable`, measurements as `log.variable`."""
    log, rows = drive.log, len(next(iter(outputs.values())))
    columns = {f"{PLANT_COMPONENT}.{n}": v[:rows] for n, v in (*log.inputs.items(), *outputs.items())}
    columns |= {f"{LOG_COMPONENT}.{n}": v[:rows] for n, v in log.outputs.items()}
    declared = drive.units | dict(log.units)  # the log's units where the FMU declares none
    units = {name: declared.get(name.partition(".")[2], "") for name in columns}
    return Results(log.time[:rows], tuple(columns), np.column_stack(list(columns.values())), units)


def residuals(comparison: Comparison) -> Results:
    """Return the residuals (measured − model), with names such as `free_run.angle`."""
    columns: dict[str, Array] = {}
    units: dict[str, str] = {}
    for horizon, replayed in sorted(comparison.replays.items(), reverse=True):
        size = f"{horizon:g}s" if float(horizon).is_integer() else f"{1000 * horizon:g}ms"
        label = "free_run" if horizon == FREE_RUN else f"within_{size}"
        columns |= {f"{label}.{n}": e for n, e in replayed.errors(comparison.log).items()}
        units |= {f"{label}.{n}": comparison.log.units[n] for n in comparison.log.outputs}
    return Results(comparison.log.time, tuple(columns), np.column_stack(list(columns.values())), units)
