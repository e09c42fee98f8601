"""Filter with the library of an FMU in worker processes, so that a crash or a hang costs one evaluation."""

from __future__ import annotations

import atexit
import itertools
import queue
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from cosim.blocks.shared_code import claim
from cosim.core.arrays import Array, Rows
from cosim.core.errors import SimulationError, TimedOut
from cosim.estimation.kernel.generate import Generated
from cosim.estimation.kernel.kernel import Data, Filtered, Simulated
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


class HostedKernel(LibraryKernel):
    """A kernel within a worker."""

    def __init__(self, generated: Generated, fmu: LibraryOf, parameters: Mapping[str, str]) -> None:
        claim(fmu.path)
        super().__init__(generated, fmu, parameters)

    def call(self, method: str, passes: Sequence[Any], options: Mapping[str, Any]) -> tuple[list[Any], float]:
        """Call a method with the log and arguments of each pass; return results and processor time [s]."""
        begin, results = time.process_time(), []
        for (number, sent), *arguments in passes:
            data = _kept[number] = _kept[number] if sent is None else sent
            for oldest in [*_kept][:-MOST_KEPT]:
                del _kept[oldest]
            results.append(getattr(self, method)(data, *arguments, **options))
        return results, time.process_time() - begin


class _Workers:
    """Idle worker processes with their kernels and logs; a thread takes one for each call.

    Attributes:
        spent: Processor time of all workers so far, and the time for which calls hung [s].
    """

    def __init__(self) -> None:
        self._idle: queue.LifoQueue[tuple[Worker, dict[int, Remote], dict[tuple[int, int], Data]]] = queue.LifoQueue()
        self._numbers = itertools.count()

    def call(
        self, kernel: RemoteLibraryKernel, method: str, passes: Sequence[tuple[Any, ...]], **options: Any
    ) -> list[Any]:
        """Return the results of a kernel's method by log; raise SimulationError if the FMU fails, crashes or hangs."""
        try:
            worker, kernels, known = self._idle.get_nowait()
        except queue.Empty:
            worker, kernels, known = Worker(*MODULES), {}, {}
        try:
            watch = Watch((NAME,), limits=kernel.limits_of(len(passes)))
            remote = kernels.setdefault(kernel.number, Remote(worker, HostedKernel, *kernel.recipe))
            remote.make(watch)
            sent = [(self._sent(log, worker, known), *rest) for log, *rest in passes]
            results, spent = remote.call("call", method, sent, options, watch=watch)
            kernel.longest[kernel.path] = max(kernel.longest.get(kernel.path, 0.0), spent)
            return list(results)
        except TimedOut:
            kernel.hung.add(kernel.path)
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


class RemoteLibraryKernel:
    """Kernel of an FMU with terms, in worker processes. A pass in which the FMU fails counts as diverged.

    Attributes:
        failures: Reason of each pass in which the FMU failed.
    """

    _numbers = itertools.count()
    longest: ClassVar[dict[Path, float]] = {}  # by FMU: longest processor time of a call that succeeded [s]
    hung: ClassVar[set[Path]] = set()  # FMUs of which a call has hung; a fit and its repetition have own kernels

    def __init__(self, generated: Generated, fmu: LibraryOf, parameters: Mapping[str, str]) -> None:
        self.layout, self.number, self.path = generated.layout, next(self._numbers), fmu.path.resolve()
        self.recipe = generated, fmu._replace(path=self.path), dict(parameters)
        self.limits = fmu.limits.model_copy(update={"load": fmu.limits.step or fmu.limits.load or LONGEST})
        self.failures: list[SimulationError] = []

    def limits_of(self, logs: int) -> Limits:
        """Return the limits of a call for several logs.

        An FMU that hung once often hangs at each value beyond a limit, for which a search must not wait each time.
        """
        longest = (self.limits.load or LONGEST) * logs
        if self.path in self.hung:
            longest = min(longest, max(LEAST, PATIENCE * self.longest.get(self.path, 0.0)))
        return self.limits.model_copy(update={"load": longest})

    def call_all(self, method: str, passes: Sequence[tuple[Any, ...]], **options: Any) -> list[Any]:
        """Call `run`, `simulate` or `step` for several logs, one after the other if the FMU fails.

        If a filter hangs, those of the other logs are not tried.
        """
        try:
            return workers.call(self, method, passes, **options)
        except SimulationError as error:
            if len(passes) > 1 and not (method == "run" and isinstance(error, TimedOut)):
                return [self.call_all(method, [each], **options)[0] for each in passes]
            self.failures.append(error)
            return [self._diverged(method, *each, **options) for each in passes]

    def _diverged(self, method: str, data: Data, *arguments: Any, states: bool = False) -> Any:
        """Return the outcome of a pass that failed."""
        layout, (rows, ny) = self.layout, data.y.shape
        outputs, nx, memory, random = len(layout.outputs), len(layout.states), layout.memory, len(layout.stochastic)
        if method == "run":
            kept = rows if states else 0
            shapes: list[tuple[int, ...]] = [(kept, nx), (kept, memory), (kept, random, random)]
            return Filtered(np.full((rows, ny), np.inf), np.ones((rows, ny)), *(np.full(s, np.nan) for s in shapes))
        if method == "simulate":
            return Simulated(*(np.full((rows, count), np.nan) for count in (outputs, nx, memory)))
        return tuple(np.full((len(arguments[1][0]), count), np.nan) for count in (nx, outputs))

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        """Filter one log, as `Kernel.run`."""
        filtered: Filtered = self.call_all("run", [(data, p, x0, P0, q, r)], states=states)[0]
        return filtered

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, first: int = 0
    ) -> Simulated:
        """Simulate with the commands of a log, as `Kernel.simulate`."""
        simulated: Simulated = self.call_all("simulate", [(data, p, x0, memory, kicks, first)])[0]
        return simulated

    def step(self, data: Data, p: Array, points: tuple[Rows, Array, Array], back: int) -> tuple[Array, Array]:
        """Return single steps from rows of a log, as `single_steps`."""
        stepped: tuple[Array, Array] = self.call_all("step", [(data, p, points, back)])[0]
        return stepped

    def responses(self, data: Data, x0: Array) -> tuple[Array, Array]:
        """Return slopes by start states, and propagations, as `LibraryKernel.responses`."""
        ((slopes, propagation),) = workers.call(self, "responses", [(data, x0)])
        return slopes, propagation

    def propagation(self, data: Data, x0: Array) -> Array:
        """Return the matrices by which deviations of a free run go on that no reading corrects, as `propagations`."""
        return lasting(self.responses(data, x0)[1])
