"""Steps of a run in a worker process, seen from both sides."""

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

from cosim.base.arrays import Array
from cosim.base.drafts import is_full
from cosim.base.errors import CosimError, DiskFull, SimulationError, Terminated, stop_error
from cosim.base.messages import Note, with_prefix
from cosim.base.scratch import lock_file, scratch, temporary_folder
from cosim.blocks.component import EarlyEnd
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import (
    GET,
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
from cosim.master.checkpoint import BESIDE, ROWS, STATE, Continuation, Keeper, Keeping
from cosim.master.inbox import Change, Control, Inbox
from cosim.master.master import StoppedRun, results_of, simulate
from cosim.master.observer import MAX_CHARACTERS, Feed, ObservedRun, Observer
from cosim.master.own_process import in_own_processes
from cosim.storage.files import hold_stops
from cosim.storage.results import Results
from cosim.storage.state_file import write_durable
from cosim.system.recording import RecordedPart, take_signals
from cosim.system.system import System

MODULES = ("cosim.master.remote", "fmpy.fmi2", "fmpy.logging")
PREFIX = ".rows-"
IN_USE = "in-use"  # file that a worker locks while it writes into a folder of checkpoints


@dataclass(frozen=True)
class SteppedRun:
    """Outcome of a stepped run.

    Attributes:
        log: Messages of the FMUs.
        failure: The failure, if any.
        changes: Changes by observers.
        state: Checkpoint at a stop, unless a folder keeps checkpoints.
        times: Wall times of components and calls, as for a manifest.
    """

    results: Results
    log: Sequence[str]
    failure: SimulationError | None = None
    changes: Sequence[Change] = ()
    state: bytes | None = None
    times: Mapping[str, Any] = field(default_factory=dict)


def _log_lines(system: System) -> list[str]:
    """Return the messages of all FMUs as lines."""
    stages = [stage.component for stage in system.stages]
    return [with_prefix(f"{one.name}: ", text) for one in stages for text in getattr(one, "log", ())]


def simulate_here(
    system: System, steps: int, h: float, observers: Sequence[Observer] = (), *, start: Continuation | None = None
) -> SteppedRun:
    """Step a system in this process."""
    with ExitStack() as stack:
        control, inbox, counters = None, None, Progress()
        if observers:
            exchange = stack.enter_context(temporary_folder("changes"))
            control, inbox = Control(system, exchange, counters), Inbox(exchange, counters)
        feed = _feed(observers, system, steps, h, control)
        rows = Rows.in_memory(steps + 1, len(system.columns))
        feed.table = rows.table
        if start is not None:
            rows.beside.extend(start.exact)  # type: ignore[attr-defined]
            rows = replace(rows, given=start.count, keeper=Keeper(Path(), rows.asked, [0], start=start))

        def give(done: int) -> None:
            feed(done)
            if feed.failure is not None:
                raise feed.failure
            if feed.stop:
                raise _early_end(system, h, done)

        failure: SimulationError | None = None
        try:
            results = simulate(system, steps, h, give if observers else None, rows, inbox=inbox)
        except StoppedRun as run:
            results, failure = run.results, run.error
        feed.end(results.values)
        changes = () if control is None else control.changes
        return SteppedRun(results, _log_lines(system), failure or feed.failure, changes)


def _feed(observers: Sequence[Observer], system: System, steps: int, h: float, control: Control | None) -> Feed:
    """Return the feed of rows to a run's observers, which may control it."""
    run = ObservedRun(system.columns, steps + 1, system.start, h, system.units, control)
    return Feed(observers, run, _times_of(system, steps, h))


def _early_end(system: System, h: float, done: int) -> EarlyEnd:
    """Return the early end requested by an observer."""
    return EarlyEnd("an observer", _last_time(system, h, done), Note("it asked for the end"))


def _times_of(system: System, steps: int, h: float) -> Array:
    """Return the times [s] of all rows."""
    return system.start + h * np.arange(steps + 1, dtype=np.float64)


def _last_time(system: System, h: float, rows: int) -> float:
    """Return the time [s] of the last finished row."""
    return system.start + h * max(0, rows - 1)


# -- in the worker ------------------------------------------------------------------------------


@dataclass(frozen=True)
class RowsJob:
    """Files and settings of a run in a worker.

    Attributes:
        table: File of the rows; further files are beside it.
        observed: Whether the caller may request an early end.
        interval: As in `Keeping`.
        given: Number of rows of a stopped run that are in the files.
        keeps: Whether a stop makes a checkpoint.
        channel: Folder of the changes by observers.
    """

    table: Path
    limits: Limits
    channel: Path
    observed: bool = False
    interval: float | None = None
    given: int = 0
    keeps: bool = False


@dataclass(frozen=True)
class WorkerEnd:
    """The end of the steps in a worker; the rows are in files.

    Attributes:
        last: Time of the last row [s], if any.
        about: Fields of the results beside the rows.
    """

    log: Sequence[str] = ()
    failure: SimulationError | None = None
    last: float | None = None
    about: Mapping[str, Any] = field(default_factory=dict)


def simulate_rows(system: System, steps: int, h: float, job: RowsJob) -> WorkerEnd:
    """Simulate into a table file."""
    here.hold_if_abandoned()
    table = job.table

    def obey(done: int) -> None:
        if here.progress.stop[0]:
            raise _early_end(system, h, done)

    system = in_own_processes(system, job.limits)
    for stage in system.stages:
        here.share_log(stage.component)
    progress = here.progress
    lock = lock_file(table.with_name(IN_USE), create=True) if job.interval is not None else None
    mapped, beside = mapped_table(table, steps + 1, len(system.columns)), ExactFile(table.with_name(BESIDE))
    failure: SimulationError | None = None
    try:
        keeper = _keeper(job, mapped) if job.keeps else None
        shared = progress.made, progress.doing, _store_loop, progress.asked, keeper, job.given
        rows = Rows(mapped, beside, *shared)
        inbox = Inbox(job.channel, progress) if job.observed else None
        results = simulate(system, steps, h, obey if job.observed else None, rows, inbox=inbox)
    except StoppedRun as run:
        results, failure = run.results, run.error
    except OSError as error:
        if not is_full(error):
            raise
        count = progress.made[0]
        reason = f"the disk is full: it has room for {count} of {steps + 1} rows while the run lasts"
        return WorkerEnd(_log_lines(system), DiskFull("the run", _last_time(system, h, count), reason))
    finally:
        beside.close()
        if lock is not None:
            os.close(lock)
    last = float(results.time[-1]) if len(results.time) else None
    about = {name: getattr(results, name) for name in ("notes", "events", "event_counts", "details")}
    return WorkerEnd(_log_lines(system), failure, last, about)


def _keeper(job: RowsJob, mapped: Array) -> Keeper:
    """Return the keeper of a run's checkpoints."""
    progress, place = here.progress, job.table.parent
    start = None
    if job.given:
        exact = read_exact(place / BESIDE, job.given)
        state = place / STATE
        content = state.read_bytes() if state.is_file() else None
        start = Continuation(mapped[: job.given].copy(), exact, content)
    exact_rows = partial(read_exact, place / BESIDE)
    return Keeper(place, progress.asked, progress.ending, job.interval, start, exact_rows, here.hold_if_abandoned)


def _store_loop(loop: str) -> None:
    """Store which loop steps the run (C or Python), for the caller to read even after a crash."""
    here.progress.loop = loop.encode()[:255]


# -- in the caller -----------------------------------------------------------------------------------


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
    """Step a system in a worker process, or in this process without one.

    The rows are in a file within `folder` until the end, or in the folder of the checkpoints.

    Args:
        folder: By default that of temporary files.
        measure_times: Whether to sum the wall time of components.
        recording: Signals of the results, by default all; the others are not read into memory.

    Raises:
        FmuError: An FMU does not load.
    """
    columns, limits, kept = len(system.columns), limits or Limits(), keeping or Keeping()
    if worker is None:
        stepped = simulate_here(system, steps, h, observers, start=kept.start)
        return replace(stepped, results=take_signals(recording, stepped.results))

    def give(rows: int) -> None:
        feed(rows)
        worker.progress.stop[0] = feed.is_over

    given = kept.first_rows
    times = ComponentTimes(system.names, given) if measure_times else None
    grace = 0.0 if keeping is None else keeping.grace
    calls = [fmi_calls(getattr(stage.component, "description", None)) for stage in system.stages]

    def at(rows: int, call: int) -> float:
        return system.start + h * (max(0, rows - 1) + (call == GET and 0 < rows <= steps))

    watch = Watch(system.names, calls, at, limits, 8 * columns, progress=give, times=times, grace=grace)
    compile_beforehand(system)
    with ExitStack() as stack:
        worker.start()
        counters = worker.progress
        counters.loop, counters.stop[0], counters.hold[0], counters.sent[0] = b"", 0, 0, 0
        exchange = stack.enter_context(temporary_folder("changes"))  # outlives a crash of the worker
        control = Control(system, exchange, counters)
        table = _begin_rows(stack, worker, folder, 8 * columns * (steps + 1), kept)
        feed = _feed(observers, system, steps, h, control if observers else None)
        if observers and columns:
            feed.table = np.memmap(table, np.float64, "r", shape=(steps + 1, columns))
        job = RowsJob(table, limits, exchange, bool(observers), kept.interval, given, keeping is not None)
        end = _end_of(worker, system, steps, h, job, watch)
        done = max(counters.made[0], given)  # A failure before the last given row loses none.
        state = read_state(table.with_name(STATE)) if kept.folder is None else None
        values = read_table(table, done, columns, mapped=recording is not None)
        beside, changes = read_exact(table.with_name(BESIDE), done), control.changes
        feed.end(values)
        time = _times_of(system, steps, h)
        if end.last is not None:
            time[done - 1] = end.last
        loop = counters.loop.decode("utf-8", "ignore")
        results = replace(results_of(system, time[:done], values, beside, loop=loop), **end.about)
        results = take_signals(recording, results)
        del values  # Its file is removed.
    component_times = {} if times is None else times.record()
    return SteppedRun(results, end.log, end.failure or feed.failure, changes, state, component_times)


def _begin_rows(stack: ExitStack, worker: Worker, folder: Path | None, size: int, kept: Keeping) -> Path:
    """Create and return the file of the rows of a run, in the folder of the checkpoints, or until the stack ends.

    Without checkpoints the folder is beside the results, or elsewhere for lack of space.

    Raises:
        DiskFull: The rows do not fit.
    """
    elsewhere = Path(tempfile.gettempdir())
    parents = (folder or elsewhere, elsewhere) if kept.folder is None else (kept.folder,)
    for parent in parents:
        if kept.folder is None:
            temporary = scratch(PREFIX, parent)
            stack.callback(temporary.remove)
            worker.take_along(temporary.path)
            parent = temporary.path
        new = parent / f"{ROWS}.new"
        try:
            allocate(new, size)
            if kept.start is not None:
                _write_start(new, kept.start)
        except OSError as error:
            new.unlink(missing_ok=True)
            if not is_full(error):
                raise
        else:
            if kept.start is None:
                (parent / STATE).unlink(missing_ok=True)
                (parent / BESIDE).unlink(missing_ok=True)
            return new.replace(parent / ROWS)
    reason = f"the disk is full: it has no room for the rows of the run, {size / 1e6:.3g} MB, while it lasts"
    raise DiskFull("the run", 0.0, reason)


def _end_of(worker: Worker, system: System, steps: int, h: float, job: RowsJob, watch: Watch) -> WorkerEnd:
    """Make the steps in the worker; return how they ended."""
    counters = worker.progress
    try:
        end: WorkerEnd = worker.call(simulate_rows, system, steps, h, job, watch=watch)
        hold_stops()  # The rows must be saved.
    except (SimulationError, KeyboardInterrupt, Terminated) as stop:
        return WorkerEnd(failure=stop_error(stop, _last_time(system, h, counters.made[0])))
    except (CosimError, OSError, MemoryError):
        raise
    except Exception as error:  # An unexpected error of a library is no reason to lose the rows.
        component, at, call = Clock(watch, counters).place()
        reason = " ".join(str(error).split())[:MAX_CHARACTERS]
        message = f"{call}: {type(error).__name__}: {reason} (--in-process shows where)"
        return WorkerEnd(failure=SimulationError(component, at, message))
    return end


def read_state(path: Path) -> bytes | None:
    """Return the content of a state file, if any."""
    return path.read_bytes() if path.is_file() else None


def _write_start(file: Path, start: Continuation) -> None:
    """Write the rows of `start` into a file, and its exact values and state beside it."""
    with file.open("r+b") as stream:
        stream.write(start.values.tobytes())
    write_durable(file.with_name(BESIDE), b"".join(map(exact_line, start.exact)))
    if start.state is not None:
        write_durable(file.with_name(STATE), start.state)
