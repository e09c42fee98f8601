"""Sources of linear models: equations with exact derivatives, and FMUs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.base.messages import Note
from cosim.linearization.kinks import STEP, Kink, kinks_at
from cosim.linearization.linear_model import Linear, Point
from cosim.linearization.set_parameters import with_parameters
from cosim.loading.file import LoadedModel
from cosim.model.model import Effect, overrides
from cosim.model.namespaces import SCALAR

EXACT = "the equations, differentiated exactly"
MAX_RATE_AT_STEADY_STATE = 1e-12  # of fast states, relative to slope and size of the states
MAX_NEWTON_STEPS = 50


class LinearizableSystem(ABC):
    """A system that can be linearized.

    Attributes:
        title: Name of the system.
        reach: Step of its differences relative to each state and input, or to 1.
    """

    title: str
    reach: float = STEP
    files: tuple[Path, ...]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]

    @abstractmethod
    def with_values(self, values: Mapping[str, Any], over: Sequence[str]) -> LinearizableSystem:
        """Return the source with the values that a scenario sets, except those named in `over`."""

    @abstractmethod
    def start(self) -> Point:
        """Return the operating point at the start values."""

    @abstractmethod
    def linear(self, points: Sequence[Point]) -> list[Linear]:
        """Return the linear model at each point.

        Raises:
            SimulationError: The model has no finite derivatives.
        """


class EquationSource(LinearizableSystem):
    """A model with its equations and active effects."""

    def __init__(self, loaded: LoadedModel, name: str) -> None:
        from cosim.model.symbolic.linearize import Linearizer

        self._loaded, self.model = loaded, (model := loaded.model)
        self.title, self.name = model.title, name
        self.files = ()
        self.states, self.inputs, self.outputs = (
            tuple(q.name for q in group) for group in (model.states, model.inputs, model.outputs)
        )
        self.units = {q.name: q.unit for q in (*model.outputs, *model.inputs, *model.states)}
        self._equations = model.acting(SCALAR)
        self._linearizer = Linearizer(model)

    def with_values(self, values: Mapping[str, Any], over: Sequence[str]) -> EquationSource:
        """Return the source with a scenario's parameters, except those set in `over`."""
        model = self.model
        names = model.declared.keys() - {text.partition("=")[0].strip() for text in over}
        texts = [f"{n}={str(v).lower() if isinstance(v, bool) else v}" for n, v in values.items() if n in names]
        if not texts:
            return self
        return EquationSource(replace(self._loaded, model=with_parameters(model, texts)), self.name)

    def start(self) -> Point:
        """Return the model's start."""
        return Point(0.0, np.array(self.model.start(), float), np.array(self.model.start_command(), float))

    def linear(self, points: Sequence[Point]) -> list[Linear]:
        """Return the linear model at each point."""
        return [self._linear(point) for point in points]

    def evaluate(self, t: float, x: Array, u: Array) -> tuple[Array, Array]:
        """Return derivatives and outputs."""
        state, command = tuple(x.tolist()), tuple(u.tolist())
        derivative, output = self._equations
        return np.array(derivative(t, state, command), float), np.array(output(t, state, command), float)

    def _linear(self, point: Point) -> Linear:
        try:
            slopes = self._linearizer(tuple(point.states), tuple(point.inputs), point.time)
            rates, values = self.evaluate(point.time, point.states, point.inputs)
        except (ArithmeticError, ValueError) as error:
            raise SimulationError(self.name, point.time, f"the equations have no value there: {error}") from None
        matrices = slopes.A, slopes.B, slopes.C, slopes.D
        if not all(np.isfinite(m).all() for m in (*matrices, rates, values)):
            raise SimulationError(
                self.name,
                point.time,
                (
                    "the derivatives, the outputs or their slopes are not finite at this point; choose another "
                    "operating point"
                ),
            )
        shaping = overrides(self.model.awake, "shape", Effect)
        shaped = [
            Note(f"{e.name} ({e.equation}) acts on the inputs before they get here and is left out") for e in shaping
        ]
        kinks, notes = self._kinks(point)
        names, remarks = (self.states, self.inputs, self.outputs), ((*shaped, *notes), tuple(kinks))
        return Linear(*matrices, *names, point, rates, values, self.units, EXACT, *remarks)

    def _kinks(self, point: Point) -> tuple[list[Kink], list[str]]:
        """Return kinks of the equations and notes."""

        def rates(z: Array) -> Array:
            n = len(self.states)
            return np.concatenate(self.evaluate(point.time, z[:n], z[n:]))

        z = np.concatenate([point.states, point.inputs])
        try:
            return kinks_at(rates, z, self.states, self.inputs, self.outputs), []
        except (ArithmeticError, ValueError):  # the equations are undefined on one side
            return [], [Note("the equations end at this point: to one side of it they have no value")]


def settle(source: LinearizableSystem, point: Point, fast: Sequence[str]) -> Point:
    """Return the point with fast states at rest, by Newton steps.

    The other states and the inputs are held: f₂(x₂) = 0.

    Raises:
        ValueError: The states do not come to rest.
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
    raise ValueError(
        f"{', '.join(fast)} cannot be residualized: no values were found at which they are at rest while the "
        "other states are constant; name other states, or another operating point"
    )
