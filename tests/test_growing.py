"""Fits of free runs to the first rows of a log, then to more and more of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cosim.estimation.growing import leaves_the_motion
from cosim.refinement.search.fits import Search
from cosim.refinement.study import read_study
from cosim.refinement.workflow import build_problem, with_likely_starts
from cosim.residuals.drive import Drive, log_of_fmu
from tests.blind.fmu_build import build
from tests.logs import write_log

ROWS, STEP, HELD = 1500, 0.02, 25  # rows, time between them [s], rows for which a force is held
NOISE = {"x": 2e-3, "phi": 3e-3}  # [m, rad]
BEGIN = {"x": 0.15, "phi": -0.3}
TRUE = {"bob": 0.24, "length": 0.508, "spring": 3.1, "rub": 0.73}
FORCE = 7.0  # [N], by which the pendulum swings over


def test_a_pendulum_that_leaves_its_log_is_fitted_from_the_first_rows(tmp_path: Path) -> None:
    """Fitted to the whole log at once, parameters end in a local optimum beside large unknown inputs."""
    fmu, rng = build(tmp_path / "pendulum.fmu", "pendulum", ways=("co_simulation",)), np.random.default_rng(1)
    time, force = STEP * np.arange(ROWS), np.repeat(rng.uniform(-FORCE, FORCE, ROWS // HELD), HELD)
    raw = write_log(tmp_path / "raw.csv", {"time": time, "force": force, "x": time})
    with Drive(log_of_fmu(raw, fmu), fmu) as drive:
        table = dict(zip(drive.outputs, drive.run(0, ROWS - 1, BEGIN | TRUE).T, strict=True))
    readings = {name: table[name] + sigma * rng.standard_normal(ROWS) for name, sigma in NOISE.items()}
    write_log(tmp_path / "e1.csv", {"time": time, "force": force, **readings})
    path = tmp_path / "study.yaml"
    logs = {"estimation": ["e1.csv"], "validation": []}
    path.write_text(json.dumps({"model": fmu.name, "logs": logs, "tolerance": dict.fromkeys(TRUE, 0.1)}))
    study = read_study(path)
    problem = with_likely_starts(build_problem(study.subject, study.logs, noise=NOISE, settings=study.settings))
    search = Search(study.subject, problem, 1, lambda stage, share: None)
    whole = search.hypothesis((), None)
    grown = search.from_first_rows(whole)
    assert leaves_the_motion(problem, whole.fit)
    assert not leaves_the_motion(problem, grown.fit)
    assert grown.fit.objective < whole.fit.objective - 1000.0
    assert {n: grown.fit.values[n] for n in TRUE} == pytest.approx(TRUE, rel=0.05)
