"""Terms without a name in co-simulation: what drives the deviations of a free run depends on its outputs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.estimation.fit import initial_fit
from cosim.estimation.posing import build_problem
from cosim.estimation.problem import Problem
from cosim.refinement.search.missing import DriveResponses
from cosim.refinement.study import read_study
from tests.blind import coupled

ROWS = 400


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a study of two pendulums with free play between them, with short logs."""
    folder = tmp_path_factory.mktemp("coupled")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(coupled, "ROWS", ROWS)
        coupled.write(folder, "gap", 1, "co_simulation")
    return folder


@pytest.fixture(scope="module")
def problem(folder: Path) -> Problem:
    """Return the problem of the study, with unnamed terms."""
    study = read_study(folder / "study.yaml")
    return build_problem(study.subject, study.logs, True, {"phi1": 1e-3, "phi2": 1e-3}, study.settings)


@pytest.mark.parametrize(("column", "output"), [(0, "phi1"), (1, "phi2")])
def test_the_response_to_an_addition_is_that_of_the_filter(problem: Problem, column: int, output: str) -> None:
    at = initial_fit(problem)
    size, torque = 1e-3, problem.layout.inputs.index("torque")
    responses = DriveResponses(problem, at)
    expected = responses(column, [size * log.u[:, torque : torque + 1] for log in problem.logs])[:, 0]
    values = {**problem.values, **at.values}
    moved = problem.score({**values, f"unnamed.{output}.command torque": size}, at.noise)
    plain = problem.score(values, at.noise)
    actual = (moved.errors - plain.errors) / np.sqrt(plain.variances)
    assert np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(actual, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("case", "verdict", "signals"),
    [
        ("gap", "unexplained", ["phi1 − phi2"]),
        ("dry_hinge", "unexplained", ["rate of phi1"]),
        ("stiffness", "parameter_error", []),
        ("nothing", "no_effect", []),
    ],
)
def test_an_effect_inside_is_no_wrong_parameter(tmp_path: Path, case: str, verdict: str, signals: list[str]) -> None:
    coupled.write(tmp_path, case, 2, "co_simulation")
    found = cosim.refine(tmp_path / "study.yaml", out=tmp_path / "refined", report=False)
    answer = json.loads((tmp_path / "refined" / "refine.json").read_text(encoding="utf-8"))
    assert found.verdict == answer["verdict"] == verdict
    assert answer["residual"]["signals"] == signals
    if signals:
        assert "Something that was not tried" in answer["sentence"]
