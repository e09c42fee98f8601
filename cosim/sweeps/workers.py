"""Workers of a sweep: local processes or a dask scheduler's workers, each with a process for FMUs."""

from __future__ import annotations

import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cosim.base.errors import CosimError, Fault, InputError, SimulationError, SweepFailed
from cosim.base.extras import optional
from cosim.base.text import counted
from cosim.base.version import __version__
from cosim.blocks.shared_code import SharedCode
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.storage.yaml_file import YamlFile
from cosim.sweeps.run_chunks import Job, RunRequest, RunResult, Way, failed_run, make_runs

MODULES = ("cosim.sweeps.run_chunks", "fmpy.fmi2", "fmpy.logging")
ANSWER = 5  # time limit of a dask scheduler's answer [s]
AHEAD = 4  # chunks requested beyond the running ones

_idle: list[Worker] = []  # idle workers of this process
_all: list[Worker] = []
_lock = threading.Lock()
_stopping = threading.Event()


@dataclass(frozen=True)
class Chunk:
    """Runs made by one worker in sequence, with the number of their criteria."""

    job: Job
    requests: Sequence[RunRequest]
    way: Way
    limits: Limits | None
    criteria: int


class Executor(ABC):
    """An executor for chunks of runs in parallel."""

    count: int

    @abstractmethod
    def submit(self, chunk: Chunk) -> Any:
        """Submit runs and return a future."""

    def wait(self, pending: set[Any]) -> tuple[set[Any], set[Any]]:
        """Wait until a future is finished; return the finished futures and the pending ones."""
        finished, others = wait(pending, return_when=FIRST_COMPLETED)
        return finished, others

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return a function's result from a local worker process; it may execute an FMU's Python."""
        with _borrow_worker() as worker:
            return worker.call(function, *arguments)

    def runs(self, future: Any) -> list[RunResult]:
        """Return the runs of a finished future."""
        results: list[RunResult] = future.result()
        return results


def run_chunk(chunk: Chunk) -> list[RunResult]:
    """Make the runs of a chunk in a worker process that is reused; a run that ends the process has failed."""
    with _borrow_worker() as worker:
        return _call_worker(worker, chunk)


@contextmanager
def _borrow_worker() -> Iterator[Worker]:
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


def _call_worker(worker: Worker, chunk: Chunk) -> list[RunResult]:
    if _stopping.is_set():
        raise RuntimeError("the sweep is being stopped")
    job, requests = chunk.job, chunk.requests
    try:
        results: list[RunResult] = worker.call(
            make_runs, job, requests, chunk.way, watch=job.watched.watch(chunk.limits)
        )
        return results
    except (SimulationError, SharedCode) as error:  # a crash, an exceeded limit, FMUs that share no process
        if len(requests) == 1:
            return [failed_run(requests[0].run, str(error), chunk.criteria, chunk.way)]
    return [run for request in requests for run in _call_worker(worker, replace(chunk, requests=[request]))]


def _end_workers(*, kill: bool) -> None:
    """End the worker processes of this process."""
    with _lock:
        workers = list(_all)
        _all.clear()
        _idle.clear()
    for worker in workers:
        worker.end(kill=kill)


class LocalExecutor(Executor):
    """Processes of this machine."""

    def __init__(self, count: int) -> None:
        self.count = count
        _stopping.clear()
        self._pool = ThreadPoolExecutor(count)  # Each thread waits for a process.

    def submit(self, chunk: Chunk) -> Future[Any]:
        """Submit runs to a process."""
        return self._pool.submit(run_chunk, chunk)

    def end(self, *, kill: bool) -> None:
        """End the processes."""
        if kill:
            _stopping.set()  # Otherwise a thread would report the end of its process as a failed run.
        self._pool.shutdown(wait=not kill, cancel_futures=True)
        _end_workers(kill=kill)


class DirectExecutor(Executor):
    """Executor that makes the runs in this process, for a debugger."""

    count = 1

    def submit(self, chunk: Chunk) -> Future[Any]:
        """Make the runs and return a finished future."""
        future: Future[Any] = Future()
        future.set_result(make_runs(chunk.job, chunk.requests, chunk.way))
        return future

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return a function's result."""
        return function(*arguments)


class DaskExecutor(Executor):
    """Workers of a dask scheduler with access to the same file paths."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self.count = max(1, sum(client.nthreads().values()))

    def submit(self, chunk: Chunk) -> Any:
        """Submit runs to the scheduler."""
        return self._client.submit(run_chunk, chunk, pure=False)

    def wait(self, pending: set[Any]) -> tuple[set[Any], set[Any]]:
        """Wait for futures; return finished and pending ones."""
        from distributed import wait as wait_for

        finished, others = wait_for(pending, return_when="FIRST_COMPLETED")
        return set(finished), set(others)

    def runs(self, future: Any) -> list[RunResult]:
        """Return the runs of a finished future; raise SweepFailed if its worker failed."""
        try:
            return super().runs(future)
        except CosimError:
            raise
        except Exception as error:
            raise SweepFailed(
                f"a dask worker failed: {_one_line(error)}; see the log of the worker; `--resume` goes on "
                "with the runs that are there"
            ) from None


@contextmanager
def executor(workers: int | None, dask: Any, *, in_process: bool = False) -> Iterator[Executor]:
    """Yield the executor: dask, this process or local processes."""
    if dask is not None:
        try:
            yield DaskExecutor(dask)
        finally:
            _end_workers(kill=False)  # workers of a cluster within this process
        return
    if in_process:
        yield DirectExecutor()
        return
    local = LocalExecutor(workers or os.cpu_count() or 1)
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

    client_class = optional("distributed", place).Client

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # cosim reports failures itself.
    try:
        client = client_class(address, timeout=ANSWER)
    except (OSError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            [
                place(
                    f"no dask scheduler answers at {address} within {ANSWER} s ({reason}); start one by "
                    "`dask scheduler`"
                )
            ]
        ) from None
    with client:
        if not client.nthreads():
            raise InputError(
                [place(f"the dask scheduler at {address} has no workers; start some by `dask worker {address}`")]
            )
        _check_versions(client, address, place)
        yield client


def _check_versions(client: Any, address: str, place: Callable[[str], Fault]) -> None:
    """Raise InputError for workers that cannot import this package in the same version."""

    def version_there() -> str:  # A nested function is pickled by value, so that a worker need not import this module.
        from importlib import import_module

        import_module("cosim.sweeps.run_chunks")
        return str(import_module("cosim.base.version").__version__)

    versions = client.run(version_there, on_error="return")
    unfit = {worker: version for worker, version in versions.items() if version != __version__}
    if unfit:
        worker, version = next(iter(unfit.items()))
        reason = _one_line(version) if isinstance(version, BaseException) else f"version {version}"
        workers, count = counted(len(unfit), "worker"), len(versions)
        message = (
            f"the dask scheduler at {address} has {workers} of {count} without cosim {__version__} ({worker}: "
            f"{reason}); install cosim {__version__} where they run, or start them in the environment of this "
            "command"
        )
        raise InputError([place(message)])


def _one_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def fault_maker(yaml: YamlFile, option: str | None) -> Callable[[str], Fault]:
    """Return a function from a message to the fault of a dask address."""
    return lambda text: yaml.fault(("dask",), text) if option is None else Fault(Path("--dask"), 0, 0, text)
