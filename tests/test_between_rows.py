"""Inputs held or interpolated between rows: what the logs say of the way that the study took them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cosim.estimation.posing import build_problem, coarsen
from cosim.estimation.problem import Problem
from cosim.model import Stepper
from cosim.refinement.refinement import Refinement
from cosim.refinement.search.fits import Hypothesis, Search
from cosim.refinement.search.input_hold import between_rows, late_input
from cosim.refinement.study import read_study
from tests.logs import write_log
from tests.studies import proven
from tests.test_refine_conditions import MOTOR

FINE = 20  # steps of the truth in a row


def motor_study(folder: Path, rig: str, study: str) -> Path:
    """A motor that lacks nothing, on a multisine that its rig holds or ramps between rows, and how a study takes it."""
    from cosim.fmi.building.file import load_model

    (folder / "motor.py").write_text(MOTOR)
    model = load_model("motor.py:Motor", folder).model
    for seed, name in enumerate("abc"):
        rng = np.random.default_rng(seed)
        time = 0.02 * np.arange(500)
        frequency, phase = rng.uniform(0.3, 8.0, 8), rng.uniform(0.0, 2.0 * np.pi, 8)
        u = 2.0 * np.sin(2.0 * np.pi * np.outer(time, frequency) + phase).sum(axis=1)
        stepper = Stepper(model)
        moment, tacho = stepper.start(), []
        for k, command in enumerate(u.tolist()):
            tacho.append(0.02 * moment.state[0])
            step = (u[min(k + 1, u.size - 1)] - command) if rig == "interpolated" else 0.0
            for part in range(FINE):
                moment = stepper.step(moment, (command + step * (part + 0.5) / FINE,), 0.02 / FINE)
        seen = np.array(tacho) + 1e-2 * rng.standard_normal(time.size)
        write_log(folder / f"{name}.csv", {"time": time, "voltage": u, "tacho": seen})
    path = folder / "study.yaml"
    logs = "logs: {estimation: [a.csv, b.csv], validation: [c.csv]}"
    path.write_text(f"model: motor.py:Motor\ninputs: {study}\n{logs}\n")
    return path


def fitted(path: Path) -> tuple[Problem, Hypothesis]:
    """Return the problem of a study and its recalibrated model."""
    study = read_study(path)
    problem = coarsen(build_problem(study.subject, study.logs, settings=study.settings))
    return problem, Search(study.subject, problem, 1, lambda stage, share: None).hypothesis((), None)


@pytest.mark.parametrize("lag", [0.0, 0.05])
def test_an_input_that_a_filter_of_the_recorder_delays_is_named(tmp_path: Path, lag: float) -> None:
    """The advice on the way between rows would lead nowhere; a recorded input that is on time raises no alarm."""
    path = motor_study(tmp_path, "held", "held")
    for name in "ab":
        table = np.genfromtxt(tmp_path / f"{name}.csv", delimiter=",", names=True)
        columns = {n: table[n] for n in table.dtype.names}
        recorded, share = columns["voltage"].copy(), np.exp(-0.02 / lag) if lag else 0.0
        for k in range(1, recorded.size):
            recorded[k] = share * recorded[k - 1] + (1.0 - share) * columns["voltage"][k]
        write_log(tmp_path / f"{name}.csv", columns | {"voltage": recorded})
    problem, base = fitted(path)
    late = late_input(problem, base)
    assert (late is not None) == (lag > 0.0)
    if late is not None:
        assert late.name == "voltage"
        assert late.rows in (1, 2)  # the lag is 2.5 rows
        warning = late.warning(0.02)
        assert f"move its column {0.02 * late.rows:.4g}" in warning
        assert late.gain > between_rows(problem, base).gain


@pytest.fixture(scope="module")
def ramped(tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    folder = tmp_path_factory.mktemp("ramped")
    return proven(motor_study(folder, "interpolated", "held"), folder / "out")


@pytest.mark.thorough
def test_refine_records_both_likelihoods_and_warns(ramped: Refinement) -> None:
    written = json.loads((ramped.folder / "refine.json").read_text())
    assert written["inputs"]["taken"] == {"voltage": "held"}
    assert written["inputs"]["gain_otherwise"] > 100.0
    assert any("`inputs: interpolated` in the study" in text for text in written["warnings"])
