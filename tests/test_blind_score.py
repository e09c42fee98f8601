"""How the blind suite counts, on cases made by hand, and the harness with refiners that only pretend."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.blind import harness, score
from tests.blind.truth import draw, write
from tests.blind.truth_study import BASE, SENSORS

COULOMB = {"coulomb_friction": {"force": 0.05}}
PAIR = COULOMB | {"servo_backlash": {"width": 0.02}}


def line(kind: str, truth: dict[str, dict[str, float]], verdict: str, *names: str, **more: Any) -> dict[str, Any]:
    effects = [{"name": n, "parameters": {}} for n in names]
    return {
        "kind": kind,
        "truth": truth,
        "disturbed": False,
        "verdict": verdict,
        "effects": effects,
        "rivals": [],
    } | more


known = partial(line, "known")


def judged(case: dict[str, Any]) -> tuple[bool, bool, bool]:
    return score.is_right(case), score.is_in_set(case), score.is_wrong(case)


RIGHT, IN_SET, WRONG, NONE = (True, True, False), (False, True, False), (False, False, True), (False, False, False)


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        (known(COULOMB, "effect_found", "coulomb_friction"), RIGHT),
        (known(PAIR, "effect_found", "servo_backlash", "coulomb_friction"), RIGHT),
        (known({"mass": {"value": 0.9}}, "parameter_error", "mass"), RIGHT),
        (known({"gyro_bias": {"value": 0.02}}, "sensor_error", "gyro_bias"), RIGHT),
        # the right name under the wrong verdict misleads nobody about the name, yet is not right
        (known({"mass": {"value": 0.9}}, "effect_found", "mass"), NONE),
        # one of two is neither right nor wrong; one too many is wrong
        (known(PAIR, "effect_found", "coulomb_friction"), NONE),
        (known(COULOMB, "effect_found", "coulomb_friction", "table_tilt"), WRONG),
        (known(COULOMB, "effect_found", "quadratic_drag"), WRONG),
        (known(COULOMB, "parameter_error", "friction"), WRONG),
        # sets
        (known(COULOMB, "ambiguous", rivals=["coulomb_friction", "stribeck_friction"]), IN_SET),
        (known(COULOMB, "ambiguous", rivals=["a", "b", "coulomb_friction"]), IN_SET),
        (known(COULOMB, "ambiguous", rivals=["a", "b", "c", "coulomb_friction"]), NONE),
        (known(COULOMB, "ambiguous", rivals=["a", "b"]), NONE),
        (known(PAIR, "ambiguous", rivals=["servo_backlash + coulomb_friction", "a + b", "c"]), IN_SET),
        (known(PAIR, "ambiguous", "coulomb_friction", rivals=["servo_backlash", "servo_dead_band"]), IN_SET),
        (known(PAIR, "ambiguous", rivals=["coulomb_friction", "a"]), NONE),
        # abstaining and failing
        (known(COULOMB, "unexplained"), NONE),
        (known(COULOMB, "no_effect"), NONE),
        (known(COULOMB, "failed"), NONE),
    ],
)
def test_known_studies_are_judged_by_names(case: dict[str, Any], expected: tuple[bool, bool, bool]) -> None:
    assert judged(case) == expected


@pytest.mark.parametrize(
    ("hits", "of", "low", "high"),
    [  # Newcombe 1998, Statist. Med. 17:857, table I, method 3 (score, no continuity correction)
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_intervals_are_those_of_the_literature(hits: int, of: int, low: float, high: float) -> None:
    # the table is printed to four digits
    assert score.wilson(hits, of) == pytest.approx((low, high), abs=5e-5)
    assert score.wilson(of - hits, of) == pytest.approx((1.0 - high, 1.0 - low), abs=5e-5)


# -- harness -------------------------------------------------------------------------------


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Logs of a second: the pretenders here do not read them."""
    monkeypatch.setattr(harness, "write", partial(write, duration=1.0))


def verdict_file(out: Path, verdict: str, effects: list[dict[str, Any]]) -> None:
    rmse = {"validation": {"psi": 1.0}, "estimation": {"psi": 1.0}}
    found = {"verdict": verdict, "effects": effects, "noise_floor": {"psi": 1.0}}
    error = {"before": {"validation": {"psi": 9.0}}, "recalibrated": rmse, "after": rmse}
    (out / "refine.json").write_text(json.dumps(found | {"error": error}))


def test_a_refiner_that_knows_everything_scores_everything(short: None, tmp_path: Path) -> None:
    turn = iter(range(20))

    def oracle(study: Path, out: Path) -> None:
        assert not list(study.parent.parent.rglob("answer*"))
        answer = draw(next(turn))
        if answer.kind != "known":
            return verdict_file(out, "no_effect" if answer.kind == "nothing" else "unexplained", [])
        names = answer.truth.keys()
        kind = "parameter_error" if names <= set(BASE) else "sensor_error" if names <= set(SENSORS) else "effect_found"
        effects = [
            {"name": n, "parameters": {p: {"value": v, "ci95": [v - 1e-9, v + 1e-9]} for p, v in values.items()}}
            for n, values in answer.truth.items()
        ]
        return verdict_file(out, kind, effects)

    lines = harness.run(range(20), oracle, tmp_path / "r.jsonl", "abc")
    figures = score.summary(lines)
    assert figures.pop("studies") == 20
    nought = ("wrong", "false_alarms", "outside_misnamed", "excess_left")
    assert figures == {name: 0.0 if name in nought else 1.0 for name in figures}
