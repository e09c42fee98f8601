"""Runs tied to the clock on the wall; observers, which get each row once and may end a run; time of components."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.core.arrays import Array
from cosim.core.errors import InputError, SimulationError
from cosim.files.results import read_results
from cosim.master.observer import ObservedRun, Observer
from examples.live.thermostat import BAND, GOAL, POWER, main
from tests.deeds import deeds_scenario
from tests.walker import walker_scenario


@pytest.mark.parametrize("in_process", [False, True])
def test_a_paced_run_has_the_same_rows_and_its_manifest_repeats_it_without_waiting(
    tmp_path: Path, in_process: bool
) -> None:
    path = deeds_scenario(tmp_path, "none", "none", duration=4.0)
    cosim.run(path, tmp_path / "free", report=False)
    began = time.monotonic()
    ran = cosim.run(path, tmp_path / "paced", pace=40.0, in_process=in_process)
    assert time.monotonic() - began > 4.0 / 40.0
    rows = (tmp_path / "free" / "results.csv").read_bytes()
    assert (tmp_path / "paced" / "results.csv").read_bytes() == rows
    assert ran.manifest["loop"] == "C"
    pacing = ran.manifest["pacing"]
    assert (pacing["pace"], pacing["points"]) == (40.0, 40)
    assert 0 <= pacing["jitter"]["p50"] <= pacing["jitter"]["p999"] <= pacing["jitter"]["max"]
    assert "40 × real time" in (tmp_path / "paced" / "report.html").read_text(encoding="utf-8")
    again = cosim.run(tmp_path / "paced" / "manifest.json", tmp_path / "again", report=False)
    assert (tmp_path / "again" / "results.csv").read_bytes() == rows
    assert "pacing" not in again.manifest


def test_steps_that_are_slower_than_the_pace_are_counted(tmp_path: Path) -> None:
    path = deeds_scenario(tmp_path, "DoStep", "slow", 0)  # 20 ms of each 5 ms
    overruns = cosim.run(path, pace=20.0, report=False).manifest["pacing"]["overruns"]
    assert overruns["count"] >= 9
    assert overruns["worst"] > 0.1


@pytest.mark.parametrize("pace", ["0", "fast", ".nan"])
def test_a_wrong_pace_is_refused_with_its_place(tmp_path: Path, pace: str) -> None:
    path = deeds_scenario(tmp_path, "none", "none")
    path.write_text(f"{path.read_text()}pace: {pace}\n", encoding="utf-8")
    with pytest.raises(InputError, match=f"yaml:{len(path.read_text().splitlines())}:.*pace"):
        cosim.run(path)


def test_functions_set_inputs_and_the_manifest_repeats_them(tmp_path: Path) -> None:
    path = deeds_scenario(tmp_path, "none", "none", duration=4.0)

    def twice(time: float, row: Mapping[str, float]) -> float:
        return 2.0 * time + 0.0 * row["good.y0"]

    ran = cosim.run(path, tmp_path / "o", pace=4.0, inputs={"good.u0": twice}, report=False)
    assert len({*ran["good.u0"]}) > 3
    assert ran.manifest["real_time"] == {"pace": 4.0}
    again = cosim.run(tmp_path / "o" / "manifest.json", tmp_path / "again", report=False)
    assert (tmp_path / "again" / "results.csv").read_bytes() == (tmp_path / "o" / "results.csv").read_bytes()
    assert "changes" not in again.manifest


def test_a_function_for_no_input_and_no_function_are_refused(tmp_path: Path) -> None:
    path = deeds_scenario(tmp_path, "none", "none")
    for inputs in ({"good.u9": lambda time, row: 1.0}, {"good.u0": 3}):
        with pytest.raises(InputError):
            cosim.run(path, inputs=inputs)  # type: ignore[arg-type]


def test_the_thermostat_of_the_example_switches_the_heater(tmp_path: Path) -> None:
    ran = main(tmp_path / "build", pace=40.0)
    power, board = ran["oven.power"], ran["oven.board"]
    off = int(np.argmax(power == 0.0))
    assert {*power} == {600.0, POWER, 0.0}  # the start value, then those of the thermostat
    assert board[:off].max() > GOAL + BAND


# -- observers -------------------------------------------------------------------------------------


class Recorder(Observer):
    """Keeps all rows; asks for the end, or fails, from a time on."""

    def __init__(self, end: float = np.inf, fails: float = np.inf) -> None:
        self.end_at, self.fails, self.ended = end, fails, 0
        self.time: list[float] = []
        self.values: list[list[float]] = []

    def begin(self, run: ObservedRun) -> None:
        self.run = run

    def rows(self, time: Array, values: Array) -> bool:
        self.time += time.tolist()
        self.values += values.tolist()
        if time[-1] >= self.fails:
            raise ValueError("the plot is closed")
        return bool(time[-1] >= self.end_at)

    def end(self) -> None:
        self.ended += 1


@pytest.mark.parametrize("in_process", [True, False])
def test_a_recorder_gets_each_row_once(project: Path, in_process: bool) -> None:
    recorder, other = Recorder(), Recorder()
    scenario = project / "scenarios" / "regulate.yaml"
    ran = cosim.run(scenario, in_process=in_process, observers=[recorder, other])
    assert (tuple(recorder.run.columns), recorder.run.rows) == (ran.results.columns, 501)
    assert recorder.time == other.time == ran.results.time.tolist()
    assert np.array(recorder.values).tobytes() == ran.results.values.tobytes()
    assert recorder.ended == 1


@pytest.mark.parametrize("in_process", [True, False])
def test_an_observer_ends_a_run_with_its_rows_kept(tmp_path: Path, in_process: bool) -> None:
    recorder = Recorder(end=0.1)
    scenario = deeds_scenario(tmp_path, "DoStep", "slow", 0, duration=200.0)
    ran = cosim.run(scenario, observers=[recorder], in_process=in_process)
    assert 0.1 <= ran.results.time[-1] < 200.0
    assert recorder.time == ran.results.time.tolist()
    assert recorder.ended == 1


@pytest.mark.parametrize("in_process", [True, False])
def test_an_observer_that_fails_ends_the_run_with_a_message_and_its_rows(project: Path, in_process: bool) -> None:
    scenario, out = project / "scenarios" / "regulate.yaml", project / "o"
    with pytest.raises(SimulationError, match=r"the observer Recorder.*ValueError: the plot is closed"):
        cosim.run(scenario, out, in_process=in_process, observers=[Recorder(fails=0.0)], report=False)
    assert len(read_results(out / "results.csv").time) >= 1


def test_a_run_tells_its_slow_component_in_manifest_and_report(tmp_path: Path) -> None:
    # 1 ms of each step, and 25 ms from t = 0.5 s on
    scenario = walker_scenario(tmp_path, pause=1000.0)
    cosim.run(scenario, tmp_path / "out", ["events=[{at: 0.5, set: {saving.pause: 25000}}]"])
    timings = json.loads((tmp_path / "out" / "manifest.json").read_text())["timings"]
    assert next(iter(timings["components"])) == "saving"
    assert timings["components"]["saving"]["step"] > 1.0
    assert "saving takes" in (tmp_path / "out" / "report.html").read_text()
