"""Compiled kernels, cached by model and measured outputs."""

from __future__ import annotations

import atexit
import queue
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any

from cosim.core.arrays import Array
from cosim.core.errors import Fault, InputError, SimulationError, TimedOut
from cosim.estimation.kernel.generate import Generated, generate, generate_stepped
from cosim.estimation.kernel.kernel import Data, Filtered, Kernel, Simulated, no_filtered, no_simulated
from cosim.estimation.kernel.library_kernel import MODEL_COMPONENT, CompiledKernel, LibraryKernel, LibraryOf
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler, cure
from cosim.isolation.limits import LOADING
from cosim.isolation.process import Remote, Worker
from cosim.isolation.watch import Watch
from cosim.model.model import Model
from cosim.model.symbolic.symbols import OfNumbersOnly
from cosim.probing.prober import MAX_TRIAL_DURATIONS
from cosim.terms.code import FmuModel

_kernels: dict[tuple[Any, ...], Kernel] = {}


def kernel(
    model: Model,
    measured: Sequence[str],
    unnamed: bool = False,
    constant: Sequence[str] = (),
    fmu: LibraryOf | None = None,
) -> Kernel:
    """Return the kernel (Kalman filter over a log) for a model and its measured outputs, compiled or from the cache.

    Boolean parameters are constants in the kernel; all other parameters are arguments.

    Args:
        unnamed: Add terms outside the catalogue (unmodelled dynamics), as in `generate`.
        constant: Parameters that the filter treats as constant states.
        fmu: FMU of a model whose equations are in a library.

    Raises:
        InputError: There is no working C compiler, or the model compares symbols with ==.
    """
    flags = tuple(getattr(model, p.name) for p in model.parameters if isinstance(p.default, bool))
    key = (type(model), flags, tuple(measured), unnamed, tuple(constant), model.integrator)
    if key not in _kernels:
        try:
            if isinstance(model, FmuModel) and fmu is not None:
                generated = (generate_stepped if model.stepped else generate)(model, measured, unnamed)
                _kernels[key] = RemoteLibraryKernel(generated, fmu)
            else:
                _kernels[key] = CompiledKernel(generate(model, measured, unnamed, constant))
        except OfNumbersOnly as error:
            line = traceback.extract_tb(error.__traceback__)[-2]  # line of the model with this operation
            place = Path(line.filename), line.lineno or 0, (line.colno or 0) + 1
            raise InputError(
                [
                    Fault(
                        *place,
                        "this line works on numbers only, but refine compiles it with symbols in place of "
                        f"numbers: {error}; use the functions of m",
                    )
                ]
            ) from error
        except (NoCompiler, CompilerFailed) as error:
            message = f"refine compiles its filter with a C compiler, but {error}; {cure('refine')}"
            raise InputError.at(Path(sys.executable), message) from error
    return _kernels[key]


# An FMU's library is filtered in worker processes, so that a crash or a hang costs only one evaluation.


KERNEL_MODULES = ("cosim.estimation.kernel.library_kernel", "fmpy.fmi2")

# idle worker processes with kernels; a thread takes one for each call
_idle: queue.LifoQueue[tuple[Worker, dict[RemoteLibraryKernel, Remote]]] = queue.LifoQueue()


@atexit.register
def end_workers() -> None:
    """End all idle worker processes."""
    with suppress(queue.Empty):
        while True:
            _idle.get_nowait()[0].end()


class RemoteLibraryKernel:
    """Kernel of an FMU with terms, in worker processes. If the FMU fails in a pass, the pass counts as diverged.

    Attributes:
        failures: Reason of each pass in which the FMU failed.
    """

    def __init__(self, generated: Generated, fmu: LibraryOf) -> None:
        self.layout, _ = generated
        self._recipe = generated, fmu._replace(path=fmu.path.resolve())
        self.limits = fmu.limits.model_copy(update={"load": fmu.limits.step or fmu.limits.load or LOADING})
        self.failures: list[SimulationError] = []
        self._longest, self._has_hung = 0.0, False  # longest processor time of a successful call [s]

    def _call(self, method: str, passes: Sequence[tuple[Any, ...]], **options: Any) -> list[Any]:
        """Return a method's result for each pass; raise SimulationError if the FMU fails, crashes or hangs."""
        try:
            worker, kernels = _idle.get_nowait()
        except queue.Empty:
            worker, kernels = Worker(*KERNEL_MODULES), {}
        most = (self.limits.load or LOADING) * len({id(data) for data, *_ in passes})
        # An FMU that hung once often hangs at each value beyond a limit, for which a search must not wait each time.
        most = min(most, max(1.0, MAX_TRIAL_DURATIONS * self._longest)) if self._has_hung else most
        try:
            watch = Watch((MODEL_COMPONENT,), limits=self.limits.model_copy(update={"load": most}), computing=True)
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
        """Call a method for several passes; if the FMU fails, call it for each half of the passes.

        If a filter hangs, the other passes are not tried.
        """
        try:
            return self._call(method, passes, **options)
        except SimulationError as error:
            if len(passes) > 1 and not (method == "run" and isinstance(error, TimedOut)):
                half = len(passes) // 2
                parts = [self.call_all(method, part, **options) for part in (passes[:half], passes[half:])]
                return [*chain.from_iterable(parts)]
            self.failures.append(error)
            if method == "run":
                return [no_filtered(self.layout, data, **options) for data, *_ in passes]
            if method == "simulate":
                return [no_simulated(self.layout, data) for data, *_ in passes]
            return [
                [no_simulated(self.layout, data.rows(row, row + length + 1)) for row in points[0]]
                for data, _, points, length in passes
            ]

    def run(self, *arguments: Any, **options: Any) -> Filtered:
        """Filter one log, as `Kernel.run`."""
        filtered: Filtered = self.call_all("run", [arguments], **options)[0]
        return filtered

    def simulate(self, *arguments: Any, **options: Any) -> Simulated:
        """Simulate with the commands of a log, as `Kernel.simulate`."""
        simulated: Simulated = self.call_all("simulate", [arguments], **options)[0]
        return simulated

    def simulate_from(
        self, data: Data, p: Array, points: tuple[Sequence[int], Any, Any], length: int
    ) -> list[Simulated]:
        """Simulate a log from several start rows, as `Problem.simulate_from`; each run has `length` further rows."""
        each = [tuple(part[k : k + 1] for part in points) for k in range(len(points[0]))]
        runs = self.call_all("simulate_from", [(data, p, point, length) for point in each])
        return [*chain.from_iterable(runs)]

    def responses(self, *arguments: Any) -> tuple[Array, Array]:
        """Return derivatives by start states, and the propagation, as `LibraryKernel.responses`."""
        found: tuple[Array, Array] = self._call("responses", [arguments])[0]
        return found
