"""The field half of the blind suite: its plants are what their model files say, its decks and sizes what is promised."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from cosim.models.file import load_model
from plant.integrate import Stepper
from plant.model import Model
from tests.blind import field_study
from tests.blind.field_rig import Entry, Rig, Run, fly
from tests.blind.field_study import RIGS

PLANTS = Path(field_study.__file__).with_name("plants")
OWN = [name for name in RIGS if name != "craft"]  # the plants that are not the craft


def model_of(rig: Rig) -> Model:
    return load_model(f"{rig.name}.py:{rig.model}", PLANTS).model


def typical(entry: Entry, seed: int = 0) -> dict[str, float]:
    """Parameters in the middle of what is plausible: well visible."""
    return entry.at(entry.unit(np.random.default_rng(seed)), math.sqrt(math.prod(entry.limits)))


def quiet(rig: Rig, rows: int) -> Run:
    rng = np.random.default_rng(5)
    start = rig.begin(np.random.default_rng(8))
    return Run(np.arange(rows) * rig.step, rig.drive(rng)[100 : 100 + rows], np.zeros((rows, len(rig.pushes))), start)


CASES = [(name, effect) for name in OWN for effect in ["base", *(set(RIGS[name].entries) - set(RIGS[name].sensors))]]


@pytest.mark.parametrize(("name", "effect"), sorted(CASES))
def test_truth_and_model_file_are_the_same_plant(name: str, effect: str) -> None:
    rig, rows = RIGS[name], 200
    truth = {} if effect == "base" else {effect: typical(rig.entries[effect])}
    base = {n: value * (1.0 + 0.3 * share) for n, (value, share) in rig.sheet.items()}
    run = quiet(rig, rows)
    course = fly(rig, rig.numbers(base, truth), run, tolerance=1e-10)
    values = base | {f"{n}.{p}": v for n, parameters in truth.items() for p, v in parameters.items()}
    model = model_of(rig)
    # fine enough that the kinks of dry friction, and a delay between two substeps, cost nothing that a sensor shows
    stepper = Stepper(type("Finer", (type(model),), {"substep": rig.step / 32.0})().with_values(values))
    moment = stepper.start(0.0, dict(zip((q.name for q in stepper.model.states), course.states[0], strict=True)))
    names = [q.name for q in model.outputs]
    for k, command in enumerate(map(tuple, run.commands)):
        found = dict(zip(names, stepper.output(moment.t, moment.state, command), strict=True))
        off = [(found[o] - r) / sigma for (o, sigma), r in zip(rig.outputs.items(), course.readings[k], strict=True)]
        assert np.max(np.abs(off)) < 1e-2, (k, off)
        moment = stepper.step(moment, command, rig.step)
