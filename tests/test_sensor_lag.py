"""Lagging sensors: the filter against a model that holds the lag as a state, and claims about lags."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from cosim.core.arrays import Array
from cosim.estimation.data import lagged
from cosim.estimation.kernel.backend import kernel
from cosim.estimation.kernel.kernel import Data, Filtered
from cosim.model import Equations, Lag, Model, Namespace, Quantity, parameter

STEP, TIME, ROWS = 0.05, 0.4, 400


@dataclass(frozen=True, kw_only=True)
class SlowGauge(Lag):
    """A gauge that follows the level."""

    name = "slow_gauge"
    outputs = ("level",)


@dataclass(frozen=True, kw_only=True)
class Tank(Model):
    """A tank with an outlet, and an independent reading of its rate of outflow."""

    base_states = (Quantity("level", "m", "level"),)
    inputs = (Quantity("inflow", "m/s", "inflow"),)
    outputs = (Quantity("level", "m", "level"), Quantity("outflow", "m/s", "outflow"))
    sensors = (SlowGauge,)
    forced = ("level",)
    substep = 0.01
    integrator = "rk4"

    rate_: float = parameter(0.5, unit="1/s", bounds=(0.01, 10), doc="outflow per level")

    def equations(self, m: Namespace) -> Equations:
        """Return the balance."""
        return Equations(lambda t, x, u: (u[0] - self.rate_ * x[0],), lambda t, x, u: (x[0], self.rate_ * x[0]))


@dataclass(frozen=True, kw_only=True)
class TankWithGauge(Tank):
    """The same tank, with its gauge as a second state."""

    base_states = (*Tank.base_states, Quantity("shown", "m", "reading"))
    sensors = ()

    time_: float = parameter(TIME, unit="s", bounds=(0.01, 10), doc="time constant of the gauge")

    def equations(self, m: Namespace) -> Equations:
        """Return the balance and the lag."""
        return Equations(
            lambda t, x, u: (u[0] - self.rate_ * x[0], (x[0] - x[1]) / self.time_),
            lambda t, x, u: (x[1], self.rate_ * x[0]),
        )


def run(
    model: Model, x0: list[float], P: Array, p: dict[str, float], u: Array, y: Array, density: float = 0.02, **more: Any
) -> Filtered:
    """Filter from a start of this covariance of the model's states."""
    tool = kernel(model, ["level", "outflow"])
    layout = tool.layout
    values = np.array([{"disturbance.time": 0.5, "slow_gauge.value": 0.0, **p}[n] for n in layout.parameters])
    states = np.zeros(len(layout.states))
    states[: len(x0)] = x0
    q = np.zeros(len(layout.stochastic))
    q[list(layout.noisy)] = density
    P0 = np.zeros((len(q), len(q)))
    P0[: len(P), : len(P)] = P
    return tool.run(Data(STEP, 0.0, u, y, 5, **more), values, states, P0, q, np.array([1e-4, 1e-3]))


@pytest.fixture
def log() -> tuple[Array, Array]:
    rng = np.random.default_rng(5)
    t = STEP * np.arange(ROWS)
    u = (0.5 + 0.5 * np.sign(np.sin(1.3 * t)))[:, None]
    y = np.column_stack([0.5 + 0.4 * np.sin(0.9 * t), 0.3 + 0.1 * np.cos(t)]) + 0.01 * rng.standard_normal((ROWS, 2))
    y[50:60, 0] = np.nan
    return u, y


def test_the_filter_equals_one_with_the_lag_as_a_state(log: tuple[Array, Array]) -> None:
    u, y = log
    change = (y[8, 0] - y[0, 0]) ** 2  # over T, 8 rows
    p, both = {"rate_": 0.5, "time_": TIME}, np.array([[0.01, 0.01], [0.01, 0.01 + change]])
    ours = run(Tank(), [0.4], both[:1, :1], p, u, y, lags=np.array([TIME / STEP, 0.0]))
    theirs = run(TankWithGauge(), [0.4, 0.4], both, p, u, y)
    known = np.isfinite(y)
    np.testing.assert_allclose(ours.variances[known], theirs.variances[known], rtol=2e-2)
    assert np.nanmax(np.abs(ours.errors - theirs.errors) / np.sqrt(theirs.variances)) < 0.03


def test_the_lag_of_a_ramp_is_exact() -> None:
    time = np.arange(0.0, 5.0, 0.1)
    expected = 2.0 * (time - TIME + TIME * np.exp(-time / TIME))
    np.testing.assert_allclose(lagged(time, 2.0 * time, TIME), expected, atol=1e-12)
