"""The field half of the blind suite: its plants are what their model files say, its logs what they should be."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from cosim.fmi.building.file import load_model
from cosim.model import Model, Stepper
from tests.blind.field_recorder import Recorder
from tests.blind.field_rig import Arrays, Floats, Rig, Run
from tests.blind.field_study import DISTURBANCES, MODELS, PLANTS, RIGS, Study, recorded, true_error, write

OWN = [name for name in PLANTS if name != "craft"]
CASES = [(name, effect) for name in OWN for effect in ["base", *(set(RIGS[name].entries) - set(RIGS[name].sensors))]]


def model_of(rig: Rig) -> Model:
    return load_model(f"{rig.name}.py:{rig.model}", MODELS).model


@pytest.mark.parametrize("name", OWN)
def test_a_model_file_states_what_its_truth_is_drawn_from(name: str) -> None:
    rig, model = RIGS[name], model_of(RIGS[name])
    assert {p.name: (p.default, p.tolerance) for p in model.parameters if p.tolerance is not None} == rig.sheet
    assert {p.name: p.default for p in model.parameters if p.tolerance is None} == rig.constants
    assert set(model.calibrated) == set(rig.sheet)
    assert model.sensor_variance == pytest.approx({o: sigma**2 for o, sigma in rig.outputs.items()})
    assert {q.name: q.start for q in model.inputs} == rig.inputs
    assert {kind.name for kind in (*model.catalogue, *model.sensors)} == set(rig.entries)


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "effect"), sorted(CASES))
def test_truth_and_model_file_are_the_same_plant(name: str, effect: str) -> None:
    rig, truth = RIGS[name], {}
    if effect != "base":  # in the middle of what is plausible: well visible
        entry = rig.entries[effect]
        truth[effect] = entry.at(entry.unit(np.random.default_rng(0)), math.sqrt(entry.low * entry.high))
    p = rig.numbers({n: value * (1.0 + 0.3 * share) for n, (value, share) in rig.sheet.items()}, truth)
    commands, start = rig.drive(np.random.default_rng(5))[100:180], rig.begin(np.random.default_rng(8))
    truly = rig.course(
        p, Run(np.arange(80) * rig.step, commands, np.zeros((80, len(rig.pushes))), start), tolerance=1e-10
    )
    model = model_of(rig)
    # fine enough that the kinks of dry friction, and a delay between two substeps, cost a sensor nothing
    finer = type("Finer", (type(model),), {"substep": rig.step / 16.0})()
    stepper = Stepper(finer.with_values({n: v for n, v in p.items() if n not in rig.constants}))
    moment = stepper.start(0.0, dict(zip((q.name for q in stepper.model.states), truly.states[0], strict=True)))
    names = [q.name for q in model.outputs]
    for k, command in enumerate(map(tuple, commands)):
        found = dict(zip(names, stepper.output(moment.t, moment.state, command), strict=True))
        off = [(found[o] - r) / sigma for (o, sigma), r in zip(rig.outputs.items(), truly.readings[k], strict=True)]
        assert np.max(np.abs(off)) < 1e-2, (k, off)
        moment = stepper.step(moment, command, rig.step)


@pytest.mark.parametrize("name", PLANTS)
def test_equations_are_the_same_for_floats_and_for_arrays(name: str) -> None:
    rig, rng = RIGS[name], np.random.default_rng(4)
    u, quiet = [1.1 * value + 0.1 for value in rig.inputs.values()], [0.0] * len(rig.pushes)
    for effect, entry in rig.entries.items():
        p = rig.numbers({}, {effect: entry.at(entry.unit(rng), entry.start)})
        rate, look = rig.bind(Floats, p)
        x = rig.scales({effect}) * rng.uniform(0.2, 1.0, len(rig.scales({effect})))
        rates, looks = rig.bind(Arrays, {key: np.array([value, 1.01 * value]) for key, value in p.items()})
        both = np.repeat(x[:, None], 2, axis=1)
        pairs = (*zip(rate(1.0, x, u, quiet), rates(1.0, both, u, quiet), strict=True),)
        pairs += (*zip(look(1.0, x, quiet), looks(1.0, both, quiet), strict=True),)
        assert [np.broadcast_to(found, 2)[0] for _, found in pairs] == pytest.approx([one for one, _ in pairs]), effect


@pytest.mark.thorough
@pytest.mark.parametrize("plant", PLANTS)
def test_a_folder_holds_logs_about_which_the_true_model_errs_by_its_sensors_noise(
    plant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(DISTURBANCES, "small", 0.0)
    base = {name: value for name, (value, _) in RIGS[plant].sheet.items()}
    study = Study(
        "field", 3, plant, "known", {}, base, "small", Recorder(noise=dict.fromkeys(RIGS[plant].outputs, 1.0))
    )
    # 1500 cells tell a deviation to 2 %; four of them
    assert true_error(study) == pytest.approx(study.rig.outputs, rel=0.08)
    path = write(study, tmp_path)
    own = set() if plant == "craft" else {f"{plant}.py"}
    assert {p.name for p in tmp_path.iterdir()} == {"study.yaml", "e1.csv", "e2.csv", "v1.csv"} | own
    assert ("tolerance: {mass: 0.1, izz: 0.2," in path.read_text()) is (plant == "craft")
    logged = np.genfromtxt(tmp_path / "v1.csv", delimiter=",", names=True)
    _, _, cells = recorded(study, 2)
    # seven digits are logged
    assert logged[next(iter(study.rig.outputs))] == pytest.approx(cells[:, 0], rel=1e-6)
