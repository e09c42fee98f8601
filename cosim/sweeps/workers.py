"""Workers of a sweep: local processes or a dask scheduler's workers, each with a process for FMUs."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from cosim.base.errors import CosimError, Fault, InputError, SimulationError, SweepFailed
from cosim.base.extras import optional
from cosim.base.text import counted
from cosim.base.version import __version__
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.storage.yaml_file import YamlFile
from cosim.sweeps.run_chunks import Asked, Job, Made, Way, error_of, failed, make_runs

MODULES = ("cosim.sweeps.run_chunks", "fmpy.fmi2", "fmpy.logging")
ANSWER = 5  # time limit of a dask scheduler's answer [s]
AHEAD = 4  # chunks requested beyond the running ones

_idle: list[Worker] = []  # idle workers of this process
_all: list[Worker] = []
_lock = threading.Lock()
_stopping = threading.Event()


class Makers(Protocol):
    """An executor for chunks of runs in parallel."""

    count: int

    def submit(self, job: Job, chunk: Sequence[Asked], way: Way, limits: Limits | None, goals: int) -> Any:
        """Submit runs and return a future."""

    def done(self, pending: set[Any]) -> tuple[set[Any], set[Any]]:
        """Wait for futures; return finished and pending ones."""

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return a function's result; it may execute an FMU's Python."""

    def runs(self, future: Any) -> list[Made]:
        """Return the runs of a finished future."""


def apart(job: Job, chunk: Sequence[Asked], way: Way, limits: Limits | None, goals: int) -> list[Made]:
    """Make runs in a reusable worker process. A run that ends the process has failed."""
    with _borrowed() as worker:
        return _called(worker, job, chunk, way, limits, goals)


def ask_apart(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return a function's result from a worker process. The function may execute an FMU's Python."""
    with _borrowed() as worker:
        return worker.call(function, *arguments)


@contextmanager
def _borrowed() -> Iterator[Worker]:
    """Yield a worker process for exclusive use."""
    with _lock:
        worker = _idle.pop() if _idle else None
        if worker is None:
            worker = Worker(*MODULES)
            _all.append(worker)
    try:
        yield worker
    finally:
        with _lock:
            _idle.append(worker)


def _called(
    worker: Worker, job: Job, chunk: Sequence[Asked], way: Way, limits: Limits | None, goals: int
) -> list[Made]:
    if _stopping.is_set():
        raise RuntimeError("the sweep is being stopped")
    try:
        found: list[Made] = worker.call(make_runs, job, chunk, way, watch=job.watched.watch(limits))
        return found
    except SimulationError as error:  # a crash or an exceeded limit
        if len(chunk) == 1:
            return [failed(chunk[0].run, error_of(error), goals, way)]
    except CosimError:
        raise
    return [run for one in chunk for run in _called(worker, job, [one], way, limits, goals)]


def _end_workers(*, kill: bool) -> None:
    """End the worker processes of this process."""
    with _lock:
        workers = list(_all)
        _all.clear()
        _idle.clear()
    for worker in workers:
        worker.end(kill=kill)


class Local:
    """Processes of this machine."""

    def __init__(self, count: int) -> None:
        self.count = count
        _stopping.clear()
        self._pool = ThreadPoolExecutor(count)  # Each thread waits for a process.

    def submit(self, job: Job, chunk: Sequence[Asked], way: Way, limits: Limits | None, goals: int) -> Future[Any]:
        """Submit runs and return a future."""
        return self._pool.submit(apart, job, chunk, way, limits, goals)

    def done(self, pending: set[Any]) -> tuple[set[Any], set[Any]]:
        """Wait for futures; return finished and pending ones."""
        finished, others = wait(pending, return_when=FIRST_COMPLETED)
        return set(finished), set(others)

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return a function's result from a worker process."""
        return ask_apart(function, *arguments)

    def runs(self, future: Future[list[Made]]) -> list[Made]:
        """Return the runs of a finished future."""
        return future.result()

    def end(self, *, kill: bool) -> None:
        """End the processes."""
        if kill:
            _stopping.set()  # Otherwise a thread would report the end of its process as a failed run.
        self._pool.shutdown(wait=not kill, cancel_futures=True)
        _end_workers(kill=kill)


class Here:
    """This process, for a debugger."""

    count = 1

    def submit(self, job: Job, chunk: Sequence[Asked], way: Way, limits: Limits | None, goals: int) -> Future[Any]:
        """Make the runs and return a finished future."""
        future: Future[Any] = Future()
        future.set_result(make_runs(job, chunk, way))
        return future

    def done(self, pending: set[Any]) -> tuple[set[Any], set[Any]]:
        """Return all futures as finished."""
        return pending, set()

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return a function's result."""
        return function(*arguments)

    def runs(self, future: Future[list[Made]]) -> list[Made]:
        """Return the runs of a finished future."""
        return future.result()


class Dask:
    """Workers of a dask scheduler with access to the same file paths."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self.count = max(1, sum(client.nthreads().values()))

    def submit(self, job: Job, chunk: Sequence[Asked], way: Way, limits: Limits | None, goals: int) -> Any:
        """Submit runs and return a future."""
        return self._client.submit(apart, job, list(chunk), way, limits, goals, pure=False)

    def done(self, pending: set[Any]) -> tuple[set[Any], set[Any]]:
        """Wait for futures; return finished and pending ones."""
        from distributed import wait as wait_for

        finished, others = wait_for(pending, return_when="FIRST_COMPLETED")
        return set(finished), set(others)

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return a function's result from a local worker process."""
        return ask_apart(function, *arguments)

    def runs(self, future: Any) -> list[Made]:
        """Return the runs of a finished future; raise SweepFailed if its worker failed."""
        try:
            found: list[Made] = future.result()
        except CosimError:
            raise
        except Exception as error:
            cure = "see the log of the worker; the same command goes on with the runs that are there"
            raise SweepFailed(f"a dask worker failed: {_one_line(error)}; {cure}") from None
        return found


@contextmanager
def makers(workers: int | None, dask: Any, *, in_process: bool = False) -> Iterator[Makers]:
    """Yield the executor: dask, this process or local processes."""
    if dask is not None:
        try:
            yield Dask(dask)
        finally:
            _end_workers(kill=False)  # workers of a cluster within this process
        return
    if in_process:
        yield Here()
        return
    local = Local(workers or os.cpu_count() or 1)
    try:
        yield local
    except BaseException:
        local.end(kill=True)
        raise
    local.end(kill=False)


@contextmanager
def dask_client(address: str | None, place: Callable[[str], Fault]) -> Iterator[Any]:
    """Yield a dask client, None without address.

    Raises:
        InputError: The scheduler does not answer or has no suitable workers.
    """
    if address is None:
        yield None
        return
    import logging

    Client = optional("distributed", place).Client

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # cosim reports failures itself.
    try:
        client = Client(address, timeout=ANSWER)
    except (OSError, ValueError, TypeError) as error:
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        message = f"no dask scheduler answers at {address} within {ANSWER} s ({why}); start one by `dask scheduler`"
        raise InputError([place(message)]) from None
    with client:
        if not client.nthreads():
            raise InputError(
                [place(f"the dask scheduler at {address} has no workers; start some by `dask worker {address}`")]
            )
        if problem := _unfit_workers(client):
            raise InputError([place(f"the dask scheduler at {address} has {problem}")])
        yield client


def _unfit_workers(client: Any) -> str:
    """Return a message on unsuitable workers, or "". A worker must import this package in the same version."""

    def version_there() -> str:  # A nested function is pickled by value, so that a worker need not import this module.
        from importlib import import_module

        import_module("cosim.sweeps.run_chunks")
        return str(import_module("cosim.base.version").__version__)

    versions = client.run(version_there, on_error="return")
    unfit = {worker: found for worker, found in versions.items() if found != __version__}
    if not unfit:
        return ""
    worker, found = next(iter(unfit.items()))
    why = _one_line(found) if isinstance(found, BaseException) else f"version {found}"
    cure = f"install cosim {__version__} where they run, or start them in the environment of this command"
    return f"{counted(len(unfit), 'worker')} of {len(versions)} without cosim {__version__} ({worker}: {why}); {cure}"


def _one_line(error: BaseException) -> str:
    said = str(error).strip()
    return f"{type(error).__name__}: {said.splitlines()[0]}" if said else type(error).__name__


def fault_of(yaml: YamlFile, given: str | None) -> Callable[[str], Fault]:
    """Return a function from a message to the fault of a dask address."""
    return lambda text: yaml.fault(("dask",), text) if given is None else Fault(Path("--dask"), 0, 0, text)
