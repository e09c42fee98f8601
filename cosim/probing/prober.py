"""Client of a probed FMU: its worker process, signals and pairs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np

from cosim.blocks.compiling import permission, with_permission
from cosim.core.arrays import Array
from cosim.core.errors import SimulationError
from cosim.core.scratch import temporary_folder
from cosim.files.archive import unpack
from cosim.fmi.description import REALS, read_description, unit_of
from cosim.fmi.fmi_types import element_names
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.watch import Watch, fmi_calls
from cosim.model.quantities import Quantity
from cosim.probing.fmu_structure import START_STEP, ProbedParameter, StartValue
from cosim.probing.log_runs import CHANCE, SAME, Course, Fmu, limits_of, noise_of, nominal_of, outputs_along
from cosim.scenario.start_values import settable

Job = Callable[..., Any]
MODULES = ("cosim.probing.model_exchange", "cosim.probing.misbehaviour", "fmpy.fmi2", "fmpy.fmi3", "fmpy.logging")
LIMITS = Limits(step=20.0, load=60.0)
USUAL_STEP, USUAL_LOAD = 5.0, 10.0  # minimum time limits of a trial [s]
SLOW = 30.0  # time limit of a trial, as a multiple of the duration of an ordinary simulation


class Prober(ExitStack):
    """An unpacked FMU and the worker process that simulates it, as a context manager.

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
        """Return the FMU with additional start values."""
        return Fmu(self.path, self.place, self.description, {**self._values, **values})

    @property
    def fmu(self) -> Fmu:
        """Return the FMU with its start values."""
        return self.with_values({})

    @contextmanager
    def hurry(self, took: float) -> Iterator[None]:
        """Limit the time of jobs within the `with` block, because trial values may hang the FMU.

        Args:
            took: Duration of an ordinary simulation [s].
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
    """Return (position, velocity, gain) of pairs without common signals.

    In a chain of integrators, the first two signals are the pair; otherwise the gain nearest to 1 decides.
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
    """Return variables or array elements as quantities.

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


# Trials of parameters and start values that may be set before initialization, to find those with an effect.


MOST_STARTS = 40  # start values tried


def settable_parameters(description: Any) -> list[Any]:
    """Return the scalar real parameters that may be set before initialization."""
    return [
        v
        for v in description.modelVariables
        if v.causality == "parameter" and v.variability in {"fixed", "tunable"} and _is_settable_real(v)
    ]


def _is_settable_real(v: Any) -> bool:
    return v.type in REALS and not v.shape and v.start is not None and settable(v)


def tried_parameters(
    prober: Prober, react: Callable[[Fmu], tuple[Array, Array]], size: Array
) -> tuple[ProbedParameter, ...]:
    """Return each settable parameter with the effects of other values.

    Args:
        react: Function of the FMU that returns its states after initialization, and a table of responses.
        size: Magnitude of each column of the table.
    """
    parameters = settable_parameters(prober.description)
    if not parameters:
        return ()
    start, table = react(prober.fmu)
    begin = time.monotonic()
    again, repeated = react(prober.fmu)
    took = time.monotonic() - begin
    noise = noise_of(table, repeated, size)
    state_noise = noise_of(start[None], again[None], np.maximum(np.abs(start), SAME))
    found = []
    with prober.hurry(took):
        for variable in parameters:
            (quantity,) = quantities(prober.description, [variable.name])
            value = quantity.start
            acts = starts = False
            failure, tried = "", value
            low, high = quantity.bounds
            wanted = [1.1 * value, 0.9 * value, 2.0 * value, 0.5 * value] if value else [0.1, 1.0, -0.1, -1.0]
            inside = [v for v in wanted if low <= v <= high]
            if not inside and np.isfinite([low, high]).all() and low < high:
                inside = [low + share * (high - low) for share in (0.1, 0.9)]
            for tried in inside:
                try:
                    state, reaction = react(prober.with_values({variable.name: tried}))
                except SimulationError as error:
                    failure = failure or str(error)
                    continue
                rows = min(len(reaction), len(table))
                differs = np.abs(reaction[:rows] - table[:rows]) > noise
                refused = np.isnan(reaction[:rows]) & ~np.isnan(table[:rows])
                acts = acts or bool((differs | refused).any()) or len(reaction) != len(table)
                starts = starts or bool((np.abs(state - start) > state_noise).any())
                if acts or starts:
                    break
            found.append(ProbedParameter(quantity, acts, starts, tried, failure))
    return tuple(found)


def start_values(prober: Prober, course: Course, base: Array, noise: Array) -> tuple[StartValue, ...]:
    """Return the start values of an FMU for co-simulation that change an output, as unknown initial states.

    Parameters whose names mark them as start values are not tried here.

    Args:
        base: Outputs along the course with the FMU's own start values.
        noise: Differences between repeated simulations.
    """
    found = []
    spread = np.maximum(base.std(axis=0), CHANCE * noise)
    used = {"input", "parameter", "calculatedParameter", "structuralParameter", "independent"}
    states = [
        v
        for v in prober.description.modelVariables
        if v.causality not in used and v.variability in {None, "continuous"} and _is_settable_real(v)
    ]
    for variable in states[:MOST_STARTS]:
        (quantity,) = quantities(prober.description, [variable.name])
        value = quantity.start
        size = START_STEP * (abs(value) or abs(nominal_of(variable)) or 1.0)
        moved = value + size if value + size <= quantity.bounds[1] else value - size
        try:
            table, _ = prober.call(outputs_along, prober.with_values({variable.name: moved}), course)
        except SimulationError:
            continue
        rows = min(len(table), len(base))
        change, by = table[:rows] - base[:rows], moved - value
        if not rows or not (np.abs(change) > noise).any():
            continue
        reach = float((np.abs(change) / spread).max()) / abs(by)
        # the only output that equals it after initialization
        slopes = change[0] / by
        shown = np.flatnonzero(np.abs(slopes) > noise / abs(by))
        output = (int(shown[0]), float(slopes[shown[0]])) if len(shown) == 1 else (-1, 0.0)
        found.append(StartValue(quantity, 1.0 / reach, *output))
    return tuple(found)
