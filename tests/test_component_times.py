"""Wall time of components and calls: sums, in manifest and report."""

from __future__ import annotations

import json
from pathlib import Path

from cosim.simulation.workflow import run
from tests.walker import walker_scenario


def test_a_run_tells_its_slow_component_in_manifest_and_report(tmp_path: Path) -> None:
    # 1 ms of each step, and 25 ms from t = 0.5 s on
    scenario = walker_scenario(tmp_path, pause=1000.0)
    slow = ["events=[{at: 0.5, set: {saving.pause: 25000}}]"]
    outcome = run(scenario, tmp_path / "out", slow, report=True)
    timings = json.loads((tmp_path / "out" / "manifest.json").read_text())["timings"]
    assert next(iter(timings["components"])) == "saving"
    assert timings["components"]["saving"]["step"] > 1.0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Where the time went" in page
    assert "saving takes" in page
    quiet = run(scenario, tmp_path / "quiet", [*slow, "components.saving.start.pause=0"], report=False, in_process=True)
    assert "components" not in quiet.manifest["timings"]
    assert (outcome.folder / "results.csv").read_bytes() == (quiet.folder / "results.csv").read_bytes()
