"""An FMU that is probed, from the caller's side: its worker process, its signals and its pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np

from cosim.blocks.compiling import permission, with_permission
from cosim.core.arrays import Array, Flags
from cosim.core.errors import Fault, refuse
from cosim.core.scratch import temporary_folder
from cosim.core.text import did_you_mean
from cosim.files.archive import unpack
from cosim.fmi.description import read_description, unit_of
from cosim.fmi.fmi_types import element_names
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.watch import Watch, fmi_calls
from cosim.model.quantities import Quantity
from cosim.probing.log_runs import Fmu, limits_of

Job = Callable[..., Any]
JOBS = ("exchange_points", "log_runs", "misbehaviour")
MODULES = (*(f"cosim.probing.{job}" for job in JOBS), "fmpy.fmi2", "fmpy.fmi3", "fmpy.logging")
LIMITS = Limits(step=20.0, load=60.0)
USUAL_STEP, USUAL_LOAD = 5.0, 10.0  # least time limits of a trial [s]
SLOW = 30.0  # time limit of a trial as a multiple of the time of an ordinary simulation


class Prober(ExitStack):
    """An FMU with a worker process that makes its simulations, as a context that unpacks it.

    Args:
        values: Start values of every instance.
        limits: Limits of every job.
    """

    def __init__(self, fmu: Path, values: Mapping[str, Any] = MappingProxyType({}), limits: Limits = LIMITS) -> None:
        super().__init__()
        self.path = path = Path(fmu).resolve()
        self.description, self.values, self._limits = read_description(path), dict(values), limits
        variables = {v.name for v in self.description.modelVariables}
        unknown = [f'has no variable "{n}"{did_you_mean(n, variables)}' for n in values if n not in variables]
        refuse(Fault(path, 0, 0, message) for message in unknown)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self.place = stack.enter_context(temporary_folder("probe"))
            self._worker = stack.enter_context(Worker(*MODULES))
            unpack(self.path, self.place)
            self.enter_context(stack.pop_all())
        return self

    def with_values(self, values: Mapping[str, Any]) -> Fmu:
        """Return the FMU with further start values."""
        return Fmu(self.path, self.place, self.description, {**self.values, **values})

    @property
    def fmu(self) -> Fmu:
        """Return the FMU with its start values."""
        return self.with_values({})

    @contextmanager
    def hurry(self, took: float) -> Iterator[None]:
        """Limit all jobs within a `with` block as trials that may hang; see `hurried`."""
        usual, self._limits = self._limits, self.hurried(took)
        try:
            yield
        finally:
            self._limits = usual

    def hurried(self, took: float) -> Limits:
        """Return the limits of a trial that may hang, from the time [s] that an ordinary simulation took."""
        step, load = max(USUAL_STEP, SLOW * took), max(USUAL_LOAD, SLOW * took)
        most = {"step": min(step, self._limits.step or step), "load": min(load, self._limits.load or load)}
        return self._limits.model_copy(update=most)

    def call(self, job: Job, *arguments: Any, limits: Limits | None = None) -> Any:
        """Return the result of a job in the worker."""
        watch = Watch([self.path.name], [fmi_calls(self.description)], limits=limits or self._limits)
        return self._worker.call(with_permission, permission.get(), job, *arguments, watch=watch)


def separate_pairs(fits: Sequence[tuple[int, int, float]]) -> list[tuple[int, int, float]]:
    """Return position, velocity and gain of pairs without a common signal.

    Of a chain of integrators these are the first two; else the gain nearest to 1 decides.
    """
    velocities = {v for _, v, _ in fits}
    chosen: list[tuple[int, int, float]] = []
    used: set[int] = set()
    for q, v, gain in sorted(fits, key=lambda fit: (fit[0] in velocities, abs(fit[2] - 1.0), fit[0])):
        if not used & {q, v}:
            used |= {q, v}
            chosen.append((q, v, gain))
    return sorted(chosen)


def quantities(
    description: Any, names: Sequence[str], starts: Sequence[float] | Array | None = None
) -> tuple[Quantity, ...]:
    """Return names of variables or of elements of arrays as quantities.

    Args:
        starts: Start values; None for those of the description.
    """
    variables = {element: v for v in description.modelVariables for element in element_names(v)}
    made = []
    for k, name in enumerate(names):
        variable = variables[name]
        if starts is None:
            given = variable.start
            values = given if isinstance(given, (list, tuple)) else str(given or "0").split()
            start = float(values[element_names(variable).index(name) if len(values) > 1 else 0])
        else:
            start = float(starts[k])
        text = " ".join((variable.description or "").split())
        made.append(Quantity(name, unit_of(variable), text, start, limits_of(variable)))
    return tuple(made)


def no_flags(rows: int, columns: int) -> Flags:
    """Return an array of False."""
    return np.zeros((rows, columns), bool)
