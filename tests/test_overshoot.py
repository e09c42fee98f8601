"""Overshoot of §4.5.4: bench steps, their refinement, and the craft with this actuator."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from controller.synthesis import numbers_of
from cosim.fmi.building.file import read_model
from cosim.model import Stepper
from cosim.refinement.workflow import refine
from plant.bench import Bench
from plant.hovercraft import Hovercraft
from tests.conftest import ROOT
from tests.logs import write_log

EXAMPLE = ROOT / "examples" / "bench" / "overshoot"
NOISE = {"force_z": 0.01, "force_x": 0.02}  # [N], those of the cells


def steps(path: Path, seed: int, angles: tuple[float, ...]) -> Path:
    """Forces of the bench of truth.yaml, by plain functions: the motor turns at 6.3 %, the tilt steps [deg]."""
    bench = read_model(EXAMPLE / "truth.yaml").model
    rng, time = np.random.default_rng(seed), 0.02 * np.arange(251)
    tilt = np.select([time < 2.5, time < 3.75], [0.0, angles[0]], angles[1])
    columns = {q.name: np.full(time.size, q.start) for q in bench.inputs}
    columns |= {"duty": np.interp(time, [0.2, 1.0], [5.0, 6.3]), "height": np.full(time.size, 0.095)}
    columns["servo_duty"] = 7.5 + np.radians(tilt) / 0.3927
    stepper, names = Stepper(bench), [q.name for q in bench.outputs]
    commands = list(zip(*(columns[q.name].tolist() for q in bench.inputs), strict=True))
    moment, rows = stepper.start(0.0), []
    for k, command in enumerate(commands):
        rows.append(stepper.output(moment.t, moment.state, command))
        moment = stepper.step(moment, command, 0.02) if k + 1 < time.size else moment
    shown = np.array(rows)
    forces = {n: shown[:, names.index(n)] + s * rng.standard_normal(time.size) for n, s in NOISE.items()}
    return write_log(path, {"time": time, **columns, **forces})


@pytest.fixture(scope="module")
def refined(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("overshoot")
    for seed, (name, angles) in enumerate({"e1": (25, 0), "e2": (-25, 10), "v1": (25, -15)}.items()):
        steps(folder / f"{name}.csv", seed, angles)
    (folder / "bench.yaml").write_text((EXAMPLE / "bench.yaml").read_text())
    study = {
        "model": "bench.yaml", "logs": {"estimation": ["e1.csv", "e2.csv"], "validation": ["v1.csv"]},
        "candidates": ["actuator_second_order"],
    }  # fmt: skip
    (folder / "study.yaml").write_text(json.dumps(study))
    refine(folder / "study.yaml", folder / "refined", report=False)
    return folder


@pytest.mark.thorough
def test_steps_that_overshoot_are_a_second_order_actuator(refined: Path) -> None:
    record = json.loads((refined / "refined" / "refine.json").read_text())
    assert record["verdict"] == "effect_found"
    ((name, found),) = ((e["name"], e["parameters"]) for e in record["effects"])
    assert name == "actuator_second_order"
    # the truth is 16 rad/s and 0.5; four steps of 20 mN noise know them to 2 % and 4 %, and this is three times that
    assert found["natural_frequency"]["value"] == pytest.approx(16.0, abs=1.0)
    assert found["damping_ratio"]["value"] == pytest.approx(0.5, abs=0.06)
    error = record["error"]
    assert error["after"]["validation"]["force_x"] < 0.6 * error["before"]["validation"]["force_x"]


@pytest.mark.thorough
def test_the_craft_takes_the_refined_actuator_and_its_regulator_is_made_for_it(refined: Path) -> None:
    (refined / "craft.yaml").write_text((EXAMPLE / "craft.yaml").read_text())
    craft = read_model(refined / "craft.yaml").model
    assert isinstance(craft, Hovercraft)
    (effect,) = craft.awake
    record = json.loads((refined / "refined" / "refine.json").read_text())
    found = record["effects"][0]["parameters"]
    assert effect.natural_frequency == pytest.approx(found["natural_frequency"]["value"])
    # the design model's lag is the mean delay of the tilt behind its command, 2ζ/ωₙ
    delay = 2.0 * effect.damping_ratio / effect.natural_frequency
    assert numbers_of(craft)["lag"] == pytest.approx(delay, rel=1e-6)
    assert delay != pytest.approx(0.0884, rel=0.1)


def test_the_bench_with_a_dormant_overshoot_is_the_bench() -> None:
    plain, dormant = Bench(), Bench().with_values({"actuator_second_order.damping_ratio": 0.3})
    assert dormant.awake == ()
    assert len(plain.states) == 5
    assert len(Bench().with_values({"actuator_second_order.natural_frequency": 16.0}).states) == 6
