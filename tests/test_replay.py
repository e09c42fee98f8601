"""Replay: simulated outputs of the FMU along a log, from different initial states."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.core.errors import InputError
from cosim.files.folders import replay_record
from cosim.files.results import read_results
from cosim.files.table import read_columns
from cosim.logs.log import Log, read_log
from cosim.residuals.drive import model_signals
from cosim.residuals.residual_statistics import rmse
from cosim.residuals.windows import window_rows
from cosim.simulation.workflow import run
from plant.hovercraft import INPUTS, OUTPUTS
from tests.cart import cart_fmu
from tests.logs import (
    IMU,
    MOVING,
    POSITION,
    RECORDED,
    Flight,
    fly,
    log_of,
    measured,
    replay,
    replay_windows,
    times,
    write_log,
)
from tests.seen import faults

ROUNDING = 1e-9  # of sums over some hundred steps; a row of delay would be 1e-3 and more


def largest(errors: dict[str, np.ndarray]) -> float:
    return max(float(np.nanmax(np.abs(e))) for e in errors.values())


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fly(times(12.0), start=MOVING)


@pytest.fixture(scope="module")
def log(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> Log:
    return log_of(tmp_path_factory.mktemp("log") / "noisy.csv", measured(flight, noise=1.0))


# -- timing -----------------------------------------------------------------------------------


def test_the_rows_of_a_run_are_the_rows_of_a_log(project: Path) -> None:
    """Row k of a result holds what is measured at t_k and the command that acts from there: so does a log."""
    outcome = run(
        project / "scenarios" / "regulate.yaml", project, ["noise=off", "duration=4"], report=False, force=True
    )
    ran, scenario = outcome.results, outcome.manifest["scenario"]
    names = [q.name for q in INPUTS] + ["psi", "psi_dot", "ax", "x", "vx"]
    path = write_log(project / "run.csv", {"time": ran.time} | {n: ran[f"plant.{n}"] for n in names})
    start = scenario["components"]["plant"]["start"]
    found = replay(read_log(path, INPUTS, OUTPUTS), project / "build" / "plant.fmu", start)
    assert np.ptp(ran["plant.psi"]) > 0.5
    assert largest(found.errors(read_log(path, INPUTS, OUTPUTS))) == 0.0  # the same steps: bit for bit


@pytest.mark.parametrize("lost", [[], [50, 51, 120]])
def test_jitter_is_replayed_as_it_was_and_lost_rows_are_stepped_over(
    tmp_path: Path, plant_fmu: Path, lost: list[int]
) -> None:
    time = times(6.0)
    time[1:-1] += np.random.default_rng(1).uniform(-0.005, 0.005, time.size - 2) * (not lost)
    flown = fly(np.delete(time, lost), start=MOVING)  # the truth holds its commands over the holes as the replay does
    log = log_of(tmp_path / "a.csv", measured(flown))
    assert largest(replay(log, plant_fmu, flown.start(0)).errors(log)) < ROUNDING


def test_an_fmu_of_equal_steps_is_given_equal_steps(tmp_path: Path) -> None:
    fmu = cart_fmu(tmp_path, variable_step=False)
    even, uneven = times(4.0), times(4.0)
    uneven[1:-1] += np.random.default_rng(1).uniform(-0.005, 0.005, uneven.size - 2)
    ends = []
    for k, time in enumerate((even, uneven)):
        columns = {"time": time, "force": np.where(time < 2.0, 1.0, -1.0), "position": 0.0 * time}
        log = read_log(write_log(tmp_path / f"{k}.csv", columns), *model_signals(fmu))
        ends.append(replay(log, fmu, {}).outputs["position"])
    # the force may turn a step late: 2 N on 2 kg for 0.02 s, then up to 2 s of 0.02 m/s
    assert ends[1] == pytest.approx(ends[0], abs=0.04)
    assert np.all(np.isfinite(ends[1]))


# -- windows ----------------------------------------------------------------------------------


def test_from_the_true_state_a_window_has_no_residual_and_predicts_each_row_once(
    flight: Flight, tmp_path: Path, plant_fmu: Path
) -> None:
    log = log_of(tmp_path / "a.csv", measured(flight, (*IMU, *POSITION, "phi", "vx")))
    found = replay_windows(log, plant_fmu, {k: flight.start(k) for k in window_rows(log, 0.5)}, 0.5)
    assert largest(found.errors(log)) < ROUNDING
    assert np.flatnonzero(np.isfinite(found.outputs["psi"])).tolist() == list(range(101, 601))  # after 2 s


def test_a_pause_of_the_log_lies_between_windows_not_in_them(tmp_path: Path, plant_fmu: Path) -> None:
    time = np.concatenate((times(4.0), 10.0 + times(4.0)))
    log = log_of(tmp_path / "a.csv", measured(fly(time)))
    rows = window_rows(log, 0.5)
    assert [k for k in rows if 170 < k < 210] == [175, 201]  # 3.5 s, then the first row after the pause
    found = replay_windows(log, plant_fmu, {k: {} for k in rows}, 0.5)
    assert math.isnan(found.outputs["psi"][201])  # the first row after the pause is nobody's prediction


# -- starts -----------------------------------------------------------------------------------


def test_a_moving_craft_is_caught_where_it_is(flight: Flight, tmp_path: Path, plant_fmu: Path) -> None:
    log = log_of(tmp_path / "a.csv", measured(flight))
    start = replay(log, plant_fmu).starts[0]
    for name, value in MOVING.items():
        assert start[f"{name}_start"] == pytest.approx(value, abs=1e-5)  # parabolas over 1 s, four passes


# -- any model, any sensors -------------------------------------------------------------------


@pytest.mark.parametrize(("starts", "mass"), [(2, 2.0), (0, 2.0), (0, 2.2)])
def test_any_fmu_can_be_replayed_and_a_wrong_one_is_told_from_a_right_one(
    tmp_path: Path, starts: int, mass: float
) -> None:
    """An FMU without start parameters has no windows; its free run is held against the noise too."""
    fmu = cart_fmu(tmp_path, starts)
    time = times(12.0, 0.01)
    force = np.sin(3.0 * time) + np.where(time > 6.0, 0.5, 0.0)
    position, velocity = np.zeros(time.size), np.zeros(time.size)
    position[0], velocity[0] = (3.0, -0.5) if starts else (0.0, 0.0)
    for k in range(time.size - 1):
        position[k + 1] = position[k] + 0.01 * velocity[k]
        velocity[k + 1] = velocity[k] + 0.01 * (force[k] - velocity[k]) / mass
    noise = 1e-3 * np.random.default_rng(1).standard_normal(time.size)
    columns = {"time": time, "force": force, "position": position + noise}
    log = read_log(write_log(tmp_path / "cart.csv", columns), *model_signals(fmu))
    comparison = cosim.replay(log.path, tmp_path / "out", fmu, report=False, in_process=True).comparison
    assert comparison.replays.keys() == ({0.5, 2.0, math.inf} if starts else {math.inf})
    is_right = mass == 2.0
    assert [c.is_explained for c in comparison.channels] == [is_right]
    assert replay_record(tmp_path / "out")["verdict"] == ("explained" if is_right else "unexplained")
    assert (tmp_path / "out" / "study.yaml").exists() == (not is_right)
    if is_right:
        assert comparison.replays[math.inf].outputs["velocity"] == pytest.approx(velocity, abs=0.01)
    assert not (tmp_path / "out" / "report.html").exists()


# -- the answer -------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize(("seconds", "seed"), [(40.0, 2), (40.0, 4), (10.0, 1), (10.0, 2), (20.0, 9)])
def test_a_right_model_is_not_accused_for_a_free_run_that_drifts_or_the_scatter_of_few_windows(
    seconds: float, seed: int, tmp_path: Path, plant_fmu: Path
) -> None:
    log = log_of(tmp_path / "a.csv", measured(fly(times(seconds), start=MOVING, seed=seed), noise=1.0, seed=seed))
    comparison = cosim.replay(log.path, fmu=plant_fmu, in_process=True).comparison
    assert [c.name for c in comparison.channels if not c.is_matched] == []
    # of two flights in 40 s an RMSE over 19 windows is known to some 15 %; the others are the rare ones, one in eight
    assert (max(c.excess for c in comparison.channels) < 1.3) is (seconds == 40.0)


def test_a_recorded_log_is_replayed_and_reported_row_by_row(tmp_path: Path, plant_fmu: Path) -> None:
    log = read_log(RECORDED, *model_signals(plant_fmu))
    seen: list[tuple[int, int]] = []
    found = cosim.replay(RECORDED, tmp_path, plant_fmu, in_process=True, progress=lambda k, n: seen.append((k, n)))
    results = read_columns(tmp_path / "results.csv")
    residual = read_results(tmp_path / "residual.csv")  # without a value before its first window
    assert results["time"].tolist() == residual.time.tolist() == log.time.tolist()
    assert results["log.psi"].tolist() == log.outputs["psi"].tolist()
    assert results["plant.tilt_left"].tolist() == log.inputs["tilt_left"].tolist()
    assert (results["log.psi"] - results["plant.psi"]).tolist() == residual["free_run.psi"].tolist()
    assert {c.partition(".")[0] for c in residual.columns} == {"free_run", "within_2s", "within_500ms"}
    score = next(c for c in found.comparison.channels if c.name == "psi").scores[2.0]
    assert rmse(residual["within_2s.psi"]) == pytest.approx(score.rmse, rel=1e-12)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert re.search(r"https?://|@import|url\(|src=", page) is None  # complete in itself
    assert len(page) < 600_000
    head, _, folded = page.partition("<details")  # residuals are in sight, overlays are not
    assert replay_record(tmp_path)["verdict"] == "explained"
    assert '<p class="verdict good answer">explained</p>' in head
    assert ("Residual of psi" in head, "restarted every" in head, "restarted every" in folded) == (True, False, True)
    assert seen
    assert seen == sorted(seen)


@pytest.mark.thorough
def test_nothing_serious_hinders_who_uses_keys_or_sees_little_in_the_page_of_a_replay(
    log: Log, tmp_path: Path, plant_fmu: Path
) -> None:
    cosim.replay(log.path, tmp_path, plant_fmu, in_process=True)
    assert faults(tmp_path / "report.html") == []


def test_a_log_is_not_written_over(log: Log, tmp_path: Path, plant_fmu: Path) -> None:
    path = tmp_path / "results.csv"
    path.write_bytes(log.path.read_bytes())
    with pytest.raises(InputError, match=r"results\.csv") as refused:
        cosim.replay(path, tmp_path, plant_fmu, in_process=True, force=True)
    assert refused.value.exit_code == 2
    assert path.read_bytes() == log.path.read_bytes()
