"""Structure of a binary: simulations along logs and evaluations about their points, in a worker process."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.base.arrays import Array, Flags
from cosim.base.errors import FmuError, InputError, SimulationError
from cosim.base.scratch import temporary_folder
from cosim.blocks.compiling import permission, with_permission
from cosim.blocks.derivatives import REALS, states_of
from cosim.blocks.description import Way, read_description, unit_of, ways
from cosim.blocks.fmi_types import element_names
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.watch import Watch, fmi_calls
from cosim.logs.log import Log
from cosim.model.quantities import Quantity
from cosim.probing import messages
from cosim.probing.exchange_points import (
    POINTS,
    SAME,
    Fmu,
    Points,
    StartPoint,
    equal_columns,
    evaluated,
    reactions,
    simulated,
    start_point,
)
from cosim.probing.fmu_structure import Pair, Port, ProbedParameter, Structure
from cosim.probing.log_runs import NAME, Course, Run, sine_course
from cosim.scenario.start_values import settable
from cosim.storage.archive import unpack

MODULES = ("cosim.probing.exchange_points", "cosim.probing.log_runs", "fmpy.fmi2", "fmpy.fmi3", "fmpy.logging")
LIMITS = Limits(step=20.0, load=60.0)
RATE_SHARE = 1e-6  # eigenvalue relative to the largest, below which it is zero
PLACES = 12  # points at which parameters are tried
STEADY = 1e-2  # share of a value that displaces an unmoved state or input
Job = Callable[..., Any]


class Prober:
    """An unpacked FMU with a worker process that makes its simulations.

    Args:
        values: Start values of every instance.
        limits: Limits of every job.
    """

    def __init__(self, path: Path, values: Mapping[str, Any], worker: Worker, place: Path, limits: Limits) -> None:
        self.path, self.description = path, read_description(path)
        self.values, self._worker, self._limits, self.place = dict(values), worker, limits, place

    def with_values(self, values: Mapping[str, Any]) -> Fmu:
        """Return the FMU with further start values."""
        return Fmu(self.path, self.place, self.description, {**self.values, **values})

    @property
    def fmu(self) -> Fmu:
        """Return the FMU with its start values."""
        return self.with_values({})

    def call(self, job: Job, *arguments: Any, limits: Limits | None = None) -> Any:
        """Return the result of a job in the worker."""
        watch = Watch([NAME], [fmi_calls(self.description)], limits=limits or self._limits)
        return self._worker.call(with_permission, permission.get(), job, *arguments, watch=watch)


def probe_structure(
    fmu: Path,
    logs: Sequence[Log] = (),
    values: Mapping[str, float] = MappingProxyType({}),
    *,
    way: Way | None = None,
    limits: Limits = LIMITS,
) -> Structure:
    """Return the structure of a binary, from simulations along logs, or along small sines without logs.

    Args:
        values: Start values by name.
        way: Interface to probe; None prefers model exchange.
        limits: Limits of each simulation.

    Raises:
        InputError: The FMU lacks the interface.
        FmuError: The FMU is invalid or does not load.
        SimulationError: The FMU fails, crashes or hangs at its start.
    """
    path = Path(fmu).resolve()
    with ExitStack() as stack:
        place = stack.enter_context(temporary_folder("probe"))
        worker = stack.enter_context(Worker(*MODULES))
        prober = Prober(path, values, worker, place, limits)
        offered = ways(prober.description)
        chosen = way or ("model-exchange" if "model-exchange" in offered else "co-simulation")
        if chosen not in offered:
            raise InputError.at(path, messages.NO_MODEL_EXCHANGE(way=chosen, ways=", ".join(offered)))
        unpack(path, place)
        courses = [Course.of(log) for log in logs] or [sine_course(prober.description, values)]
        if chosen == "co-simulation":
            from cosim.probing.co_simulation import co_simulation_structure

            return co_simulation_structure(prober, courses)
        if len(states_of(prober.description)) != len(prober.description.derivatives):
            raise InputError.at(path, messages.DERIVATIVES_WITHOUT_STATES(), FmuError.exit_code)
        return _exchange_structure(prober, courses)


def _exchange_structure(prober: Prober, courses: Sequence[Course]) -> Structure:
    names = states, inputs, outputs = prober.fmu.names
    start: StartPoint = prober.call(start_point, prober.fmu, courses[0])
    firsts = [_measured_start(course, start.shown, outputs) for course in courses]
    runs: list[Run] = [
        prober.call(simulated, prober.fmu, course, first) for course, first in zip(courses, firsts, strict=True)
    ]
    if not any(run.time.size for run in runs):
        raise SimulationError(NAME, float(courses[0].time[0]), runs[0].stop)
    points, scales = _points(prober, courses, firsts, [run for run in runs if run.time.size], runs)
    known, table = points.known_table
    n = len(states)
    found = equal_columns(known[:, :n], table[:, n:])
    depends = points.depends
    pairs = _pairs(names, known, table, points)
    paired = {name for pair in pairs for name in (pair.position, pair.velocity)}
    storages = tuple(
        name
        for k, name in enumerate(states)
        if name not in paired and (np.delete(depends[k, :n], k).any() or depends[k, n:].any())
    )
    largest, slowest = _rates([s[:n, :n] for s in points.slopes])
    return Structure(
        fmu=prober.path,
        way="model-exchange",
        states=quantities(prober.description, states, start.states),
        inputs=quantities(prober.description, inputs, start.inputs),
        outputs=quantities(prober.description, outputs, start.outputs),
        state_in_rate=depends[:n, :n],
        input_in_rate=depends[:n, n:],
        state_in_output=depends[n:, :n],
        input_in_output=depends[n:, n:],
        pairs=pairs,
        storages=storages,
        shown={states[k]: outputs[j] for k, j in found.items()},
        largest_rate=largest,
        slowest=slowest,
        scales=scales,
        step=min(course.step for course in courses),
        events=tuple(run.events for run in runs),
        parameters=_parameters(prober, courses[0], points, table),
        stops=tuple(run.stop for run in runs if run.stop),
    )


def _measured_start(course: Course, shown: Mapping[int, int], outputs: Sequence[str]) -> dict[int, float]:
    """Return the initial states that the first row of a log measures."""
    measured = {k: course.outputs.get(outputs[j]) for k, j in shown.items()}
    return {k: float(v[0]) for k, v in measured.items() if v is not None and np.isfinite(v[0])}


def _points(
    prober: Prober, courses: Sequence[Course], firsts: Sequence[Mapping[int, float]], good: Sequence[Run], runs: Any
) -> tuple[Points, dict[str, float]]:
    """Return evaluations about points of all simulations, and the spread of each signal."""
    states, inputs, outputs = prober.fmu.names
    known = np.concatenate([np.hstack([run.states, run.inputs]) for run in good])
    values = np.concatenate([run.values for run in good])
    spread, spreads = known.std(axis=0), values.std(axis=0)
    largest = np.abs(known).max(axis=0)
    nominal = np.array([_nominal(prober.description, name) for name in (*states, *inputs)])
    unmoved = np.where(largest > 0.0, STEADY * largest, nominal)
    scale = np.maximum(np.where(spread > SAME * largest, spread, 0.0), np.where(spread > SAME * largest, 0.0, unmoved))
    size = np.maximum(np.abs(values).max(axis=0), SAME)
    points = Points(scale, size, np.zeros((values.shape[1], known.shape[1]), bool))
    reals_only = all(name in inputs for course in courses for name in course.inputs)
    share = max(2, POINTS // max(1, len(good)))
    for course, first, run in zip(courses, firsts, runs, strict=True):
        if not run.time.size:
            continue
        rows = sorted({int(k) for k in np.linspace(0, run.time.size - 1, share)})
        replayed = run if reals_only and not run.events.total else None
        points = prober.call(evaluated, prober.fmu, course, first, rows, points, replayed)
    rates = [f"der({name})" for name in states]
    columns = (*states, *inputs, *rates, *outputs)
    return points, dict(zip(columns, map(float, (*spread, *spreads)), strict=True))


def _nominal(description: Any, name: str) -> float:
    """Return the nominal value of a variable, 1 without one."""
    for variable in description.modelVariables:
        if variable.name == name:
            own = getattr(variable, "nominal", None) or getattr(variable.declaredType, "nominal", None)
            return abs(float(own or 1.0))
    return 1.0


def _pairs(names: Sequence[Sequence[str]], known: Array, table: Array, points: Points) -> tuple[Pair, ...]:
    """Return the states with a rate that equals another state times a constant."""
    states, inputs, _ = names
    n = len(states)
    rates, x = table[:, :n], known[:, :n]
    fits = []
    for q, v in permutations(range(n), 2):
        gain = float(rates[:, q] @ x[:, v] / max(float(x[:, v] @ x[:, v]), 1e-300))
        size = np.abs(rates[:, q]).max(initial=0.0)
        if size > 0.0 and np.abs(rates[:, q] - gain * x[:, v]).max() <= SAME * size:
            fits.append((q, v, gain))
    slopes = np.array(points.slopes)[:, :n, n:]
    pairs = []
    for q, v, gain in separate_pairs(fits):
        acting = [j for j in range(len(inputs)) if points.depends[v, n + j] and not points.depends[q, n + j]]
        ports = tuple(
            Port(inputs[j], float(np.nanmedian(slopes[:, v, j])), int(points.depends[:n, n + j].sum()) == 1)
            for j in acting
        )
        pairs.append(Pair(states[q], states[v], 1.0 if abs(gain - 1.0) <= SAME else gain, ports))
    return tuple(pairs)


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


def _rates(matrices: Sequence[Array]) -> tuple[float, float]:
    """Return the largest and the smallest magnitude of eigenvalues that are not zero to rounding."""
    finite = [m for m in matrices if m.size and np.isfinite(m).all()]
    if not finite:
        return 0.0, 0.0
    sizes = np.abs(np.concatenate([np.linalg.eigvals(m) for m in finite]))
    largest = float(sizes.max())
    return largest, float(sizes[sizes >= RATE_SHARE * largest].min())


# -- parameters -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Reference:
    """Reaction of the FMU with its own parameters, against which others are compared.

    Attributes:
        start, table: Reaction of the FMU: states after initialization, rates with outputs.
        state_noise, noise: Differences of equal numbers, by rounding or by chance.
    """

    start: Array
    table: Array
    state_noise: Array
    noise: Array


def settable_parameters(description: Any) -> list[Any]:
    """Return the scalar real parameters that may be set before initialization."""
    return [
        v
        for v in description.modelVariables
        if v.causality == "parameter"
        and v.variability in {"fixed", "tunable"}
        and v.type in REALS
        and not v.shape
        and v.start is not None
        and settable(v)
    ]


def _parameters(prober: Prober, course: Course, points: Points, table: Array) -> tuple[ProbedParameter, ...]:
    every = max(1, -(-len(points.places) // PLACES))
    places = points.places[::every]
    return tried_parameters(prober, lambda fmu: prober.call(reactions, fmu, course, places), points.size)


def tried_parameters(
    prober: Prober, react: Callable[[Fmu], tuple[Array, Array]], size: Array
) -> tuple[ProbedParameter, ...]:
    """Return each settable parameter with what other values of it change.

    Args:
        react: Function of the FMU that returns its states after initialization, and a table of reactions.
        size: Magnitude of each column of the table.
    """
    parameters = settable_parameters(prober.description)
    if not parameters:
        return ()
    (start, table), (again, repeated) = react(prober.fmu), react(prober.fmu)
    rows = min(len(table), len(repeated))
    noise = np.nan_to_num(np.abs(table[:rows] - repeated[:rows])).max(axis=0, initial=0.0)
    reference = Reference(
        start, table, 10.0 * np.abs(again - start) + SAME * np.maximum(np.abs(start), SAME), SAME * size + 10.0 * noise
    )
    return tuple(_tried(prober, variable, react, reference) for variable in parameters)


def _tried(prober: Prober, variable: Any, react: Any, reference: Reference) -> ProbedParameter:
    (quantity,) = quantities(prober.description, [variable.name])
    value = float(prober.values.get(variable.name, variable.start))
    acts = starts = False
    failure, tried = "", value
    for tried in trial_values(value, quantity.bounds):
        try:
            start, table = react(prober.with_values({variable.name: tried}))
        except SimulationError as error:
            failure = failure or str(error)
            continue
        rows = min(len(table), len(reference.table))
        differs = np.abs(table[:rows] - reference.table[:rows]) > reference.noise
        refused = np.isnan(table[:rows]) & ~np.isnan(reference.table[:rows])
        acts = acts or bool((differs | refused).any()) or len(table) != len(reference.table)
        starts = starts or bool((np.abs(start - reference.start) > reference.state_noise).any())
        failure = ""
        if acts or starts:
            break
    return ProbedParameter(quantity, acts, starts, tried, failure)


def trial_values(value: float, bounds: tuple[float, float]) -> list[float]:
    """Return values to try instead of a parameter's value, the nearest first."""
    wanted = [1.1 * value, 0.9 * value, 2.0 * value, 0.5 * value] if value else [0.1, 1.0, -0.1, -1.0]
    inside = [v for v in wanted if bounds[0] <= v <= bounds[1]]
    low, high = bounds
    if not inside and np.isfinite([low, high]).all() and low < high:
        inside = [low + share * (high - low) for share in (0.1, 0.9)]
    return inside


def quantities(description: Any, names: Sequence[str], starts: Sequence[float] | None = None) -> tuple[Quantity, ...]:
    """Return names of variables or of elements of arrays as quantities.

    Args:
        starts: Start values; None for those of the description.
    """
    variables = {element: v for v in description.modelVariables for element in element_names(v)}
    made = []
    for k, name in enumerate(names):
        variable = variables[name]
        start = float(variable.start) if starts is None else float(starts[k])
        bounds = _end(variable, "min", -np.inf), _end(variable, "max", np.inf)
        text = " ".join((variable.description or "").split())
        made.append(Quantity(name, unit_of(variable), text, start, bounds))
    return tuple(made)


def _end(variable: Any, name: str, without: float) -> float:
    """Return a limit of a variable or of its type."""
    values = getattr(variable, name, None), getattr(variable.declaredType, name, None)
    return next((float(v) for v in values if v is not None), without)


def no_flags(rows: int, columns: int) -> Flags:
    """Return an array of False."""
    return np.zeros((rows, columns), bool)
