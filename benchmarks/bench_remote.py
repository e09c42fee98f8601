"""Wall time of a step of an FMU behind a server on this machine: `python -m benchmarks.bench_remote FMU`."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

from cosim.blocks.description import read_description
from cosim.blocks.remote_fmu import RemoteFmu, find_distant
from cosim.serving.fmu_server import FmuServer

H = 0.02
STEPS = 500  # in a round


def remote_step_us(fmu: Path, rounds: int = 9) -> float:
    """Return the median time [us] of a step: inputs there, a step, outputs back."""
    with FmuServer([fmu.parent]) as server:
        thread = threading.Thread(target=lambda: server.run(once=True))
        thread.start()
        distant = find_distant(f"127.0.0.1:{server.port}", fmu.name, None)
        description = read_description(distant.path)
        inputs = frozenset(v.name for v in description.modelVariables if v.causality == "input")
        block = RemoteFmu("fmu", distant.path, description, {}, inputs, distant=distant)
        try:
            block.bind_nothing()
            block.open(0.0, 2 * H * rounds * STEPS)
            block.start()
            step = block.stepping([0], 0)
            times = [_seconds(step, k * STEPS) for k in range(rounds)]
        finally:
            block.close()
            thread.join()
    return 1e6 * median(times) / STEPS


def _seconds(step: Callable[[float, float], None], first: int) -> float:
    begin = time.perf_counter()
    for k in range(first, first + STEPS):
        step(k * H, H)
    return time.perf_counter() - begin


if __name__ == "__main__":
    print(f"{remote_step_us(Path(sys.argv[1])):.1f} us per step")
