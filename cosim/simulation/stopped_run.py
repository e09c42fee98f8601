"""Stopped and finished runs in their folders, from which `cosim run FOLDER --resume` and `--until` continue.

results/NAME/checkpoint/run.json   manifest of the run before its outcome
                        state      last checkpoint
                        rows       rows while the run lasts, and afterwards where `record` leaves some out of
                                   results.csv; `beside` holds text and the like
"""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cosim.blocks.compiling import compiling, permission
from cosim.blocks.model_exchange import MIN_SOLVER_STEPS
from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.core.messages import Note
from cosim.core.scratch import lock_file
from cosim.core.times import rounding, roundings
from cosim.core.version import __version__
from cosim.files.files import check_writable, write_json
from cosim.files.folders import content_of, has_type, new_run, newest_run, sound_part
from cosim.files.results import Results, read_results, rows_in
from cosim.files.state_file import sync, unpack
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import read_exact, read_table
from cosim.master.beforehand import with_feedthrough, without_ended_states
from cosim.master.checkpoint import BESIDE_FILE, ROWS_FILE, STATE_FILE, Continuation, RowsHash
from cosim.master.observer import Change, with_changes
from cosim.master.remote import IN_USE, read_state
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.manifest import check_pinned
from cosim.system.events import is_exchange
from cosim.system.system import System, build_system

NOTHING_TO_RESUME = (
    "contains no stopped run; start one with `cosim run SCENARIO`, with `checkpoint: 60 s` to store checkpoints"
)
DAMAGED_CHECKPOINT = "the checkpoint is damaged: {reason}; run the scenario again from its start"
OTHER_VERSION = (
    "its run was started by cosim {version}, and this is {own}, which may compute other values; continue with "
    "{version}, or run the scenario again from its start"
)
ROWS_OF_ANOTHER_RUN = (
    "the recorded rows do not match the checkpoint: a file in this folder was changed or removed; restore the folder, "
    "or run the scenario again from its start"
)
STOPPED_BEFORE_ROWS = "its run was stopped before its first row or checkpoint; run the scenario again from its start"

CHECKPOINT, RUN, MANIFEST_FILE = "checkpoint", "run.json", "manifest.json"
PATIENCE, PAUSE = 15.0, 0.05  # time [s] for the worker of a killed command to end, and between two looks
EXTRA = "files"  # key of run.json beside those of a manifest: name of the rows file, warnings of an SSP
EXTRA_KIND = {"rows": str, "warnings": [str]}
COMPILED = "compile"  # key of a manifest: True if a resumed run may compile sources of FMUs


@dataclass
class Prepared:
    """A run that is ready to be stepped.

    Attributes:
        record: Manifest without timings and outcome.
        warnings: Warnings that do not come from the scenario.
        changes: Changes by observers before the run was stopped.
        start: Rows and state from which a stopped run continues; None for a new run.
    """

    file: ScenarioFile
    place: Path
    system: System
    rows_file: str
    record: dict[str, Any]
    warnings: Sequence[str] = ()
    start: Continuation | None = None
    changes: Sequence[Change] = ()


def prepare_stopped(
    path: Path, until: float | None, worker: Worker | None, tell: Callable[[str], None], stack: ExitStack
) -> Prepared:
    """Return a stopped or finished run that is ready to continue; `tell` shows how it continues.

    Args:
        until: New stop time [s]; None for that of the scenario.
        stack: Stack that holds the lock of the folder and the permission of the run to compile sources.

    Raises:
        InputError: The run is finished, `until` is not later than the last row, or the files do not fit together.
    """
    folder, source, record, state, checkpoint = _open_stopped(path, stack)
    extra = record.pop(EXTRA, {})

    @cache
    def results() -> Results:
        if (table := rows_in(folder)) is None:
            raise InputError.at(folder, NOTHING_TO_RESUME if state is None else ROWS_OF_ANOTHER_RUN)
        return read_results(table, {}, record.get("beside", ()))

    overrides, first, begin = list[str](), None, record["scenario"].get("start_time", 0.0)
    if until is not None:
        times = results().time if state is None else [checkpoint["time"]]
        reached = float(times[-1]) if len(times) else -math.inf
        if not reached < until < math.inf:
            reason = f"--until {until:g} s is not after t = {reached:g} s, the last row; give a later time"
            raise InputError.at(folder, reason)
        overrides, first = [f"duration={until - begin!r}"], ScenarioFile(source).scenario
    file = ScenarioFile(source, overrides, option="--until")
    check_pinned(file)
    stack.enter_context(compiling(permission.get() or record.get(COMPILED) is True))
    system, solver_steps = build_system(file), dict[str, float]()
    if first is not None:  # the default of the longest solver step depends on the stop time
        stop = first.start_time + first.step * first.steps  # as the master computes it
        longest = (stop - first.start_time) / MIN_SOLVER_STEPS
        exchanged: list[Any] = [stage.component for stage in system.stages if is_exchange(stage.component)]
        solver_steps = {component.name: longest for component in exchanged if component.instance.longest is None}
    if solver_steps:
        overrides += [f"components.{name}.solver_step={longest!r}" for name, longest in solver_steps.items()]
        file = ScenarioFile(source, overrides, option="--until")
        system = build_system(file)
    system, scenario = with_feedthrough(file, system, worker), file.scenario
    table = rows_in(folder)
    rows_file = extra.get("rows", "results.csv" if table is None else table.name)
    start = _continuation(folder, state, checkpoint, system, scenario.step, results)
    if start is None or (start.count > scenario.steps and table is not None):
        end, time_ = scenario.start_time + scenario.duration, results().time
        if len(time_) and time_[-1] >= end - rounding(end, scenario.step):
            reason = f"its run is finished, at t = {end:g} s; to extend it, give a later time as --until"
            raise InputError.at(folder, reason)
    if first is not None and start is not None:
        grid, limits = (scenario.steps, scenario.step), scenario.limits or Limits()
        start, ended = without_ended_states(system, grid, start, first.steps, worker, limits)
        if ended:
            end = scenario.start_time + first.steps * scenario.step
            reason = f"the saved state does not go beyond t = {end:g} s, the end that the FMU was told"
            tell(Note(f"{', '.join(ended)}: {reason}; so all steps are made again"))
    check_writable(folder, (rows_file, MANIFEST_FILE, "report.html"), file.files)
    if changes := [Change(point, values) for point, values in checkpoint.get("changes", ())]:
        system = replace(system, events=with_changes(system.events, changes))
        start = start and replace(start, changes=changes)
    warnings = list(extra.get("warnings", ()))  # those that do not come from the scenario
    is_recorded = until is None and extra
    record["warnings"] = list(record.get("warnings", ())) if is_recorded else [*system.warnings, *warnings]
    record.pop("no_report", None)
    record |= {"status": "ok", "loop": "", "timings": {}, "criteria": []}
    record["scenario"]["duration"] = scenario.duration
    for name, longest in solver_steps.items():
        record["scenario"]["components"][name]["solver_step"] = longest
    if start is None:
        note = (
            f"record omits signals or rows, so the run is repeated from t = {scenario.start_time:g} s; checkpoint: "
            "stores all of them"
        )
    else:
        last = scenario.start_time + (start.count - 1) * scenario.step
        note = f"the run continues from t = {last:g} s, row {start.count} of {scenario.steps + 1}"
        if names := start.unsaved(system):
            note += f"; the state of {', '.join(names)} is not saved, so all steps are repeated"
    tell(Note(note))
    return Prepared(file, folder, system, rows_file, record, warnings, start, changes)


def _open_stopped(path: Path, stack: ExitStack) -> tuple[Path, Path, dict[str, Any], bytes | None, dict[str, Any]]:
    """Lock the folder of a run against other commands until the stack is closed.

    Returns:
        The folder, the file of the record (checkpoint/run.json or manifest.json) and its content, the file of the last
        checkpoint as bytes and its content.

    Raises:
        InputError: The folder contains no run to continue, or a checkpoint that is damaged or of another version.
    """
    folder = path.parent if path.name == MANIFEST_FILE and path.is_file() else newest_run(path)
    if not folder.is_dir():
        raise InputError.at(
            path, "not the folder of a run; --resume and --until take the folder of an earlier run, as results/NAME"
        )
    source = next((file for file in (folder / CHECKPOINT / RUN, folder / MANIFEST_FILE) if file.is_file()), None)
    record = {} if source is None else content_of(source)
    if source is None or (source.name == MANIFEST_FILE and "scenario" not in record):
        raise InputError.at(folder, NOTHING_TO_RESUME)
    sound, _ = sound_part(folder / MANIFEST_FILE, record)
    wrong = [key for key in record if key not in sound or (key == EXTRA and not has_type(record[key], EXTRA_KIND))]
    if wrong or "scenario" not in sound:
        raise InputError.at(source, DAMAGED_CHECKPOINT.format(reason=f"it has no {[*wrong, 'scenario'][0]}"))
    if (version := record.get("cosim_version")) != __version__:
        raise InputError.at(source, OTHER_VERSION.format(version=version, own=__version__))
    stack.enter_context(new_run(folder, "", "cosim run", force=True))
    _wait_for_worker(folder / CHECKPOINT)
    file = folder / CHECKPOINT / STATE_FILE
    state = read_state(file)
    try:
        checkpoint = {} if state is None else unpack(state)
        if state is not None and type(checkpoint["point"]) is not int:
            raise TypeError("it has no point")
    except (ValueError, LookupError, TypeError, RecursionError) as error:  # also BadState
        raise InputError.at(file, DAMAGED_CHECKPOINT.format(reason=str(error))) from None
    return folder, source, record, state, checkpoint


def _continuation(
    folder: Path,
    state: bytes | None,
    checkpoint: Mapping[str, Any],
    system: System,
    step: float,
    results: Callable[[], Results],
) -> Continuation | None:
    """Return rows and state from which a run continues; None if it must start again, as rows are missing.

    Raises:
        InputError: The files do not fit together.
    """
    rows, count = folder / CHECKPOINT / ROWS_FILE, checkpoint["point"] + 1 if checkpoint else 0
    if rows.is_file():
        width = len(system.columns)
        if not count:
            raise InputError.at(folder / CHECKPOINT, STOPPED_BEFORE_ROWS)
        if rows.stat().st_size < 8 * count * width:
            raise InputError.at(rows, ROWS_OF_ANOTHER_RUN)
        values: Array = read_table(rows, count, width)
        exact: Sequence[tuple[Any, ...]] = read_exact(rows.with_name(BESIDE_FILE), count)
    elif system.recording is None:
        # the first rows of the results
        whole = results()
        expected = system.start + step * np.arange(len(whole.time), dtype=np.float64)
        on_grid = np.abs(whole.time - expected) <= roundings(expected, step)
        complete = len(whole.time) if on_grid.all() else int(np.argmin(on_grid))  # an FMU may end between
        count = count or complete
        if not complete:
            raise InputError.at(folder, STOPPED_BEFORE_ROWS)
        if whole.columns != system.columns or complete < count:
            raise InputError.at(folder, ROWS_OF_ANOTHER_RUN)
        readers: dict[str, Callable[[str], Any]] = {"Binary": bytes.fromhex, "String": str}
        columns = [
            [readers.get(system.signals[name].kind, int)(str(value)) for value in whole.exact[name][:count]]
            for name in system.beside
        ]
        values, exact = np.ascontiguousarray(whole.values[:count]), [*zip(*columns, strict=True)]
    else:
        return None
    if checkpoint and RowsHash().of(values, exact, count) != checkpoint["rows"]:
        raise InputError.at(folder, ROWS_OF_ANOTHER_RUN)
    return Continuation(values, exact, state)


def _wait_for_worker(kept: Path) -> None:
    """Wait until the worker of a killed command has ended."""
    path = kept / IN_USE
    for _ in range(round(PATIENCE / PAUSE)):
        if not path.is_file():
            return
        lock = lock_file(path)
        if lock is not None:
            os.close(lock)
            return
        time.sleep(PAUSE)
    raise InputError.at(kept, "a process of the killed run still writes into it; try again in a moment")


def remove_checkpoints(folder: Path) -> None:
    """Remove the checkpoints of another run, once its worker has ended."""
    _wait_for_worker(folder / CHECKPOINT)
    shutil.rmtree(folder / CHECKPOINT, ignore_errors=True)


def write_run(folder: Path, record: Mapping[str, Any], rows_file: str, warnings: Sequence[str]) -> Path:
    """Write run.json; return the folder of checkpoints.

    Args:
        warnings: Warnings in the record that do not come from the scenario.
    """
    kept = folder / CHECKPOINT
    kept.mkdir(exist_ok=True)
    write_json(kept / RUN, {**record, EXTRA: {"rows": rows_file, "warnings": list(warnings)}})
    sync(kept / RUN)
    sync(kept)
    return kept


def end_keeping(folder: Path, *, is_kept: bool, keeps_rows: bool = False) -> None:
    """Remove checkpoint files that the results make unnecessary.

    Args:
        is_kept: True if the checkpoints in the folder belong to this run.
        keeps_rows: True if the rows are kept, because the results contain only a part of them.
    """
    kept = folder / CHECKPOINT
    if not is_kept:
        shutil.rmtree(kept, ignore_errors=True)
    for name in (IN_USE,) if keeps_rows else (ROWS_FILE, BESIDE_FILE, IN_USE):
        with suppress(OSError):
            (kept / name).unlink(missing_ok=True)
