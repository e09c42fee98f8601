"""Filter with the library of an FMU in worker processes, so that a crash or a hang costs one evaluation."""

from __future__ import annotations

import atexit
import itertools
import queue
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.base.errors import SimulationError
from cosim.isolation.process import Worker
from cosim.isolation.rows import OTHER
from cosim.isolation.watch import Watch
from cosim.kernel.generate import Generated
from cosim.kernel.kernel import Data, Filtered, Simulated
from cosim.kernel.library_kernel import NAME, LibraryKernel, LibraryOf

MODULES = ("cosim.kernel.remote_kernel", "fmpy.fmi2")
LONGEST = 60.0  # default limit of a pass over a log [s]

# -- in the worker ----------------------------------------------------------------------------

_made: dict[int, LibraryKernel] = {}


def make(number: int, *arguments: Any) -> None:
    """Create a kernel in the worker."""
    _made[number] = LibraryKernel(*arguments)


def call(number: int, method: str, arguments: tuple[Any, ...], options: Mapping[str, Any]) -> tuple[Any, float]:
    """Call a method of a kernel; return its result and the processor time [s]."""
    begin = time.process_time()
    result = getattr(_made[number], method)(*arguments, **options)
    return result, time.process_time() - begin


# -- in the caller ----------------------------------------------------------------------------


class _Workers:
    """Idle worker processes; a thread takes one for each call.

    Attributes:
        spent: Processor time of all workers so far [s].
    """

    def __init__(self) -> None:
        self._idle: queue.LifoQueue[tuple[Worker, set[tuple[int, int]]]] = queue.LifoQueue()
        self.spent = 0.0

    def call(self, kernel: RemoteLibraryKernel, method: str, arguments: tuple[Any, ...], **options: Any) -> Any:
        """Return the result of a kernel's method; raise SimulationError if the FMU fails, crashes or hangs."""
        try:
            worker, known = self._idle.get_nowait()
        except queue.Empty:
            worker, known = Worker(*MODULES), set()
        try:
            worker.start()
            watch = Watch((NAME,), limits=kernel.limits)
            if (worker.starts, kernel.number) not in known:
                worker.call(make, kernel.number, *kernel.recipe, watch=watch, doing=OTHER)
                known.add((worker.starts, kernel.number))
            result, spent = worker.call(call, kernel.number, method, arguments, options, watch=watch, doing=OTHER)
            self.spent += spent
            return result
        finally:
            self._idle.put((worker, known))

    def end(self) -> None:
        """End all idle processes."""
        with suppress(queue.Empty):
            while True:
                worker, _ = self._idle.get_nowait()
                worker.end()


workers = _Workers()
atexit.register(workers.end)


def processor_time() -> float:
    """Return the processor time of this process and of its filters in worker processes [s]."""
    return time.process_time() + workers.spent


class RemoteLibraryKernel:
    """Kernel of an FMU with terms, in worker processes. A pass in which the FMU fails counts as diverged.

    Attributes:
        failures: Reason of each pass in which the FMU failed.
    """

    _numbers = itertools.count()

    def __init__(self, generated: Generated, fmu: LibraryOf, parameters: Mapping[str, str]) -> None:
        self.layout, self.number = generated.layout, next(self._numbers)
        self.recipe = generated, fmu._replace(path=fmu.path.resolve()), dict(parameters)
        self.limits = fmu.limits.model_copy(update={"load": fmu.limits.step or fmu.limits.load or LONGEST})
        self.failures: list[SimulationError] = []

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        """Filter one log, as `Kernel.run`."""
        try:
            filtered: Filtered = workers.call(self, "run", (data, p, x0, P0, q, r), states=states)
        except SimulationError as error:
            self.failures.append(error)
            rows = len(data.u) if states else 0
            shape, count = data.y.shape, len(self.layout.stochastic)
            nothing = np.full((rows, len(self.layout.states)), np.nan), np.full((rows, self.layout.memory), np.nan)
            return Filtered(np.full(shape, np.inf), np.ones(shape), *nothing, np.full((rows, count, count), np.nan))
        return filtered

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, *, first: int = 0
    ) -> Simulated:
        """Simulate with the commands of a log, as `Kernel.simulate`."""
        try:
            simulated: Simulated = workers.call(self, "simulate", (data, p, x0, memory, kicks), first=first)
        except SimulationError as error:
            self.failures.append(error)
            rows, counts = len(data.u), (len(self.layout.outputs), len(self.layout.states), self.layout.memory)
            return Simulated(*(np.full((rows, count), np.nan) for count in counts))
        return simulated

    def step(self, data: Data, p: Array, points: tuple[Rows, Array, Array], back: int) -> tuple[Array, Array]:
        """Return single steps from rows of a log, as `single_steps`."""
        try:
            stepped: tuple[Array, Array] = workers.call(self, "step", (data, p, points, back))
        except SimulationError as error:
            self.failures.append(error)
            rows, layout = len(points[0]), self.layout
            return np.full((rows, len(layout.states)), np.nan), np.full((rows, len(layout.outputs)), np.nan)
        return stepped
