"""Integration of a model over a communication step, with constant inputs and equal substeps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from cosim.model.duals import DualNamespace, jacobian
from cosim.model.model import STIFF, Effect, Model, Number, Values, overrides
from cosim.model.namespaces import SCALAR, Namespace
from cosim.model.rosenbrock import step as stiff_step

Derivative = Callable[[Number, Values, Values], Values]


def substeps(step: float, longest: float) -> int:
    """Return the least number of equal substeps not longer than `longest`, apart from rounding."""
    return max(1, math.ceil(step / longest - 1e-6))


def rk4(f: Derivative, t: Number, x: Values, u: Values, h: Number) -> Values:
    """Return x(t + h) by the classical Runge-Kutta method, with constant command u."""
    half = 0.5 * h
    k1 = f(t, x, u)
    k2 = f(t + half, tuple([a + half * k for a, k in zip(x, k1)]), u)  # noqa: B905 - hot loop
    k3 = f(t + half, tuple([a + half * k for a, k in zip(x, k2)]), u)  # noqa: B905
    k4 = f(t + h, tuple([a + h * k for a, k in zip(x, k3)]), u)  # noqa: B905
    sixth = h / 6.0
    return tuple([a + sixth * (p + 2.0 * (q + r) + s) for a, p, q, r, s in zip(x, k1, k2, k3, k4)])  # noqa: B905


@dataclass(frozen=True)
class Moment:
    """Complete state of a simulation: time [s], continuous states, and memory of each shaping effect."""

    t: Number
    state: Values
    memory: tuple[Values, ...] = ()


class Stepper:
    """Integrator of a model in a namespace: `moment = stepper.step(moment, command, h)`."""

    def __init__(self, model: Model, m: Namespace = SCALAR) -> None:
        self.model = model
        self.namespace = m
        self.derivative, self.output = model.acting(m)
        self.shaping: tuple[Any, ...] = overrides(model.awake, "shape", Effect)

    def start(self, t: Number = 0.0, values: Mapping[str, Number] | None = None) -> Moment:
        """Return the initial moment at time `t` [s] from start values of states and of `effect.memory`."""
        values = values or {}
        inputs = dict(zip((q.name for q in self.model.inputs), self.model.start_command(), strict=True))
        memory = tuple(
            e.remember(t, tuple(values.get(f"{e.name}.{q.name}", inputs.get(q.name, q.start)) for q in e.memory))
            for e in self.shaping
        )
        return Moment(t, self.model.start(values, self.namespace), memory)

    def shape(
        self, t: Number, h: Number, command: Values, memory: tuple[Values, ...]
    ) -> tuple[Values, tuple[Values, ...]]:
        """Return the command after all shaping effects, and the new memory of each effect."""
        after = []
        for effect, values in zip(self.shaping, memory, strict=True):
            command, values = effect.shape(self.namespace, t, h, command, values)
            after.append(values)
        return command, tuple(after)

    @cached_property
    def _slopes(self) -> Derivative:
        """Return the derivative function ẋ = f(t, x, u) on dual numbers, for the Jacobian."""
        return self.model.acting(DualNamespace()).derivative

    def step(self, moment: Moment, command: Values, h: float) -> Moment:
        """Advance by the communication step `h` [s], with constant `command`."""
        n = substeps(h, self.model.substep)
        dt = h / n
        start, x, memory = moment.t, moment.state, moment.memory
        derivative, shaped, is_stiff = self.derivative, command, self.model.integrator == STIFF
        for k in range(n):
            t = start + k * dt
            if memory:
                shaped, memory = self.shape(t, dt, command, memory)
            if is_stiff:
                x = stiff_step(derivative, jacobian(self._slopes, t, x, shaped), t, x, shaped, dt)
            else:
                x = rk4(derivative, t, x, shaped, dt)
        return Moment(start + h, x, memory)
