"""Observers get each row of a run once, while it is made, and may end it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.core.arrays import Array
from cosim.core.errors import SimulationError
from cosim.files.results import read_results
from cosim.master.observer import ObservedRun, Observer
from tests.deeds import deeds_scenario


class Recorder(Observer):
    """Keeps all rows; asks for the end, or fails, from a time on."""

    def __init__(self, end: float = np.inf, fails: float = np.inf) -> None:
        self.end_at, self.fails, self.ended = end, fails, 0
        self.run: ObservedRun | None = None
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
    assert recorder.run is not None
    assert (tuple(recorder.run.columns), recorder.run.rows) == (ran.results.columns, 501)
    assert recorder.time == other.time == ran.results.time.tolist()
    assert np.array(recorder.values).tobytes() == ran.results.values.tobytes()
    assert recorder.ended == 1


def test_an_observer_ends_a_run_with_its_rows_kept(project: Path) -> None:
    recorder = Recorder(end=2.0)
    ran = cosim.run(project / "scenarios" / "regulate.yaml", in_process=True, observers=[recorder])
    assert 2.0 <= ran.results.time[-1] < 4.0
    assert recorder.time == ran.results.time.tolist()


def test_an_observer_ends_a_run_in_a_worker_with_its_rows_kept(tmp_path: Path) -> None:
    recorder = Recorder(end=0.1)
    scenario = deeds_scenario(tmp_path, "DoStep", "slow", 0, duration=200.0)
    ran = cosim.run(scenario, tmp_path / "o", observers=[recorder], report=False)
    assert 0.1 <= ran.results.time[-1] < 200.0
    assert recorder.time == ran.results.time.tolist()
    assert recorder.ended == 1


@pytest.mark.parametrize("in_process", [True, False])
def test_an_observer_that_fails_ends_the_run_with_a_message_and_its_rows(project: Path, in_process: bool) -> None:
    with pytest.raises(SimulationError, match=r"the observer Recorder.*ValueError: the plot is closed") as failed:
        cosim.run(
            project / "scenarios" / "regulate.yaml", project / "o", in_process=in_process,
            observers=[Recorder(fails=0.0)], report=False,
        )  # fmt: skip
    assert failed.value.exit_code == 4
    assert len(read_results(project / "o" / "results.csv").time) >= 1
