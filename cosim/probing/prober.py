"""An FMU that is probed, from the caller's side: its worker process, its signals and its pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from cosim.blocks.compiling import permission, with_permission
from cosim.core.arrays import Array
from cosim.core.scratch import temporary_folder
from cosim.files.archive import unpack
from cosim.fmi.description import read_description, unit_of
from cosim.fmi.fmi_types import element_names
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.watch import Watch, fmi_calls
from cosim.model.quantities import Quantity
from cosim.probing.log_runs import Fmu, limits_of

Job = Callable[..., Any]
MODULES = ("cosim.probing.model_exchange", "cosim.probing.misbehaviour", "fmpy.fmi2", "fmpy.fmi3", "fmpy.logging")
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
        self.path = Path(fmu).resolve()
        self.description, self._values, self._limits = read_description(self.path), dict(values), limits

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self.place = stack.enter_context(temporary_folder("probe"))
            self._worker = stack.enter_context(Worker(*MODULES))
            unpack(self.path, self.place)
            self.enter_context(stack.pop_all())
        return self

    def with_values(self, values: Mapping[str, Any]) -> Fmu:
        """Return the FMU with further start values."""
        return Fmu(self.path, self.place, self.description, {**self._values, **values})

    @property
    def fmu(self) -> Fmu:
        """Return the FMU with its start values."""
        return self.with_values({})

    @contextmanager
    def hurry(self, took: float) -> Iterator[None]:
        """Limit all jobs within a `with` block as trials that may hang.

        Args:
            took: Time that an ordinary simulation took [s].
        """
        usual = self._limits
        step, load = max(USUAL_STEP, SLOW * took), max(USUAL_LOAD, SLOW * took)
        most = {"step": min(step, usual.step or step), "load": min(load, usual.load or load)}
        self._limits = usual.model_copy(update=most)
        try:
            yield
        finally:
            self._limits = usual

    def call(self, job: Job, *arguments: Any) -> Any:
        """Return the result of a job in the worker."""
        watch = Watch([self.path.name], [fmi_calls(self.description)], limits=self._limits)
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
        given = variable.start if starts is None else starts[k]
        values = given if isinstance(given, (list, tuple)) else str(given or "0").split()
        start = float(values[element_names(variable).index(name) if len(values) > 1 else 0])
        text = " ".join((variable.description or "").split())
        made.append(Quantity(name, unit_of(variable), text, start, limits_of(variable)))
    return tuple(made)
