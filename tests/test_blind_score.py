"""Scoring of the blind suite, stability of its seeds, and the harness with a refiner that knows the true effects."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.blind import baseline, harness, score, truth
from tests.blind.field_rig import flat
from tests.blind.truth import BASE, SENSORS

RIGHT, IN_SET, WRONG, NONE = (True, True, False), (False, True, False), (False, False, True), (False, False, False)
OPEN = [{"name": "stribeck", "in_place_of": "coulomb"}]


def line(truth: str, verdict: str, names: str = "", rivals: str = "", **more: Any) -> score.Line:
    """A line of results of a known study, as the harness writes it; names are words, rivals between bars."""
    told = {"kind": "known", "plant": "cart", "truth": {n: {} for n in truth.split()}, "sensors": ["gyro_bias"]}
    found = {"effects": [{"name": n, "parameters": {}} for n in names.split()], "verdict": verdict}
    return told | found | {"rivals": rivals.split(" | ") if rivals else []} | more


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        (line("coulomb", "effect_found", "coulomb"), RIGHT),
        (line("coulomb backlash", "effect_found", "backlash coulomb", grade="claimed"), RIGHT),
        (line("gyro_bias", "sensor_error", "gyro_bias"), RIGHT),
        # the right name under the wrong verdict misleads nobody about the name, yet is not right
        (line("mass", "effect_found", "mass"), NONE),
        # one of two is neither right nor wrong; one too many is wrong
        (line("coulomb backlash", "effect_found", "coulomb"), NONE),
        (line("coulomb", "effect_found", "coulomb table_tilt"), WRONG),
        # a part that is the whole is said with less confidence than it could be: not right, not wrong
        (line("coulomb", "effect_found", "coulomb", grade="part"), NONE),
        (line("coulomb gyro_bias", "unexplained", "coulomb drag", grade="part"), WRONG),
        (line("coulomb", "unexplained", "drag", grade="nearest"), NONE),
        # sets
        (line("coulomb", "ambiguous", rivals="a | b | coulomb"), IN_SET),
        (line("coulomb", "ambiguous", rivals="a | b | c | coulomb"), NONE),
        (line("coulomb backlash", "ambiguous", rivals="backlash + coulomb | a + b | c"), IN_SET),
        (line("coulomb backlash", "ambiguous", "coulomb", "backlash | dead_band", grade="part"), IN_SET),
        (line("coulomb backlash", "ambiguous", rivals="coulomb | a"), NONE),
        # left open in place of the claim
        (line("stribeck", "effect_found", "coulomb", not_excluded=OPEN), IN_SET),
        (line("drag", "effect_found", "coulomb", not_excluded=OPEN), WRONG),
        (line("coulomb", "effect_found", "tilt", alike=[["tilt", "coulomb"]]), IN_SET),
        (line("coulomb", "failed"), NONE),
    ],
)
def test_known_studies_are_judged_by_what_is_claimed(case: score.Line, expected: tuple[bool, bool, bool]) -> None:
    assert (score.is_right(case), score.is_in_set(case), score.is_wrong(case)) == expected


@pytest.mark.parametrize(
    ("case", "named", "wrong"),
    [
        (line("drag delay", "effect_found", "drag friction"), {"drag"}, {"friction"}),
        # a part in one of few rivals is named, and no rival is wrong
        (line("drag delay", "ambiguous", rivals="drag + delay | friction + delay"), {"drag", "delay"}, set()),
        (line("drag", "ambiguous", rivals="drag | a | b | c"), set(), set()),
        # a stranger has no name
        (line("drag wind", "effect_found", "drag wind", strangers=["wind"]), {"drag"}, {"wind"}),
    ],
)
def test_studies_in_parts_are_judged_by_the_part(case: score.Line, named: set[str], wrong: set[str]) -> None:
    assert (score.named_parts(case), score.wrong_parts(case)) == (named, wrong)


def test_friction_of_the_arm_is_due_only_where_the_yardstick_halves_an_error() -> None:
    without = {"without": [2.0, 1.0]}
    cases = [line("coulomb_1", "unexplained", yardstick=without | {"with": left}) for left in ([0.9, 1.0], [1.5, 0.8])]
    assert score.counts(score.ARM, cases)["all_parts_named"] == (0, 1)


def test_wilson_intervals_are_those_of_the_literature() -> None:
    # Newcombe 1998, Statist. Med. 17:857, table I, method 3 (score, no continuity correction), to four digits
    assert score.wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert score.wilson(20, 20) == pytest.approx((1.0 - 0.1611, 1.0), abs=5e-5)


def test_seeds_draw_the_frozen_studies() -> None:
    for line in (line for line in harness.read(baseline.LINES).values() if line["suite"] in harness.QUICK):
        drawn = harness.QUICK[line["suite"]](line["seed"])
        same = {"kind", "plant", "way", "version", "size", "disturbance", "disturbed"} & drawn.keys() & line.keys()
        assert {key: drawn[key] for key in same} == {key: line[key] for key in same}
        if "truth" in drawn:  # of the field and of FMUs it takes seconds
            assert flat(drawn["truth"]) == pytest.approx(flat(line["truth"]), rel=1e-5)  # six digits are kept


def test_a_refiner_that_knows_everything_scores_everything(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(truth, "write", partial(truth.write, duration=1.0))  # logs that this refiner does not read
    turn = iter(range(20))

    def oracle(study: Path, out: Path) -> None:
        assert {p.name for p in study.parent.parent.rglob("*.*")} == {"study.yaml", "e1.csv", "e2.csv", "v1.csv"}
        answer = truth.draw(next(turn))
        names = answer.truth.keys()
        verdict = (
            "parameter_error" if names <= set(BASE) else "sensor_error" if names <= set(SENSORS) else "effect_found"
        )
        effects = [
            {"name": n, "parameters": {p: {"value": v, "ci95": [v - 1e-9, v + 1e-9]} for p, v in values.items()}}
            for n, values in answer.truth.items()
        ]
        if answer.kind != "known":
            verdict, effects = "no_effect" if answer.kind == "nothing" else "unexplained", []
        rmse = {"validation": {"psi": 1.0}}
        error = {"before": {"validation": {"psi": 9.0}}, "recalibrated": rmse, "after": rmse}
        found = {"verdict": verdict, "effects": effects, "noise_floor": {"psi": 1.0}, "error": error}
        (out / "refine.json").write_text(json.dumps(found))

    one, results = partial(harness.conduct_here, refiner=oracle, of_revision="abc"), tmp_path / "r.jsonl"
    assert harness.run([(score.LABORATORY, seed) for seed in range(20)], one, results) == 0
    figures = score.summary(score.LABORATORY, list(harness.read(results, "abc").values()))
    assert figures.pop("studies") == 20
    nought = ("wrong", "false_alarms", "outside_misnamed", "excess_left")
    assert figures == {name: 0.0 if name in nought else 1.0 for name in figures}
