"""Hypotheses that act alike for every input: one claim under both names, and no experiment that cannot exist."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from cosim.estimation.fit import initial_fit
from cosim.estimation.posing import build_problem
from cosim.estimation.problem import Problem
from cosim.estimation.subject.interface import Subject
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.logs.log import Log
from cosim.model import Equations, Model, Namespace, Number, Quantity, Values, parameter
from cosim.refinement.decision.equivalence import act_alike
from cosim.refinement.search.fits import Hypothesis, Search
from tests.test_refine_fmu import NOISE, run_motor, study_of_way


@dataclass(frozen=True, kw_only=True)
class Exchanger(Model):
    """A heat exchanger: the same rates for all conductances and the inverse of all heat capacities."""

    base_states = (Quantity("cold", "K", ""), Quantity("hot", "K", ""))
    inputs = (Quantity("inlet", "K", ""),)
    outputs = base_states
    forced = ("cold", "hot")
    calibrated = ("UA", "c", "C_c", "C_h")
    substep = 0.1

    UA: float = parameter(2.0, unit="W/K", bounds=(0.1, 20.0), doc="conductance between both sides")
    c: float = parameter(1.0, unit="W/K", bounds=(0.1, 20.0), doc="heat flow of the inlet")
    C_c: float = parameter(3.0, unit="J/K", bounds=(0.1, 30.0), doc="heat capacity of the cold side")
    C_h: float = parameter(5.0, unit="J/K", bounds=(0.1, 30.0), doc="heat capacity of the hot side")

    def equations(self, m: Namespace) -> Equations:
        """Return the balances of both sides."""

        def derivative(t: Number, state: Values, command: Values) -> Values:
            flow = self.UA * (state[1] - state[0])
            return (flow + self.c * (command[0] - state[0])) / self.C_c, -flow / self.C_h

        return Equations(derivative, lambda t, state, command: state)


def search_of(subject: Subject, problem: Problem) -> Search:
    return Search(subject, problem, 30, lambda stage, share: None)


def supposed(search: Search, values: Mapping[str, float]) -> Hypothesis:
    """Return a hypothesis with the given values of its parameters, and all others as stated."""
    given = search.problem.values
    candidates = search.subject.candidates([q.name for q in search.subject.inputs])
    parts = tuple(c for c in candidates if not values.keys().isdisjoint(c.parameters))
    return Hypothesis(parts, replace(initial_fit(search.problem), values={**given, **values}), 0.0)


@pytest.fixture(scope="module", params=["model_exchange", "co_simulation"])
def motor(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Search:
    folder = tmp_path_factory.mktemp("motor")
    for k, name in enumerate(("e1", "e2")):
        run_motor(folder / f"{name}.csv", k)
    study = study_of_way(folder, request.param)
    return search_of(study.subject, build_problem(study.subject, study.logs, noise=NOISE))


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ({"damping": 4e-4}, {"viscous_at_speed.coefficient": 3e-4}, True),
        ({"damping": 4e-4}, {"viscous_at_speed.coefficient": 5e-5}, True),  # fitted elsewhere
        ({"damping": 4e-4}, {"quadratic_drag_at_speed.coefficient": 3e-6}, False),
        ({"damping": 4e-4}, {"coulomb_at_speed.level": 0.01}, False),
        ({"damping": 4e-4}, {"inertia": 3e-4}, False),
        ({"bias_at_load_torque.value": 1e-3}, {"bias_at_voltage.value": 0.1}, False),
        # a tenth of a row: alike on any log, but for an enlarged effect
        ({"lag_at_voltage.time": 2e-3}, {"delay.voltage": 2e-3}, False),
        (
            {"lag_at_voltage.time": 1e-3},
            {"second_order_lag_at_voltage.time": 7e-4, "second_order_lag_at_voltage.damping": 0.7},
            False,
        ),
    ],
)
def test_a_settable_damping_and_a_viscous_term_act_alike_and_what_only_looks_alike_does_not(
    motor: Search, one: dict[str, float], other: dict[str, float], expected: bool
) -> None:
    assert act_alike(motor, supposed(motor, one), supposed(motor, other)) is expected


def test_sums_act_alike_where_only_ratios_of_parameters_act(tmp_path: Path) -> None:
    time = 0.5 * np.arange(400)
    inlet = 300.0 + 20.0 * np.sign(np.sin(0.2 * time))
    readings = {n: np.full(time.size, 300.0) for n in ("cold", "hot")}
    log = Log(tmp_path / "log.csv", time, {"inlet": inlet}, readings, {}, 0.5, {}, {})
    subject = ModelSubject.of(Exchanger())
    search = search_of(subject, build_problem(subject, [log], noise={"cold": 0.1, "hot": 0.1}))
    flows = supposed(search, {"UA": 3.0, "c": 1.5})
    assert act_alike(search, flows, supposed(search, {"C_c": 2.0, "C_h": 10.0 / 3.0}))
    assert act_alike(search, flows, supposed(search, {"C_c": 2.1, "C_h": 3.2}))
    assert not act_alike(search, flows, supposed(search, {"UA": 3.0, "C_c": 2.0}))  # C_h far beyond its tolerance
    far = supposed(search, {"UA": 3.0, "c": 0.7})
    assert not act_alike(search, far, supposed(search, {"C_c": 2.1, "C_h": 3.2}))
