"""Steps of a run in a worker process, seen from both sides."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.base.drafts import is_full
from cosim.base.errors import CosimError, DiskFull, SimulationError, Terminated, stop_error
from cosim.base.scratch import ScratchFolder, scratch
from cosim.blocks.component import EndedEarly
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import GET, ExactFile, Progress, Rows, allocate, mapped_table, read_exact, read_table
from cosim.isolation.watch import Clock, Watch, fmi_calls
from cosim.master.c_loop import compile_beforehand
from cosim.master.halving import Halved
from cosim.master.master import StoppedRun, results_of, simulate
from cosim.master.observer import Feed, Observed, Observer
from cosim.master.own_process import in_own_processes
from cosim.storage.files import hold_stops
from cosim.storage.results import Results
from cosim.system.system import System

MODULES = ("cosim.master.remote", "fmpy.fmi2", "fmpy.logging")
PREFIX, ROWS, BESIDE = ".rows-", "rows", "beside"
LONGEST_WORDS = 500  # of an error message [characters]
SMALLER = 0.9  # share of rows to try next on a full disk


@dataclass(frozen=True)
class Stepped:
    """Results of the steps, messages of the FMUs, and the failure, if any."""

    results: Results
    said: Sequence[str]
    failure: SimulationError | None = None


def said_of(system: System) -> list[str]:
    """Return the messages of all FMUs as lines."""
    return [f"{s.component.name}: {text}" for s in system.stages for text in getattr(s.component, "log", ())]


def simulate_here(system: System, steps: int, h: float, observers: Sequence[Observer] = ()) -> Stepped:
    """Step a system in this process; raise FmuError if an FMU does not load."""
    feed = _feed(observers, system, steps, h)
    rows = Rows.in_memory(steps + 1, len(system.columns))
    feed.table = rows.table

    def give(done: int) -> None:
        feed(done)
        if feed.failure is not None:
            raise feed.failure
        if feed.stop:
            raise _early(system, h, done)

    try:
        made, failure = _stepped(system, steps, h, give if observers else None, rows), None
    except StoppedRun as run:
        made, failure = run.results, run.error
    feed.end(made.values)
    return Stepped(made, said_of(system), failure or feed.failure)


def _feed(observers: Sequence[Observer], system: System, steps: int, h: float) -> Feed:
    """Return the feed of a run's rows to its observers."""
    time = system.start + h * np.arange(steps + 1, dtype=np.float64)
    return Feed(observers, Observed(system.columns, steps + 1, system.start, h), time)


def _early(system: System, h: float, done: int) -> EndedEarly:
    """Return the early end requested by an observer."""
    return EndedEarly("an observer", _reached(system, h, done), "it asked for the end")


def _reached(system: System, h: float, made: int) -> float:
    """Return the time [s] of the last finished row."""
    return system.start + h * max(0, made - 1)


def _stepped(
    system: System, steps: int, h: float, progress: Callable[[int], None] | None = None, rows: Rows | None = None
) -> Results:
    """Return the rows of a run, or its differences by halving."""
    if not system.halved:
        return simulate(system, steps, h, progress, rows)
    return Halved(system, steps, h, progress, rows or Rows.in_memory(steps + 1, len(system.columns))).results()


# -- in the worker ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ended:
    """The end of the steps in a worker; the rows are in files.

    Attributes:
        last: Time of the last row [s], if any.
    """

    said: Sequence[str] = ()
    failure: SimulationError | None = None
    last: float | None = None
    notes: Sequence[str] = ()


def simulate_rows(system: System, steps: int, h: float, table: Path, limits: Limits, observed: bool) -> Ended:
    """Simulate into a table file.

    Args:
        observed: Whether the caller may request an early end.
    """

    def obey(done: int) -> None:
        if here.progress.stop[0]:
            raise _early(system, h, done)

    system = in_own_processes(system, limits)
    for stage in system.stages:
        here.share_log(stage.component)
    progress = here.progress
    mapped, beside = mapped_table(table, steps + 1, len(system.columns)), ExactFile(table.with_name(BESIDE))
    failure: SimulationError | None = None
    try:
        rows = Rows(mapped, beside, progress.made, progress.doing, _tell_loop)
        made = _stepped(system, steps, h, obey if observed else None, rows)
    except StoppedRun as run:
        made, failure = run.results, run.error
    except OSError as error:
        if not is_full(error):
            raise
        made_rows = progress.made[0]
        return Ended(said_of(system), _disk_full(_reached(system, h, made_rows), made_rows, steps + 1))
    finally:
        beside.close()
    return Ended(said_of(system), failure, float(made.time[-1]) if len(made.time) else None, made.notes)


def _tell_loop(loop: str) -> None:
    """Store the kind of loop for the caller, even in case of a crash."""
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
) -> Stepped:
    """Step a system in a worker process.

    The rows are in a file within `folder` until the end.

    Raises:
        FmuError: An FMU does not load.
    """
    columns, limits = len(system.columns), limits or Limits()
    feed = _feed(observers, system, steps, h)

    def give(made: int) -> None:
        feed(made)
        worker.progress.stop[0] = feed.over

    watch = Watch(
        [stage.component.name for stage in system.stages],
        [fmi_calls(getattr(stage.component, "description", None)) for stage in system.stages],
        lambda made, call: system.start + h * (max(0, made - 1) + (call == GET and 0 < made <= steps)),
        limits,
        8 * columns,
        progress=give,
    )
    ended = Ended()
    compile_beforehand(system)
    with ExitStack() as stack:
        worker.start()
        counters = worker.progress
        counters.loop, counters.stop[0] = b"", 0
        held, count = _room((folder, Path(tempfile.gettempdir())), steps + 1, 8 * columns)
        stack.callback(held.remove)
        worker.take_along(held.path)
        table = held.path / ROWS
        if observers and columns:
            feed.table = np.memmap(table, np.float64, "r", shape=(count, columns))
        try:
            ended = worker.call(simulate_rows, system, count - 1, h, table, limits, bool(observers), watch=watch)
            hold_stops()  # The rows must be saved.
        except (SimulationError, KeyboardInterrupt, Terminated) as stop:
            ended = Ended(failure=stop_error(stop, _reached(system, h, counters.made[0])))
        except (CosimError, OSError, MemoryError):
            raise
        except Exception as error:  # An unexpected error of a library is no reason to lose the rows.
            ended = Ended(failure=_unforeseen(error, watch, counters))
        done = counters.made[0]
        values, beside = read_table(table, done, columns), read_exact(table.with_name(BESIDE), done)
    feed.end(values)
    failure = ended.failure or feed.failure
    time = system.start + h * np.arange(steps + 1, dtype=np.float64)
    if ended.last is not None:
        time[done - 1] = ended.last
    if failure is None and done == count <= steps:
        failure = _disk_full(time[count - 1].item(), count, steps + 1)
    loop = counters.loop.decode("utf-8", "ignore")
    return Stepped(results_of(system, time[:done], values, beside, ended.notes, loop), ended.said, failure)


def _unforeseen(error: Exception, watch: Watch, counters: Progress) -> SimulationError:
    """Return an unexpected error with its call as SimulationError."""
    component, at, call = Clock(watch, counters).place()
    words = " ".join(str(error).split())[:LONGEST_WORDS]
    return SimulationError(component, at, f"{call}: {type(error).__name__}: {words} (--in-process shows where)")


def _disk_full(time: float, count: int, rows: int) -> DiskFull:
    """Return the error of a disk without space for the rows."""
    return DiskFull("the run", time, f"the disk is full: it has room for {count} of {rows} rows while the run lasts")


def _room(folders: Sequence[Path], rows: int, width: int) -> tuple[ScratchFolder, int]:
    """Return a folder with the rows file, and its number of rows.

    The folder is beside the results, or elsewhere for lack of space. A full disk takes fewer rows.

    Raises:
        DiskFull: No row fits.
    """
    count = rows
    while count:
        for beside in folders:
            held = scratch(PREFIX, beside)
            try:
                allocate(held.path / ROWS, count * width)
            except OSError as error:
                held.remove()
                if not is_full(error):
                    raise
            else:
                return held, count
        count = int(SMALLER * count)
    raise _disk_full(0.0, 0, rows)
