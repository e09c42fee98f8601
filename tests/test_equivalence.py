"""Hypotheses that act alike for every input: one claim under both names, and no experiment that cannot exist."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.estimation.fit import initial_fit
from cosim.estimation.posing import build_problem
from cosim.estimation.problem import Problem
from cosim.kernel.kernel import Data
from cosim.logs.log import Log
from cosim.model import Equations, Model, Namespace, Number, Quantity, Values, parameter
from cosim.refinement.decision import equivalence
from cosim.refinement.decision.claims import alike_groups
from cosim.refinement.decision.equivalence import act_alike, split_alike
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Hypothesis
from cosim.subject.interface import Subject
from cosim.subject.model_subject import ModelSubject
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


BAND = {"dead_band_at_voltage.width": 0.3}


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


def test_a_failing_fmu_shows_no_equivalence(motor: Search, monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = np.full_like(motor.problem.logs[0].y, np.nan)
    monkeypatch.setattr(equivalence._Course, "outputs", lambda course, values: nothing)
    assert not act_alike(
        motor, supposed(motor, {"damping": 4e-4}), supposed(motor, {"viscous_at_speed.coefficient": 3e-4})
    )


def test_inputs_go_beyond_the_logs_and_are_the_same_each_time(motor: Search) -> None:
    def course(times: float) -> Data:
        return equivalence._Course.exciting(motor.problem, times, both_signs=True).data

    logged = np.concatenate([log.u for log in motor.problem.logs])
    ratios = np.ptp(course(3.0).u, axis=0) / np.ptp(logged, axis=0)
    assert ratios == pytest.approx(3.0, rel=0.1)
    assert np.array_equal(course(3.0).u, course(3.0).u)


def test_a_dead_band_is_no_bias_where_an_input_could_change_its_sign(motor: Search) -> None:
    """The voltage of the logs is from 30 V up, far above the width; below zero, both differ."""
    logs = [replace(log, u=log.u + np.array([30.0 - log.u[:, 0].min(), 0.0])) for log in motor.problem.logs]
    search = search_of(motor.subject, replace(motor.problem, logs=logs))
    course = equivalence._Course.exciting(search.problem, 1.0, both_signs=False).data
    assert course.u[:, 0].min() > 29.0
    bias, band = (supposed(search, values) for values in ({"bias_at_voltage.value": -0.3}, BAND))
    assert not act_alike(search, bias, band)


def test_one_of_each_group_of_alikes_stays_a_rival(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of {a, x}, {b, x}, {c}, {d} and {e} the first two act alike, and the last two."""
    alike = [{("a", "x"), ("b", "x")}, {("d",), ("e",)}]
    monkeypatch.setattr(equivalence, "act_alike", lambda search, h, o: {h.names, o.names} in alike)
    nothing: Any = None
    sets = [Named(names, None) for names in (("a", "x"), ("b", "x"), ("c",), ("d",), ("e",))]
    hypotheses: Any = sets
    rivals, like = split_alike(nothing, hypotheses[0], hypotheses[1:])
    assert [h.names for h in rivals] == [("c",), ("d",)]
    assert alike_groups(like) == (("a", "b"), ("d", "e"))


@dataclass(frozen=True)
class Named:
    """A hypothesis that has names only."""

    names: tuple[str, ...]
    fit: Any
