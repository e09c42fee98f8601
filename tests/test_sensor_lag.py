"""Lagging sensors: the filter against a model that holds the lag as a state, and claims about lags."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from cosim.estimation.kernel.backend import kernel
from cosim.estimation.kernel.kernel import Data
from cosim.estimation.past_readings import lagged
from cosim.model import Equations, Lag, Model, Quantity, parameter

STEP, TIME, ROWS = 0.05, 0.4, 400


@dataclass(frozen=True, kw_only=True)
class SlowGauge(Lag):
    name = "slow_gauge"
    outputs = ("level",)


@dataclass(frozen=True, kw_only=True)
class Tank(Model):
    """A tank with an outlet, and an independent reading of its rate of outflow."""

    base_states = (Quantity("level", "m", "level"),)
    inputs = (Quantity("inflow", "m/s", "inflow"),)
    outputs = (Quantity("level", "m", "level"), Quantity("outflow", "m/s", "outflow"))
    sensors = (SlowGauge,)
    forced: ClassVar[tuple[str, ...]] = ("level",)
    substep = 0.01
    integrator = "rk4"

    rate_: float = parameter(0.5, unit="1/s", bounds=(0.01, 10), doc="outflow per level")

    def equations(self, m):
        return Equations(lambda t, x, u: (u[0] - self.rate_ * x[0],), lambda t, x, u: (x[0], self.rate_ * x[0]))


@dataclass(frozen=True, kw_only=True)
class TankWithGauge(Model):
    """The same tank, with its gauge as a second state."""

    base_states = (Quantity("level", "m", "level"), Quantity("shown", "m", "reading"))
    inputs = (Quantity("inflow", "m/s", "inflow"),)
    outputs = (Quantity("level", "m", "level"), Quantity("outflow", "m/s", "outflow"))
    forced: ClassVar[tuple[str, ...]] = ("level",)
    substep = 0.01
    integrator = "rk4"

    rate_: float = parameter(0.5, unit="1/s", bounds=(0.01, 10), doc="outflow per level")
    time_: float = parameter(TIME, unit="s", bounds=(0.01, 10), doc="time constant of the gauge")

    def equations(self, m):
        def derivative(t, x, u):
            return u[0] - self.rate_ * x[0], (x[0] - x[1]) / self.time_

        return Equations(derivative, lambda t, x, u: (x[1], self.rate_ * x[0]))


def run(model, x0, *, covariance, p, y, u, density=0.02, **more):
    tool = kernel(model, ["level", "outflow"])
    layout = tool.layout
    values = np.array([p[n] for n in layout.parameters])
    states = np.zeros(len(layout.states))
    states[: len(x0)] = x0
    q = np.zeros(len(layout.stochastic))
    q[list(layout.noisy)] = density
    P0 = np.zeros((len(layout.stochastic),) * 2)
    for (a, b), value in covariance.items():
        P0[layout.uncertain.index(a), layout.uncertain.index(b)] = value
    data = Data(STEP, 0.0, u, y, 5, **more)
    return tool.run(data, values, states, P0, q, np.array([1e-4, 1e-3]))


@pytest.fixture
def log():
    rng = np.random.default_rng(5)
    t = STEP * np.arange(ROWS)
    u = (0.5 + 0.5 * np.sign(np.sin(1.3 * t)))[:, None]
    y = np.column_stack([0.5 + 0.4 * np.sin(0.9 * t), 0.3 + 0.1 * np.cos(t)]) + 0.01 * rng.standard_normal((ROWS, 2))
    y[50:60, 0] = np.nan
    return u, y


def test_the_filter_equals_one_with_the_lag_as_a_state(log):
    u, y = log
    p = {"rate_": 0.5, "time_": TIME, "disturbance.time": 0.5, "slow_gauge.value": 0.0}
    change = (y[8, 0] - y[0, 0]) ** 2  # over T, 8 rows
    states = {("level", "level"): 0.01}
    shown = {("level", "shown"): 0.01, ("shown", "level"): 0.01, ("shown", "shown"): 0.01 + change}
    ours = run(Tank(), [0.4], covariance=states, p=p, u=u, y=y, lags=np.array([TIME / STEP, 0.0]))
    theirs = run(TankWithGauge(), [0.4, 0.4], covariance=states | shown, p=p, u=u, y=y)
    known = np.isfinite(y)
    np.testing.assert_allclose(ours.variances[known], theirs.variances[known], rtol=2e-2)
    size = np.sqrt(theirs.variances)
    assert np.nanmax(np.abs(ours.errors - theirs.errors) / size) < 0.03


def test_readings_of_the_past_see_an_output_bend_between_rows(log):
    """The output follows steps of the inflow within a row; without noise, only the way of the output matters."""
    u, nothing = log[0], np.zeros((ROWS, 2))
    p = {"rate_": 20.0, "time_": 0.5 * STEP, "disturbance.time": 0.5, "slow_gauge.value": 0.0}
    truth = kernel(TankWithGauge(), ["level", "outflow"])
    values = np.array([p[n] for n in truth.layout.parameters])
    start = np.array([u[0, 0] / 20.0, u[0, 0] / 20.0, *[0.0] * (len(truth.layout.states) - 2)])
    twice = Data(0.5 * STEP, 0.0, np.repeat(u, 2, axis=0), np.repeat(nothing, 2, axis=0), 40)
    course = truth.simulate(twice, values, start, np.zeros(0))
    lagging, late = nothing.copy(), nothing.copy()
    lagging[:, 0], lagging[:, 1] = course.outputs[::2, 0], course.outputs[::2, 1]
    late[:, 0], late[:, 1] = np.append(start[0], course.states[1:-1:2, 0]), lagging[:, 1]
    arguments = {"covariance": {}, "p": p, "u": u, "density": 0.0}
    errors = [
        run(Tank(), start[:1], **arguments, y=lagging, lags=np.array([0.5, 0.0])).errors,
        run(Tank(), start[:1], **arguments, y=late, late=np.tile([0.5, 0.0], (ROWS, 1))).errors,
    ]
    bend = np.abs(late[1:, 0] - 0.5 * (course.states[:-2:2, 0] + course.states[2::2, 0])).max()
    assert bend > 0.0015
    assert np.abs(errors).max() < 0.01 * bend


def test_a_lag_of_zero_changes_nothing_and_a_short_one_is_a_delay(log):
    u, y = log
    p = {"rate_": 0.5, "disturbance.time": 0.5, "slow_gauge.value": 0.0}
    arguments = {"covariance": {("level", "level"): 0.01}, "p": p, "u": u, "y": y}
    without, zero = run(Tank(), [0.4], **arguments), run(Tank(), [0.4], **arguments, lags=np.zeros(2))
    np.testing.assert_array_equal(without.errors, zero.errors)
    short = run(Tank(), [0.4], **arguments, lags=np.array([0.02, 0.0]))
    late = run(Tank(), [0.4], **arguments, late=np.tile([0.02, 0.0], (ROWS, 1)))
    of_lag, of_delay = (np.nan_to_num(r.errors - without.errors).ravel() for r in (short, late))
    np.testing.assert_allclose(of_lag @ of_delay / (of_delay @ of_delay), 1.0, atol=0.2)


def test_the_lag_of_a_ramp_is_exact():
    time = np.arange(0.0, 5.0, 0.1)
    expected = 2.0 * (time - TIME + TIME * np.exp(-time / TIME))
    np.testing.assert_allclose(lagged(time, 2.0 * time, TIME), expected, atol=1e-12)
