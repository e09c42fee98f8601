"""Stopped and finished runs in their folders, from which `cosim run FOLDER --resume` and `--until` continue.

results/NAME/checkpoint/run.json   manifest of the run before its outcome
                        state      last checkpoint
                        rows       rows while the run lasts, and afterwards where `record` leaves some out of
                                   results.csv; `beside` holds text and the like
"""

from __future__ import annotations

import copy
import math
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.blocks.model_exchange import MIN_SOLVER_STEPS
from cosim.core.errors import InputError
from cosim.core.scratch import lock_file
from cosim.core.times import rounding, roundings
from cosim.core.version import __version__
from cosim.files.files import write_json
from cosim.files.folders import content_of, has_type, new_run, newest_run, sound_part
from cosim.files.results import Results, read_results, rows_in
from cosim.files.state_file import sync, unpack
from cosim.isolation.rows import read_exact, read_table
from cosim.master.checkpoint import BESIDE_FILE, ROWS_FILE, STATE_FILE, Continuation, RowsHash
from cosim.master.remote import IN_USE, read_state
from cosim.scenario.scenario import Scenario
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.events import is_exchange
from cosim.system.system import System

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


@dataclass(frozen=True)
class StoppedRun:
    """A stopped or finished run, read from its folder.

    Attributes:
        source: File of the record: checkpoint/run.json or manifest.json.
        record: Manifest.
        rows_file: Name of the file with the rows.
        state: Content of the last checkpoint's file as bytes, if any.
        checkpoint: Last checkpoint, read from `state`.
    """

    folder: Path
    source: Path
    record: dict[str, Any]
    rows_file: str
    state: bytes | None
    checkpoint: Mapping[str, Any]

    def base(self, warnings: Sequence[str] | None) -> dict[str, Any]:
        """Return the manifest without timings and outcome.

        Args:
            warnings: Warnings of the system; None for the recorded ones.
        """
        record = copy.deepcopy(self.record)
        for key in ("no_report", EXTRA):
            record.pop(key, None)
        record["warnings"] = list(record.get("warnings", ())) if warnings is None else [*warnings, *self.warnings]
        return record | {"status": "ok", "loop": "", "timings": {}, "criteria": []}

    @property
    def warnings(self) -> list[str]:
        """Return the warnings that do not come from the scenario."""
        return list(self.record.get(EXTRA, {}).get("warnings", ()))

    def solver_steps(self, system: System) -> dict[str, float]:
        """Return component → longest solver step [s] so far, where this default depends on the stop time."""
        start = self._first.start_time
        stop = start + self._first.step * self._first.steps  # as the master computes it
        exchanged: list[Any] = [stage.component for stage in system.stages if is_exchange(stage.component)]
        return {c.name: (stop - start) / MIN_SOLVER_STEPS for c in exchanged if c.instance.longest is None}

    def scenario(self, until: float | None, solver_steps: Mapping[str, float] = MappingProxyType({})) -> ScenarioFile:
        """Return the scenario, with the stop time `until` [s] if it is not None.

        Args:
            solver_steps: Component → longest step of its solver [s].

        Raises:
            InputError: `until` is not later than the last row.
        """
        start = self.record["scenario"].get("start_time", 0.0)
        overrides = [] if until is None else [f"duration={until - start!r}"]
        overrides += [f"components.{name}.solver_step={longest!r}" for name, longest in solver_steps.items()]
        if until is not None and not self._reached < until < math.inf:
            raise InputError.at(
                self.folder,
                f"--until {until:g} s is not after t = {self._reached:g} s, the last row; give a later time",
            )
        return ScenarioFile(self.source, overrides, option="--until")

    @property
    def end(self) -> int:
        """Return the last communication point of the scenario so far."""
        return self._first.steps

    @cached_property
    def _first(self) -> Scenario:
        """Return the scenario of the run so far."""
        return ScenarioFile(self.source).scenario

    @cached_property
    def _results(self) -> Results:
        """Return the results so far; raise InputError if there are none."""
        rows = rows_in(self.folder)
        if rows is None:
            raise InputError.at(self.folder, NOTHING_TO_RESUME if self.state is None else ROWS_OF_ANOTHER_RUN)
        return read_results(rows, {}, self.record.get("beside", ()))

    @property
    def _reached(self) -> float:
        """Return the time [s] of the last checkpoint or row."""
        if self.state is not None:
            return float(self.checkpoint["time"])
        return float(self._results.time[-1]) if len(self._results.time) else -math.inf

    def start(self, system: System, scenario: Scenario) -> Continuation | None:
        """Return rows and state from which the run continues; None if it must start again, as rows are missing.

        Raises:
            InputError: The run is finished, or its files do not fit together.
        """
        kept = self.folder / CHECKPOINT
        count = self.checkpoint["point"] + 1 if self.checkpoint else 0
        start = None
        if (rows := kept / ROWS_FILE).is_file():
            width = len(system.columns)
            if not count:
                raise InputError.at(kept, STOPPED_BEFORE_ROWS)
            if rows.stat().st_size < 8 * count * width:
                raise InputError.at(rows, ROWS_OF_ANOTHER_RUN)
            start = Continuation(read_table(rows, count, width), read_exact(kept / BESIDE_FILE, count), self.state)
        elif system.recording is None:
            # the first rows of the results
            results, rows = self._results, self.folder / self.rows_file
            expected = scenario.start_time + scenario.step * np.arange(len(results.time), dtype=np.float64)
            on_grid = np.abs(results.time - expected) <= roundings(expected, scenario.step)
            complete = len(results.time) if on_grid.all() else int(np.argmin(on_grid))  # an FMU may end between
            count = count or complete
            if not complete:
                raise InputError.at(rows, STOPPED_BEFORE_ROWS)
            if results.columns != system.columns or complete < count:
                raise InputError.at(rows, ROWS_OF_ANOTHER_RUN)
            readers: dict[str, Callable[[str], Any]] = {"Binary": bytes.fromhex, "String": str}
            columns = [
                [readers.get(system.signals[name].kind, int)(str(value)) for value in results.exact[name][:count]]
                for name in system.beside
            ]
            values = np.ascontiguousarray(results.values[:count])
            start = Continuation(values, [*zip(*columns, strict=True)], self.state)
        if start and self.checkpoint and RowsHash().of(start.values, start.exact, count) != self.checkpoint["rows"]:
            raise InputError.at(self.folder, ROWS_OF_ANOTHER_RUN)
        if start is None or (start.count > scenario.steps and rows_in(self.folder) is not None):
            end, time_ = scenario.start_time + scenario.duration, self._results.time
            if len(time_) and time_[-1] >= end - rounding(end, scenario.step):
                raise InputError.at(
                    self.folder, f"its run is finished, at t = {end:g} s; to extend it, give a later time as --until"
                )
        return start


def open_stopped(path: Path, stack: ExitStack) -> StoppedRun:
    """Return the run in a folder, and lock the folder against other commands until the stack is closed.

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
    kept = folder / CHECKPOINT
    _wait_for_worker(kept)
    checkpoint: dict[str, Any] = {}
    state = read_state(kept / STATE_FILE)
    if state is not None:
        try:
            checkpoint = unpack(state)
            if type(checkpoint["point"]) is not int:
                raise TypeError("it has no point")
        except (ValueError, LookupError, TypeError, RecursionError) as error:  # also BadState
            raise InputError.at(kept / STATE_FILE, DAMAGED_CHECKPOINT.format(reason=str(error))) from None
    rows = rows_in(folder)
    rows_file = record.get(EXTRA, {}).get("rows", "results.csv" if rows is None else rows.name)
    return StoppedRun(folder, source, record, rows_file, state, checkpoint)


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
