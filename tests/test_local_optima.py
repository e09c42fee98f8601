"""Fits of free runs that end in a local optimum, and from other starts."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from cosim.estimation.free_runs import with_likely_starts
from cosim.estimation.posing import build_problem
from cosim.estimation.problem import Problem
from cosim.refinement.search.fits import Search
from cosim.refinement.study import Study, read_study
from cosim.residuals.drive import Drive, log_of_fmu
from tests.blind.fmu_build import build
from tests.logs import write_log

ROWS, STEP, HELD = 1500, 0.02, 25  # rows, time between them [s], rows for which a force is held
NOISE = {"x": 2e-3, "phi": 3e-3}  # [m, rad]
BEGIN = {"x": 0.15, "phi": -0.3}
TRUE = {"bob": 0.24, "length": 0.508, "spring": 3.1, "rub": 0.73}


def posed(folder: Path, force: float, begin: Mapping[str, float], seed: int) -> tuple[Study, Problem]:
    """The study of a pendulum with wrong parameters and one log, and its problem with likely start states."""
    fmu, rng = build(folder / "pendulum.fmu", "pendulum", ways=("co_simulation",)), np.random.default_rng(seed)
    time, forces = STEP * np.arange(ROWS), np.repeat(rng.uniform(-force, force, ROWS // HELD), HELD)
    raw = write_log(folder / "raw.csv", {"time": time, "force": forces, "x": time})
    with Drive(log_of_fmu(raw, fmu), fmu) as drive:
        table = dict(zip(drive.outputs, drive.run(0, ROWS - 1, {**begin, **TRUE}).T, strict=True))
    readings = {name: table[name] + sigma * rng.standard_normal(ROWS) for name, sigma in NOISE.items()}
    write_log(folder / "e1.csv", {"time": time, "force": forces, **readings})
    path = folder / "study.yaml"
    logs = {"estimation": ["e1.csv"], "validation": []}
    path.write_text(json.dumps({"model": fmu.name, "logs": logs, "tolerance": dict.fromkeys(TRUE, 0.1)}))
    study = read_study(path)
    problem = build_problem(study.subject, study.logs, noise=NOISE, settings=study.settings)
    return study, with_likely_starts(problem)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_pendulum_that_leaves_its_log_is_fitted_from_other_starts(seed: int, tmp_path: Path) -> None:
    """Fitted from the given parameters alone, they end in a local optimum beside large unknown inputs."""
    study, problem = posed(tmp_path, 7.0, BEGIN, seed)
    search = Search(study.subject, problem, 1, lambda stage, share: None)
    given = search.hypothesis((), None)
    best = search.from_the_prior(given)
    assert best.fit.objective < given.fit.objective - 100.0
    assert {n: best.fit.values[n] for n in TRUE} == pytest.approx(TRUE, rel=0.05)
