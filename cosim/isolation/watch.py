"""Supervision of a worker by its caller: current FMI call, duration, process size, and end of the process."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import psutil

from cosim.blocks.component import ADVANCE, GET, PUT
from cosim.core.errors import SimulationError, TimedOut
from cosim.isolation.limits import Limits
from cosim.isolation.rows import CALLS, NO_CALL, OTHER, WAITING, Progress

CALL_KEYS = {"set": PUT, "step": ADVANCE, "get": GET, "other": OTHER}  # names in the manifest
READING_PAUSE = 0.003, 0.007  # [s] limits of the random time between two readings of the current call
PLAIN_CALLS = ("setting its inputs", "stepping", "reading its outputs")  # for components that are not FMUs
FMI_CALLS = {
    "2": ("fmi2SetReal", "fmi2DoStep", "fmi2GetReal"),
    "3": ("fmi3SetFloat64", "fmi3DoStep", "fmi3GetFloat64"),
}


class ComponentTimes:
    """Wall time of each component's calls, sampled by the caller of a worker about 200 times per second.

    Args:
        components: Names, indexed by the component number in `Rows.doing`.
        first_row: Number of rows of a stopped run; repeating its steps is not counted.
    """

    def __init__(self, components: Sequence[str], first_row: int = 0) -> None:
        self._components, self._first_row = components, first_row
        self._seconds = [[0.0] * CALLS for _ in components]
        self._rest = self._waiting = 0.0
        self._readings = 0  # number of readings, without waiting and the start of the worker
        self._last = time.monotonic()

    def read(self, rows: int, doing: int) -> None:
        """Add the time since the last reading to the current call."""
        now = time.monotonic()
        elapsed, self._last = now - self._last, now
        if rows < self._first_row:
            return
        number, call = divmod(doing, CALLS)
        if doing == WAITING:
            self._waiting += elapsed
        elif 0 <= number < len(self._components):
            self._seconds[number][call] += elapsed
            self._readings += 1
        elif rows:  # before the first row, the worker starts
            self._rest += elapsed
            self._readings += 1

    def record(self) -> dict[str, Any]:
        """Return the times [s] for the manifest; the component with the longest time is first."""
        sums = sorted(zip(self._components, self._seconds, strict=True), key=lambda pair: -sum(pair[1]))
        whole = max(sum(sum(seconds) for _, seconds in sums) + self._rest, 1e-9)
        components = {
            name: {"share": round(sum(seconds) / whole, 4)}
            | {key: round(seconds[call], 4) for key, call in CALL_KEYS.items()}
            for name, seconds in sums
        }
        waiting = {"waiting": round(self._waiting, 4)} if self._waiting else {}
        return {"components": components, "rest": round(self._rest, 4), **waiting, "readings": self._readings}


@dataclass(frozen=True)
class Watch:
    """Data for supervising a job and describing its calls.

    Attributes:
        components: Names, indexed by the component number in `Rows.doing`.
        calls: FMI names of put, advance and get for each component.
        time: Function of the number of rows and the current call that returns the simulated time [s].
        width: Size of a row [bytes], excluded from the memory limit.
        spent: [total time without loading [s]], to which this job adds.
        progress: Function that is called with the number of rows.
        grace: Time [s] for a stopped job to end by itself, for a checkpoint.
        times: Wall time of components and calls, sampled during the job.
        computing: True if time limits of calls exclude the time in which the worker waits for a processor, so that
            results do not depend on the load of the machine.
    """

    components: Sequence[str] = ()
    calls: Sequence[Sequence[str]] = ()
    time: Callable[[int, int], float] = lambda made, call: 0.0
    limits: Limits = field(default_factory=Limits)
    width: int = 0
    spent: list[float] = field(default_factory=lambda: [0.0])
    progress: Callable[[int], None] | None = None
    grace: float = 0.0
    times: ComponentTimes | None = None
    computing: bool = False


def fmi_calls(description: Any) -> Sequence[str]:
    """Return FMI's names of the functions for put, advance and get.

    For other components (description None), plain words are returned.
    """
    return FMI_CALLS.get(str(getattr(description, "fmiVersion", ""))[:1], PLAIN_CALLS)


def _memory(pid: int, limit: float) -> int:
    """Return the memory [bytes] of a process and its children; above `limit`, shared pages count only once."""
    processes = set[psutil.Process]()
    with suppress(psutil.Error):
        own = psutil.Process(pid)
        processes = {own, *own.children(recursive=True)}
    for other in psutil.pids() if sys.platform != "win32" else ():  # orphans stay in the session of the worker
        with suppress(OSError, psutil.Error):
            if os.getsid(other) == pid:
                processes.add(psutil.Process(other))
    size = 0
    for is_exact in (False, True):
        size = 0
        for process in processes:
            with suppress(psutil.Error):  # the process has ended
                size += process.memory_full_info().pss if is_exact else process.memory_info().rss
        if size <= limit or not sys.platform.startswith("linux"):
            break
    return size


def _processor_time(pid: int) -> tuple[float, str]:
    """Return the processor time of a process [s], and its status."""
    with suppress(psutil.Error):
        process = psutil.Process(pid)
        used = process.cpu_times()
        return used.user + used.system, process.status()
    return 0.0, psutil.STATUS_DEAD


CRASHES = {"SIGSEGV", "SIGABRT", "SIGBUS", "SIGFPE", "SIGILL", "SIGTRAP", "SIGSYS"}


def how_ended(code: int) -> str:
    """Return a phrase that explains a process's return code."""
    if code >= 0:
        return f"ended the process, exit code {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    if name == "SIGKILL":
        return f"was killed, probably by the operating system because memory ran out ({name})"
    if name in CRASHES:
        return f"crashed: {(signal.strsignal(-code) or 'unknown').lower()} ({name})"
    return f"was ended ({name})"


class Clock:
    """Supervision of a worker between two checks: durations and process size."""

    def __init__(self, watch: Watch, progress: Progress) -> None:
        self.watch, self.progress = watch, progress
        self.since = self.last = time.monotonic()
        self.key: tuple[Any, ...] = ()
        self.rows = 0  # number of rows at the last check
        self.used: float | None = None  # processor time of the worker at the first check [s]

    def look(self, pid: int) -> None:
        """Check the limits: raise TimedOut for time, SimulationError for memory."""
        now, rows, doing = time.monotonic(), self.progress.made[0], self.progress.doing[0]
        watch, limits = self.watch, self.watch.limits
        if watch.progress is not None and rows != self.rows:
            self.rows = rows
            watch.progress(rows)
        is_named, is_other = self.progress.named[0], doing % CALLS == OTHER  # NO_CALL counts as OTHER too.
        loading = not rows and is_other and not (is_named and b"Instantiate" not in self.progress.call)
        # does not change during a step or call
        key = (rows,) if rows and not is_other else (rows, doing, is_named, self.progress.call)
        waiting = doing in (NO_CALL, WAITING)
        if key != self.key or waiting:
            self.key, self.since = key, now
        watch.spent[0] += 0.0 if loading or (waiting and rows) else now - self.last
        self.last = now
        limit, name = (limits.loading, "load") if loading else (limits.step, "step")
        component, at, call = self.place()
        if watch.computing and self.used is None:
            self.used = _processor_time(pid)[0]
        if limit is not None and now - self.since > limit and not self._is_kept_waiting(pid, limit):
            reason = f"{call} takes longer than {limit:g} s (limits: {name}); raise this limit if the FMU is only slow"
            raise TimedOut(component, at, reason)
        if limits.total is not None and watch.spent[0] > limits.total:
            reason = f"{call} was stopped: the run takes longer than {limits.total:g} s in all (limits: total); raise "
            raise TimedOut(component, at, f"{reason}this limit or shorten the run")
        self.check_memory(pid)

    def _is_kept_waiting(self, pid: int, limit: float) -> bool:
        """Return True if a worker that wants to compute had a processor for less than `limit` [s]."""
        if self.used is None:
            return False
        used, status = _processor_time(pid)
        return status in (psutil.STATUS_RUNNING, psutil.STATUS_STOPPED) and used - self.used < limit

    def check_memory(self, pid: int) -> None:
        """Raise SimulationError if the worker and its children exceed the memory limit."""
        limit = self.watch.limits.memory
        if limit is None:
            return
        rows = self.progress.made[0] * self.watch.width
        size = _memory(pid, limit + rows) - rows
        if size > limit:
            component, at, call = self.place()
            message = (
                f"{call}: its process and child processes use {size / 1e6:.4g} MB, more than the limit of "
                f"{limit / 1e6:.4g} MB (limits: memory)"
            )
            raise SimulationError(component, at, message)

    def place(self) -> tuple[str, float, str]:
        """Return the component, simulated time [s] and call at which the worker is."""
        number, call = divmod(self.progress.doing[0], CALLS)
        watch = self.watch
        if not 0 <= number < len(watch.components):
            return "the run", 0.0, "the worker"
        if self.progress.named[0]:
            name = self.progress.call.decode("utf-8", "replace")
        elif call != OTHER:
            name = (watch.calls[number] if watch.calls else PLAIN_CALLS)[call]
        else:
            name = "unloading" if self.progress.made[0] else "loading"
        return watch.components[number], watch.time(self.progress.made[0], call), name

    def place_of_streams(self) -> tuple[str, float, str]:
        """Return component, simulated time [s] and message for an FMU that has changed its process's streams."""
        component, at, _ = self.place()
        calls = zip(self.watch.components, self.watch.calls, strict=False)
        fmus = [name for name, names in calls if names is not PLAIN_CALLS]
        message = "closed, read or wrote file descriptors that it did not open"
        if len(fmus) > 1:
            message += "; to see which FMU did, set process: own for each"
        return " or ".join(fmus) or component, at, message
