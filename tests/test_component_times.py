"""Wall time of components and calls: sums, in manifest and report."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cosim.isolation.rows import CALLS, NOTHING
from cosim.isolation.watch import ComponentTimes
from cosim.simulation.report import write_pages
from cosim.simulation.report.run_rows import time_sentence
from cosim.simulation.workflow import run
from tests.walker import walker_scenario

WHEEL, ROAD = 0, CALLS


def test_the_start_of_the_worker_counts_for_nothing() -> None:
    now = [0.0]
    times = ComponentTimes(["wheel"], clock=lambda: now[0])
    now[0] = 3.0
    times.read(0, NOTHING)
    assert times.record() == {
        "components": {"wheel": {"share": 0.0, "set": 0.0, "step": 0.0, "get": 0.0, "other": 0.0}},
        "rest": 0.0,
        "readings": 0,
    }


@pytest.mark.parametrize(("readings", "is_told"), [(2000, True), (20, False)])
def test_a_run_long_enough_to_measure_has_a_sentence(readings: int, is_told: bool) -> None:
    components = {"wheel": {"share": 0.96, "step": 9.0, "set": 0.3, "get": 0.3, "other": 0.1}, "road": {"share": 0.04}}
    sentence = time_sentence({"readings": readings, "components": components, "waiting": 7.0})
    assert [part in sentence for part in ("wheel", "96%", "9.6 s", "0.10 s", "7.0 s")] == [is_told] * 5


def test_a_run_tells_its_slow_component_in_manifest_and_report(tmp_path: Path) -> None:
    # 1 ms of each step, and 25 ms from t = 0.5 s on
    scenario = walker_scenario(tmp_path, pause=1000.0)
    slow = ["events=[{at: 0.5, set: {saving.pause: 25000}}]"]
    outcome = run(scenario, tmp_path / "out", slow, report=write_pages)
    timings = json.loads((tmp_path / "out" / "manifest.json").read_text())["timings"]
    assert next(iter(timings["components"])) == "saving"
    assert timings["components"]["saving"]["step"] > 1.0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Where the time went" in page
    assert "saving takes" in page
    quiet = run(scenario, tmp_path / "quiet", [*slow, "components.saving.start.pause=0"], report=False, in_process=True)
    assert "components" not in quiet.manifest["timings"]
    assert outcome.file.read_bytes() == quiet.file.read_bytes()
