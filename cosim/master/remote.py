"""Stepping a run in a worker process: the caller's side and the worker's side."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cosim.blocks.component import GET, EarlyEnd
from cosim.core.drafts import is_full
from cosim.core.errors import CosimError, DiskFull, SimulationError, Terminated, stop_error
from cosim.core.messages import Note, with_prefix
from cosim.core.scratch import lock_file, scratch, temporary_folder
from cosim.files.files import hold_stops
from cosim.files.results import Results
from cosim.files.state_file import write_durable
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import (
    ExactFile,
    Progress,
    Rows,
    allocate,
    exact_line,
    mapped_table,
    read_exact,
    read_table,
)
from cosim.isolation.watch import Clock, ComponentTimes, Watch, fmi_calls
from cosim.master.c_loop import compile_beforehand
from cosim.master.checkpoint import BESIDE_FILE, ROWS_FILE, STATE_FILE, Continuation, Keeper, Keeping
from cosim.master.master import Master, results_of
from cosim.master.observer import MAX_CHARACTERS, Change, Control, Feed, Inbox, Observer
from cosim.master.own_process import in_own_processes
from cosim.system.recording import RecordedPart, take_signals
from cosim.system.system import System

RUN_MODULES = ("cosim.master.remote", "fmpy.fmi2", "fmpy.logging")
ROWS_FOLDER_PREFIX = ".rows-"
IN_USE = "in-use"  # file that a worker locks while it writes into a folder of checkpoints
GRACE, SHORT_GRACE = 10.0, 2.0  # time [s] for a checkpoint at a stop, with and without checkpoints on request


@dataclass(frozen=True)
class SteppedRun:
    """Result of stepping a run.

    Attributes:
        log: Messages of the FMUs.
        failure: Error because of which the run stopped, if any.
        changes: Changes by observers.
        state: Content of the checkpoint at which the run was stopped, unless a folder contains checkpoints.
        times: Wall times of components and calls, in the form of the manifest.
    """

    results: Results
    log: Sequence[str]
    failure: SimulationError | None = None
    changes: Sequence[Change] = ()
    state: bytes | None = None
    times: Mapping[str, Any] = field(default_factory=dict)


def simulate_in(
    worker: Worker | None,
    system: System,
    steps: int,
    h: float,
    limits: Limits | None = None,
    *,
    folder: Path | None = None,
    observers: Sequence[Observer] = (),
    keeping: Keeping | None = None,
    measure_times: bool = False,
    recording: RecordedPart | None = None,
) -> SteppedRun:
    """Step a system in a worker process, or in this process if there is no worker.

    During the run, the rows are in a file in `folder`, or in the folder of the checkpoints.

    Args:
        folder: Folder for the rows; by default that of temporary files.
        measure_times: Measure the wall time of components.
        recording: Signals of the results, by default all; other signals are not read into memory.

    Raises:
        FmuError: An FMU does not load.
    """
    columns, limits, kept = len(system.columns), limits or Limits(), keeping or Keeping()
    given = 0 if kept.start is None else kept.start.count
    with ExitStack() as stack:
        exchange = stack.enter_context(temporary_folder("changes"))  # remains after a crash of the worker
        if worker is None:
            stepped = _simulate_here(system, steps, h, exchange, observers, kept.start)
            return replace(stepped, results=take_signals(recording, stepped.results))
        compile_beforehand(system)
        worker.start()
        counters = worker.progress
        counters.loop, counters.stop[0], counters.hold[0], counters.sent[0] = b"", 0, 0, 0
        control = Control(system, exchange, counters)
        table, rows = _begin_rows(stack, worker, folder, steps + 1, columns, kept)
        mapped = np.memmap(table, np.float64, "r", shape=(rows, columns)) if observers and columns else None
        feed = Feed(observers, system, steps, h, control, mapped)

        def give(done: int) -> None:
            feed(done)
            counters.stop[0] = feed.stop or feed.failure is not None

        def at(row: int, call: int) -> float:
            return _time_of(system, h, row + (call == GET and 0 < row <= steps))

        times = ComponentTimes(system.names, given) if measure_times else None
        calls = [fmi_calls(getattr(stage.component, "description", None)) for stage in system.stages]
        grace = 0.0 if keeping is None else SHORT_GRACE if kept.interval is None else GRACE
        watch = Watch(system.names, calls, at, limits, 8 * columns, progress=give, times=times, grace=grace)
        settings: dict[str, Any] = {"interval": kept.interval, "given": given, "keeps": keeping is not None}
        settings["channel"] = exchange if observers else None
        log: Sequence[str] = ()
        failure: SimulationError | None = None
        last, ended = None, dict[str, Any]()
        try:
            job = partial(simulate_rows, system, steps, h, table, rows, limits, **settings)
            log, failure, last, ended = worker.call(job, watch=watch)
            hold_stops()  # a signal must not interrupt saving the rows
        except (SimulationError, KeyboardInterrupt, Terminated) as stop:
            failure = stop_error(stop, _time_of(system, h, counters.made[0]))
        except (CosimError, OSError, MemoryError):
            raise
        except Exception as error:  # even after an unexpected error of a library, the rows are kept
            component, t, call = Clock(watch, counters).place()
            reason = " ".join(str(error).split())[:MAX_CHARACTERS]
            message = f"{call}: {type(error).__name__}: {reason} (--in-process shows where)"
            failure = SimulationError(component, t, message)
        done = max(counters.made[0], given)  # A failure before the last given row loses none.
        state = read_state(table.with_name(STATE_FILE)) if kept.folder is None else None
        values = read_table(table, done, columns, mapped=recording is not None)
        beside, changes = read_exact(table.with_name(BESIDE_FILE), done), control.changes
        feed.end(values)
        time = system.start + h * np.arange(done, dtype=np.float64)
        if last is not None:
            time[done - 1] = last
        loop = counters.loop.decode("utf-8", "ignore")
        results = replace(results_of(system, time, values, beside, loop), **ended)
        results = take_signals(recording, results)
        del values  # its file is removed below
    component_times = {} if times is None else times.record()
    return SteppedRun(results, log, failure or feed.failure, changes, state, component_times)


def _simulate_here(
    system: System,
    steps: int,
    h: float,
    exchange: Path,
    observers: Sequence[Observer],
    start: Continuation | None,
) -> SteppedRun:
    """Step a system in this process; changes by observers go through the folder `exchange`."""
    counters, rows = Progress(), Rows.in_memory(steps + 1, len(system.columns))
    control = Control(system, exchange, counters)
    feed = Feed(observers, system, steps, h, control, rows.table)
    if start is not None:
        rows.beside.extend(start.exact)
        rows = replace(rows, given=start.count, keeper=Keeper(Path(), rows.asked, [0], start=start))

    def give(done: int) -> None:
        feed(done)
        if feed.failure is not None:
            raise feed.failure
        if feed.stop:
            raise _early_end(system, h, done)

    inbox = Inbox(exchange, counters) if observers else None
    master = Master(system, steps, h, give if observers else None, rows, inbox=inbox)
    results = master.results()
    feed.end(results.values)
    return SteppedRun(results, _log_lines(system), master.failure or feed.failure, control.changes)


def _begin_rows(
    stack: ExitStack, worker: Worker, folder: Path | None, count: int, columns: int, kept: Keeping
) -> tuple[Path, int]:
    """Create the file for the rows of a run, in the folder of the checkpoints, otherwise as a temporary file.

    A temporary file is beside the results or, if space is lacking there, elsewhere; `stack` removes it. If the disk has
    no space for all rows, the file has room for fewer.

    Returns:
        The file and its number of rows.

    Raises:
        DiskFull: The disk has too little space for the rows.
    """
    elsewhere, given = Path(tempfile.gettempdir()), 0 if kept.start is None else kept.start.count
    rows = count
    while rows >= max(given, 1):
        for parent in (folder or elsewhere, elsewhere) if kept.folder is None else (kept.folder,):
            if kept.folder is None:
                temporary = scratch(ROWS_FOLDER_PREFIX, parent)
                stack.callback(temporary.remove)
                worker.remove_if_killed(temporary.path)
                parent = temporary.path
            new = parent / f"{ROWS_FILE}.new"
            try:
                allocate(new, 8 * columns * rows)
                if kept.start is not None:
                    with new.open("r+b") as stream:
                        stream.write(kept.start.values.tobytes())
                    write_durable(parent / BESIDE_FILE, b"".join(map(exact_line, kept.start.exact)))
                    if kept.start.state is not None:
                        write_durable(parent / STATE_FILE, kept.start.state)
            except OSError as error:
                new.unlink(missing_ok=True)
                if not is_full(error):
                    raise
            else:
                if kept.start is None:
                    (parent / STATE_FILE).unlink(missing_ok=True)
                    (parent / BESIDE_FILE).unlink(missing_ok=True)
                return new.replace(parent / ROWS_FILE), rows
        rows //= 2
    raise DiskFull("the run", 0.0, f"the disk is full: the rows of the run need {8e-6 * columns * count:.3g} MB")


def simulate_rows(
    system: System,
    steps: int,
    h: float,
    table: Path,
    rows: int,
    limits: Limits,
    *,
    channel: Path | None,
    interval: float | None,
    given: int,
    keeps: bool,
) -> tuple[Sequence[str], SimulationError | None, float | None, Mapping[str, Any]]:
    """Simulate in the worker, and write rows into a table file.

    Args:
        table: File of the rows; further files are beside it.
        rows: Number of rows for which the file has room.
        channel: Folder for changes by observers; None if there are no observers.
        interval: As in `Keeping`.
        given: Number of rows of a stopped run that are in the files.
        keeps: True if a checkpoint is written when the run is stopped.

    Returns:
        Messages of the FMUs, the error if any, the time of the last row [s] (None without rows), and fields of the
        results in addition to the rows.
    """
    here.hold_if_abandoned()
    progress, place = here.progress, table.parent
    system = in_own_processes(system, limits)
    for stage in system.stages:
        here.share_log(stage.component)

    def obey(done: int) -> None:
        if progress.stop[0]:
            raise _early_end(system, h, done)

    def tell_loop(loop: str) -> None:  # the caller can read it even after a crash
        progress.loop = loop.encode()[:255]

    lock = lock_file(place / IN_USE, create=True) if interval is not None else None
    mapped, beside = mapped_table(table, rows, len(system.columns)), ExactFile(place / BESIDE_FILE)
    keeper, start = None, None
    try:
        if keeps and given:
            exact, state = read_exact(place / BESIDE_FILE, given), read_state(place / STATE_FILE)
            start = Continuation(mapped[:given].copy(), exact, state)
        if keeps:
            keeper = Keeper(place, progress.asked, progress.ending, interval, start)
        shared = progress.made, progress.doing, tell_loop, progress.asked, keeper, given
        inbox = None if channel is None else Inbox(channel, progress)
        rows_ = Rows(mapped, beside, *shared)
        master = Master(system, steps, h, None if channel is None else obey, rows_, inbox=inbox)
        results = master.results()
    finally:
        beside.close()
        if lock is not None:
            os.close(lock)
    last = float(results.time[-1]) if len(results.time) else None
    about = {name: getattr(results, name) for name in ("notes", "events", "event_counts", "details")}
    return _log_lines(system), master.failure, last, about


def _log_lines(system: System) -> list[str]:
    """Return the messages of all FMUs as lines."""
    stages = [stage.component for stage in system.stages]
    return [with_prefix(f"{one.name}: ", text) for one in stages for text in getattr(one, "log", ())]


def _early_end(system: System, h: float, done: int) -> EarlyEnd:
    """Return the EarlyEnd of a run that an observer ended after `done` rows."""
    return EarlyEnd("an observer", _time_of(system, h, done), Note("it requested the end of the run"))


def _time_of(system: System, h: float, rows: int) -> float:
    """Return the time [s] of the last of the first `rows` rows."""
    return system.start + h * max(0, rows - 1)


def read_state(path: Path) -> bytes | None:
    """Return the content of a state file; None if the file does not exist."""
    return path.read_bytes() if path.is_file() else None
