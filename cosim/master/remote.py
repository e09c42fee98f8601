"""Steps of a run in a worker process, seen from both sides."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.drafts import is_full
from cosim.base.errors import CosimError, DiskFull, SimulationError, Terminated, stop_error
from cosim.base.messages import with_prefix
from cosim.base.scratch import ScratchFolder, lock_file, scratch, temporary_folder
from cosim.blocks.component import EarlyEnd
from cosim.isolation import worker as here
from cosim.isolation.component_times import ComponentTimes, Slower
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
from cosim.isolation.watch import Clock, Watch, fmi_calls
from cosim.master import messages
from cosim.master.c_loop import compile_beforehand
from cosim.master.checkpoint import BESIDE, ROWS, STATE, Continuation, Keeper, Keeping
from cosim.master.inbox import Change, Channel, Control, FileChannel, Inbox, MemoryChannel
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
DISK_RETRY_SHARE = 0.9  # share of rows to try next on a full disk


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
    channel = MemoryChannel()
    feed = _feed(observers, system, steps, h, channel)
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

    try:
        with _inbox(system, h, channel, observed=bool(observers)) as inbox:
            results, failure = simulate(system, steps, h, give if observers else None, rows, inbox=inbox), None
    except StoppedRun as run:
        results, failure = run.results, run.error
    feed.end(results.values)
    return SteppedRun(results, _log_lines(system), failure or feed.failure, channel.noted())


def _feed(observers: Sequence[Observer], system: System, steps: int, h: float, channel: Channel) -> Feed:
    """Return the feed of rows to a run's observers, which may send changes through a channel."""
    time = _times_of(system, steps, h)
    control = Control(system, channel) if observers else None
    return Feed(observers, ObservedRun(system.columns, steps + 1, system.start, h, system.units, control), time)


def _early_end(system: System, h: float, done: int) -> EarlyEnd:
    """Return the early end requested by an observer."""
    return EarlyEnd("an observer", _last_time(system, h, done), messages.END_REQUESTED())


def _times_of(system: System, steps: int, h: float) -> Array:
    """Return the times [s] of all rows."""
    return system.start + h * np.arange(steps + 1, dtype=np.float64)


def _time_of_call(system: System, steps: int, h: float, rows: int, call: int) -> float:
    """Return the simulated time [s] of a call after so many finished rows."""
    return system.start + h * (max(0, rows - 1) + (call == GET and 0 < rows <= steps))


def _last_time(system: System, h: float, rows: int) -> float:
    """Return the time [s] of the last finished row."""
    return system.start + h * max(0, rows - 1)


@contextmanager
def _inbox(system: System, h: float, channel: Channel, *, observed: bool) -> Iterator[Inbox | None]:
    """Yield the inbox of a run with observers or partners, None without; links to partners are open meanwhile."""
    plan = None if system.real_time is None else system.real_time.live
    if plan is None:
        yield Inbox(channel) if observed else None
        return
    from cosim.master.live_values import LiveValues

    with closing(LiveValues(system, plan, h)) as partners:
        yield Inbox(channel, partners)


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
        details: Entries of the manifest about the steps.
    """

    log: Sequence[str] = ()
    failure: SimulationError | None = None
    last: float | None = None
    notes: Sequence[str] = ()
    events: tuple[tuple[float, str, str], ...] = ()
    event_counts: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)


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
        shared = progress.made, progress.doing, _store_loop, progress.asked, keeper, job.given, progress.steps
        rows = Rows(mapped, beside, *shared)
        with _inbox(system, h, FileChannel(job.channel, progress), observed=job.observed) as inbox:
            results = simulate(system, steps, h, obey if job.observed else None, rows, inbox=inbox)
    except StoppedRun as run:
        results, failure = run.results, run.error
    except OSError as error:
        if not is_full(error):
            raise
        count = progress.made[0]
        return WorkerEnd(_log_lines(system), _disk_full(_last_time(system, h, count), count, steps + 1))
    finally:
        beside.close()
        if lock is not None:
            os.close(lock)
    last = float(results.time[-1]) if len(results.time) else None
    ends = results.events, results.event_counts, results.details
    return WorkerEnd(_log_lines(system), failure, last, results.notes, *ends)


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


def simulate_apart(
    worker: Worker,
    system: System,
    steps: int,
    h: float,
    folder: Path,
    limits: Limits | None = None,
    *,
    observers: Sequence[Observer] = (),
    keeping: Keeping | None = None,
    warn: Callable[[Slower], None] | None = None,
    recording: RecordedPart | None = None,
) -> SteppedRun:
    """Step a system in a worker process.

    The rows are in a file within `folder` until the end, or in the folder of the checkpoints.

    Args:
        warn: Function called when a component gets much slower; None measures no times of components.
        recording: Signals of the results, by default all; the others are not read into memory.

    Raises:
        FmuError: An FMU does not load.
    """
    columns, limits, kept = len(system.columns), limits or Limits(), keeping or Keeping()

    def give(rows: int) -> None:
        feed(rows)
        worker.progress.stop[0] = feed.is_over

    last, given = partial(_last_time, system, h), kept.first_rows
    times = ComponentTimes(system.names, steps + 1, last, warn, given=given) if warn is not None else None
    grace = 0.0 if keeping is None else keeping.grace
    calls = [fmi_calls(getattr(stage.component, "description", None)) for stage in system.stages]
    at = partial(_time_of_call, system, steps, h)
    watch = Watch(system.names, calls, at, limits, 8 * columns, progress=give, times=times, grace=grace)
    compile_beforehand(system)
    with ExitStack() as stack:
        worker.start()
        counters = worker.progress
        counters.loop, counters.stop[0], counters.hold[0], counters.sent[0] = b"", 0, 0, 0
        exchange = stack.enter_context(temporary_folder("changes"))  # outlives a crash of the worker
        channel = FileChannel(exchange, counters)
        table, count = _begin_rows(stack, worker, folder, (steps + 1, 8 * columns), kept)
        feed = _feed(observers, system, steps, h, channel)
        if observers and columns:
            feed.table = np.memmap(table, np.float64, "r", shape=(count, columns))
        job = RowsJob(table, limits, exchange, bool(observers), kept.interval, given, keeping is not None)
        end = _end_of(worker, system, count - 1, h, job, watch)
        done = max(counters.made[0], given)  # A failure before the last given row loses none.
        state = read_state(table.with_name(STATE)) if kept.folder is None else None
        values = read_table(table, done, columns, mapped=recording is not None)
        beside, changes = read_exact(table.with_name(BESIDE), done), channel.noted()
        feed.end(values)
        time = _times_of(system, steps, h)
        if end.last is not None:
            time[done - 1] = end.last
        loop = counters.loop.decode("utf-8", "ignore")
        results = results_of(system, time[:done], values, beside, end.notes, loop, details=end.details)
        results = take_signals(recording, results)
        del values  # Its file is removed.
    results = replace(results, events=end.events, event_counts=end.event_counts)
    failure = end.failure or feed.failure
    if failure is None and done == count <= steps:
        failure = _disk_full(time[count - 1].item(), count, steps + 1)
    component_times = {} if times is None else times.record()
    return SteppedRun(results, end.log, failure, changes, state, component_times)


def _begin_rows(
    stack: ExitStack, worker: Worker, folder: Path, size: tuple[int, int], kept: Keeping
) -> tuple[Path, int]:
    """Create the file of the rows of a run; return the file and the number of rows that fit.

    It is in the folder of the checkpoints, or in one that is removed with the stack.

    Args:
        size: Rows, and bytes of a row.
    """
    if kept.folder is not None:
        return kept.folder / ROWS, _allocate_kept(kept.folder, *size, kept)
    place, count = _allocate_rows((folder, Path(tempfile.gettempdir())), *size)
    stack.callback(place.remove)
    worker.take_along(place.path)
    if kept.start is not None:
        _write_start(place.path, kept.start)
    return place.path / ROWS, count


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
        return WorkerEnd(failure=_convert_unexpected(error, watch, counters))
    return end


def _convert_unexpected(error: Exception, watch: Watch, counters: Progress) -> SimulationError:
    """Return an unexpected error with its call as SimulationError."""
    component, at, call = Clock(watch, counters).place()
    reason = " ".join(str(error).split())[:MAX_CHARACTERS]
    message = messages.UNEXPECTED_ERROR(call=call, error=type(error).__name__, reason=reason)
    return SimulationError(component, at, message)


def read_state(path: Path) -> bytes | None:
    """Return the content of a state file, if any."""
    return path.read_bytes() if path.is_file() else None


def _allocate_kept(folder: Path, rows: int, width: int, kept: Keeping) -> int:
    """Create the kept files; return the number of rows.

    Raises:
        DiskFull: No further row fits.
    """
    count, start = rows, kept.start
    while count and count >= kept.first_rows:
        try:
            allocate(folder / f"{ROWS}.new", count * width)
            if start is None:
                (folder / STATE).unlink(missing_ok=True)
                (folder / BESIDE).unlink(missing_ok=True)
            else:
                _write_start(folder, start, f"{ROWS}.new")
        except OSError as error:
            (folder / f"{ROWS}.new").unlink(missing_ok=True)
            if not is_full(error):
                raise
            count = int(DISK_RETRY_SHARE * count)
        else:
            (folder / f"{ROWS}.new").replace(folder / ROWS)
            return count
    raise _disk_full(0.0, kept.first_rows, rows)


def _write_start(folder: Path, start: Continuation, rows: str = ROWS) -> None:
    """Write the rows and the state of `start`."""
    with (folder / rows).open("r+b") as stream:
        stream.write(start.values.tobytes())
    write_durable(folder / BESIDE, b"".join(map(exact_line, start.exact)))
    if start.state is not None:
        write_durable(folder / STATE, start.state)


def _disk_full(time: float, count: int, rows: int) -> DiskFull:
    """Return the error of a disk without space for the rows."""
    return DiskFull("the run", time, messages.DISK_FULL(count=count, rows=rows))


def _allocate_rows(folders: Sequence[Path], rows: int, width: int) -> tuple[ScratchFolder, int]:
    """Create the file of the rows; return its folder and the number of rows that fit.

    The folder is beside the results, or elsewhere for lack of space. On a full disk, the number is smaller.

    Raises:
        DiskFull: No row fits.
    """
    count = rows
    while count:
        for parent in folders:
            folder = scratch(PREFIX, parent)
            try:
                allocate(folder.path / ROWS, count * width)
            except OSError as error:
                folder.remove()
                if not is_full(error):
                    raise
            else:
                return folder, count
        count = int(DISK_RETRY_SHARE * count)
    raise _disk_full(0.0, 0, rows)
