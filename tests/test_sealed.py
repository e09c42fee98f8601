"""Sealed logs: an error that rises on them stands in the first sentence, and they change no file beside."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cosim.fmi.building.file import load_model
from cosim.model import Stepper
from cosim.refinement.proof.measure import is_significant_rise
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.refine_page import write_refine_report
from tests.logs import write_log
from tests.studies import named, proven
from tests.test_refine_conditions import MOTOR


def motor_log(path: Path, seed: int, fan: float) -> None:
    """A motor that turns a fan, on steps of its voltage."""
    rng = np.random.default_rng(seed)
    stepper = Stepper(load_model("motor.py:Motor", path.parent).model.with_values({"fan.factor": fan}))
    u = 6.0 * np.repeat(rng.uniform(-1, 1, 30), 20)
    moment, tacho = stepper.start(), []
    for command in u.tolist():
        tacho.append(0.02 * moment.state[0])
        moment = stepper.step(moment, (command,), 0.02)
    seen = np.array(tacho) + 1e-2 * rng.standard_normal(u.size)
    write_log(path, {"time": 0.02 * np.arange(u.size), "voltage": u, "tacho": seen})


@pytest.fixture(scope="module")
def another(tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    """A study whose sealed log is of a motor without the fan that the others have."""
    folder = tmp_path_factory.mktemp("another")
    (folder / "motor.py").write_text(MOTOR)
    for seed, name, fan in ((0, "a", 5e-6), (1, "b", 5e-6), (2, "c", 0.0)):
        motor_log(folder / f"{name}.csv", seed, fan)
    logs = "logs: {estimation: [a.csv, b.csv], validation: [c.csv]}"
    (folder / "study.yaml").write_text(f"model: motor.py:Motor\n{logs}\n")
    return proven(folder / "study.yaml", folder / "out")


@pytest.mark.thorough
def test_an_error_that_rises_on_sealed_logs_stands_in_the_first_sentence(another: Refinement, tmp_path: Path) -> None:
    assert named(another) == {"fan"}
    error = another.record["error"]
    assert error["after"]["validation"]["tacho"] > 1.5 * error["before"]["validation"]["tacho"]
    assert "tacho" in str(another.record["sentence"]).split(" with ")[0]
    write_refine_report(tmp_path / "report.html", another)


@pytest.mark.thorough
def test_what_sealed_logs_show_changes_no_model_and_no_verdict(another: Refinement) -> None:
    study = another.study.path
    bare = study.with_name("bare.yaml")
    bare.write_text(study.read_text().replace(", validation: [c.csv]", ""))
    r = proven(bare, study.parent / "bare")
    assert (r.folder / "model.yaml").read_bytes() == (another.folder / "model.yaml").read_bytes()
    assert sorted(p.name for p in r.folder.iterdir()) == sorted(p.name for p in another.folder.iterdir())
    said = str(another.record["sentence"])
    assert said.endswith(str(r.record["sentence"]))
    sealed = {"study", "sentence", "error", "horizons", "noise_floor", "noise_floors", "floor_scatters", "seconds"}
    sealed |= {"replays"}  # which names the log that plant.fmu has replayed too
    kept = [{k: v for k, v in x.record.items() if k not in sealed} for x in (r, another)]
    assert kept[0] == kept[1]
    assert json.loads((another.folder / "refine.json").read_text())["sentence"] == said


def test_chance_alone_makes_a_rise_as_rarely_as_it_says() -> None:
    rng = np.random.default_rng(1)
    told = sum(is_significant_rise(rng.standard_normal(5).tolist(), 0.01) for _ in range(4000))
    assert 20 < told < 65  # 40 expected, give or take 6.3
