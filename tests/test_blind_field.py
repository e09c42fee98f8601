"""The field half of the blind suite: its plants are what their model files say, its decks and sizes are as promised."""

from __future__ import annotations

import ast
import csv
import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.loading.file import load_model
from cosim.model import Model, Stepper
from tests.blind import field_score, field_study, harness
from tests.blind.field_cost import Conditions, costs, remaining
from tests.blind.field_craft import CraftRig
from tests.blind.field_recorder import FAULTS, Recorder
from tests.blind.field_rig import Arrays, Entry, Floats, Rig, Run, coloured, fly, manoeuvre
from tests.blind.field_study import (
    DISTURBANCES,
    LEAST,
    PLANTS,
    RIGS,
    Study,
    conditions,
    course,
    deal,
    draw,
    rows_to_keep,
)
from tests.blind.field_visibility import middling, mimics, plain
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


@pytest.mark.parametrize("name", OWN)
def test_equations_say_the_same_of_floats_and_of_arrays(name: str) -> None:
    rig = RIGS[name]
    every = {**rig.entries, **rig.outside}
    p = rig.numbers({}, {n: typical(entry) for n, entry in every.items()})
    names = set(every)
    x = 0.3 * rig.scales(names) * np.random.default_rng(2).uniform(0.5, 1.0, rig.scales(names).size)
    u, push = list(rig.inputs.values()), [0.0] * len(rig.pushes)
    one, many = rig.bind(Floats, p), rig.bind(Arrays, p)
    columns = np.repeat(x[:, None], 3, axis=1)
    for single, several in ((one[0](1.3, x.tolist(), u, push), many[0](1.3, columns, u, push)),):
        assert [np.max(np.abs(np.asarray(b) - a)) for a, b in zip(single, several, strict=True)] == pytest.approx(
            [0.0] * len(single), abs=1e-9 * max(map(abs, single))
        )
    assert one[1](1.3, x.tolist(), push) == pytest.approx([float(np.ravel(v)[0]) for v in many[1](1.3, columns, push)])


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


def test_a_late_sensor_shows_what_was_there_and_a_scale_comes_before_a_bias() -> None:
    rig = RIGS["drive_train"]
    run = still(rig, 200)
    errors = {"load_latency": {"value": 0.01}, "tacho_scale": {"value": 1.1}, "tacho_bias": {"value": 0.2}}
    right, wrong = (fly(rig, rig.numbers({}, truth), run).readings for truth in ({}, errors))
    assert wrong[2:, 2] == pytest.approx(right[:-2, 2], abs=1e-6)  # two rows late; the integration's tolerance
    assert wrong[:, 1] == pytest.approx(1.1 * right[:, 1] + 0.2, abs=1e-6)
    assert wrong[:, 0] == pytest.approx(right[:, 0], abs=1e-6)


def test_the_truths_import_nothing_of_the_project() -> None:
    for path in Path(field_study.__file__).parent.glob("field_*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            modules = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            modules += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {m.split(".")[0] for m in modules} & {"plant", "controller", "fmus", "cosim"}, path.name


def test_manoeuvres_use_the_whole_range_and_stay_within_it() -> None:
    values = manoeuvre(np.random.default_rng(3), 3000, 0.005, (-2.0, 4.0), (0.05, 1.5))
    assert (values.min(), values.max()) == (-2.0, 4.0)
    samples = coloured(np.random.default_rng(5), 100_000, [2.0], 0.1, 1.0)
    # 10⁴ s of a 1 s correlation are 5000 independent squares: 2 % of a variance; four of them
    assert samples.var() == pytest.approx(4.0, rel=0.08)
    assert np.corrcoef(samples[10:, 0], samples[:-10, 0])[0, 1] == pytest.approx(math.exp(-1.0), abs=0.06)


# -- decks -------------------------------------------------------------------------------------------------


def test_two_hundred_seeds_deal_what_is_promised() -> None:
    assert Counter(d.kind for d in DEALS) == {"known": 110, "nothing": 50, "outside": 40}
    assert Counter(d.plant for d in DEALS) == dict.fromkeys(PLANTS, 40)
    assert Counter(d.disturbance for d in DEALS) == dict.fromkeys(DISTURBANCES, 100)
    numbers = Counter(d.effects for d in DEALS if d.kind == "known")
    assert sorted(numbers) == [1, 2, 3, 4]
    assert max(numbers.values()) - min(numbers.values()) <= 1


@pytest.mark.parametrize("begin", range(0, 200, 20))
def test_any_twenty_seeds_are_eleven_known_five_nothing_four_outside(begin: int) -> None:
    kinds = Counter(deal(seed).kind for seed in range(begin, begin + 20))
    assert kinds == {"known": 11, "nothing": 5, "outside": 4}
    assert {deal(seed).plant for seed in range(begin + 3, begin + 8)} == set(PLANTS)


def test_base_numbers_are_all_off_and_within_their_tolerances() -> None:
    for plant, rig in RIGS.items():
        drawn = [field_study.base_numbers(rig, np.random.default_rng(n)) for n in range(200)]
        for name, (value, share) in rig.sheet.items():
            off = np.array([one[name] / value - 1.0 for one in drawn])
            assert np.all(np.abs(off) <= share), plant
            # of a normal truncated at two deviations the deviation is 0.88 of it; 200 draws tell it to 5 %
            assert np.std(off) == pytest.approx(0.44 * share, rel=0.2)
            assert np.all(off != 0.0)


def test_names_of_one_family_are_never_dealt_together() -> None:
    for rig in RIGS.values():
        for n in range(50):
            names = set(field_study.names_of(rig, np.random.default_rng(n), 4))
            assert len(names) == 4
            assert all(len(family & names) <= 1 for family in rig.families)


# -- sizes -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["tanks", "drive_train"])
def sized(request: pytest.FixtureRequest) -> Study:
    return draw(first("known", request.param))


@pytest.mark.thorough
def test_left_out_of_the_true_model_each_effect_costs_what_is_said_and_enough(sized: Study) -> None:
    again = costs(sized.rig, sized.base, sized.truth, conditions(sized))
    assert again == pytest.approx(sized.costs)
    assert set(again) == set(sized.truth)
    assert min(again.values()) >= LEAST


def test_what_others_can_take_over_costs_nothing_but_their_prior() -> None:
    e = np.eye(3)
    # a change of 3 along a free direction is taken over; of one with a prior, ½·(3 − b)² + ½·b² is least at b = 1.5
    assert remaining(3.0 * e[0], e[:, :1], 0) == pytest.approx(0.0, abs=1e-12)
    assert remaining(3.0 * e[0], e[:, :1], 1) == pytest.approx(4.5)
    assert remaining(3.0 * e[0] + 2.0 * e[1], e[:, :1], 0) == pytest.approx(4.0)


@pytest.mark.thorough
def test_a_bias_costs_less_than_on_paper_and_nothing_where_nobody_reads() -> None:
    # N readings of noise σ are worth N·b²/2σ² against a bias b, were nothing else unknown
    rig = RIGS["tanks"]
    study = plain("tanks", {"meter_bias": {"value": 1e-7}})
    given = conditions(study)
    cost = costs(rig, study.base, study.truth, given)["meter_bias"]
    on_paper = 0.5 * 2 * rig.rows * (1e-7 / 1e-6) ** 2
    assert 0.0 < cost < on_paper
    twice = costs(rig, study.base, {"meter_bias": {"value": 2e-7}}, given)["meter_bias"]
    assert twice == pytest.approx(4.0 * cost, rel=1e-3)  # a bias is linear
    blind = [np.where([True, True, False], v, np.inf) for v in given.variances]  # nobody reads the meter
    unread = costs(rig, study.base, study.truth, Conditions(given.runs, blind, given.push_deviations))
    assert unread["meter_bias"] < 1e-6 * cost


@pytest.mark.thorough
@pytest.mark.parametrize(("plant", "stranger"), [("quarter_car", "spring_play"), ("tanks", "backflow")])
def test_no_effect_of_the_catalogue_passes_for_a_stranger(plant: str, stranger: str) -> None:
    # those that are mimicked best of their plants; `python -m tests.blind.field_visibility` has them all
    nats, left = mimics(plain(plant, {stranger: middling(RIGS[plant], stranger)[0]}))
    assert nats > LEAST
    assert min(left.values()) > 0.2


# -- recorder ----------------------------------------------------------------------------------------------


def recorder(rig: Rig, **changes: Any) -> Recorder:
    return replace(plain(rig.name, {}).recorder, **changes)


def cells(rig: Rig, readings: np.ndarray, stamp_error: float = 0.0, **changes: Any) -> tuple[np.ndarray, np.ndarray]:
    """What a recorder makes of readings, and the noise in it."""
    made = recorder(rig, **changes)
    noise = np.random.default_rng(1).standard_normal(readings.shape) * made.deviations(rig)
    return made.spoil(np.random.default_rng(2), rig, readings, noise, stamp_error), noise


def test_recorder_faults_do_what_they_say() -> None:
    rig = RIGS["cart"]
    readings = np.column_stack([np.linspace(0.0, 8.0, 4000), np.zeros(4000), np.zeros(4000)])
    sigma = np.array(list(rig.outputs.values()))
    right, noise = cells(rig, readings)
    assert right == pytest.approx(readings + noise, abs=0.0)
    coarse, _ = cells(rig, readings, quantum={"angle": 3.0})
    assert coarse[:, 1] / (3.0 * sigma[1]) == pytest.approx(np.round(coarse[:, 1] / (3.0 * sigma[1])), abs=1e-9)
    assert coarse[:, 0] == pytest.approx(right[:, 0])
    hit, _ = cells(rig, readings, outliers=0.005)
    away = np.abs(hit - right) / sigma
    assert set(np.round(np.unique(away[away > 1.0]))) == {30.0}
    assert np.mean(away > 1.0) == pytest.approx(0.005, abs=0.0026)  # 12 000 cells: four of √(0.005/12000)
    loud, _ = cells(rig, readings, noise=dict.fromkeys(rig.outputs, 2.0))
    assert np.std(loud - readings, axis=0) == pytest.approx(2.0 * sigma, rel=0.05)
    late, _ = cells(rig, readings, stamp_error=0.1)
    # it moves at 8 m in 80 s: a stamp of 0.1 s is a centimetre there, and nothing where nothing moves
    assert np.std((late - right)[:, 0]) == pytest.approx(0.1 * 8.0 / 80.0, rel=0.05)
    assert np.max(np.abs((late - right)[:, 1:])) == 0.0


def test_rows_are_taken_early_and_late_and_lost() -> None:
    rig = RIGS["cart"]
    times = recorder(rig, jitter=0.2).times(np.random.default_rng(1), 1000, rig.step)
    off = times / rig.step - np.arange(1000)
    assert 0.19 < np.max(np.abs(off)) <= 0.2 + 1e-4  # stamps have six digits
    whole = recorder(rig, lost=0.03, whole_rows=True, hole=20).rows_to_keep(np.random.default_rng(1), 1000, 3)
    assert {tuple(row) for row in whole.tolist()} == {(True,) * 3, (False,) * 3}
    assert 0.02 < np.mean(~whole) - 0.02 < 0.05
    single = recorder(rig, lost=0.03).rows_to_keep(np.random.default_rng(1), 1000, 3)
    assert len({tuple(row) for row in single.tolist()}) > 2


def test_a_study_has_one_or_two_faults_and_every_fault_its_turn() -> None:
    drawn = [Recorder.draw(np.random.default_rng(n), ["a", "b"], 20) for n in range(100)]
    assert {len(one.faults) for one in drawn} == {1, 2}
    assert {fault for one in drawn for fault in one.faults} == set(FAULTS)
    for one in drawn:
        assert ("noise" in one.faults) is (set(one.noise.values()) != {1.0})
        assert ("jitter" in one.faults, "outliers" in one.faults) == (one.jitter > 0.0, one.outliers > 0.0)
        assert ("quantised" in one.faults, "dropouts" in one.faults) == (bool(one.quantum), one.lost > 0.0)


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


def test_runs_of_a_study_differ_and_the_pushes_are_of_its_size() -> None:
    study = plain("cart", {})
    (a, _), (b, _) = course(study, 0), course(study, 1)
    assert not np.array_equal(a.commands, b.commands)
    assert np.std(a.pushes[:, 0]) == pytest.approx(DISTURBANCES["small"] * 8.0, rel=0.5)  # 40 s of 1 s


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


def test_only_draws_from_the_half_that_knows_the_name() -> None:
    assert harness.seeds(2, 0, ["cart"], "field") == [seed for seed in range(10) if deal(seed).plant == "cart"]
    assert harness.seeds(2, 0, ["cart"], "laboratory") == []
    with pytest.raises(SystemExit):
        harness.main(["1", "--half", "laboratory", "--only", "cart"])
