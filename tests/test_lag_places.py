"""On a linear plant, a lag of its only moving input and a lag of its only sensor look the same: neither is claimed."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from cosim.estimation.posing import build_problem
from cosim.refinement.decision.claims import experiment_for
from cosim.refinement.search.attribution import Attributor
from cosim.refinement.study import read_study
from cosim.residuals.drive import Drive, log_of_fmu
from tests.blind.fmu_build import build
from tests.logs import write_log
from tests.studies import weighed

ROWS, STEP, LAG, NOISE = 400, 2.0, 5.0, 0.02
IN, OUT = "lag_at_heater", "lag_at_T_air"


@pytest.mark.thorough
def test_a_lag_of_the_input_and_one_of_the_sensor_are_rivals(tmp_path: Path) -> None:
    fmu = build(tmp_path / "box.fmu", "heated_box", ways=("model_exchange",))
    time, rng = STEP * np.arange(ROWS), np.random.default_rng(3)
    for name in ("e1", "e2"):
        heater = np.repeat(rng.uniform(0.0, 1.0, ROWS // 20), 20)
        heater[:20] = 0.0
        share, lagged, mean = math.exp(-STEP / LAG), np.zeros(ROWS + 1), np.zeros(ROWS)
        for k, u in enumerate(heater):
            lagged[k + 1] = u + (lagged[k] - u) * share
            mean[k] = u + (lagged[k] - u) * (1.0 - share) * LAG / STEP
        columns = {"time": time, "heater": mean, "T_room": np.full(ROWS, 295.0)}
        raw = write_log(tmp_path / "raw.csv", columns | {"T_air": time})
        with Drive(log_of_fmu(raw, fmu), fmu) as drive:
            table = dict(zip(drive.outputs, drive.run(0, ROWS - 1, {}).T, strict=True))
        readings = table["T_air"] + NOISE * rng.standard_normal(ROWS)
        write_log(tmp_path / f"{name}.csv", columns | {"heater": heater, "T_air": readings})
    path = tmp_path / "study.yaml"
    path.write_text(json.dumps({"model": fmu.name, "logs": {"estimation": ["e1.csv", "e2.csv"], "validation": []}}))
    study = read_study(path)
    problem = build_problem(study.subject, study.logs, noise={"T_air": NOISE})
    candidates = [c for c in study.subject.candidates(["heater"]) if c.name in (IN, OUT, "bias_at_heater")]
    a = weighed(Attributor(study.subject, problem, candidates).run())
    assert a.decision.verdict == "ambiguous"
    assert a.decision.rivals.keys() == {frozenset({IN}), frozenset({OUT})}
    assert abs(a.best.fit.values[a.best.candidates[0].parameters[0]] - LAG) < 0.5
    assert "sensor" in experiment_for(study.subject, [*a.decision.rivals])
