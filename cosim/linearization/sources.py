"""Sources of linear models: equations with exact derivatives, and FMUs for model exchange in a worker process."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from cosim.blocks.compiling import permission, with_permission
from cosim.blocks.derivatives import DifferentiableFmu, slopes_at
from cosim.core.arrays import Array
from cosim.core.errors import Fault, FmuError, InputError, SimulationError, refuse
from cosim.core.text import did_you_mean
from cosim.core.units import read_quantity
from cosim.files.yaml_file import short
from cosim.fmi.building.file import LoadedModel
from cosim.fmi.description import name_states, reals, scalars, states_of, units_of, ways
from cosim.isolation import worker as here
from cosim.isolation.process import Worker
from cosim.isolation.rows import OTHER
from cosim.isolation.watch import Watch, fmi_calls
from cosim.linearization.linear_model import Linear, Point
from cosim.model.model import Effect, Model, overrides
from cosim.model.namespaces import SCALAR
from cosim.residuals.drive import start_values

LINEARIZATION_MODULES = ("cosim.linearization.sources", "fmpy.fmi2", "fmpy.logging")
FMU_COMPONENT = "fmu"
DIRECTIONAL = "directional derivatives of the FMU"
DIFFERENCE_STEP = 1e-5  # step of central differences, relative to each state and input, or to 1
# smallest derivative of an FMU that differences can resolve, relative to the largest in a row
MAX_SLOPE_DEVIATION = 1e-3
# tolerance of a steady state of fast states, relative to derivative and size of the states
MAX_RATE_AT_STEADY_STATE = 1e-12
MAX_NEWTON_STEPS = 50


class EquationSource:
    """A model with its equations and active effects."""

    files: tuple[Path, ...] = ()

    def __init__(self, loaded: LoadedModel, name: str) -> None:
        from cosim.model.symbolic.linearize import Linearizer

        self._loaded, self.model = loaded, (model := loaded.model)
        self.title, self.name = model.title, name
        groups = model.states, model.inputs, model.outputs
        self.states, self.inputs, self.outputs = (tuple(q.name for q in group) for group in groups)
        self.units = {q.name: q.unit for q in (*model.outputs, *model.inputs, *model.states)}
        self.start = Point(0.0, np.array(model.start(), float), np.array(model.start_command(), float))
        self._equations = model.acting(SCALAR)
        self._linearizer = Linearizer(model)

    def with_values(self, values: Mapping[str, Any], over: Sequence[str]) -> EquationSource:
        """Return the source with a scenario's parameters, except those in `over`."""
        names = self.model.declared.keys() - {text.partition("=")[0].strip() for text in over}
        texts = [f"{n}={str(v).lower() if isinstance(v, bool) else v}" for n, v in values.items() if n in names]
        if not texts:
            return self
        return EquationSource(replace(self._loaded, model=with_parameters(self.model, texts)), self.name)

    def computed(self, t: float, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return the value of a function of the equations; raise SimulationError if it is undefined."""
        try:
            return function(*arguments)
        except (ArithmeticError, ValueError) as error:
            raise SimulationError(
                self.name, t, f"the equations fail at this point: {error}; choose another operating point"
            ) from None

    def evaluate(self, t: float, x: Array, u: Array) -> Array:
        """Return derivatives and outputs in one array."""
        place = t, tuple(x.tolist()), tuple(u.tolist())
        return np.concatenate([self.computed(t, function, *place) for function in self._equations], dtype=float)

    def linear(self, points: Sequence[Point]) -> list[Linear]:
        """Return the linear model at each point.

        Raises:
            SimulationError: The model has no finite derivatives.
        """
        shaping = overrides(self.model.awake, "shape", Effect)
        notes = [
            f"{e.name} ({e.equation}) acts on the inputs only and is not part of the linear model" for e in shaping
        ]
        models = []
        for point in points:
            values = self.evaluate(point.time, point.states, point.inputs)
            exact = self.computed(point.time, self._linearizer, tuple(point.states), tuple(point.inputs), point.time)
            slopes = np.block([[exact.A, exact.B], [exact.C, exact.D]])
            if not (np.isfinite(slopes).all() and np.isfinite(values).all()):
                text = "the derivatives, the outputs or their slopes are not finite at this point"
                raise SimulationError(self.name, point.time, f"{text}; choose another operating point")
            models.append(linear_model(self, point, slopes, values, "the equations, differentiated exactly", notes))
        return models


class ExchangeSource:
    """An FMU with access to its derivatives.

    Args:
        step: Step of central differences, which then replace the FMU's directional derivatives.
    """

    def __init__(
        self, worker: Worker, path: Path, description: Any, start: Mapping[str, Any], step: float | None = None
    ) -> None:
        if "model-exchange" not in ways(description):
            cure = "give the model's own file (model.yaml, file.py:Class or base), or an FMU for model exchange"
            text = f"supports co-simulation only, without access to states and derivatives; {cure}"
            raise InputError.at(path, f"{text}; `cosim build --native` builds such an FMU from a model file")
        if len(states_of(description)) != len(description.derivatives):
            text = (
                "declares derivatives without their states; its modelDescription.xml needs the attribute `derivative`"
            )
            raise InputError.at(path, text, FmuError.exit_code)
        self._worker, self._path, self._description, self._start = worker, path, description, dict(start)
        # FMI 1.0 declares a number of states without names; the library may name them.
        if description.fmiVersion == "1.0" and description.numberOfContinuousStates > len(description.derivatives):
            name_states(path, description, self._call(read, "state_references"))
        self.title, self.files = description.modelName or path.stem, (path,)
        listed = states_of(description), reals(description, "input"), reals(description, "output")
        self.states, self.inputs, self.outputs = (scalars(group) for group in listed)
        self.units = {name: unit for group in listed for name, unit in units_of(group).items()}
        self._step = step
        block = DifferentiableFmu(FMU_COMPONENT, path, description, self._start, frozenset())
        self._directional = step is None and block.gives_slopes

    def with_values(self, values: Mapping[str, Any], over: Sequence[str]) -> ExchangeSource:
        """Return the source with start values of a scenario's component; values set by the user take precedence."""
        names = {v.name for v in self._description.modelVariables}
        texts = [f"{n}={v if isinstance(v, str) else json.dumps(v)}" for n, v in values.items() if n in names]
        start = start_values(self._path, texts, lambda name, message: Fault(self._path, 0, 0, message))
        return ExchangeSource(self._worker, self._path, self._description, {**start, **self._start}, self._step)

    @property
    def start(self) -> Point:
        """Return the point after the FMU's initialization."""
        return Point(0.0, *self._call(read, "current_point"))

    def linear(self, points: Sequence[Point]) -> list[Linear]:
        """Return the linear model at each point; raise SimulationError if derivatives are not finite."""
        results = self._call(differentiate, list(points), self._step or DIFFERENCE_STEP, self._directional)
        return [linear_model(self, *result) for result in results]

    def _call(self, function: Any, *more: Any) -> Any:
        watch = Watch([FMU_COMPONENT], [fmi_calls(self._description)])
        fmu = self._path.resolve(), self._description, self._start
        return self._worker.call(with_permission, permission.get(), function, *fmu, *more, watch=watch)


Source = EquationSource | ExchangeSource


def linear_model(
    source: Source, point: Point, slopes: Array, values: Array, method: str, notes: Sequence[str]
) -> Linear:
    """Return the linear model of a source.

    Args:
        slopes: Partial derivatives of derivatives and outputs (rows) by states and inputs (columns).
        values: Derivatives and outputs at the point.
    """
    n, names = len(source.states), (source.states, source.inputs, source.outputs)
    matrices = slopes[:n, :n], slopes[:n, n:], slopes[n:, :n], slopes[n:, n:]
    return Linear(*matrices, *names, point, values[:n], values[n:], source.units, method, tuple(notes))


# -- in the worker of an FMU --------------------------------------------------------------------


def read(path: Path, description: Any, start: Mapping[str, Any], method: str) -> Any:
    """Initialize the FMU, and return the result of one of its methods."""
    with closing(_open(path, description, start)) as block:
        return getattr(block, method)()


Differentiated = tuple[Point, Array, Array, str, list[str]]  # point, slopes, rates and outputs, method, notes


def differentiate(
    path: Path,
    description: Any,
    start: Mapping[str, Any],
    points: Sequence[Point],
    step: float,
    directional: bool,
) -> list[Differentiated]:
    """Return, for each point, the arguments of `linear_model`.

    If directional derivatives fail, the FMU is reopened and finite differences are used.
    """
    try:
        with closing(_open(path, description, start)) as block:
            return [_differentiate(block, point, step, directional) for point in points]
    except SimulationError as error:
        if not directional or "DirectionalDerivative" not in str(error):
            raise
        reason = error.reason.partition(":")[0]
    note = f"finite differences of step {step:g} replace the FMU's own derivatives: {reason}"
    repeated = differentiate(path, description, start, points, step, False)
    return [(*result[:-1], [note, *result[-1]]) for result in repeated]


def _differentiate(block: DifferentiableFmu, point: Point, step: float, directional: bool) -> Differentiated:
    states, outputs = scalars(states_of(block.description)), scalars(reals(block.description, "output"))
    slopes, rates, after = slopes_at(block, point.time, point.states, point.inputs, step, directional=directional)
    notes = list[str]()
    moved = np.abs(after - point.states) > 1e-9 * (1.0 + np.abs(point.states))
    if moved.any():
        text = ", ".join(f"{name} = {v:.6g}" for name, v, m in zip(states, after, moved, strict=True) if m)
        notes.append(f"an event of the FMU at this point has changed its states: {text}")
    method = f"central differences of the FMU, with a step of {step:g} relative to each value or to 1"
    if directional:
        method = DIRECTIONAL
        differences, _, _ = slopes_at(block, point.time, after, point.inputs, step, directional=False)
        size = np.maximum(np.abs(differences).max(axis=1, initial=0.0), np.abs(slopes).max(axis=1, initial=0.0))
        deviates = np.abs(slopes - differences).max(axis=1, initial=0.0) > MAX_SLOPE_DEVIATION * np.maximum(size, 1e-9)
        if deviates.any():
            rows = ", ".join(compress([*(f"the derivative of {name}" for name in states), *outputs], deviates))
            notes.append(
                f"the FMU's directional derivatives disagree with finite differences (step {step:g}) in these rows: "
                f"{rows}. Finite differences are used there"
            )
            slopes = np.where(deviates[:, None], differences, slopes)
    return replace(point, states=after), slopes, rates, method, notes


def _open(path: Path, description: Any, start: Mapping[str, Any]) -> DifferentiableFmu:
    here.progress.doing[0] = OTHER
    block = DifferentiableFmu(FMU_COMPONENT, path, description, start, frozenset())
    here.share_log(block)
    block.bind_nothing()
    block.open(0.0, 1.0)
    block.start()
    return block


# -- in the calling process ---------------------------------------------------------------------


def settle(source: Source, point: Point, fast: Sequence[str]) -> Point:
    """Return the point with fast states at their steady state, found by Newton steps.

    The other states and the inputs are constant: f₂(x₂) = 0.

    Raises:
        ValueError: No steady state was found.
    """
    if not fast:
        return point
    rows = [source.states.index(n) for n in fast]
    for _ in range(MAX_NEWTON_STEPS):
        (linear,) = source.linear([point])
        rates, own = linear.rates[rows], linear.A[np.ix_(rows, rows)]
        size = max(1.0, float(np.abs(own).max() * np.abs(point.states[rows]).max()))
        if np.abs(rates).max() <= MAX_RATE_AT_STEADY_STATE * size:
            return point
        states = point.states.copy()
        try:
            states[rows] -= np.linalg.solve(own, rates)
        except np.linalg.LinAlgError:
            break
        if not np.isfinite(states).all():
            break
        point = replace(point, states=states)
    text = "no steady state was found with the other states constant"
    cure = "give other states, or another operating point"
    raise ValueError(f"{', '.join(fast)} cannot be residualized: {text}; {cure}")


# -- values of `--set` and of a scenario --------------------------------------------------------


def with_parameters(model: Model, texts: Sequence[str]) -> Model:
    """Return the model with parameters from `--set NAME=VALUE`.

    Raises:
        InputError: Texts have faults; the error names all of them.
    """
    faults, values = list[Fault](), dict[str, Any]()
    for text in texts:
        name, _, value = (part.strip() for part in text.partition("="))
        try:
            if (declared := model.declared.get(name)) is None:
                hint = did_you_mean(name, model.declared)
                raise ValueError(f"{model.title} has no such parameter{hint}; write NAME=VALUE, such as mass=2")
            is_switch = isinstance(declared.default, bool)
            switch: dict[str, Any] = {"true": True, "false": False}
            values[name] = switch.get(value, short(value)) if is_switch else read_quantity(value, declared.unit)
        except ValueError as error:
            faults.append(Fault(Path("--set"), 0, 0, f"{short(text)}: {error}"))
    refuse(faults)
    try:
        return model.with_values(values)
    except ValueError as error:
        raise InputError.at(Path("--set"), f"{error}; correct the value") from None
