"""What a refine claims: shared parts, claims that explain much, parts that no term replaces, the simplest model."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.linear_algebra import square_roots
from cosim.estimation.fit import Fit
from cosim.estimation.noise_model import Noise
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.refinement.decision.claims import (
    Claims,
    Doubt,
    Grade,
    Improvement,
    Rung,
    judge,
    name_of,
)
from cosim.refinement.proof.nearest import nearest
from cosim.refinement.proof.replay_check import check_claim, check_on_sealed_logs
from cosim.refinement.record import effects
from cosim.refinement.search.hypotheses import Attribution, Hypothesis, Support
from cosim.refinement.search.unnamed import Leftover, UnnamedTerm
from cosim.refinement.workflow import refine
from plant.hovercraft import Hovercraft
from tests.blind import arm

CRAFT = ModelSubject.of(Hovercraft())
CANDIDATES = {c.name: c for c in CRAFT.candidates(())}
FRICTION, DRAG, DAMPING, STRIBECK = "coulomb_friction", "quadratic_drag", "yaw_damping", "stribeck_friction"
NOISE = Noise(np.zeros(1), math.log(0.15), np.zeros(1), np.full(1, -np.inf))


def fitted(*names: str, score: float = -200.0, **values: float) -> Hypothesis:
    """A hypothesis whose parameters are 0.1, each known to 0.01."""
    parts = tuple(CANDIDATES[n] for n in names)
    free = tuple(f for c in parts for f in c.free)
    known = {f.name: values.get(c.name, 0.1) for c in parts for f in c.free}
    fit = Fit(known, NOISE, free, (0.0,), 0.0, 1e4 * np.eye(len(free)), 5, True)
    return Hypothesis(parts, fit, score)


def attribution(best: Hypothesis, *rivals: Hypothesis, ratios: tuple[float, ...] = (0.3, 0.4)) -> Attribution:
    base = Hypothesis((), replace(fitted().fit), 0.0)
    tried = (best, *rivals, fitted(FRICTION, score=-150.0), base)
    facts = base, base.fit, tried, best, rivals, Support(200.0, 9.0), {}, (1e9,)
    return Attribution(*facts, error_ratios=ratios)


def judged(a: Attribution, leftover: Leftover | None = None, move: float = 0.0) -> Claims:
    nothing = Leftover((), None, 0.0, 8.0)
    return judge(a, leftover or nothing, CRAFT, ["vx"], {"vx": move} if move else {}, still=False)


def test_beside_an_unknown_input_a_claim_must_halve_the_error() -> None:
    """However fine the sensors are, and so however large the gain of the unknown input is."""
    much, little = (judged(attribution(fitted(FRICTION), ratios=r), move=0.3) for r in ((0.4, 0.5), (0.6, 0.65)))
    assert (much.name, much.grade, much.disturbed) == ("effect_found", "part", "vx")
    assert (little.name, little.claimed, little.rivals) == ("unexplained", None, (FRICTION,))
    parameter = judged(attribution(fitted("mass"), ratios=(0.4, 0.5)), move=0.3)  # may stand for what is missing
    assert (parameter.name, parameter.claimed, parameter.rivals) == ("unexplained", None, ("mass",))


def test_a_term_that_does_not_lead_on_every_log_is_not_named() -> None:
    term = UnnamedTerm("vx", "vx", 30.0, 0.1, 30.0, 0.2)
    best = fitted(FRICTION)
    for is_stable in (True, False):
        claims = judged(attribution(best), Leftover((term,), best.fit, 30.0, 8.0, is_stable=is_stable))
        assert (claims.term is not None, claims.misfit["signals"]) == (is_stable, ["vx"] if is_stable else [])


def test_what_all_rivals_contain_is_claimed_with_an_interval_over_all_of_them() -> None:
    best, rival = fitted(FRICTION, DRAG), fitted(FRICTION, DAMPING, score=-199.0, coulomb_friction=0.15)
    a = attribution(best, rival)
    claims = judged(a)
    assert (claims.name, claims.grade) == ("ambiguous", "part")
    assert claims.claimed is not None
    (entry,) = effects(CRAFT, claims.claimed, a.tried, claims.claimed_candidates)
    assert entry.name == FRICTION
    low, high = entry.parameters["force"].ci95
    assert (low, high) == (pytest.approx(0.05 - 0.0196, abs=1e-4), pytest.approx(0.15 + 0.0196, abs=1e-4))
    apart = judged(attribution(fitted(DRAG), fitted(DAMPING, score=-199.0)))
    assert (apart.grade, apart.claimed_candidates) == ("nearest", ())


@pytest.mark.parametrize(
    ("names", "verdict"),
    [
        (("mass",), "parameter_error"),
        (("camera_latency",), "sensor_error"),
        (("camera_latency", "mass"), "sensor_error"),
        ((FRICTION, "mass", "gyro_bias"), "effect_found"),
    ],
)
def test_effect_found_needs_an_effect(names: tuple[str, ...], verdict: str) -> None:
    assert name_of([CANDIDATES[n] for n in names], CRAFT) == verdict


@pytest.mark.parametrize(
    ("after", "largest", "halves", "grade"),
    [
        (4.0, {}, False, "nearest"),
        (4.0, {"x": 3.9}, False, "nearest"),
        (4.0, {"x": 4.1}, False, "claimed"),  # a pendulum that passes its upright position
        (8.0, {"x": 9.0}, False, "nearest"),  # most of the excess remains
        (8.0, {"x": 9.0}, True, "part"),
    ],
)
def test_a_claim_is_not_judged_where_two_runs_of_the_model_differ_as_much(
    after: float, largest: dict[str, float], halves: bool, grade: Grade
) -> None:
    claims = Claims("effect_found", fitted(FRICTION), grade="claimed")
    errors = {"before": {"x": 10.0, "y": 10.0}, "after": {"x": after, "y": 1.2}}
    floor, support = {"x": 1.0, "y": 1.0}, {FRICTION: Support(64.0, 7.0, 60.0, -1.0)}
    checked = check_claim(claims, errors, floor, support, largest=largest, halves=halves)
    assert (checked.grade, checked.unjudged) == (grade, "x" if grade == "claimed" else "")
    assert grade != "nearest" or checked.doubt == Doubt("unsteady", names=(FRICTION,))


@pytest.mark.parametrize("doubt", ["kept", "no_nearer"])
def test_what_would_withdraw_a_claim_that_halves_the_error_leaves_a_part(doubt: str) -> None:
    claims = Claims("effect_found", fitted(FRICTION), grade="claimed")
    after = {"kept": 9.0, "no_nearer": 6.0}[doubt]
    errors = {"before": {"x": 10.0}, "recalibrated": {"x": 5.0}, "after": {"x": after}}
    alternative = "recalibrated" if doubt == "no_nearer" else ""
    checked = check_claim(claims, errors, {"x": 1.0}, largest={"x": 9.5}, alternative=alternative, halves=True)
    assert (checked.grade, checked.unjudged) == ("part", "")


def test_a_claim_that_halves_the_held_out_error_is_never_withdrawn() -> None:
    claims = Claims("effect_found", fitted(FRICTION), grade="claimed")
    before, after = {"x": 10.0}, {"x": 9.0}
    errors = {"before": before, "recalibrated": before, "after": after}
    assert check_claim(claims, errors, {"x": 1.0}, alternative="recalibrated").name == "unexplained"
    kept = check_claim(claims, errors, {"x": 1.0}, alternative="recalibrated", halves=True)
    assert (kept.name, kept.grade) == ("effect_found", "part")
    assert kept.part is not None
    assert kept.part.share == pytest.approx(80 / 99)


def test_a_claim_that_leaves_most_of_the_excess_error_of_a_sealed_channel_is_a_part() -> None:
    claims = Claims("effect_found", fitted(FRICTION), grade="claimed", written=False)
    floor = {"x": 1.0, "y": 1.0}
    held = replace(claims, improvement=Improvement({"x": 48 / 99, "y": 0.0, "without a floor": 1.0}, "recalibrated"))
    assert check_on_sealed_logs(held, floor) is held
    part = check_on_sealed_logs(
        replace(claims, improvement=Improvement({"x": 63 / 99, "y": 0.0}, "recalibrated")), floor
    )
    assert (part.name, part.grade, part.nearest_hypothesis) == ("effect_found", "part", claims.claimed)
    assert part.part is not None
    assert part.part.share == pytest.approx(63 / 99)
    disputed = replace(claims, name="ambiguous", grade="part", improvement=Improvement({"x": 143 / 99}, "recalibrated"))
    assert check_on_sealed_logs(disputed, floor) is disputed


def test_the_error_ratio_is_the_mean_over_the_logs_and_each_log_has_to_improve() -> None:
    ratios = {(0.4, 0.6): True, (0.1, 1.1): False, (0.6, 0.6): False, (): False}
    assert {logs: attribution(fitted(FRICTION), ratios=logs).halves_error for logs in ratios} == ratios


def test_square_roots_of_covariances_exist_for_singular_and_diverged_ones_too() -> None:
    singular = np.array([[4.0, 2.0], [2.0, 1.0]])
    roots = square_roots(np.stack([singular, np.full((2, 2), np.nan)]))
    np.testing.assert_allclose(roots @ roots.transpose(0, 2, 1), np.stack([singular, np.zeros((2, 2))]), atol=1e-12)


@pytest.mark.thorough
def test_friction_of_an_arm_is_claimed_beside_what_no_catalogue_has(tmp_path: Path) -> None:
    """Fine encoders on an unstable plant, an elastic belt and torque ripple; the yardstick is a least-squares fit."""
    study = arm.draw(3)
    told: Any = refine(arm.write(study, tmp_path / "study"), tmp_path / "out").record
    assert (told["verdict"], told["grade"]) == ("effect_found", "part")
    found = {e["name"]: e["parameters"]["level"]["value"] for e in told["effects"]}
    assert found.keys() == study.truth.keys()
    for name, values in study.truth.items():
        assert found[name] == pytest.approx(values["level"], rel=0.1)
    errors, floor = told["error"], told["noise_floor"]
    for channel, before in errors["before"]["validation"].items():
        assert errors["after"]["validation"][channel] < 0.15 * before
        assert floor[channel] < before


def test_the_simplest_model_within_a_standard_error_of_the_best_is_the_nearest() -> None:
    one, two = fitted(FRICTION), fitted(FRICTION, DRAG)
    rungs = [
        Rung(None, np.array([0.0, 0.0, 0.0])),
        Rung(replace(fitted(), candidates=()), np.array([-0.2, -0.3, -0.2])),
        Rung(one, np.array([-1.0, -1.1, -1.05])),
        Rung(two, np.array([-1.06, -1.05, -1.09])),
    ]
    assert nearest(rungs) is one
    assert nearest([*rungs[:2], rungs[3]]) is two
