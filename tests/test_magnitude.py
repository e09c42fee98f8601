"""A sensor of speed without direction is found although wide tolerances let the base model follow its readings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cosim.estimation.posing import build_problem
from cosim.refinement.decision.judgement import decide
from cosim.refinement.search.attribution import Attributor
from cosim.refinement.study import read_study
from cosim.refinement.workflow import _candidates
from cosim.residuals.drive import Drive, log_of_fmu
from tests.blind.fmu_build import PLANTS, build
from tests.logs import write_log

ROWS, STEP, NOISE = 600, 0.02, 0.3
ON_TRIAL = {"magnitude_at_speed", "scale_at_speed", "bias_at_speed", "gain_at_voltage", "bias_at_voltage"}


@pytest.mark.thorough
def test_the_magnitude_is_tried_from_the_given_parameters(tmp_path: Path) -> None:
    fmu = build(tmp_path / "motor.fmu", "dc_motor", ways=("model_exchange",))
    time, rng = STEP * np.arange(ROWS), np.random.default_rng(5)
    columns = {"time": time, "voltage": 6.0 * np.repeat(rng.choice([-1.0, 1.0], ROWS // 30), 30)}
    columns["load_torque"] = np.zeros(ROWS)
    raw = write_log(tmp_path / "raw.csv", columns | {"speed": time})
    with Drive(log_of_fmu(raw, fmu), fmu) as drive:
        table = dict(zip(drive.outputs, drive.run(0, ROWS - 1, {}).T, strict=True))
    readings = np.abs(np.abs(table["speed"]) + NOISE * rng.standard_normal(ROWS))
    write_log(tmp_path / "e1.csv", columns | {"speed": readings})
    wide = {v.name: "50%" for v in PLANTS["dc_motor"].parameters}
    lists = {"estimation": ["e1.csv"], "validation": []}
    path = tmp_path / "study.yaml"
    path.write_text(json.dumps({"model": fmu.name, "logs": lists, "tolerance": wide}))
    study = read_study(path)
    problem = build_problem(study.subject, study.logs, noise={"speed": NOISE}, settings=study.settings)
    every = _candidates(study)
    assert not {"bias_at_current", "bias_at_angle"} & {c.name for c in every}  # no log has these outputs
    candidates = [c for c in every if c.name in ON_TRIAL]
    best = decide(Attributor(study.subject, problem, candidates).run()).best
    assert best.names == ("magnitude_at_speed",)
    assert abs(best.fit.values["magnitude_at_speed.value"] - 1.0) < 0.1
