"""Changes during a run take effect at a communication point, and the manifest repeats them byte for byte."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.core.arrays import Array
from cosim.core.errors import InputError, SimulationError
from cosim.core.times import first_point
from cosim.master.observer import Control, ObservedRun, Observer
from cosim.simulation.run_signals import Run
from tests.deeds import deeds_fmu, deeds_scenario
from tests.typed import typed_fmu

STEPS = 60
Changes = Mapping[int, Mapping[str, Any]]


class Changer(Observer):
    """Sends changes, each when the rows have reached a number."""

    control: Control

    def __init__(self, changes: Changes) -> None:
        self._changes, self._count = dict(changes), 0
        self.set: dict[str, Any] = {}

    def begin(self, run: ObservedRun) -> None:
        assert run.control is not None
        self.control = run.control
        self._send()

    def _send(self) -> None:
        for point in [point for point in self._changes if point <= self._count]:
            self.set |= self.control.set(self._changes.pop(point))

    def rows(self, time: Array, values: Array) -> bool:
        self._count += len(time)
        self._send()
        return False


def scenario(folder: Path, more: str = "") -> Path:
    """Two typed FMUs in a row, inputs of the first free, and an FMU that takes 20 ms a step."""
    typed_fmu(folder, units=("rpm", "rad/s"))
    deeds_fmu(folder / "slow.fmu", "DoStep", "slow", 0)
    parts = "{a: {fmu: typed.fmu, start: {gain: 4}}, b: {fmu: typed.fmu}, slow: {fmu: slow.fmu}}"
    text = f"name: typed\nduration: {STEPS * 0.01}\nstep: 0.01\ncomponents: {parts}\n"
    (folder / "s.yaml").write_text(f"{text}connections: [{{from: a.r_out, to: b.r_in}}]\n{more}\n")
    return folder / "s.yaml"


def repeated(folder: Path) -> dict[str, Any]:
    """Repeat the run in `o`; its rows are the same bytes."""
    again = cosim.run(folder / "o" / "manifest.json", folder / "again", report=False)
    assert (folder / "again" / "results.csv").read_bytes() == (folder / "o" / "results.csv").read_bytes()
    return dict(again.manifest)


@pytest.mark.parametrize("in_process", [False, True])
def test_a_change_shows_in_the_rows_and_the_manifest_repeats_the_run(tmp_path: Path, in_process: bool) -> None:
    given = scenario(tmp_path, "events: [{at: 0.005, set: {a.gain: 2}}]")
    changer = Changer({0: {"a.r_in": "10 rad/s", "b.gain": 3.0}, 20: {"a.r_in": 5, "a.s_in": "x"}})
    ran = cosim.run(given, tmp_path / "o", in_process=in_process, observers=[changer], report=False)
    assert changer.set == {"a.r_in": 5.0, "b.gain": 3.0, "a.s_in": "x"}
    changes = ran.manifest["changes"]
    speed, second = ran["a.r_in"], first_point(changes[1]["at"], 0.0, 0.01)
    assert changes[0]["at"] == 0.0
    assert 20 <= second <= STEPS
    assert changes[0]["set"] == {"a.r_in": pytest.approx(10 * 60 / (2 * np.pi)), "b.gain": 3.0}
    assert changes[1]["set"] == {"a.r_in": 5.0, "a.s_in": "x"}
    assert {*speed[:second]} == {changes[0]["set"]["a.r_in"]}
    assert {*speed[second:]} == {5.0}
    assert ran.results.exact["a.s_in"][second - 1 : second + 1] == ["", "x"]
    assert [event["at"] for event in ran.manifest["scenario"]["events"]] == [0.005, *(c["at"] for c in changes)]
    assert any("2 changes made during the run" in warning for warning in ran.warnings)
    again = repeated(tmp_path)
    assert again["scenario"]["events"] == ran.manifest["scenario"]["events"]
    assert "changes" not in again


def changed(given: Path, folder: Path, step: float, changes: Changes) -> tuple[Run, int]:
    """Return a run with one change, which repeats to the byte, and the row of the change."""
    ran = cosim.run(given, folder / "o", observers=[Changer(changes)], report=False)
    (change,) = ran.manifest["changes"]
    repeated(folder)
    return ran, first_point(change["at"], 0.0, step)


def test_a_change_in_the_loop_in_c_repeats_to_the_byte(tmp_path: Path) -> None:
    path = deeds_scenario(tmp_path, "DoStep", "slow", 0, duration=STEPS * 0.1)
    ran, point = changed(path, tmp_path, 0.1, {20: {"good.u0": 2.5}})
    assert ran.manifest["loop"] == "C"
    assert (*ran["good.u0"][point - 1 : point + 1],) == (0.0, 2.5)


def test_a_change_takes_precedence_over_an_event_at_the_same_point(tmp_path: Path) -> None:
    events = ", ".join(f"{{at: {0.01 * k:.2f}, set: {{a.r_in: {k}}}}}" for k in range(STEPS))
    ran, point = changed(scenario(tmp_path, f"events: [{events}]"), tmp_path, 0.01, {9: {"a.r_in": -1}})
    assert (*ran["a.r_in"][point : point + 2],) == (-1, point + 1)


WRONG = {
    "a.r_in": "5 kg", "a.e_in": 3, "a.b_in": 1, "b.r_in": 1, "a.warn_at": 1, "a.none": 1, "c.x": 1,
    "a.gain": float("nan"), "a.i_in": 1.5,
}  # fmt: skip


def test_what_can_be_changed_is_listed_and_wrong_changes_are_refused_with_every_reason(tmp_path: Path) -> None:
    places, listed = list[str](), dict[str, Any]()

    class Wrong(Changer):
        def rows(self, time: Array, values: Array) -> bool:
            with pytest.raises(InputError) as refused:
                self.control.set({"a.s_in": "right", **WRONG})
            places.extend(str(f.file) for f in refused.value.faults)
            listed.update({v.name: v for v in self.control.variables})
            return True

    ran = cosim.run(scenario(tmp_path), observers=[Wrong({})])
    assert {*places} == {*WRONG}
    assert set(ran.results.exact["a.s_in"]) == {""}
    assert "changes" not in ran.manifest
    assert {"a.r_in", "a.gain", "b.i_in"} < {*listed}
    assert not {"b.r_in", "a.h", "a.warn_at"} & {*listed}
    assert (listed["a.r_in"].unit, listed["a.r_in"].is_input) == ("rpm", True)
    assert (listed["a.gain"].start, listed["a.gain"].is_input) == (4.0, False)
    assert listed["a.e_in"].items == {"first": 1, "second": 2}
    assert listed["a.i_in"].bounds == (-(2**31), 2**31 - 1)


def test_a_pause_holds_the_run_and_no_time_limit_counts_it(tmp_path: Path) -> None:
    seen: list[int] = []

    class Pauser(Changer):
        def begin(self, run: ObservedRun) -> None:
            super().begin(run)
            self.control.paused = True
            threading.Timer(1.0, self.go_on).start()

        def go_on(self) -> None:
            seen.append(self._count)
            self.control.paused = False

    limits = "{step: 0.5 s, total: 0.9 s}"
    path = deeds_scenario(tmp_path, "none", "none", limits=limits)
    ran = cosim.run(path, observers=[Pauser({})])
    assert seen == [0]  # nothing before the end of the pause
    assert len(ran.time) == 11


def test_changes_before_a_crash_are_in_the_manifest(tmp_path: Path) -> None:
    path = deeds_scenario(tmp_path, "DoStep", "segfault", 20, duration=4.0)
    with pytest.raises(SimulationError, match="segmentation"):
        cosim.run(path, tmp_path / "o", observers=[Changer({0: {"good.u0": 2.0}})], report=False)
    manifest = json.loads((tmp_path / "o" / "manifest.json").read_text())
    assert manifest["changes"] == [{"at": 0.0, "set": {"good.u0": 2.0}}]
