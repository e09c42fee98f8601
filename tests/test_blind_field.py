"""The field half of the blind suite: its plants are what their model files say, its decks and sizes are as promised."""

from __future__ import annotations

import csv
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.fmi.building.file import load_model
from cosim.model import Model, Stepper
from tests.blind import field_score, field_study
from tests.blind.field_rig import Entry, Rig, Run, fly
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
    assert {p.name: p.default for p in model.parameters if p.tolerance is None} == rig.constants
    assert model.sensor_variance == pytest.approx({o: sigma**2 for o, sigma in rig.outputs.items()})
    assert {q.name: q.start for q in model.inputs} == rig.inputs
    assert {kind.name for kind in (*model.catalogue, *model.sensors)} == set(rig.entries)
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


# -- decks -------------------------------------------------------------------------------------------------


def test_two_hundred_seeds_deal_what_is_promised() -> None:
    assert Counter(d.kind for d in DEALS) == {"known": 110, "nothing": 50, "outside": 40}
    assert Counter(d.plant for d in DEALS) == dict.fromkeys(PLANTS, 40)
    assert Counter(d.disturbance for d in DEALS) == dict.fromkeys(DISTURBANCES, 100)
    numbers = Counter(d.effects for d in DEALS if d.kind == "known")
    assert sorted(numbers) == [1, 2, 3, 4]
    assert max(numbers.values()) - min(numbers.values()) <= 1


# -- logs --------------------------------------------------------------------------------------------------


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
