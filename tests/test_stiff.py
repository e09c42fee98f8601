"""Stiff models: one implicit method in kernel and FMUs, held against an independent solver."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.estimation.kernel.backend import kernel
from cosim.estimation.kernel.kernel import Data
from cosim.estimation.posing import build_problem
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.fmi.building.build import build as build_fmus
from cosim.fmi.building.file import LoadedModel, own_model, read_model, write_model
from cosim.fmi.building.substep import with_substep
from cosim.logs.log import read_log
from cosim.model import Equations, Model, Namespace, Number, Quantity, Stepper, Values, parameter
from cosim.model.duals import DualNamespace, jacobian
from cosim.model.namespaces import SCALAR
from cosim.model.rosenbrock import step
from cosim.model.symbolic.linearize import linearize
from plant.hovercraft import Hovercraft
from tests.logs import replay
from tests.motor import motor_log
from tests.native import NEEDS_COMPILER
from tests.test_substep import message_of, motor

WINDING = "2.4e-5"  # H: L/R is 20 microseconds
ROW = 0.01  # s


@dataclass(frozen=True, kw_only=True)
class Box(Model):
    """A heated box that loses heat by conduction and radiation, and a thermocouple in it that follows within 50 µs."""

    base_states = (Quantity("box", "K", "of the air", 300.0), Quantity("sensor", "K", "of the thermocouple", 300.0))
    inputs = (Quantity("power", "W", "of the heater"),)
    outputs = (Quantity("reading", "K", "of the thermocouple"),)
    rate = ROW

    lag: float = parameter(5e-5, unit="s", bounds=(1e-6, 10), doc="of the thermocouple")

    def equations(self, m: Namespace) -> Equations:
        """C·dT/dt = P − k·(T − T₀) − ε·T⁴,   τ·dS/dt = T − S."""

        def derivative(t: Number, x: Values, u: Values) -> Values:
            box, sensor = x
            return (u[0] - 0.4 * (box - 300.0) - 5e-9 * box**4) / 2.0, (box - sensor) / self.lag

        return Equations(derivative, lambda t, x, u: (x[1],))


def stiff_motor(folder: Path, **changes: str) -> LoadedModel:
    return with_substep(motor(folder, inductance=WINDING, **changes))[0]


def deviation(model: Model, command: list[float], h: float) -> float:
    """Return the largest difference from Radau's solution, of the range of each state."""
    stepper, derivative = Stepper(model), model.acting(SCALAR).derivative
    moment, exact, states, seen = stepper.start(), np.array(model.start()), [], []
    for k, u in enumerate(command):
        moment = stepper.step(replace(moment, t=k * h), (u,), h)
        solved = solve_ivp(
            lambda t, x, u=u: derivative(t, tuple(x), (u,)), (0.0, h), exact, method="Radau", rtol=1e-10, atol=1e-12
        )
        exact = solved.y[:, -1]
        states.append(moment.state)
        seen.append(exact)
    return float(np.max(np.abs(np.array(states) - np.array(seen)) / np.ptp(np.array(seen), axis=0)))


def test_the_implicit_method_is_of_order_four() -> None:
    def van_der_pol(t: float, x: Values, u: Values) -> Values:
        return x[1], (1.0 - x[0] ** 2) * x[1] - x[0]

    exact = solve_ivp(lambda t, x: van_der_pol(t, x, ()), (0.0, 2.0), [2.0, 0.5], "DOP853", rtol=1e-13, atol=1e-14)
    errors = []
    for n in (20, 40, 80):
        x: Values = (2.0, 0.5)
        for k in range(n):
            J = [[0.0, 1.0], [-2.0 * x[0] * x[1] - 1.0, 1.0 - x[0] ** 2]]
            x = step(van_der_pol, J, k * 2.0 / n, x, (), 2.0 / n)
        errors.append(np.abs(np.array(x) - exact.y[:, -1]).max())
    assert math.log2(errors[0] / errors[1]) > 3.8
    assert math.log2(errors[1] / errors[2]) > 3.8


@pytest.mark.parametrize("rate", [-1e3, -1e6, -1e9])
def test_the_implicit_method_ends_a_mode_that_is_too_fast(rate: float) -> None:
    (x,) = step(lambda t, x, u: (rate * x[0],), [[rate]], 0.0, (1.0,), (), 1.0)
    assert abs(x) < 10.0 / abs(rate)


def test_dual_numbers_give_the_jacobian_of_the_symbols() -> None:
    craft = Hovercraft().with_values(dict.fromkeys(("coulomb_friction.force", "tilt_offset.right"), 0.05))
    state = tuple(0.1 + 0.03 * k for k in range(len(craft.states)))
    command = tuple(6.0 + 0.1 * k for k in range(len(craft.inputs)))
    rows = jacobian(craft.acting(DualNamespace()).derivative, 0.3, state, command)
    np.testing.assert_allclose(rows, linearize(craft, state, command, 0.3).A, rtol=1e-12, atol=1e-12)


def test_a_heated_box_with_a_fast_sensor_follows_an_independent_solver() -> None:
    model = with_substep(LoadedModel(Box(), "box.py:Box"))[0].model
    assert model.integrator == "stiff"
    assert deviation(model, [50.0] * 20 + [400.0] * 20 + [0.0] * 20, ROW) < 1e-6


@pytest.mark.thorough
@NEEDS_COMPILER
@pytest.mark.parametrize("kind", ["python", "native"])
def test_kernel_and_fmu_integrate_a_stiff_model_alike(tmp_path: Path, kind: str) -> None:
    given = motor(tmp_path, inductance=WINDING)
    path = motor_log(tmp_path / "a.csv", 1, step=ROW, seconds=3.0, inductance=float(WINDING))
    log = read_log(path, given.model.inputs, given.model.outputs)
    loaded, _ = with_substep(given, [log])
    write_model(tmp_path / "model.yaml", loaded)
    (fmu,) = build_fmus(tmp_path / "built", str(tmp_path / "model.yaml"), native=kind == "native")
    problem = build_problem(ModelSubject.of(loaded.model), [log])
    start = {f"{q.name}_start": x for q, x in zip(loaded.model.states, problem.x0[0].tolist(), strict=False)}
    through, run = replay(log, fmu, start), problem.own_run(0)
    for k, output in enumerate(problem.layout.outputs):
        assert np.max(np.abs(through.outputs[output] - run.outputs[:, k])) < 1e-9  # A and rad/s
    exact = build_problem(ModelSubject.of(loaded.model.with_substep(1e-5, "rk4")), [log]).own_run(0)
    assert np.max(np.abs(exact.outputs - run.outputs)) < 1e-5  # of steps of 10 A


@NEEDS_COMPILER
def test_the_filter_carries_its_covariance_as_the_method_carries_the_state(tmp_path: Path) -> None:
    """Variances and innovations are those of RK4 in substeps that are short enough for the winding."""
    model = own_model("motor.py:Motor", motor(tmp_path, inductance=WINDING) and tmp_path)
    rng, rows = np.random.default_rng(4), 200
    u = np.repeat(rng.uniform(-12.0, 12.0, rows // 20), 20)[:, None]
    y = rng.normal(size=(rows, 2)) * [1.0, 5.0] + u * [0.8, 8.0]
    runs = []
    for integrator, substep in (("stiff", ROW / 8), ("rk4", 1e-5)):
        k = kernel(model.with_substep(substep, integrator), ("current", "speed"))
        values = {p.name: getattr(model, p.name) for p in model.parameters} | {"disturbance.time": 0.15}
        p = np.array([values.get(name, 0.0) for name in k.layout.parameters])
        size = len(k.layout.stochastic)
        q = np.zeros(size)
        q[list(k.layout.noisy)] = 1e2
        data = Data(ROW, 0.0, u, y, round(ROW / substep), interpolated=frozenset({"voltage"}))
        runs.append(k.run(data, p, np.zeros(len(k.layout.states)), np.eye(size), q, np.array([1.0, 25.0])))
    np.testing.assert_allclose(runs[0].variances, runs[1].variances, rtol=1e-5)
    np.testing.assert_allclose(runs[0].errors, runs[1].errors, atol=1e-4)


def test_a_fast_mode_that_rings_on_is_refused(tmp_path: Path) -> None:
    """A resonance of 1.6 kHz that lasts for many rows: an implicit method would end it at once."""
    (tmp_path / "ringing.py").write_text(RINGING)
    said = message_of(
        lambda: with_substep(LoadedModel(own_model("ringing.py:Ringing", tmp_path), "ringing.py:Ringing"))
    )
    assert "Ringing is stiff" in said


def test_a_model_file_keeps_the_integrator(tmp_path: Path) -> None:
    loaded = stiff_motor(tmp_path)
    write_model(tmp_path / "model.yaml", loaded)
    read = read_model(tmp_path / "model.yaml")
    assert (read.model.integrator, read.model.substep) == ("stiff", loaded.model.substep)
    assert with_substep(read) == (read, [])


RINGING = '''
from dataclasses import dataclass

from cosim.model import Equations, Model, Quantity


@dataclass(frozen=True, kw_only=True)
class Ringing(Model):
    """A light mass on a stiff spring."""

    base_states = (Quantity("x", "m", "position"), Quantity("v", "m/s", "speed"))
    inputs = (Quantity("u", "m/s2", "push"),)
    outputs = base_states
    sensor_variance = {"x": 1e-4, "v": 1e-4}
    forced = ("v",)
    rate = 0.01

    def equations(self, m):
        return Equations(lambda t, x, u: (x[1], u[0] - 1e8 * x[0] - 2.0 * x[1]), lambda t, x, u: x)
'''
