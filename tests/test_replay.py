"""Replay: what the FMU itself would have done, row by row, from wherever it starts."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import InputError
from cosim.files.results import read_results
from cosim.files.table import read_columns
from cosim.logs.log import Log, read_log
from cosim.residuals.compare import verdict
from cosim.residuals.drive import log_of_fmu, model_signals
from cosim.residuals.residual_statistics import rmse
from cosim.residuals.windows import window_rows
from cosim.residuals.workflow import write_replay
from cosim.simulation.workflow import run
from plant.hovercraft import INPUTS, OUTPUTS, Hovercraft
from tests.cart import cart_fmu
from tests.logs import (
    IMU,
    MOVING,
    POSITION,
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

RECORDED = Path(__file__).parent / "data" / "hovercraft_10s.csv"
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


def test_windows_begin_after_two_seconds_and_predict_each_row_once(log: Log, plant_fmu: Path) -> None:
    rows = window_rows(log, 2.0)
    assert rows == [100, 200, 300, 400, 500]  # 12 s at 50 Hz: the last whole one ends at row 600
    found = replay_windows(log, plant_fmu, {k: {} for k in rows}, 2.0)
    assert np.flatnonzero(np.isfinite(found.outputs["psi"])).tolist() == list(range(101, 601))
    assert window_rows(log, 0.5)[-1] == 575


def test_from_the_true_state_a_window_has_no_residual(flight: Flight, tmp_path: Path, plant_fmu: Path) -> None:
    log = log_of(tmp_path / "a.csv", measured(flight, (*IMU, *POSITION, "phi", "vx")))
    found = replay_windows(log, plant_fmu, {k: flight.start(k) for k in window_rows(log, 0.5)}, 0.5)
    assert largest(found.errors(log)) < ROUNDING


def test_a_window_knows_the_time_at_which_it_starts(tmp_path: Path, plant_fmu: Path) -> None:
    sag = {"battery_sag.drop": 0.2, "battery_sag.time": 5.0}  # acts by FMU time
    flown = fly(times(8.0), Hovercraft().with_values(sag), MOVING)
    log = log_of(tmp_path / "a.csv", measured(flown))
    rows = window_rows(log, 2.0)
    found = replay_windows(log, plant_fmu, {k: flown.start(k) | sag for k in rows}, 2.0)
    assert largest(found.errors(log)) < ROUNDING
    without = replay_windows(log, plant_fmu, {k: flown.start(k) for k in rows}, 2.0)
    assert rmse(without.errors(log)["psi_dot"]) > 1e-3  # the sag is seen at all


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


def test_a_start_that_is_given_is_not_touched(log: Log, plant_fmu: Path) -> None:
    found = replay(log, plant_fmu, {"psi_start": 1.0, "mass": 0.8})
    assert found.starts[0] == {"psi_start": 1.0, "mass": 0.8}
    assert (found.outputs["psi"][0], found.outputs["vx"][0]) == (1.0, 0.0)


@pytest.mark.parametrize("starts", [2, 0])
def test_any_fmu_can_be_replayed(tmp_path: Path, starts: int) -> None:
    fmu = cart_fmu(tmp_path, starts)
    time = times(12.0, 0.01)
    force = np.sin(3.0 * time) + np.where(time > 6.0, 0.5, 0.0)
    position, velocity = np.zeros(time.size), np.zeros(time.size)
    position[0], velocity[0] = (3.0, -0.5) if starts else (0.0, 0.0)
    for k in range(time.size - 1):
        position[k + 1] = position[k] + 0.01 * velocity[k]
        velocity[k + 1] = velocity[k] + 0.01 * (force[k] - velocity[k]) / 2.0
    noise = 1e-3 * np.random.default_rng(1).standard_normal(time.size)
    columns = {"time": time, "force": force, "position": position + noise}
    log = read_log(write_log(tmp_path / "cart.csv", columns), *model_signals(fmu))
    comparison = write_replay(tmp_path / "out", log, fmu)
    assert comparison.replays.keys() == ({0.5, 2.0, math.inf} if starts else {math.inf})
    assert comparison.replays[math.inf].outputs["velocity"] == pytest.approx(velocity, abs=0.01)
    assert "position" in verdict(comparison)
    assert [c.name for c in comparison.channels if not c.is_explained] == []


def test_a_free_run_is_held_against_the_noise_too(tmp_path: Path) -> None:
    """An FMU without start parameters has no windows; a wrong one is told from a right one all the same."""
    fmu, time = cart_fmu(tmp_path, starts=0), times(12.0)
    force, position, velocity = np.sin(3.0 * time), np.zeros(time.size), 0.0
    for k in range(time.size - 1):
        position[k + 1] = position[k] + 0.02 * velocity
        velocity += 0.02 * (force[k] - velocity) / 2.2  # a tenth heavier than the FMU has it
    noisy = position + 1e-3 * np.random.default_rng(1).standard_normal(time.size)
    columns = {"time": time, "force": force, "position": noisy}
    log = read_log(write_log(tmp_path / "cart.csv", columns), *model_signals(fmu))
    told = verdict(write_replay(tmp_path / "out", log, fmu, report=False))
    assert "nothing that the model lacks" not in told
    assert "The fit of position is" in told


def test_a_model_without_the_signals_of_the_log_is_refused(log: Log, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        replay(log, cart_fmu(tmp_path))
    told = "\n".join(map(str, refused.value.faults))
    assert 'has no input "duty_right"' in told
    assert 'has no output "psi"' in told


# -- the answer -------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [2, 4])
def test_a_right_model_is_not_accused_for_a_free_run_that_drifts(seed: int, tmp_path: Path, plant_fmu: Path) -> None:
    flown = fly(times(40.0), start=MOVING, seed=seed)
    log = log_of(tmp_path / "a.csv", measured(flown, noise=1.0, seed=seed))
    comparison = write_replay(tmp_path, log, plant_fmu, report=False)
    drift = comparison.replays[math.inf].errors(log)["psi"]
    assert float(np.abs(drift).max()) > math.radians(5.0)
    # an RMSE over 19 windows is known to some 15 %; carried by the free run, positions would be at 1.6 to 3.4
    assert {c.name: c.excess for c in comparison.channels if not c.excess < 1.3} == {}


@pytest.mark.thorough
@pytest.mark.parametrize(("seconds", "seed"), [(10.0, 1), (10.0, 2), (20.0, 9)])
def test_a_right_model_is_not_accused_for_the_scatter_of_few_windows(
    seconds: float, seed: int, tmp_path: Path, plant_fmu: Path
) -> None:
    log = log_of(tmp_path / "a.csv", measured(fly(times(seconds), start=MOVING, seed=seed), noise=1.0, seed=seed))
    comparison = write_replay(tmp_path, log, plant_fmu, report=False)
    assert max(c.excess for c in comparison.channels) > 1.5  # these are the rare ones: one flight in eight
    assert [c.name for c in comparison.channels if not c.is_matched] == []


@pytest.mark.thorough
@pytest.mark.parametrize("force", [0.0, 0.08])
def test_a_camera_of_two_hertz_is_enough_to_see_friction(force: float, tmp_path: Path, plant_fmu: Path) -> None:
    """Its own noise is told beside the model: what the craft moves between two of its samples is none."""
    craft = Hovercraft().with_values({"coulomb_friction.force": force})
    flown = measured(fly(times(40.0), craft, MOVING), noise=1.0)
    for name in POSITION:
        flown[name][np.arange(flown[name].size) % 25 != 0] = np.nan
    comparison = write_replay(tmp_path, log_of(tmp_path / "a.csv", flown), plant_fmu, report=False)
    found = {c.name for c in comparison.channels if not c.is_matched}
    assert found <= set(POSITION)
    assert bool(found) == bool(force)


@pytest.mark.thorough
def test_a_late_actuator_is_named_a_delay(tmp_path: Path, plant_fmu: Path) -> None:
    late = Hovercraft().with_values({"actuator_delay.time": 0.06})
    log = log_of(tmp_path / "a.csv", measured(fly(times(12.0), late, MOVING), noise=1.0))
    comparison = write_replay(tmp_path / "out", log, plant_fmu, report=False)
    assert re.search(r"psi_dot trails the model by (5[5-9]|6[0-5])\u00a0ms", verdict(comparison))
    assert not (tmp_path / "out" / "report.html").exists()


@pytest.mark.thorough
def test_results_hold_the_log_and_the_replay_row_by_row(log: Log, tmp_path: Path, plant_fmu: Path) -> None:
    comparison = write_replay(tmp_path, log, plant_fmu)
    results = read_columns(tmp_path / "results.csv")
    residual = read_results(tmp_path / "residual.csv")  # without a value before its first window
    assert results["time"].tolist() == residual.time.tolist() == log.time.tolist()
    assert results["log.psi"].tolist() == log.outputs["psi"].tolist()
    assert results["plant.tilt_left"].tolist() == log.inputs["tilt_left"].tolist()
    assert (results["log.psi"] - results["plant.psi"]).tolist() == residual["free_run.psi"].tolist()
    assert {c.partition(".")[0] for c in residual.columns} == {"free_run", "within_2s", "within_500ms"}
    score = next(c for c in comparison.channels if c.name == "psi").scores[2.0]
    assert rmse(residual["within_2s.psi"]) == pytest.approx(score.rmse, rel=1e-12)


def test_a_recorded_log_is_replayed_and_reported(tmp_path: Path, plant_fmu: Path) -> None:
    log = read_log(RECORDED, *model_signals(plant_fmu))
    seen: list[tuple[int, int]] = []
    comparison = write_replay(tmp_path, log, plant_fmu, progress=lambda k, n: seen.append((k, n)))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert verdict(comparison).split(".")[0] in page
    (seconds,) = re.findall(r"([\d.]+) s at ", page)
    assert float(seconds) == pytest.approx(log.time[-1] - log.time[0])
    assert re.search(r"https?://|@import|url\(|src=", page) is None  # complete in itself
    assert len(page) < 600_000
    assert seen
    assert all(a <= b and k <= n for (a, _), (b, _), (k, n) in zip(seen, seen[1:], seen, strict=False))


@pytest.mark.thorough
def test_nothing_serious_hinders_who_uses_keys_or_sees_little_in_the_page_of_a_replay(
    log: Log, tmp_path: Path, plant_fmu: Path
) -> None:
    write_replay(tmp_path, log, plant_fmu)
    assert faults(tmp_path / "report.html") == []


def test_a_log_is_not_written_over(log: Log, tmp_path: Path, plant_fmu: Path) -> None:
    path = tmp_path / "results.csv"
    path.write_bytes(log.path.read_bytes())
    with pytest.raises(InputError, match="is read, and results would be written over it") as refused:
        write_replay(tmp_path, log_of_fmu(path, plant_fmu), plant_fmu)
    assert refused.value.exit_code == 2
    assert path.read_bytes() == log.path.read_bytes()
