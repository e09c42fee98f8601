"""Derivatives of an FMU at any state, and the Jacobian by directional derivatives or differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cosim.blocks.fmu import FmuBlock
from cosim.blocks.model_exchange import ModelExchange
from cosim.blocks.solvers import derivatives_of, numbers
from cosim.core.arrays import Array
from cosim.core.errors import SimulationError
from cosim.fmi.description import declares_slopes, reals, scalars, states_of
from cosim.fmi.fmi_types import is_negated


class DifferentiableFmu(FmuBlock):
    """An FMU for model exchange, which is evaluated at single points between `open` and `close`."""

    instance: ModelExchange

    def __init__(
        self, name: str, path: Any, description: Any, start: Mapping[str, Any], connected: frozenset[str]
    ) -> None:
        super().__init__(name, path, description, start, connected, way="model-exchange")
        self._states = states_of(description)
        self._inputs, self._outputs = reals(description, "input"), reals(description, "output")
        self._rates = [unknown.variable for unknown in description.derivatives]
        self.order = len(scalars(self._states))

    @property
    def gives_slopes(self) -> bool:
        """Return True if the FMU provides directional derivatives and has no arrays."""
        plain = all(not v.shape for v in (*self._states, *self._inputs, *self._outputs))
        return plain and declares_slopes(self.path, "model-exchange")

    def state_references(self) -> list[int]:
        """Return the value references of the states (FMI 1.0 only)."""
        return self.instance.state_references()

    def current_point(self) -> tuple[Array, Array]:
        """Return the current states and inputs."""
        return self._vector(self.instance.fmu.getContinuousStates), self._read(self._inputs)

    def move(self, t: float, states: Array, inputs: Array) -> Array:
        """Set time, states and inputs, and handle events.

        Returns:
            The states after the events.
        """
        with self.instance.check_calls():
            self.instance.fmu.setTime(t)
            self.instance.set_states(states)
            self.instance.event(lambda: self._write_reals(self._inputs, inputs))
        return self._vector(self.instance.fmu.getContinuousStates)

    def rates(self, states: Array, inputs: Array) -> Array:
        """Return derivatives and outputs at given states and inputs, without handling events."""
        with self.instance.check_calls():
            self.instance.set_states(states)
            self._write_reals(self._inputs, inputs)
        rates = self._vector(derivatives_of(self.instance.fmu))
        return np.concatenate([rates, self._read(self._outputs)])

    def directional_slopes(self) -> Array:
        """Return the Jacobian from the FMU's directional derivatives.

        Rows are derivatives and outputs, columns states and inputs.
        """
        unknowns, knowns = (*self._rates, *self._outputs), (*self._states, *self._inputs)
        columns = self.instance.directional_derivatives(unknowns, knowns)
        return np.array(columns, float).T.reshape(len(unknowns), len(knowns))

    # -- internal -------------------------------------------------------------------------------

    def _vector(self, function: Any) -> Array:
        """Return one number per state from an FMU function."""
        with self.instance.check_calls():
            return np.array(numbers(function, self.order), float)

    def _read(self, variables: Sequence[Any]) -> Array:
        if not variables:
            return np.zeros(0)
        fmu, references = self.instance.fmu, [v.valueReference for v in variables]
        with self.instance.check_calls():
            if self.instance.version == 3:
                return np.array(fmu.getFloat64(references, nValues=len(scalars(variables))), float)
            return _with_signs(variables, np.array(fmu.getReal(references), float))

    def _write_reals(self, variables: Sequence[Any], values: Array) -> None:
        if variables:
            fmu, references = self.instance.fmu, [v.valueReference for v in variables]
            write = fmu.setFloat64 if self.instance.version == 3 else fmu.setReal
            write(references, _with_signs(variables, values).tolist())


def _with_signs(variables: Sequence[Any], values: Array) -> Array:
    """Convert values of variables to values of their value references, or back; signs of negated aliases change."""
    negated = [is_negated(v) for v in variables]
    return np.where(negated, -values, values) if any(negated) else values


def slopes_at(
    block: DifferentiableFmu, t: float, states: Array, inputs: Array, step: float, *, directional: bool
) -> tuple[Array, Array, Array]:
    """Return at a point: the Jacobian, the derivatives followed by outputs, and the states after events.

    Args:
        step: Step of the central differences, relative to max(1, |value|).
        directional: Use the FMU's directional derivatives instead of differences.

    Raises:
        SimulationError: A result is not finite.
    """
    after = block.move(t, states, inputs)
    z, n = np.concatenate([after, inputs]), len(after)
    rates = block.rates(after, inputs)
    fault = "{} are not finite at these states and inputs; choose another operating point"
    if not np.isfinite(rates).all():
        raise SimulationError(block.name, t, fault.format("its derivatives or outputs"))
    if directional:
        slopes = block.directional_slopes()
    else:
        columns = []
        for k, h in enumerate(step * np.maximum(1.0, np.abs(z))):
            ahead, behind = z.copy(), z.copy()
            ahead[k], behind[k] = z[k] + h, z[k] - h
            difference = block.rates(ahead[:n], ahead[n:]) - block.rates(behind[:n], behind[n:])
            columns.append(difference / (ahead[k] - behind[k]))
        slopes = np.array(columns).T.reshape(rates.size, z.size)
        block.rates(after, inputs)
    if not np.isfinite(slopes).all():
        raise SimulationError(block.name, t, fault.format("the slopes of its derivatives or outputs"))
    return slopes, rates, after
