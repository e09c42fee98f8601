"""What `--json` tells a script: whether criteria were met, what a failure left, the numbers of a replay."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.verbs.cli import entry
from tests.cart import cart_fmu
from tests.deeds import deeds_scenario
from tests.logs import times, write_log

SCENARIO = """name: s
duration: 1
step: 0.1
components: {r: {block: reference, signals: {x: {start: 1}}}}
"""


def told(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], *arguments: str | Path
) -> tuple[int, dict[str, Any]]:
    """Exit code and JSON of a command."""
    monkeypatch.setattr("sys.argv", ["cosim", *map(str, arguments), "--json"])
    with pytest.raises(SystemExit) as ended:
        entry()
    return int(ended.value.code or 0), json.loads(capfd.readouterr().out)


@pytest.mark.parametrize(
    ("criteria", "code", "status", "met"),
    [
        ("{peak: {of: r.x, max: 2}}", 0, "ok", True),
        ("{peak: [{of: r.x, max: 2}, {of: r.x, max: 0.5}]}", 5, "missed", False),
        ("{}", 0, "ok", None),
    ],
)
def test_a_script_reads_from_json_whether_all_criteria_were_met(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str],
    criteria: str, code: int, status: str, met: bool | None,
) -> None:  # fmt: skip
    file = tmp_path / "s.yaml"
    file.write_text(f"{SCENARIO}criteria: {criteria}\n")
    ended, said = told(monkeypatch, capfd, "run", file, "--out", tmp_path / "o", "--no-report", "--in-process")
    assert (ended, said["exit_code"], said["status"], said["met"]) == (code, code, status, met)
    assert json.loads((tmp_path / "o" / "manifest.json").read_text())["status"] == "ok"  # it came to its end


@pytest.mark.skipif(sys.platform == "win32", reason="its crashes go by other names")
def test_json_of_a_failed_run_says_who_when_why_and_what_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    scenario = deeds_scenario(tmp_path, "DoStep", "abort", 5)
    code, said = told(monkeypatch, capfd, "run", scenario, "--out", out, "--no-report")
    assert (code, said["exit_code"], said["status"], said["component"]) == (4, 4, "failed", "bad")
    assert said["time"] == pytest.approx(0.4)
    assert "crashed" in said["reason"]
    assert (said["results"], said["manifest"]) == (str(out / "results.csv"), str(out / "manifest.json"))
    assert said["report"] is None


def test_json_of_a_replay_holds_its_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    fmu, time = cart_fmu(tmp_path, starts=0), times(4.0)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(time.size)
    log = write_log(tmp_path / "cart.csv", {"time": time, "force": 0.0 * time, "position": 0.5 + noise})
    code, said = told(monkeypatch, capfd, "replay", log, "--plant", fmu, "--out", tmp_path / "o", "--no-report")
    assert code == 0
    (position,) = said["channels"]
    assert (position["name"], position["horizon"], position["rows"]) == ("position", None, time.size)
    assert position["rmse"] == pytest.approx(0.5, rel=1e-3)  # the FMU stays at 0
    assert position["rmse"] == position["free_run"]["rmse"]
    assert position["fit"] < 0
    assert position["explained"] is False
