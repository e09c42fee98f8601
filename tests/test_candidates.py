"""What may be missing or wrong, and within which limits a fit may look for it."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from cosim.estimation.subject.candidates import base_parameters, values_of_special_case
from cosim.estimation.subject.model_subject import ModelSubject, neutral_values
from cosim.model import Equations, Model, Namespace, parameter
from plant.hovercraft import Hovercraft


def test_a_base_parameter_is_looked_for_within_its_own_bounds_near_its_value() -> None:
    craft = Hovercraft()
    mass = next(f for f in base_parameters(ModelSubject.of(craft), neutral_values(craft), {}) if f.name == "mass")
    assert (mass.low, mass.high) == craft.declared["mass"].bounds
    assert mass.prior == pytest.approx((0.705, 0.00705))  # 2 % hold 95 %: a standard deviation is half of that


def test_the_tolerance_of_a_study_goes_before_that_of_the_model_and_that_before_the_usual() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Stated(Model):
        base_states = inputs = outputs = ()
        calibrated = ("sure", "usual")
        sure: float = parameter(2.0, unit="N", bounds=(0, 10), doc="a force", tolerance=0.1)
        usual: float = parameter(2.0, unit="N", bounds=(0, 10), doc="a force")
        loose: float = parameter(2.0, unit="N", bounds=(0, 10), doc="a force", tolerance=0.3)
        left: float = parameter(2.0, unit="N", bounds=(0, 10), doc="a force")

        def equations(self, m: Namespace) -> Equations:
            raise NotImplementedError

    def sigmas(stated: dict[str, float]) -> dict[str, float]:
        found = base_parameters(
            ModelSubject.of(Stated()), dict.fromkeys(("sure", "usual", "loose", "left"), 2.0), stated
        )
        return {f.name: f.prior[1] for f in found if f.prior}

    assert sigmas({}) == pytest.approx({"sure": 0.1, "usual": 0.02, "loose": 0.3})
    assert sigmas({"sure": 0.2, "left": 0.4}) == pytest.approx({"sure": 0.2, "usual": 0.02, "loose": 0.3, "left": 0.4})


def test_the_thrust_line_is_on_trial_only_where_the_duty_varies() -> None:
    craft = Hovercraft()
    still, varied = (
        {c.name for c in ModelSubject.of(craft).candidates(inputs)}
        for inputs in (["tilt_right"], ["tilt_right", "duty_left"])
    )
    assert varied - still == {"thrust_slope"}


def test_an_effect_whose_likelihood_has_two_hills_starts_on_both() -> None:
    craft = Hovercraft()
    tried = {c.name: c for c in ModelSubject.of(craft).candidates([])}
    low, high = tried["actuator_second_order"].starts
    assert low.keys() == high.keys() == set(tried["actuator_second_order"].parameters)
    assert low != high
    assert len(tried["yaw_damping"].starts) == 1


def test_an_effect_takes_the_values_at_which_it_equals_a_simpler_one() -> None:
    model = ModelSubject.of(Hovercraft())
    dry, peaked, drag = (
        next(c for c in model.candidates(()) if c.name == name)
        for name in ("coulomb_friction", "stribeck_friction", "quadratic_drag")
    )
    at = {"coulomb_friction.force": 0.04, "quadratic_drag.coefficient": 0.3}
    same = {"stribeck_friction.force": 0.04, "stribeck_friction.static_force": 0.04}
    assert values_of_special_case(peaked, dry, at) == same
    assert values_of_special_case(dry, peaked, at) == {}
    assert values_of_special_case(peaked, drag, at) == {}
