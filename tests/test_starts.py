"""Where a replay starts: parabolas through what was measured; start states of free runs of an FMU from a log."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.core.arrays import Array
from cosim.estimation import fit as fitting
from cosim.estimation.kernel.library_kernel import propagation
from cosim.estimation.posing import build_problem, with_likely_starts
from cosim.estimation.problem import Problem
from cosim.logs.log import Log
from cosim.refinement.decision.bundle import replay_errors
from cosim.refinement.study import Study, read_study
from cosim.residuals.drive import Drive, as_columns, log_of_fmu
from cosim.residuals.windows import StartParameter, first_start, noise_levels, window_start
from tests.blind.fmu_build import build
from tests.logs import times, write_log

PLACES, STEP = ("x", "vx"), 0.02
VALUE, SLOPE = 0.3, -0.7


class Body:
    """A drive of a body that keeps its velocity, whatever the log says: what the model lacks is an acceleration."""

    outputs, frame, given = PLACES, None, dict[str, float]()

    def __init__(self, log: Log) -> None:
        self.log = log

    def run(self, first: int, last: int, start: Mapping[str, float]) -> Array:
        t = self.log.time[first : last + 1] - self.log.time[first]
        speed = np.full(t.size, start.get("vx_start", 0.0))
        return np.column_stack([start.get("x_start", 0.0) + speed * t, speed])


BODY: Any = {n: StartParameter(f"{n}_start", 1.0, -math.inf, math.inf, (0.1, 0.2)) for n in PLACES}


def measured(acceleration: float, channels: tuple[str, ...] = PLACES) -> Log:
    time, rng, noise = times(6.0), np.random.default_rng(4), 1e-4
    x = VALUE + SLOPE * time + 0.5 * acceleration * time**2 + noise * rng.standard_normal(time.size)
    v = SLOPE + acceleration * time + 10 * noise * rng.standard_normal(time.size)
    outputs = {n: y for n, y in zip(PLACES, (x, v), strict=True) if n in channels}
    return Log(Path("a.csv"), time, {}, outputs, dict.fromkeys(outputs, "rad"), STEP, {}, {})


@pytest.mark.parametrize("channels", [PLACES, ("x",)])
@pytest.mark.parametrize("acceleration", [0.0, 0.4])
def test_the_first_start_is_that_of_the_body_also_where_its_speed_is_not_measured(
    acceleration: float, channels: tuple[str, ...]
) -> None:
    drive: Any = Body(measured(acceleration, channels))
    start = first_start(drive, BODY)
    # 50 rows of 0.1 mm: of a parabola's end 3·σ/√50, of its slope 19·σ/(1 s·√50)
    assert start["x_start"] == pytest.approx(VALUE, abs=4 * 3e-4 / math.sqrt(50))
    assert start["vx_start"] == pytest.approx(SLOPE, abs=4 * 19e-4 / math.sqrt(50))


@pytest.mark.parametrize("acceleration", [0.0, 0.4])
def test_a_window_starts_at_the_end_of_a_parabola_through_the_half_second_before(acceleration: float) -> None:
    log, k, since = measured(acceleration), 200, 150
    drive: Any = Body(log)
    carried = drive.run(since, k, {"x_start": 1.0, "vx_start": 0.0})
    carrier = as_columns(np.vstack([np.full((since, 2), np.nan), carried]), PLACES)
    start = window_start(drive, BODY, noise_levels(log), carrier, since, k)
    t = log.time[k]
    assert start["x_start"] == pytest.approx(VALUE + SLOPE * t + 0.5 * acceleration * t**2, abs=4e-4)
    assert start["vx_start"] == pytest.approx(SLOPE + acceleration * t, abs=5e-3)


# -- start states of free runs of an FMU --------------------------------------------------------------

ROWS = 400
NOISE = {"motor_phi": 0.01, "motor_w": 0.3, "load_phi": 0.01}
BEGIN = {"motor.phi": 0.4, "motor.w": 14.0, "load.phi": 0.3, "load.w": 15.0}


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """The study of a turning drive; the speed of its load is not measured."""
    folder = tmp_path_factory.mktemp("drive")
    fmu = build(folder / "drive.fmu", "drive", ways=("co_simulation",))
    time = times(3.99, 0.01)
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


def test_start_states_are_those_of_the_log(problem: Problem) -> None:
    names = [problem.layout.states[k] for k in problem.layout.start_places]
    assert names == ["start.motor_phi", "start.motor_w", "start.load_phi", "start.load_w"]  # all that show
    estimates = problem.x0[0][problem.layout.start_places]
    assert np.abs(estimates - [*BEGIN.values()]).max() < 0.4  # of 15 rad/s, with a noise of 0.3 rad/s in each row


def test_a_free_run_and_predictions_leave_no_more_than_the_noise(study: Study, problem: Problem) -> None:
    noise = problem.at(problem.noise.smallest)
    errors, variances = problem.innovations(problem.values, noise, 0)
    assert np.nanmean(errors[100:] ** 2 / variances[100:]) == pytest.approx(1.0, abs=0.2)
    undisturbed = replace(fitting.initial_fit(problem), noise=noise)
    residuals = replay_errors(problem, study.subject.horizon, undisturbed, 0)
    assert np.sqrt(np.nanmean(residuals**2, axis=(0, 1))) == pytest.approx([*NOISE.values()], rel=0.3)


def test_deviations_go_on_as_those_of_a_linear_machine() -> None:
    """An oscillator of which the angle is read: the rate is a hidden state, that the row before tells."""
    transition = expm(0.02 * np.array([[0.0, 1.0], [-20.0, -0.05]]))
    tried = np.array([np.linalg.matrix_power(transition, k)[0] for k in range(500)])
    other = tried @ [1.0, -3.0]
    found = propagation(tried[:, None, :])[0]
    assert other[2:] == pytest.approx(found[0] * other[1:-1] + found[1] * other[:-2], abs=1e-9)
