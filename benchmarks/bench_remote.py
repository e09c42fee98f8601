"""Wall time of a step of an FMU behind a server on this machine: `python -m benchmarks.bench_remote FMU`.

Steps alternate with bare messages and answers by ZeroMQ between two processes, since other programs delay both.
"""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cosim.blocks.description import read_description
from cosim.blocks.remote_fmu import RemoteFmu, find_distant
from cosim.blocks.wire import HEAD
from cosim.serving.fmu_server import FmuServer

H = 0.02
STEPS, ROUNDS = 500, 9
ECHO = """
import zmq

with zmq.Context() as context, context.socket(zmq.PAIR) as socket:
    socket.bind("tcp://127.0.0.1:*")
    print(socket.last_endpoint.decode(), flush=True)
    while True:
        socket.send(socket.recv())
"""


def remote_step_us(fmu: Path) -> float:
    """Return the median time [us] of a step: inputs there, a step, outputs back."""
    return float(np.median(remote_times(fmu)[0]))


def remote_times(fmu: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the times [us] of steps, and of bare messages and answers of the same length."""
    with remote_block(fmu) as block, echo() as exchange:
        message = bytes(HEAD.size + 8 * len(block.inputs))
        step = block.stepping([0], 0)
        steps, bare = [], []
        for first in range(0, ROUNDS * STEPS, STEPS):
            steps.append(_times(first, lambda k: step(k * H, H)))
            bare.append(_times(first, lambda k: exchange(message)))
    return np.concatenate(steps), np.concatenate(bare)


@contextmanager
def remote_block(fmu: Path) -> Iterator[RemoteFmu]:
    """Yield an FMU behind a server of this machine, after initialization."""
    with FmuServer([fmu.parent]) as server:
        thread = threading.Thread(target=lambda: server.run(once=True))
        thread.start()
        distant = find_distant(f"127.0.0.1:{server.port}", fmu.name, None)
        description = read_description(distant.path)
        inputs = frozenset(v.name for v in description.modelVariables if v.causality == "input")
        block = RemoteFmu("fmu", distant.path, description, {}, inputs, distant=distant)
        try:
            block.bind_nothing()
            block.open(0.0, 2 * H * ROUNDS * STEPS)
            block.start()
            yield block
        finally:
            block.close()
            thread.join()


@contextmanager
def echo() -> Iterator[Callable[[bytes], bytes]]:
    """Yield a function that exchanges one message with another process and returns the answer."""
    import zmq

    with (
        subprocess.Popen([sys.executable, "-c", ECHO], stdout=subprocess.PIPE, text=True) as process,
        zmq.Context() as context,
        context.socket(zmq.PAIR) as socket,
    ):
        assert process.stdout is not None
        socket.linger = 0
        socket.connect(process.stdout.readline().strip())

        def exchange(message: bytes) -> bytes:
            socket.send(message)
            return bytes(socket.recv())

        try:
            yield exchange
        finally:
            process.kill()


def _times(first: int, call: Callable[[int], object]) -> NDArray[np.float64]:
    clock, times = time.perf_counter, np.empty(STEPS)
    for j in range(STEPS):
        begin = clock()
        call(first + j)
        times[j] = clock() - begin
    return 1e6 * times


if __name__ == "__main__":
    for name, times in zip(("step", "bare message and answer"), remote_times(Path(sys.argv[1])), strict=True):
        least, quarter, median, most = np.percentile(times, (0, 25, 50, 90))
        print(f"{name}: at least {least:.0f} us, quarter {quarter:.0f}, median {median:.0f}, 90 % below {most:.0f} us")
