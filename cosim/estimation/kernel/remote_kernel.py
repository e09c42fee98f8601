"""Filter with the library of an FMU in worker processes, so that a crash or a hang costs one evaluation."""

from __future__ import annotations

import atexit
import itertools
import queue
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from cosim.blocks.shared_code import claim
from cosim.core.arrays import Array, Rows
from cosim.core.errors import SimulationError, TimedOut
from cosim.estimation.kernel.generate import Generated
from cosim.estimation.kernel.kernel import Begin, Data, Filtered, Inputs, Simulated
from cosim.estimation.kernel.library_kernel import NAME, LibraryKernel, LibraryOf
from cosim.estimation.kernel.propagation import lasting
from cosim.isolation.limits import Limits
from cosim.isolation.process import Remote, Worker
from cosim.isolation.watch import Watch

MODULES = ("cosim.estimation.kernel.remote_kernel", "fmpy.fmi2")
MOST_KEPT = 32  # logs that a worker keeps
LONGEST = 60.0  # default limit of a pass over a log [s]
PATIENCE, LEAST = 20.0, 1.0  # after a hang, limit relative to the longest pass that succeeded, and least limit [s]

_kept: dict[tuple[int, int], Data] = {}  # in a worker: the last logs, as they are filtered again and again


class HostedKernel:
    """A kernel within a worker."""

    def __init__(self, generated: Generated, fmu: LibraryOf, parameters: Mapping[str, str]) -> None:
        claim(fmu.path)
        self._kernel = LibraryKernel(generated, fmu, parameters)

    def call(self, method: str, passes: Sequence[Any], options: Mapping[str, Any]) -> tuple[list[Any], float]:
        """Call a method with the log and arguments of each pass; return results and processor time [s]."""
        begin, results = time.process_time(), []
        for (number, sent), *arguments in passes:
            data = _kept[number] = _kept[number] if sent is None else sent
            for oldest in [*_kept][:-MOST_KEPT]:
                del _kept[oldest]
            results.append(getattr(self._kernel, method)(data, *arguments, **options))
        return results, time.process_time() - begin


class _Workers:
    """Idle worker processes with their kernels and logs; a thread takes one for each call.

    Attributes:
        spent: Processor time of all workers so far, and the time for which calls hung [s].
    """

    def __init__(self) -> None:
        self._idle: queue.LifoQueue[tuple[Worker, dict[int, Remote], dict[tuple[int, int], Data]]] = queue.LifoQueue()
        self.spent, self._numbers = 0.0, itertools.count()

    def call(
        self, kernel: RemoteLibraryKernel, method: str, passes: Sequence[tuple[Any, ...]], **options: Any
    ) -> list[Any]:
        """Return the results of a kernel's method by log; raise SimulationError if the FMU fails, crashes or hangs."""
        try:
            worker, kernels, known = self._idle.get_nowait()
        except queue.Empty:
            worker, kernels, known = Worker(*MODULES), {}, {}
        begin = time.perf_counter()
        try:
            watch = Watch((NAME,), limits=kernel.limits_of(len(passes)))
            remote = kernels.setdefault(kernel.number, Remote(worker, HostedKernel, *kernel.recipe))
            remote.make(watch)
            sent = [(self._sent(log, worker, known), *rest) for log, *rest in passes]
            results, spent = remote.call("call", method, sent, options, watch=watch)
            self.spent += spent
            kernel.pace.longest = max(kernel.pace.longest, spent)
            return list(results)
        except TimedOut:
            self.spent += time.perf_counter() - begin  # It may sleep, and a fit must end in time all the same.
            kernel.pace.has_hung = True
            raise
        finally:
            self._idle.put((worker, kernels, known))

    def _sent(self, data: Data, worker: Worker, known: dict[tuple[int, int], Data]) -> tuple[Any, Data | None]:
        """Return the number of a log, and its data unless the worker keeps them."""
        for (start, number), other in known.items():
            if other is data and start == worker.starts:
                return (start, number), None
        known[worker.starts, next(self._numbers)] = data
        for oldest in [*known][:-MOST_KEPT]:
            del known[oldest]
        return [*known][-1], data

    def end(self) -> None:
        """End all idle processes."""
        with suppress(queue.Empty):
            while True:
                self._idle.get_nowait()[0].end()


workers = _Workers()
atexit.register(workers.end)


def processor_time() -> float:
    """Return the processor time of this process and of its filters in worker processes, and of their hangs [s]."""
    return time.process_time() + workers.spent


@dataclass
class _Pace:
    """Longest processor time of a call of an FMU's kernels [s], and whether one has hung."""

    longest: float = 0.0
    has_hung: bool = False


class RemoteLibraryKernel:
    """Kernel of an FMU with terms, in worker processes. A pass in which the FMU fails counts as diverged.

    Attributes:
        failures: Reason of each pass in which the FMU failed.
    """

    _numbers = itertools.count()
    _paces: ClassVar[dict[Path, _Pace]] = {}  # by FMU: a fit and its repetition have kernels of their own

    def __init__(self, generated: Generated, fmu: LibraryOf, parameters: Mapping[str, str]) -> None:
        self.layout, self.number = generated.layout, next(self._numbers)
        self.recipe = generated, fmu._replace(path=fmu.path.resolve()), dict(parameters)
        self.limits = fmu.limits.model_copy(update={"load": fmu.limits.step or fmu.limits.load or LONGEST})
        self.failures: list[SimulationError] = []
        self.pace = self._paces.setdefault(self.recipe[1].path, _Pace())

    def limits_of(self, logs: int) -> Limits:
        """Return the limits of a call for several logs.

        An FMU that hung once often hangs at each value beyond a limit, for which a search must not wait each time.
        """
        longest = (self.limits.load or LONGEST) * logs
        if self.pace.has_hung:
            longest = min(longest, max(LEAST, PATIENCE * self.pace.longest))
        return self.limits.model_copy(update={"load": longest})

    def _try(self, method: str, arguments: Any, diverged: Callable[[], Any], **options: Any) -> Any:
        """Return the result of a method, or that of `diverged` if the FMU fails."""
        try:
            return workers.call(self, method, [arguments], **options)[0]
        except SimulationError as error:
            self.failures.append(error)
            return diverged()

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        """Filter one log, as `Kernel.run`."""
        diverged = partial(self._diverged, data, states=states)
        filtered: Filtered = self._try("run", (data, p, x0, P0, q, r), diverged, states=states)
        return filtered

    def _diverged(self, data: Data, *, states: bool = False) -> Filtered:
        """Return the outcome of a pass that failed."""
        rows, layout, count = len(data.u) if states else 0, self.layout, len(self.layout.stochastic)
        nothing = _nothing(rows, len(layout.states)), _nothing(rows, layout.memory), _nothing(rows, count, count)
        return Filtered(np.full(data.y.shape, np.inf), np.ones(data.y.shape), *nothing)

    def run_all(self, inputs: Sequence[Inputs]) -> Sequence[Filtered]:
        """Filter several logs; one after the other if the FMU fails, none if it hangs."""
        try:
            return workers.call(self, "run", inputs)
        except TimedOut as error:
            self.failures.append(error)
            return [self._diverged(data) for data, *_ in inputs]
        except SimulationError:
            return [self.run(*each) for each in inputs]

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, first: int = 0
    ) -> Simulated:
        """Simulate with the commands of a log, as `Kernel.simulate`."""
        counts = len(self.layout.outputs), len(self.layout.states), self.layout.memory
        simulated: Simulated = self._try(
            "simulate",
            (data, p, x0, memory, kicks, first),
            lambda: Simulated(*(_nothing(len(data.u), count) for count in counts)),
        )
        return simulated

    def simulate_all(self, begins: Sequence[Begin]) -> Sequence[Simulated]:
        """Simulate several times, one after the other if the FMU fails."""
        try:
            return workers.call(self, "simulate", begins)
        except SimulationError:
            return [self.simulate(*each) for each in begins]

    def responses(self, data: Data, x0: Array) -> tuple[Array, Array]:
        """Return slopes by start states, and propagations, as `LibraryKernel.responses`."""
        ((slopes, propagation),) = workers.call(self, "responses", [(data, x0)])
        return slopes, propagation

    def propagation(self, data: Data, x0: Array) -> Array:
        """Return the matrices by which deviations of a free run go on that no reading corrects, as `propagations`."""
        return lasting(self.responses(data, x0)[1])

    def step(self, data: Data, p: Array, points: tuple[Rows, Array, Array], back: int) -> tuple[Array, Array]:
        """Return single steps from rows of a log, as `single_steps`."""
        counts, rows = (len(self.layout.states), len(self.layout.outputs)), len(points[0])
        stepped: tuple[Array, Array] = self._try(
            "step", (data, p, points, back), lambda: tuple(_nothing(rows, count) for count in counts)
        )
        return stepped


def _nothing(*shape: int) -> Array:
    return np.full(shape, np.nan)
