"""The field half of the blind suite: its plants are what their model files say, its decks and sizes are as promised."""

from __future__ import annotations

import csv
import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.loading.file import load_model
from cosim.model import Model, Stepper
from tests.blind import field_score, field_study, harness
from tests.blind.field_craft import CraftRig
from tests.blind.field_rig import Entry, Floats, Rig, Run, fly
from tests.blind.field_study import (
    DISTURBANCES,
    PLANTS,
    RIGS,
    deal,
    draw,
    rows_to_keep,
)
from tests.blind.field_visibility import plain
from tests.blind.field_write import recorded, true_error, write
from tests.blind.truth_craft import STATES, Craft, Dynamics

FOLDER = Path(field_study.__file__).with_name("plants")
OWN = [name for name in PLANTS if name != "craft"]
DEALS = [deal(seed) for seed in range(200)]


def first(kind: str, plant: str = "", effects: int | None = None) -> int:
    """The first seed of a kind."""
    fits = (d for d in DEALS if d.kind == kind and plant in ("", d.plant) and effects in (None, d.effects))
    return next(fits).seed


def model_of(rig: Rig) -> Model:
    return load_model(f"{rig.name}.py:{rig.model}", FOLDER).model


def typical(entry: Entry) -> dict[str, float]:
    """Parameters in the middle of what is plausible: well visible."""
    return entry.at(entry.unit(np.random.default_rng(0)), math.sqrt(math.prod(entry.limits)))


def still(rig: Rig, rows: int) -> Run:
    commands = rig.drive(np.random.default_rng(5))[100 : 100 + rows]
    return Run(np.arange(rows) * rig.step, commands, np.zeros((rows, len(rig.pushes))), rig.begin(_moving()))


def _moving() -> np.random.Generator:
    return np.random.default_rng(8)


# -- plants ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", OWN)
def test_a_model_file_states_what_its_truth_is_drawn_from(name: str) -> None:
    rig, model = RIGS[name], model_of(RIGS[name])
    stated = {p.name: (p.default, p.tolerance) for p in model.parameters if p.tolerance is not None}
    assert stated == rig.sheet
    assert set(model.calibrated) == set(rig.sheet)
    assert 3 <= len(rig.sheet) <= 6
    assert all(0.02 <= share <= 0.3 for _, share in rig.sheet.values())
    assert {p.name: p.default for p in model.parameters if p.tolerance is None} == rig.constants
    assert model.sensor_variance == pytest.approx({o: sigma**2 for o, sigma in rig.outputs.items()})
    assert {q.name: q.start for q in model.inputs} == rig.inputs
    assert {q.name for q in model.base_states} == set(rig.states)
    assert (model.rate, model.horizon) == (rig.step, rig.horizon)
    assert 1500 <= rig.rows <= 4000
    assert 8 <= len(model.catalogue) <= 12
    assert {kind.name for kind in (*model.catalogue, *model.sensors)} == set(rig.entries)
    assert {kind.name for kind in model.sensors} == set(rig.sensors)
    assert {"bias", "scale", "late"} == {sensor.kind for sensor in rig.sensors.values()}
    assert len(rig.outside) >= 4
    assert not set(rig.outside) & set(rig.entries)


CASES = [(name, effect) for name in OWN for effect in ["base", *(set(RIGS[name].entries) - set(RIGS[name].sensors))]]


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "effect"), sorted(CASES))
def test_truth_and_model_file_are_the_same_plant(name: str, effect: str) -> None:
    rig, rows = RIGS[name], 80
    truth = {} if effect == "base" else {effect: typical(rig.entries[effect])}
    base = {n: value * (1.0 + 0.3 * share) for n, (value, share) in rig.sheet.items()}
    run = still(rig, rows)
    truly = fly(rig, rig.numbers(base, truth), run, tolerance=1e-10)
    model = model_of(rig)
    # fine enough that the kinks of dry friction, and a delay between two substeps, cost a sensor nothing
    finer = type("Finer", (type(model),), {"substep": rig.step / 16.0})()
    flat = {f"{n}.{p}": v for n, parameters in truth.items() for p, v in parameters.items()}
    stepper = Stepper(finer.with_values(base | flat))
    moment = stepper.start(0.0, dict(zip((q.name for q in stepper.model.states), truly.states[0], strict=True)))
    names = [q.name for q in model.outputs]
    for k, command in enumerate(map(tuple, run.commands)):
        found = dict(zip(names, stepper.output(moment.t, moment.state, command), strict=True))
        off = [(found[o] - r) / sigma for (o, sigma), r in zip(rig.outputs.items(), truly.readings[k], strict=True)]
        assert np.max(np.abs(off)) < 1e-2, (k, off)
        moment = stepper.step(moment, command, rig.step)


@pytest.mark.parametrize("effect", ["base", *sorted(set(CraftRig.entries) - set(CraftRig.sensors))])
def test_the_crafts_equations_on_arrays_are_the_laboratorys(effect: str) -> None:
    rig = RIGS["craft"]
    truth = {} if effect == "base" else {effect: typical(rig.entries[effect])}
    base = {n: value * (1.0 - 0.4 * share) for n, (value, share) in rig.sheet.items()}
    dynamics = Dynamics(Craft(base=base, effects=truth))
    dynamics.command, dynamics.disturbance = (6.4, 6.35, 0.12, -0.1), (1e-3, -2e-3, 1e-4)
    x = np.array([0.1, -0.2, 0.7, 0.3, -0.1, 0.4, 0.01, 0.1, 1.9, 2.1, 0.05, -0.03])
    whole = np.zeros(len(STATES))
    places = [STATES.index(name) for name in rig.states]
    whole[places] = x
    rate, look = rig.bind(Floats, rig.numbers(base, truth))
    assert rate(2.0, x.tolist(), dynamics.command, dynamics.disturbance) == pytest.approx(
        np.array(dynamics.derivative(2.0, whole))[places].tolist(), rel=1e-9, abs=1e-9
    )
    outputs = dynamics.outputs(2.0, whole)
    assert look(2.0, x.tolist(), dynamics.disturbance) == pytest.approx([outputs[o] for o in rig.outputs], rel=1e-9)


# -- decks -------------------------------------------------------------------------------------------------


def test_two_hundred_seeds_deal_what_is_promised() -> None:
    assert Counter(d.kind for d in DEALS) == {"known": 110, "nothing": 50, "outside": 40}
    assert Counter(d.plant for d in DEALS) == dict.fromkeys(PLANTS, 40)
    assert Counter(d.disturbance for d in DEALS) == dict.fromkeys(DISTURBANCES, 100)
    numbers = Counter(d.effects for d in DEALS if d.kind == "known")
    assert sorted(numbers) == [1, 2, 3, 4]
    assert max(numbers.values()) - min(numbers.values()) <= 1


# -- sizes -------------------------------------------------------------------------------------------------


# -- recorder ----------------------------------------------------------------------------------------------


# -- logs --------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_the_same_seed_writes_the_same_bytes(tmp_path: Path) -> None:
    seed = first("outside", "tanks")
    one, other = draw(seed), draw(seed)
    assert one == other
    for study, folder in ((one, "a"), (other, "b")):
        write(study, tmp_path / folder)
    for path in sorted((tmp_path / "a").iterdir()):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


@pytest.mark.thorough
@pytest.mark.parametrize("plant", PLANTS)
def test_a_folder_holds_the_logs_and_nothing_of_the_answer(tmp_path: Path, plant: str) -> None:
    study = draw(first("nothing", plant))
    path = write(study, tmp_path)
    own = set() if plant == "craft" else {f"{plant}.py"}
    assert {p.name for p in tmp_path.iterdir()} == {"study.yaml", "e1.csv", "e2.csv", "v1.csv"} | own
    assert ("tolerance: {mass: 0.1, izz: 0.2," in path.read_text()) is (plant == "craft")
    _, _, table = recorded(study, 2)
    with (tmp_path / "v1.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["time", *study.rig.inputs, *study.rig.outputs]
    there = rows_to_keep(study, 2).any(axis=1) if study.recorder.whole_rows else np.ones(len(table), bool)
    assert len(rows) == np.sum(there)
    # seven digits are logged
    logged = [[float(row[o] or "nan") for o in study.rig.outputs] for row in rows]
    assert np.array(logged) == pytest.approx(table[there], rel=1e-6, nan_ok=True)


@pytest.mark.thorough
@pytest.mark.parametrize("plant", PLANTS)
def test_without_disturbance_the_true_model_errs_by_its_sensors_noise(
    plant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(DISTURBANCES, "small", 0.0)
    study = plain(plant, {}, seed=3)
    sigma = study.rig.outputs
    # 1500 cells tell a deviation to 2 %; four of them
    assert true_error(study) == pytest.approx(sigma, rel=0.08)


# -- counting ----------------------------------------------------------------------------------------------

COULOMB, PAIR = {"cart_coulomb": {"level": 0.1}}, {"cart_coulomb": {"level": 0.1}, "gyro_bias": {"value": 0.01}}
OPEN = [{"name": "cart_stribeck", "in_place_of": "cart_coulomb"}]


def line(kind: str, truth: dict[str, Any], verdict: str, *names: str, **more: Any) -> dict[str, Any]:
    effects = [{"name": n, "parameters": {}} for n in names]
    told = {"kind": kind, "truth": truth, "verdict": verdict, "effects": effects, "rivals": [], "plant": "cart"}
    return told | {"sensors": ["gyro_bias"], "disturbance": "small", "seconds": 1.0} | more


def judged(case: dict[str, Any]) -> tuple[bool, bool, bool]:
    return field_score.is_right(case), field_score.is_in_set(case), field_score.is_wrong(case)


RIGHT, IN_SET, WRONG, NONE = (True, True, False), (False, True, False), (False, False, True), (False, False, False)


@pytest.mark.parametrize(
    ("truth", "verdict", "names", "more", "expected"),
    [
        (COULOMB, "effect_found", ["cart_coulomb"], {}, RIGHT),
        (PAIR, "effect_found", ["gyro_bias", "cart_coulomb"], {"grade": "claimed"}, RIGHT),
        ({"gyro_bias": {"value": 0.1}}, "sensor_error", ["gyro_bias"], {}, RIGHT),
        (COULOMB, "parameter_error", ["cart_mass"], {}, WRONG),
        (PAIR, "effect_found", ["cart_coulomb"], {"grade": "part"}, NONE),
        # a part that is the whole is said with less confidence than it could be: not right, not wrong
        (COULOMB, "effect_found", ["cart_coulomb"], {"grade": "part"}, NONE),
        (PAIR, "unexplained", ["cart_coulomb", "bob_drag"], {"grade": "part"}, WRONG),
        (COULOMB, "unexplained", ["bob_drag"], {"grade": "nearest"}, NONE),
        (COULOMB, "effect_found", ["cart_coulomb"], {"grade": "nearest"}, NONE),
        (COULOMB, "ambiguous", [], {"rivals": ["cart_coulomb", "cart_drag"]}, IN_SET),
        (COULOMB, "ambiguous", [], {"rivals": ["a", "b", "c", "cart_coulomb"]}, NONE),
        (PAIR, "ambiguous", ["gyro_bias"], {"rivals": ["cart_coulomb", "cart_drag"], "grade": "part"}, IN_SET),
        (COULOMB, "failed", [], {}, NONE),
        ({"cart_stribeck": {}}, "effect_found", ["cart_coulomb"], {}, WRONG),
        ({"cart_stribeck": {}}, "effect_found", ["cart_coulomb"], {"not_excluded": OPEN}, IN_SET),
        ({"cart_drag": {}}, "effect_found", ["cart_coulomb"], {"not_excluded": OPEN}, WRONG),
        (COULOMB, "effect_found", ["cart_coulomb"], {"not_excluded": OPEN}, RIGHT),
        (COULOMB, "effect_found", ["tilt"], {"alike": [["tilt", "cart_coulomb"]]}, IN_SET),
        (COULOMB, "effect_found", ["bob_drag"], {"alike": [["tilt", "cart_coulomb"]]}, WRONG),
    ],
)
def test_known_studies_are_judged_by_what_is_claimed(
    truth: dict[str, Any], verdict: str, names: list[str], more: dict[str, Any], expected: tuple[bool, bool, bool]
) -> None:
    assert judged(line("known", truth, verdict, *names, **more)) == expected


@pytest.mark.parametrize(
    ("verdict", "grade", "alarm", "flagged", "misnamed"),
    [
        ("no_effect", "", False, False, False),
        ("unexplained", "nearest", False, True, False),
        ("unexplained", "part", True, False, True),
        ("effect_found", "claimed", True, False, True),
        ("effect_found", "", True, False, True),
        ("ambiguous", "", True, True, False),
        ("failed", "", False, False, False),
    ],
)
def test_nothing_and_outside_are_judged_by_names_put_forward(
    verdict: str, grade: str, alarm: bool, flagged: bool, misnamed: bool
) -> None:
    assert field_score.is_false_alarm(line("nothing", {}, verdict, "bob_drag", grade=grade)) is alarm
    outside = line("outside", {"magnet": {}}, verdict, "bob_drag", grade=grade)
    assert (field_score.is_flagged(outside), field_score.is_misnamed(outside)) == (flagged, misnamed)
    assert not field_score.is_misnamed(line("outside", {"bob_drag": {}}, verdict, "bob_drag", grade=grade))


def test_the_sealed_ratio_is_of_the_claim_or_else_of_what_is_nearest() -> None:
    errors = {
        "error": {"after": {"a": 2.0, "b": 6.0}, "nearest": {"a": 1.0, "b": 2.0}},
        "error_true": {"a": 1.0, "b": 2.0},
    }
    assert field_score.sealed_ratio(line("known", COULOMB, "effect_found", **errors)) == pytest.approx(2.5)
    assert field_score.sealed_ratio(line("known", COULOMB, "unexplained", **errors)) == pytest.approx(1.0)
    del errors["error"]["nearest"]
    assert field_score.sealed_ratio(line("known", COULOMB, "unexplained", **errors)) == pytest.approx(2.5)
    assert field_score.sealed_ratio(line("known", COULOMB, "failed")) == math.inf


def test_the_summary_counts_each_figure_among_its_own_studies() -> None:
    errors = {"error": {"after": {"a": 2.0}}, "error_true": {"a": 1.0}}
    claim = [{"name": "cart_coulomb", "parameters": {"level": {"ci95": [0.0, 0.2]}}}]
    lines = [
        line("known", COULOMB, "effect_found", **errors) | {"effects": claim},
        line("known", PAIR, "effect_found", "cart_drag", disturbance="large", **errors),
        line("known", PAIR, "failed"),
        line("nothing", {}, "no_effect"),
        line("nothing", {}, "unexplained", seconds=3.0),
        line("outside", {"magnet": {}}, "unexplained"),
    ]
    found = field_score.summary(lines)
    assert found["by_effects"] == {
        "1": {"studies": 1, "right": 1.0, "in_set": 1.0, "wrong": 0.0},
        "2": {"studies": 2, "right": 0.0, "in_set": 0.0, "wrong": 0.5},
    }
    del found["by_effects"]
    assert found == {
        "studies": 6,
        "right": 0.3333,
        "in_set": 0.3333,
        "wrong": 0.3333,
        "false_alarms": 0.0,
        "no_effect": 0.5,
        "outside_flagged": 1.0,
        "outside_misnamed": 0.0,
        "coverage": 1.0,
        "coverage_disturbed_small": 1.0,
        "coverage_disturbed_large": None,
        "sealed_ratio_median": 2.0,
        "sealed_ratio_90": None,  # the failed one's is infinite
        "seconds_median": 1.0,
        "seconds_95": 3.0,
    }
    assert "cart: cart_coulomb" in field_score.table(lines)


# -- harness -----------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_both_halves_are_run_and_the_fields_figures_stand_under_field(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def pretender(study: Path, out: Path) -> None:
        with (study.parent / "v1.csv").open() as file:
            channels = csv.DictReader(file).fieldnames or []
        rmse = {"validation": dict.fromkeys(channels, 1.0)}
        found = {"verdict": "unexplained", "effects": [], "noise_floor": rmse["validation"], "grade": "nearest"}
        stages = ("before", "recalibrated", "after", "nearest")
        (out / "refine.json").write_text(json.dumps(found | {"error": dict.fromkeys(stages, rmse)}))

    monkeypatch.setattr(harness, "command_refiner", lambda *_: pretender)
    results = tmp_path / "r.jsonl"
    assert harness.main(["1", "--only", "nothing", "--results", str(results)]) == 0
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert figures["studies"] == figures["field"]["studies"] == 1
    assert (figures["field"]["no_effect"], figures["field"]["false_alarms"]) == (0.0, 0.0)
    lines = [json.loads(text) for text in results.read_text().splitlines()]
    assert [entry.get("half", "laboratory") for entry in lines] == ["laboratory", "field"]
    assert {"plant", "faults", "disturbance", "grade", "costs", "base", "error_true"} <= lines[1].keys()
    assert "nearest" in lines[1]["error"]
    assert set(harness.read(results, lines[1]["revision"], "field")) == {lines[1]["seed"]}
    assert harness.main(["1", "--half", "field", "--only", "nothing", "--results", str(results)]) == 0
    assert list(json.loads(capsys.readouterr().out.splitlines()[-1])) == ["field"]
