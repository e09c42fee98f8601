"""Runs tied to the clock on the wall: waits, overruns, jitter; no wall time is asserted."""

from __future__ import annotations

import json
from array import array
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.core.errors import InputError
from cosim.isolation.rows import WAITING
from cosim.master.observer import ObservedRun, Observer
from cosim.master.pacing import Pacer
from examples.live.thermostat import BAND, GOAL, POWER, main
from tests.cases import some
from tests.deeds import deeds_scenario


class Wall:
    """A clock of its own, which only sleeping, reading and working move on."""

    def __init__(self) -> None:
        self.now, self.naps, self.doing = 100.0, list[float](), array("q", [7])
        self.seen: set[int] = set()

    def clock(self) -> float:
        self.now += 1e-6
        return self.now

    def sleep(self, duration: float) -> None:
        self.seen.add(self.doing[0])
        self.naps.append(duration)
        self.now += duration

    def pacer(self, pace: float, steps: int, h: float) -> Pacer:
        return Pacer(pace, steps, h, self.doing, clock=self.clock, sleep=self.sleep)


def test_each_point_waits_for_its_time_counted_from_the_first() -> None:
    wall = Wall()
    pacer = wall.pacer(10.0, 100, 0.02)
    for k in range(101):
        pacer.wait(k)
        wall.now += 1e-3  # the work of a step
    assert wall.now == pytest.approx(100.0 + 100 * 0.002, abs=2e-3)
    assert wall.seen == {WAITING}
    assert wall.doing[0] == 7
    record = pacer.record(0.0)
    assert (record["pace"], record["points"], record["overruns"]) == (10.0, 100, {"count": 0})
    assert record["jitter"]["max"] < 1e-5
    assert pacer.notes(0.0) == ()


def test_a_slow_step_is_counted_and_caught_up() -> None:
    wall = Wall()
    pacer = wall.pacer(1.0, 20, 0.01)
    for k in range(21):
        pacer.wait(k)
        wall.now += 0.035 if k == 9 else 0.001
    overruns, jitter = pacer.record(5.0)["overruns"], pacer.record(5.0)["jitter"]
    assert (overruns["count"], overruns["beyond_step"]) == (3, 2)  # 25, 16 and 7 ms late
    assert overruns["worst"] == pytest.approx(0.025, abs=1e-4)
    assert overruns["at"] == overruns["first_at"] == pytest.approx(5.10)
    assert jitter["max"] == pytest.approx(0.025, abs=1e-4)
    assert jitter["p50"] < 1e-4
    (note,) = pacer.notes(5.0)
    assert "2 of 20 communication points" in note
    assert "caught up" in note


@pytest.mark.parametrize("in_process", [False, True])
def test_a_paced_run_has_the_same_rows_and_its_manifest_repeats_it_without_waiting(
    tmp_path: Path, in_process: bool
) -> None:
    path = deeds_scenario(tmp_path, "none", "none", duration=4.0)
    cosim.run(path, tmp_path / "free", report=False)
    ran = cosim.run(path, tmp_path / "paced", pace=40.0, in_process=in_process)
    rows = (tmp_path / "free" / "results.csv").read_bytes()
    assert (tmp_path / "paced" / "results.csv").read_bytes() == rows
    assert ran.manifest["loop"] == "C"
    pacing = ran.manifest["pacing"]
    assert (pacing["pace"], pacing["points"]) == (40.0, 40)
    assert (
        0 <= pacing["jitter"]["p50"] <= pacing["jitter"]["p99"] <= pacing["jitter"]["p999"] <= pacing["jitter"]["max"]
    )
    assert "40 × real time" in (tmp_path / "paced" / "report.html").read_text(encoding="utf-8")
    again = cosim.run(tmp_path / "paced" / "manifest.json", tmp_path / "again", report=False)
    assert (tmp_path / "again" / "results.csv").read_bytes() == rows
    assert "pacing" not in again.manifest


def test_pauses_and_requested_ends_of_a_paced_run(tmp_path: Path) -> None:
    path = deeds_scenario(tmp_path, "none", "none", duration=1000.0)

    class Ending(Observer):
        count = 0

        def begin(self, run: ObservedRun) -> None:
            self.control = run.control

        def rows(self, time: object, values: object) -> bool:
            self.count += len(values)  # type: ignore[arg-type]
            return self.count >= 5

    ran = cosim.run(path, tmp_path / "o", pace=5.0, observers=[Ending()], report=False)
    assert 5 <= len(ran.time) < 1000
    assert ran.manifest["pacing"]["points"] - len(ran.time) in {-1, 0}  # the end may come during the wait for a point
    assert json.loads((tmp_path / "o" / "manifest.json").read_text())["pacing"] == ran.manifest["pacing"]


@pytest.mark.parametrize("pace", some(["0", "-1", "fast", ".nan", ".inf"], every=2))
def test_a_wrong_pace_is_refused_with_its_place(tmp_path: Path, pace: str) -> None:
    path = deeds_scenario(tmp_path, "none", "none")
    path.write_text(f"{path.read_text()}pace: {pace}\n", encoding="utf-8")
    with pytest.raises(InputError) as refused:
        cosim.run(path)
    (fault,) = refused.value.faults
    assert (fault.line, fault.exit_code) == (len(path.read_text().splitlines()), 2)
    assert "pace" in str(fault)


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


@pytest.mark.parametrize(("name", "function"), [("good.u9", lambda time, row: 1.0), ("good.u0", 3)])
def test_a_function_for_no_input_and_no_function_are_refused(tmp_path: Path, name: str, function: object) -> None:
    path = deeds_scenario(tmp_path, "none", "none")
    with pytest.raises(InputError) as refused:
        cosim.run(path, inputs={name: function})  # type: ignore[dict-item]
    assert refused.value.exit_code == 2


def test_the_thermostat_of_the_example_switches_the_heater(tmp_path: Path) -> None:
    ran = main(tmp_path / "build", pace=40.0)
    power, board = ran["oven.power"], ran["oven.board"]
    off = int(np.argmax(power == 0.0))
    assert {*power} == {600.0, POWER, 0.0}  # the start value, then those of the thermostat
    assert board[:off].max() > GOAL + BAND
