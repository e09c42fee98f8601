"""Execution of the runs of a sweep: in processes of this machine, or by the workers of a dask scheduler."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from queue import SimpleQueue
from typing import Any
from uuid import uuid4

from cosim.blocks.stepping import cores
from cosim.core.errors import CosimError, Fault, InputError, SweepFailed
from cosim.core.extras import optional
from cosim.core.version import __version__
from cosim.isolation.process import Worker, start_together
from cosim.sweeps.reading import Sweep
from cosim.sweeps.runs import SWEEP_MODULES, Job, RunRequest, RunResult, make_runs_apart, work_in

SCHEDULER_TIMEOUT_S = 5  # time limit of a dask scheduler's answer [s]
RUNS_PER_THREAD = 4  # requested at once from a dask cluster
REQUESTED = 2  # messages for each process here: the one under way, and the next
MESSAGE_S, MOST_IN_MESSAGE = 0.1, 200  # duration [s] and number of the runs that a message asks for

MOMENT = 0.5  # time without a finished run [s] after which finished runs are stored

MakeRuns = Callable[[Iterable[RunRequest]], Iterator[Sequence[RunResult]]]  # empty: no run has finished for a moment


def make_runs_here(job: Job, workers: int | None, requests: Iterable[RunRequest]) -> Iterator[Sequence[RunResult]]:
    """Yield the results of runs in processes of this machine, as they are finished, and none after a moment without.

    Args:
        workers: Number of processes; None means one per core.
    """
    count = workers or cores()
    processes, idle, kill = [Worker(*SWEEP_MODULES) for _ in range(count)], SimpleQueue[Worker](), True
    start_together(processes)
    for process in processes:
        idle.put(process)
    threads = ThreadPoolExecutor(count, initializer=lambda: work_in(idle.get()))
    try:
        left, pending, together, begin, made = iter(requests), set[Future[list[RunResult]]](), 1, time.perf_counter(), 0
        while True:
            while len(pending) < REQUESTED * count and (some := [*islice(left, together)]):
                pending.add(threads.submit(make_runs_apart, job, some))
            if not pending:
                break
            done, pending = wait(pending, MOMENT, FIRST_COMPLETED)
            if not done:
                yield ()
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for results in (future.result() for future in done):
                made += len(results)
                together = min(MOST_IN_MESSAGE, 1 + int(MESSAGE_S * made / (count * (time.perf_counter() - begin))))
                yield results
        kill = False
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.end(kill=kill)
        threads.shutdown()


@contextmanager
def dask_cluster(sweep: Sweep, address: str, place: Callable[[str], Fault]) -> Iterator[MakeRuns]:
    """Yield a function that executes runs on the workers of a dask scheduler; runs of a lost worker are repeated.

    A worker does not need access to files of this machine: it gets the scenario and the files of its components once,
    in a folder of its own. A file is stored in a folder named by the hash of its content.

    Args:
        place: Function from a message to a fault of the option or key with the address.

    Raises:
        InputError: The scheduler does not answer or has no suitable workers.
    """
    distributed = optional("distributed", place)
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # cosim reports failures
    folder, job, contents, places = f"cosim-{uuid4().hex}", sweep.job, dict[str, bytes](), dict[str, str]()
    for path in (job.scenario, *sweep.files):
        content = path.read_bytes()
        places[str(path)] = name = f"{hashlib.sha256(content).hexdigest()}/{path.name}"
        contents[name] = content
    given = (f"{name}={json.dumps(path)}" for name, path in sweep.component_files.items())
    job = replace(job, overrides=(*job.overrides, *given))

    plugin: Any = distributed.WorkerPlugin

    class Files(plugin):  # type: ignore[misc]  # distributed is untyped
        """Plugin that copies the files to each worker, also one that starts during the sweep; pickled by value."""

        def setup(self, worker: Any) -> None:
            from cosim.core.version import __version__ as version

            if version != __version__:
                raise ImportError(f"it has cosim {version}")
            for name, content in contents.items():
                file = Path(worker.local_directory, folder, name)
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(content)

        def teardown(self, worker: Any) -> None:
            shutil.rmtree(Path(worker.local_directory, folder), ignore_errors=True)

    def make_runs(requests: Iterable[RunRequest]) -> Iterator[Sequence[RunResult]]:
        requests = iter(requests)
        futures = distributed.as_completed([])
        free = RUNS_PER_THREAD * sum(client.nthreads().values())
        while True:
            for request in islice(requests, free):
                futures.add(client.submit(make_run_of_dask, job, request, folder, places, pure=False))
            if futures.is_empty():
                return
            try:
                result = next(futures).result()
            except CosimError:
                raise
            except Exception as error:
                reason = _one_line(error)
                raise SweepFailed(
                    f"the dask cluster failed: {reason}; see its logs; completed runs are stored; --resume continues "
                    "the sweep"
                ) from None
            yield (result,)
            free = 1

    try:
        client = distributed.Client(address, timeout=SCHEDULER_TIMEOUT_S)
    except (OSError, ValueError, TypeError) as error:
        message = f"no dask scheduler answers at {address} within {SCHEDULER_TIMEOUT_S} s ({_one_line(error)}); "
        raise InputError([place(message + "start one by `dask scheduler`")]) from None
    with client:
        if not client.nthreads():
            message = f"the dask scheduler at {address} has no workers; start one by `dask worker {address}`"
            raise InputError([place(message)])
        try:
            client.register_plugin(Files(), name=folder)
        except Exception as error:
            message = f"a worker of the dask scheduler at {address} cannot simulate ({_one_line(error)}); "
            cure = (
                f"install cosim {__version__} where the workers run, or start them in the environment of this command"
            )
            raise InputError([place(message + cure)]) from None
        try:
            yield make_runs
        finally:
            with suppress(Exception):  # the scheduler may be lost
                client.unregister_worker_plugin(folder)


def make_run_of_dask(job: Job, request: RunRequest, folder: str, places: Mapping[str, str]) -> RunResult:
    """Execute a run in a worker of dask, with the worker's copies of the files.

    Args:
        folder: Folder of the copies within that of the worker.
        places: Path in the job or the request → path of the copy in the folder.
    """
    from distributed import get_worker

    here = Path(get_worker().local_directory, folder)
    if not here.is_dir():
        raise FileNotFoundError(f"the worker did not receive the files of the sweep: {here}")

    def with_copies(overrides: Iterable[str]) -> tuple[str, ...]:
        texts = list(overrides)
        for path, name in places.items():
            texts = [text.replace(json.dumps(path), json.dumps(str(here / name))) for text in texts]
        return tuple(texts)

    scenario = here / places[str(job.scenario)]
    job = replace(job, scenario=scenario, overrides=with_copies(job.overrides))
    return make_runs_apart(job, [replace(request, overrides=with_copies(request.overrides))])[0]


def _one_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
