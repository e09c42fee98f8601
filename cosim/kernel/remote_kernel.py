"""Filter with the library of an FMU in worker processes, so that a crash or a hang costs one evaluation."""

from __future__ import annotations

import atexit
import itertools
import queue
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, ClassVar, NamedTuple

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.base.errors import SimulationError, TimedOut
from cosim.blocks.shared_code import claim
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import OTHER
from cosim.isolation.watch import Watch
from cosim.kernel.generate import Generated
from cosim.kernel.kernel import Begin, Data, Filtered, Inputs, Simulated
from cosim.kernel.library_kernel import NAME, LibraryKernel, LibraryOf

MODULES = ("cosim.kernel.remote_kernel", "fmpy.fmi2")
MOST_KEPT = 32  # logs that a worker keeps
LONGEST = 60.0  # default limit of a pass over a log [s]
PATIENCE, LEAST = 20.0, 1.0  # after a hang, limit relative to the longest pass that succeeded, and least limit [s]

# -- in the worker ----------------------------------------------------------------------------

_made: dict[int, LibraryKernel] = {}
_kept: dict[int, Data] = {}  # logs that are filtered again and again


class _Log(NamedTuple):
    """A log on its way: a number under which the worker keeps it, and its data where the worker does not know it."""

    number: int
    data: Data | None


def _unpack(argument: Any) -> Any:
    """Return arguments with the data of logs."""
    if isinstance(argument, list):
        return [_unpack(each) for each in argument]
    if isinstance(argument, tuple) and argument and isinstance(argument[0], _Log):
        number, data = argument[0]
        if data is None:
            data = _kept[number]
        elif number >= 0:
            _kept[number] = data
            for old in [*_kept][: -2 * MOST_KEPT]:
                del _kept[old]
        return (data, *argument[1:])
    return argument


def make(number: int, generated: Generated, fmu: LibraryOf, parameters: Mapping[str, str]) -> None:
    """Create a kernel in the worker."""
    claim(fmu.path)
    _made[number] = LibraryKernel(generated, fmu, parameters)


def call(number: int, method: str, arguments: Any, options: Mapping[str, Any]) -> tuple[Any, float]:
    """Call a method of a kernel; return its result and the processor time [s]."""
    begin = time.process_time()
    unpacked = _unpack(arguments)
    arguments = (unpacked,) if isinstance(unpacked, list) else unpacked
    result = getattr(_made[number], method)(*arguments, **options)
    return result, time.process_time() - begin


# -- in the caller ----------------------------------------------------------------------------


class _Workers:
    """Idle worker processes; a thread takes one for each call.

    Attributes:
        spent: Processor time of all workers so far, and the time for which calls hung [s].
    """

    def __init__(self) -> None:
        self._idle: queue.LifoQueue[tuple[Worker, set[tuple[int, int]]]] = queue.LifoQueue()
        self.spent = 0.0
        self._numbering, self._numbers = Lock(), itertools.count()
        self._logs: deque[tuple[int, Data]] = deque(maxlen=MOST_KEPT)
        self._seen: deque[Data] = deque(maxlen=MOST_KEPT)

    def call(self, kernel: RemoteLibraryKernel, method: str, arguments: Any, **options: Any) -> Any:
        """Return the result of a kernel's method; raise SimulationError if the FMU fails, crashes or hangs."""
        try:
            worker, known = self._idle.get_nowait()
        except queue.Empty:
            worker, known = Worker(*MODULES), set()
        begin = time.perf_counter()
        try:
            worker.start()
            watch = Watch((NAME,), limits=kernel.limits_of(len(arguments) if isinstance(arguments, list) else 1))
            if (worker.starts, kernel.number) not in known:
                worker.call(make, kernel.number, *kernel.recipe, watch=watch, doing=OTHER)
                known.add((worker.starts, kernel.number))
            packed = self._pack(arguments, worker.starts, known)
            result, spent = worker.call(call, kernel.number, method, packed, options, watch=watch, doing=OTHER)
            self.spent += spent
            kernel.pace.longest = max(kernel.pace.longest, spent)
            return result
        except TimedOut:
            self.spent += time.perf_counter() - begin  # It may sleep, and a fit must end in time all the same.
            kernel.pace.has_hung = True
            raise
        finally:
            self._idle.put((worker, known))

    def _pack(self, arguments: Any, starts: int, known: set[tuple[int, int]]) -> Any:
        """Return arguments without the data of logs that the worker keeps."""
        if isinstance(arguments, list):
            return [self._pack(each, starts, known) for each in arguments]
        if not isinstance(arguments[0], Data):
            return arguments
        number = self._number(arguments[0])
        key = starts, -1 - number
        is_known = number >= 0 and key in known
        if number >= 0:
            known.add(key)
        return (_Log(number, None if is_known else arguments[0]), *arguments[1:])

    def _number(self, data: Data) -> int:
        """Return the number of a log that comes for the second time, −1 for others."""
        with self._numbering:
            for number, other in self._logs:
                if other is data:
                    return number
            if not any(other is data for other in self._seen):
                self._seen.append(data)
                return -1
            self._logs.append((next(self._numbers), data))
            return self._logs[-1][0]

    def end(self) -> None:
        """End all idle processes."""
        with suppress(queue.Empty):
            while True:
                worker, _ = self._idle.get_nowait()
                worker.end()


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

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        """Filter one log, as `Kernel.run`."""
        try:
            filtered: Filtered = workers.call(self, "run", (data, p, x0, P0, q, r), states=states)
        except SimulationError as error:
            self.failures.append(error)
            return self._diverged(data, states=states)
        return filtered

    def _diverged(self, data: Data, *, states: bool = False) -> Filtered:
        """Return the outcome of a pass that failed."""
        rows = len(data.u) if states else 0
        shape, count = data.y.shape, len(self.layout.stochastic)
        nothing = np.full((rows, len(self.layout.states)), np.nan), np.full((rows, self.layout.memory), np.nan)
        return Filtered(np.full(shape, np.inf), np.ones(shape), *nothing, np.full((rows, count, count), np.nan))

    def run_all(self, inputs: Sequence[Inputs]) -> Sequence[Filtered]:
        """Filter several logs; one after the other if the FMU fails, none if it hangs."""
        try:
            filtered: Sequence[Filtered] = workers.call(self, "run_all", [*inputs])
        except TimedOut as error:
            self.failures.append(error)
            return [self._diverged(data) for data, *_ in inputs]
        except SimulationError:
            return [self.run(*each) for each in inputs]
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

    def simulate_all(self, begins: Sequence[Begin]) -> Sequence[Simulated]:
        """Simulate several times, one after the other if the FMU fails."""
        try:
            simulated: Sequence[Simulated] = workers.call(self, "simulate_all", [*begins])
        except SimulationError:
            return [self.simulate(*each[:5], first=each[5]) for each in begins]
        return simulated

    def responses(self, data: Data, x0: Array) -> tuple[Array, Array]:
        """Return slopes by start states, and propagations, as `LibraryKernel.responses`."""
        slopes, propagation = workers.call(self, "responses", (data, x0))
        return np.asarray(slopes), np.asarray(propagation)

    def propagation(self, data: Data, x0: Array) -> Array:
        """Return the matrices by which deviations of the outputs of a free run go on, as `propagation`."""
        return np.asarray(workers.call(self, "propagation", (data, x0)))

    def step(self, data: Data, p: Array, points: tuple[Rows, Array, Array], back: int) -> tuple[Array, Array]:
        """Return single steps from rows of a log, as `single_steps`."""
        try:
            stepped: tuple[Array, Array] = workers.call(self, "step", (data, p, points, back))
        except SimulationError as error:
            self.failures.append(error)
            rows, layout = len(points[0]), self.layout
            return np.full((rows, len(layout.states)), np.nan), np.full((rows, len(layout.outputs)), np.nan)
        return stepped
