"""Stiff models: one implicit method in kernel and FMUs, held against an independent solver."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.estimation.posing import build_problem
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.fmi.building.build import build as build_fmus
from cosim.fmi.building.file import LoadedModel, read_model, write_model
from cosim.fmi.building.substep import with_substep
from cosim.logs.log import read_log
from cosim.model import Equations, Model, Namespace, Quantity, Values
from cosim.model.rosenbrock import step
from tests.cases import some
from tests.logs import replay
from tests.motor import motor_log
from tests.native import NEEDS_COMPILER
from tests.test_substep import message_of, motor

WINDING = "2.4e-5"  # H: L/R is 20 microseconds
ROW = 0.01  # s


@dataclass(frozen=True, kw_only=True)
class Ringing(Model):
    """A light mass on a stiff spring."""

    base_states = (Quantity("x", "m", "position"), Quantity("v", "m/s", "speed"))
    inputs = (Quantity("u", "m/s2", "push"),)
    outputs = base_states
    rate = ROW

    def equations(self, m: Namespace) -> Equations:
        """x'' = u − 1e8·x − 2·x'."""
        return Equations(lambda t, x, u: (x[1], u[0] - 1e8 * x[0] - 2.0 * x[1]), lambda t, x, u: x)


def test_the_implicit_method_is_of_order_four_and_ends_a_mode_that_is_too_fast() -> None:
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
    assert np.diff(-np.log2(errors)).min() > 3.8
    for rate in (-1e3, -1e9):
        (left,) = step(lambda t, x, u, rate=rate: (rate * x[0],), [[rate]], 0.0, (1.0,), (), 1.0)
        assert abs(left) < 10.0 / abs(rate)


@NEEDS_COMPILER
@pytest.mark.parametrize("kind", some(["native", "python"], every=2))
def test_kernel_and_fmu_integrate_a_stiff_model_alike(tmp_path: Path, kind: str) -> None:
    given = motor(tmp_path, inductance=WINDING)
    path = motor_log(tmp_path / "a.csv", 1, step=ROW, seconds=3.0, inductance=float(WINDING))
    log = read_log(path, given.model.inputs, given.model.outputs)
    loaded, _ = with_substep(given, [log])
    write_model(tmp_path / "model.yaml", loaded)
    read = read_model(tmp_path / "model.yaml")
    assert (read.model.integrator, read.model.substep) == ("stiff", loaded.model.substep)
    (fmu,) = build_fmus(tmp_path / "built", str(tmp_path / "model.yaml"), native=kind == "native")
    problem = build_problem(ModelSubject.of(loaded.model), [log])
    start = {f"{q.name}_start": x for q, x in zip(loaded.model.states, problem.x0[0].tolist(), strict=False)}
    through, run = replay(log, fmu, start), problem.simulate(problem.values, 0)
    for k, output in enumerate(problem.layout.outputs):
        assert np.max(np.abs(through.outputs[output] - run.outputs[:, k])) < 1e-9  # A and rad/s
    fine = build_problem(ModelSubject.of(loaded.model.with_substep(1e-5, "rk4")), [log])
    exact = fine.simulate(fine.values, 0)
    assert np.max(np.abs(exact.outputs - run.outputs)) < 1e-5  # of steps of 10 A


def test_a_fast_mode_that_rings_on_is_refused() -> None:
    """A resonance of 1.6 kHz that lasts for many rows: an implicit method would end it at once."""
    assert "Ringing is stiff" in message_of(lambda: with_substep(LoadedModel(Ringing(), "ringing.py:Ringing")))
