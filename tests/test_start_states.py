"""Start states of free runs of an FMU: which variables set them, and their estimates from a log."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.estimation import fit as fitting
from cosim.estimation.free_runs import with_likely_starts
from cosim.estimation.kernel.library_kernel import propagation
from cosim.estimation.posing import build_problem
from cosim.estimation.problem import Problem
from cosim.refinement.decision.scatter import replay_errors
from cosim.refinement.study import Study, read_study
from cosim.residuals.drive import Drive, log_of_fmu
from tests.blind.fmu_build import build
from tests.logs import write_log

ROWS, STEP = 400, 0.01
NOISE = {"motor_phi": 0.01, "motor_w": 0.3, "load_phi": 0.01}
BEGIN = {"motor.phi": 0.4, "motor.w": 14.0, "load.phi": 0.3, "load.w": 15.0}


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """The study of a turning drive; the speed of its load is not measured."""
    folder = tmp_path_factory.mktemp("drive")
    fmu = build(folder / "drive.fmu", "drive", ways=("co_simulation",))
    time = STEP * np.arange(ROWS)
    torque = np.sign(np.sin(3.0 * time))
    raw = write_log(folder / "raw.csv", {"time": time, "torque": torque, "motor.phi": time})
    with Drive(log_of_fmu(raw, fmu), fmu) as drive:
        table = dict(zip(drive.outputs, drive.run(0, ROWS - 1, BEGIN).T, strict=True))
    rng = np.random.default_rng(4)
    levels = {name.replace("_", ".", 1): sigma for name, sigma in NOISE.items()}
    readings = {name: y + levels[name] * rng.standard_normal(ROWS) for name, y in table.items()}
    write_log(folder / "e1.csv", {"time": time, "torque": torque, **readings})
    path = folder / "study.yaml"
    path.write_text(json.dumps({"model": fmu.name, "logs": {"estimation": ["e1.csv"], "validation": []}}))
    return read_study(path)


@pytest.fixture(scope="module")
def problem(study: Study) -> Problem:
    return with_likely_starts(build_problem(study.subject, study.logs, noise=NOISE))


@pytest.mark.thorough
def test_every_state_that_shows_in_an_output_is_a_start_state(problem: Problem) -> None:
    names = [problem.layout.states[k] for k in problem.layout.start_places]
    assert names == ["start.motor_phi", "start.motor_w", "start.load_phi", "start.load_w"]


def test_start_states_are_those_of_the_log(problem: Problem) -> None:
    estimates = problem.x0[0][problem.layout.start_places]
    assert np.abs(estimates - [*BEGIN.values()]).max() < 0.4  # of 15 rad/s, with a noise of 0.3 rad/s in each row


def test_a_free_run_leaves_no_more_than_the_noise(problem: Problem) -> None:
    noise = problem.at(problem.noise.smallest)
    errors, variances = problem.innovations(problem.values, noise, 0)
    assert np.nanmean(errors[100:] ** 2 / variances[100:]) == pytest.approx(1.0, abs=0.2)


def test_predictions_are_parts_of_the_free_run(study: Study, problem: Problem) -> None:
    undisturbed = replace(fitting.initial_fit(problem), noise=problem.at(problem.noise.smallest))
    residuals = replay_errors(problem, study.subject.horizon, undisturbed, 0)
    sizes = np.sqrt(np.nanmean(residuals**2, axis=(0, 1)))
    assert sizes == pytest.approx([*NOISE.values()], rel=0.3)


def test_deviations_go_on_as_those_of_a_linear_machine() -> None:
    """An oscillator of which the angle is read: the rate is a hidden state, that the row before tells."""
    transition = expm(0.02 * np.array([[0.0, 1.0], [-20.0, -0.05]]))
    tried = np.array([np.linalg.matrix_power(transition, k)[0] for k in range(500)])
    other = tried @ [1.0, -3.0]
    found = propagation(tried[:, None, :])[0]
    assert other[2:] == pytest.approx(found[0] * other[1:-1] + found[1] * other[:-2], abs=1e-9)
