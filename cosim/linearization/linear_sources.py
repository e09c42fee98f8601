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
from cosim.linearization.kinks import STEP, Kink, kinks_at
from cosim.linearization.linear_model import Linear, Point
from cosim.linearization.set_parameters import with_parameters
from cosim.loading.file import LoadedModel
from cosim.model.model import Effect, overrides
from cosim.model.namespaces import SCALAR

EXACT = "the equations, differentiated exactly"
SETTLED = 1e-12  # share of the rates below which fast states are at steady state
PASSES = 50


class Source(ABC):
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
    def with_values(self, values: Mapping[str, Any], over: Sequence[str]) -> Source:
        """Return the source with a scenario's values, except those set in `over`."""

    @abstractmethod
    def start(self) -> Point:
        """Return the start point."""

    @abstractmethod
    def linear(self, points: Sequence[Point]) -> list[Linear]:
        """Return the linear model at each point.

        Raises:
            SimulationError: The model has no finite derivatives.
        """


class EquationSource(Source):
    """A model with its equations and active effects."""

    def __init__(self, loaded: LoadedModel, name: str) -> None:
        from cosim.model.symbolic.linearize import Linearizer

        self._loaded, self.model = loaded, loaded.model
        model = loaded.model
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
        named = {text.partition("=")[0].strip() for text in over}
        texts = [f"{n}={str(v).lower() if isinstance(v, bool) else v}" for n, v in values.items()]
        wanted = [text for text in texts if (n := text.partition("=")[0]) in model.declared and n not in named]
        if not wanted:
            return self
        return EquationSource(replace(self._loaded, model=with_parameters(model, wanted)), self.name)

    def start(self) -> Point:
        """Return the model's start."""
        return Point(0.0, np.array(self.model.start(), float), np.array(self.model.start_command(), float))

    def linear(self, points: Sequence[Point]) -> list[Linear]:
        """Return the linear model at each point."""
        return [self._about(point) for point in points]

    def _about(self, point: Point) -> Linear:
        try:
            found = self._linearizer(tuple(point.states), tuple(point.inputs), point.time)
            rates, values = self._at(point.time, point.states, point.inputs)
        except (ArithmeticError, ValueError) as error:
            raise SimulationError(self.name, point.time, f"the equations have no value there: {error}") from None
        matrices = found.A, found.B, found.C, found.D
        if not all(np.isfinite(m).all() for m in (*matrices, rates, values)):
            raise SimulationError(self.name, point.time, "the equations or their slopes are not finite there")
        kinks, notes = self._kinks(point)
        names, told = (self.states, self.inputs, self.outputs), ((*self._memories(), *notes), tuple(kinks))
        return Linear(*matrices, *names, point, rates, values, self.units, EXACT, *told)

    def _at(self, t: float, x: Array, u: Array) -> tuple[Array, Array]:
        state, command = tuple(x.tolist()), tuple(u.tolist())
        derivative, output = self._equations
        return np.array(derivative(t, state, command), float), np.array(output(t, state, command), float)

    def _memories(self) -> list[str]:
        """Return notes on effects that shape commands before the equations."""
        shaping = overrides(self.model.awake, "shape", Effect)
        return [f"{e.name} ({e.equation}) acts on the inputs before they get here and is left out" for e in shaping]

    def _kinks(self, point: Point) -> tuple[list[Kink], list[str]]:
        """Return kinks of the equations and notes."""

        def rates(z: Array) -> Array:
            n = len(self.states)
            return np.concatenate(self._at(point.time, z[:n], z[n:]))

        z = np.concatenate([point.states, point.inputs])
        try:
            return kinks_at(rates, z, self.states, self.inputs, self.outputs), []
        except (ArithmeticError, ValueError):  # the equations are undefined on one side
            return [], ["the equations end at this point: to one side of it they have no value"]


def settled(source: Source, point: Point, fast: Sequence[str]) -> Point:
    """Return the point with fast states at rest, by Newton steps.

    The other states and the inputs are held: f₂(x₂) = 0.

    Raises:
        ValueError: The states do not come to rest.
    """
    rows = [source.states.index(n) for n in fast]
    for _ in range(PASSES if rows else 0):
        (found,) = source.linear([point])
        rates, own = found.rates[rows], found.A[np.ix_(rows, rows)]
        if np.abs(rates).max() <= SETTLED * max(1.0, float(np.abs(own).max() * np.abs(point.states[rows]).max())):
            return point
        states = point.states.copy()
        try:
            states[rows] -= np.linalg.solve(own, rates)
        except np.linalg.LinAlgError:
            break
        if not np.isfinite(states).all():
            break
        point = Point(point.time, states, point.inputs)
    if rows:
        raise ValueError(f"{', '.join(fast)} come to no rest while the other states are held")
    return point
