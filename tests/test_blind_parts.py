"""The arm and the mixed studies of the blind suite: sheet of the arm, drawn studies, and what counts as named."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.model.quantities import parameters_of
from tests.blind import arm, parts
from tests.blind.plants.arm import Arm


def test_the_drawn_arm_has_the_numbers_and_tolerances_of_its_model() -> None:
    declared = {p.name: (p.default, p.tolerance) for p in parameters_of(Arm) if p.name in arm.SHEET}
    assert declared == arm.SHEET
    levels = {f"{name}.level" for name in arm.FRICTION}
    assert levels <= {f"{e.name}.{p.name}" for e in Arm.catalogue for p in parameters_of(e)}


@pytest.mark.parametrize("seed", [0, 5])
def test_an_arm_at_rest_on_its_own_torques_stays_there(seed: int) -> None:
    study = arm.draw(seed)
    p = study.base
    q1, q2 = 0.4, -0.7
    lower = p["gravity_2"] * np.cos(q1 + q2)
    smooth = arm.ArmStudy(seed, study.truth, p, study.stiffness, (0.0, 12.0, 0.0), (1.0, 1.0))
    motor = q2 + lower / study.stiffness  # the belt carries the weight of link 2
    slopes = arm._elastic(
        smooth, np.array([q1, motor, q2, 0.0, 0.0, 0.0]), [p["gravity_1"] * np.cos(q1) + lower, lower]
    )
    np.testing.assert_allclose(slopes, 0.0, atol=1e-10)


def line(truth: list[str], verdict: str, names: list[str], **more: object) -> parts.Line:
    """A line of results, as the harness writes it."""
    effects = [{"name": n} for n in names] if verdict != "ambiguous" else []
    return {
        "plant": "cart", "kind": "known", "truth": {n: {} for n in truth}, "verdict": verdict, "effects": effects,
        "rivals": names if verdict == "ambiguous" else [], "base": {}, "strangers": [], "grade": "claimed",
    } | more  # fmt: skip


def test_a_claim_names_its_parts_and_a_foreign_name_is_wrong() -> None:
    done = line(["drag", "delay"], "effect_found", ["drag", "friction"])
    assert parts.named_parts(done) == {"drag"}
    assert parts.wrong_parts(done) == {"friction"}


def test_a_part_in_one_of_few_rivals_is_named_and_no_rival_is_wrong() -> None:
    done = line(["drag", "delay"], "ambiguous", ["drag + delay", "friction + delay"])
    assert parts.named_parts(done) == {"drag", "delay"}
    assert parts.wrong_parts(done) == set()
    many = line(["drag"], "ambiguous", ["drag", "a", "b", "c"])
    assert parts.named_parts(many) == set()


def test_friction_is_due_only_where_the_yardstick_halves_an_error() -> None:
    due = line(["coulomb_1"], "unexplained", [], yardstick={"without": [2.0, 1.0], "with": [0.9, 1.0]})
    small = line(["coulomb_1"], "unexplained", [], yardstick={"without": [2.0, 1.0], "with": [1.5, 0.8]})
    assert parts.counts([due, small])["all_parts_named"] == (0, 1)
