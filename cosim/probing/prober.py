"""Simulations of a probed FMU along the inputs of a log or along small sines, and the worker process that runs them."""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.blocks.compiling import permission, with_permission
from cosim.blocks.component import ADVANCE, GET, PUT
from cosim.blocks.derivatives import DifferentiableFmu
from cosim.blocks.fmu import FmuBlock
from cosim.core.arrays import Array
from cosim.core.errors import SimulationError
from cosim.core.scratch import temporary_folder
from cosim.files.archive import unpack
from cosim.fmi.description import Way, read_description, reals, scalars, states_of, unit_of
from cosim.fmi.fmi_types import DOUBLE_TYPES, element_names
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import OTHER
from cosim.isolation.watch import Watch, fmi_calls
from cosim.logs.log import Log
from cosim.model.quantities import Quantity
from cosim.probing.fmu_structure import START_STEP, EventCount, ProbedParameter, StartValue
from cosim.scenario.start_values import settable

DEFAULT_ROWS = 400  # of a simulation without a log
DEFAULT_DURATION_S = 10.0  # without a log and a default experiment
SINE_AMPLITUDE_SHARE = 0.1  # amplitude of a sine relative to the input's range or start value
SAME = 1e-9  # relative difference below which numbers are equal
RANDOM_DIFFERENCE_RATIO = 10.0  # difference relative to that of repeated simulations, up to which it is random
SINE_PERIODS = (1.0, 3.0, 7.0, 13.0)  # periods over the duration; every input has its own phases


@dataclass(frozen=True, eq=False)
class Course:
    """Input trajectories of a simulation, constant between rows, and measurements for initial states.

    Attributes:
        step: Typical step [s].
        states: Index of a state → initial value that replaces the FMU's.
    """

    name: str
    time: Array
    inputs: Mapping[str, Array]
    outputs: Mapping[str, Array]
    step: float
    states: Mapping[int, float] = field(default_factory=dict)

    @classmethod
    def of(cls, log: Log) -> Course:
        """Return the input trajectories and measurements of a log."""
        return cls(log.path.name, log.time, dict(log.inputs), dict(log.outputs), log.step)

    def first(self, rows: int) -> Course:
        """Return the first rows."""
        inputs, outputs = ({n: v[:rows] for n, v in each.items()} for each in (self.inputs, self.outputs))
        return replace(self, time=self.time[:rows], inputs=inputs, outputs=outputs)

    def begun(self, shown: Mapping[int, int], outputs: Sequence[str]) -> Course:
        """Return a copy whose initial states are taken from the measurements in the first row.

        Args:
            shown: Index of a state → index of the output that equals it.
        """
        columns = {k: self.outputs.get(outputs[j]) for k, j in shown.items()}
        first = {k: float(y[0]) for k, y in columns.items() if y is not None and np.isfinite(y[0])}
        return replace(self, states=first)

    def parted(self, row: int, parts: int) -> Course:
        """Return a copy with two additional rows in the step after a row, spaced by a part of the step."""
        if parts == 1:
            return self
        part = (self.time[row + 1] - self.time[row]) / parts
        time = np.insert(self.time, row + 1, self.time[row] + part * np.array([1.0, 2.0]))
        inputs = {n: np.insert(v, row + 1, [v[row]] * 2) for n, v in self.inputs.items()}
        return replace(self, time=time, inputs=inputs, outputs={})


def sine_course(description: Any) -> Course:
    """Return input trajectories of small sines around the start values of the inputs."""
    experiment = description.defaultExperiment
    begin = float(getattr(experiment, "startTime", None) or 0.0)
    end = float(getattr(experiment, "stopTime", None) or 0.0)
    duration = end - begin if end > begin else DEFAULT_DURATION_S
    step = float(getattr(experiment, "stepSize", None) or duration / DEFAULT_ROWS)
    step *= max(1, round(duration / DEFAULT_ROWS / step))  # whole steps of the FMU
    rows = int(min(DEFAULT_ROWS, max(2, round(duration / step))))
    time = np.asarray(begin + step * np.arange(rows + 1), np.float64)
    phase = 2.0 * np.pi * np.arange(rows + 1) / rows
    inputs = {}
    for k, variable in enumerate(v for v in reals(description, "input") if not v.shape):
        start = float(variable.start or 0.0)
        waves = [np.sin(p * phase + 1.7 * k + p) for p in SINE_PERIODS]
        size, (low, high) = amplitude_of(variable, start), limits_of(variable)
        centre = min(max(start, low + size), high - size)
        inputs[variable.name] = np.asarray(centre + size / len(SINE_PERIODS) * np.sum(waves, axis=0), np.float64)
    return Course("sines", time, inputs, {}, step)


def amplitude_of(variable: Any, start: float) -> float:
    """Return a small amplitude for a variable: a share of its range, start value or nominal value."""
    low, high = limits_of(variable)
    if math.isfinite(high - low) and high > low:
        return SINE_AMPLITUDE_SHARE * (high - low)
    return SINE_AMPLITUDE_SHARE * (abs(start) or abs(nominal_of(variable)) or 1.0)


def nominal_of(variable: Any) -> float:
    """Return the nominal value of a variable or of its type; 0 if it has none."""
    return float(getattr(variable, "nominal", None) or getattr(variable.declaredType, "nominal", None) or 0.0)


def limits_of(variable: Any) -> tuple[float, float]:
    """Return min and max of a variable or of its type; infinite if it has none."""

    def end(name: str, default: float) -> float:
        values = getattr(variable, name, None), getattr(variable.declaredType, name, None)
        return next((float(v) for v in values if v is not None), default)

    return end("min", -math.inf), end("max", math.inf)


def moved(variable: Any, held: Array) -> Array:
    """Return values of a variable displaced by a typical size, downwards where an upper limit requires this."""
    size, (low, high) = float(np.std(held)) or amplitude_of(variable, float(held[0])), limits_of(variable)
    if held.max() + size > high and held.min() - size >= low:
        size = -size
    return np.clip(held + size, min(low, float(held.min())), max(high, float(held.max())))


def noise_of(table: Array, repeated: Array, size: Array) -> Array:
    """Return the differences between equal simulations, due to rounding or randomness, for each column of a table.

    Args:
        size: Magnitude of each column.
    """
    rows = min(len(table), len(repeated))
    apart: Array = np.nan_to_num(np.abs(table[:rows] - repeated[:rows])).max(axis=0, initial=0.0)
    return SAME * size + RANDOM_DIFFERENCE_RATIO * apart


@dataclass(eq=False)
class Run:
    """A simulation, up to its end or to the failure of the FMU.

    Attributes:
        time: Times of the rows [s].
        states, inputs, values: Arrays with one row per time; values are derivatives and outputs in model exchange,
            otherwise outputs.
        stop: Error that ended the simulation early.
    """

    time: Array
    states: Array
    inputs: Array
    values: Array
    events: EventCount
    stop: SimulationError | None = None


@dataclass(frozen=True, eq=False)
class Fmu:
    """An FMU as passed to the worker process.

    Attributes:
        place: Folder of the unpacked FMU.
        values: Start values.
    """

    path: Path
    place: Path
    description: Any
    values: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Return the name of the file, for messages."""
        return self.path.name

    @property
    def names(self) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
        """Return names of continuous states, inputs and outputs."""
        about = self.description
        return scalars(states_of(about)), scalars(reals(about, "input")), scalars(reals(about, "output"))

    def too_short(self, course: Course) -> SimulationError:
        """Return the error for a simulation that ended after too few rows."""
        text = "the log has too few rows to probe the FMU; give a longer one"
        return SimulationError(self.name, float(course.time[0]), text)

    @contextmanager
    def opened(
        self, course: Course, way: Way | None = None, recorded: frozenset[str] = frozenset()
    ) -> Iterator[tuple[Any, Any]]:
        """Yield a loaded, uninitialized instance with the inputs of the first row, and its row of signals.

        Args:
            way: Interface that is stepped; None for a model-exchange instance with access to derivatives.
            recorded: Names of further variables to read besides the outputs.
        """
        about = self.name, self.path, self.description, self.values, frozenset(course.inputs)
        block = FmuBlock(*about, way=way, recorded=recorded) if way else DifferentiableFmu(*about)
        here.progress.made[0] = 0
        announce(OTHER)
        block.instance.place = self.place
        here.share_log(block)
        row = (ctypes.c_double * max(1, len(block.inputs) + len(block.outputs)))()
        block.bind(row, 0, [None] * (len(block.exact_inputs) + len(block.exact_outputs)), 0)
        # loading has its own time limit; outputs are read after initialization
        end = float(course.time[-1]) + course.step
        block.load()
        announce(GET)
        block.begin(float(course.time[0]), end)
        put_row(block, row, course, 0)
        with closing(block):
            yield block, row


def announce(call: int) -> None:
    """Record the next FMU call in memory shared with the caller, which enforces its time limit."""
    here.progress.doing[0] = call


def put_row(block: FmuBlock, row: Any, course: Course, k: int) -> None:
    """Set the inputs of row k."""
    for number, signal in enumerate(block.inputs):
        if signal.name in course.inputs:
            row[number] = float(course.inputs[signal.name][k])
    announce(PUT)
    block.put()


def simulate(
    fmu: Fmu,
    course: Course,
    visit: Callable[[DifferentiableFmu, float, Array, Array], None] = lambda block, t, x, u: None,
    rows: Collection[int] = (),
) -> Run:
    """Simulate an FMU for model exchange with given input trajectories.

    Args:
        visit: Function of (FMU, time, states, inputs), called at each row of `rows`; it must not change the FMU.
    """
    visited, last = frozenset(rows), course.time.size - 1
    states, inputs, values = list[Array](), list[Array](), list[Array]()
    stop: SimulationError | None = None
    with fmu.opened(course) as (block, row):
        try:
            block.start()
            if course.states:
                x, u = block.current_point()
                x[[*course.states]] = [*course.states.values()]
                block.move(float(course.time[0]), x, u)
                block.instance.solver.reset(float(course.time[0]))
            for k, t in enumerate(course.time.tolist()):
                put_row(block, row, course, k)
                x, u = block.current_point()
                values.append(block.rates(x, u))
                states.append(x)
                inputs.append(u)
                if k in visited:
                    visit(block, t, x, u)
                    block.rates(x, u)
                if k < last:
                    announce(ADVANCE)
                    block.advance(t, float(course.time[k + 1]) - t)
                    here.progress.made[0] += 1
        except SimulationError as error:
            stop = error
        counts, made = block.instance.event_counts, len(inputs)
    events = EventCount(course.name, counts["state"], counts["time"], counts["step"])
    known, u, rates = (
        np.array(each, float).reshape(made, -1 if made else 0) for each in (states, inputs, values[:made])
    )
    return Run(course.time[:made], known, u, rates, events, stop)


def run_along(
    block: FmuBlock, row: Any, course: Course, first: int | None = None
) -> tuple[Array, SimulationError | None]:
    """Return the outputs of a loaded FMU in each row of a simulation, and the error that ended it early, if any.

    Args:
        first: Row at which an initialized FMU continues; None to initialize it.
    """
    table, stop = list[list[float]](), None

    def get() -> None:
        announce(GET)
        block.get()
        table.append(row[len(block.inputs) : len(block.inputs) + len(block.outputs)])

    try:
        if first is None:
            announce(OTHER)
            block.start()
        get()
        for k in range(first or 0, course.time.size - 1):
            put_row(block, row, course, k)
            announce(ADVANCE)
            block.advance(float(course.time[k]), float(course.time[k + 1] - course.time[k]))
            put_row(block, row, course, k + 1)
            get()
            here.progress.made[0] += 1
    except SimulationError as error:
        stop = error
    return np.array(table, float).reshape(len(table), len(block.outputs)), stop


def outputs_along(
    fmu: Fmu, course: Course, way: Way = "co-simulation", recorded: frozenset[str] = frozenset()
) -> tuple[Array, SimulationError | None]:
    """Return outputs and recorded variables in each row of a simulation, and the error that ended it early, if any."""
    with fmu.opened(course, way, recorded) as (block, row):
        table, stop = run_along(block, row, course)
        names = [s.name for s in block.outputs]
    order = dict.fromkeys((*scalars(reals(fmu.description, "output")), *names))
    return table[:, [names.index(name) for name in order]], stop


# Access to a probed FMU: its worker process, signals and pairs.


Job = Callable[..., Any]
PROBER_MODULES = (
    "cosim.probing.model_exchange",
    "cosim.probing.misbehaviour",
    "fmpy.fmi2",
    "fmpy.fmi3",
    "fmpy.logging",
)
LIMITS = Limits(step=20.0, load=60.0)
USUAL_STEP, USUAL_LOAD = 5.0, 10.0  # minimum time limits of a trial [s]
MAX_TRIAL_DURATIONS = 30.0  # time limit of a trial, as a multiple of the duration of an ordinary simulation


@dataclass(eq=False)
class Prober:
    """An unpacked FMU, and the worker process that simulates it.

    Attributes:
        fmu: The FMU with the start values of every instance.
        limits: Limits of every job.
    """

    fmu: Fmu
    worker: Worker
    limits: Limits

    @property
    def path(self) -> Path:
        """Return the path of the FMU."""
        return self.fmu.path

    @property
    def description(self) -> Any:
        """Return the description of the FMU."""
        return self.fmu.description

    def with_values(self, values: Mapping[str, Any]) -> Fmu:
        """Return the FMU with additional start values."""
        return replace(self.fmu, values={**self.fmu.values, **values})

    @contextmanager
    def hurry(self, took: float) -> Iterator[None]:
        """Limit the time of jobs within the `with` block, because the FMU may hang with trial values.

        Args:
            took: Duration of an ordinary simulation [s].
        """
        usual = self.limits
        step, load = max(USUAL_STEP, MAX_TRIAL_DURATIONS * took), max(USUAL_LOAD, MAX_TRIAL_DURATIONS * took)
        most = {"step": min(step, usual.step or step), "load": min(load, usual.load or load)}
        self.limits = usual.model_copy(update=most)
        try:
            yield
        finally:
            self.limits = usual

    def call(self, job: Job, *arguments: Any) -> Any:
        """Return the result of a job in the worker."""
        watch = Watch([self.path.name], [fmi_calls(self.description)], limits=self.limits, computing=True)
        return self.worker.call(with_permission, permission.get(), job, *arguments, watch=watch)


@contextmanager
def probing(fmu: Path, values: Mapping[str, Any] = MappingProxyType({}), limits: Limits = LIMITS) -> Iterator[Prober]:
    """Unpack an FMU, start its worker process, and end both after the `with` block.

    Args:
        values: Start values of every instance.
        limits: Limits of every job.
    """
    path = Path(fmu).resolve()
    description = read_description(path)
    with temporary_folder("probe") as place, Worker(*PROBER_MODULES) as worker:
        unpack(path, place)
        yield Prober(Fmu(path, place, description, dict(values)), worker, limits)


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


# Trials of parameters and start values that can be set before initialization, to find those with an effect.


MOST_STARTS = 40  # start values tried


def settable_parameters(description: Any) -> list[Any]:
    """Return the scalar real parameters that can be set before initialization."""
    return [
        v
        for v in description.modelVariables
        if v.causality == "parameter" and v.variability in {"fixed", "tunable"} and _is_settable_real(v)
    ]


def _is_settable_real(v: Any) -> bool:
    return v.type in DOUBLE_TYPES and not v.shape and v.start is not None and settable(v)


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
    """Return the start values of a co-simulation FMU that change an output; fits use them as unknown initial states.

    Parameters whose names mark them as start values are not tried here.

    Args:
        base: Outputs along the course with the FMU's own start values.
        noise: Differences between repeated simulations.
    """
    found = []
    spread = np.maximum(base.std(axis=0), RANDOM_DIFFERENCE_RATIO * noise)
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
        # the only output that equals the start value after initialization
        slopes = change[0] / by
        shown = np.flatnonzero(np.abs(slopes) > noise / abs(by))
        output = (int(shown[0]), float(slopes[shown[0]])) if len(shown) == 1 else (-1, 0.0)
        found.append(StartValue(quantity, 1.0 / reach, *output))
    return tuple(found)
