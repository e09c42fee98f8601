"""Filter with the library of an FMU in worker processes, so that a crash or a hang costs one evaluation."""

from __future__ import annotations

import atexit
import queue
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.errors import SimulationError, TimedOut
from cosim.estimation.kernel.generate import Generated
from cosim.estimation.kernel.kernel import Data, Filtered, Simulated, no_filtered, no_simulated
from cosim.estimation.kernel.library_kernel import NAME, LibraryKernel, LibraryOf
from cosim.isolation.limits import LOADING
from cosim.isolation.process import Remote, Worker
from cosim.isolation.watch import Watch
from cosim.probing.prober import SLOW

MODULES = ("cosim.estimation.kernel.library_kernel", "fmpy.fmi2")

# idle worker processes with their kernels; a thread takes one for each call
_idle: queue.LifoQueue[tuple[Worker, dict[RemoteLibraryKernel, Remote]]] = queue.LifoQueue()


@atexit.register
def end_workers() -> None:
    """End all idle processes."""
    with suppress(queue.Empty):
        while True:
            _idle.get_nowait()[0].end()


class RemoteLibraryKernel:
    """Kernel of an FMU with terms, in worker processes. A pass in which the FMU fails counts as diverged.

    Attributes:
        failures: Reason of each pass in which the FMU failed.
    """

    def __init__(self, generated: Generated, fmu: LibraryOf) -> None:
        self.layout = generated.layout
        self._recipe = generated, fmu._replace(path=fmu.path.resolve())
        self.limits = fmu.limits.model_copy(update={"load": fmu.limits.step or fmu.limits.load or LOADING})
        self.failures: list[SimulationError] = []
        self._longest, self._has_hung = 0.0, False  # processor time of a call that succeeded [s]

    def _call(self, method: str, passes: Sequence[tuple[Any, ...]], **options: Any) -> list[Any]:
        """Return the results of a method for each pass; raise SimulationError if the FMU fails, crashes or hangs."""
        try:
            worker, kernels = _idle.get_nowait()
        except queue.Empty:
            worker, kernels = Worker(*MODULES), {}
        most = (self.limits.load or LOADING) * len(passes)
        # An FMU that hung once often hangs at each value beyond a limit, for which a search must not wait each time.
        most = min(most, max(1.0, SLOW * self._longest)) if self._has_hung else most
        try:
            watch = Watch((NAME,), limits=self.limits.model_copy(update={"load": most}))
            remote = kernels.setdefault(self, Remote(worker, LibraryKernel, *self._recipe))
            results, spent = remote.call("call", method, passes, options, watch=watch)
            self._longest = max(self._longest, spent)
            return list(results)
        except TimedOut:
            self._has_hung = True
            raise
        finally:
            _idle.put((worker, kernels))

    def call_all(self, method: str, passes: Sequence[tuple[Any, ...]], **options: Any) -> list[Any]:
        """Call `run`, `simulate` or `step` for several logs, one after the other if the FMU fails.

        If a filter hangs, those of the other logs are not tried.
        """
        try:
            return self._call(method, passes, **options)
        except SimulationError as error:
            if len(passes) > 1 and not (method == "run" and isinstance(error, TimedOut)):
                return [self.call_all(method, [each], **options)[0] for each in passes]
            self.failures.append(error)
            return [self._diverged(method, *each, **options) for each in passes]

    def _diverged(self, method: str, data: Data, *arguments: Any, states: bool = False, **_: Any) -> Any:
        """Return the outcome of a pass that failed."""
        if method == "run":
            return no_filtered(self.layout, data, states=states)
        if method == "simulate":
            return no_simulated(self.layout, data)
        signals = self.layout.states, self.layout.outputs
        return tuple(np.full((len(arguments[1][0]), len(names)), np.nan) for names in signals)

    def run(self, *arguments: Any, **options: Any) -> Filtered:
        """Filter one log, as `Kernel.run`."""
        filtered: Filtered = self.call_all("run", [arguments], **options)[0]
        return filtered

    def simulate(self, *arguments: Any, **options: Any) -> Simulated:
        """Simulate with the commands of a log, as `Kernel.simulate`."""
        simulated: Simulated = self.call_all("simulate", [arguments], **options)[0]
        return simulated

    def step(self, *arguments: Any) -> tuple[Array, Array]:
        """Return single steps from rows of a log, as `single_steps`."""
        stepped: tuple[Array, Array] = self.call_all("step", [arguments])[0]
        return stepped

    def responses(self, *arguments: Any) -> tuple[Array, Array]:
        """Return slopes by start states, and propagations, as `LibraryKernel.responses`."""
        found: tuple[Array, Array] = self._call("responses", [arguments])[0]
        return found
