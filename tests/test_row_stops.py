"""Commands that are stopped or killed while they write the rows of a run."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from cosim.history.entries import entries
from cosim.storage.folder_lock import folder_locks
from cosim.storage.folders import rows_of_killed
from tests.deeds import deeds_scenario
from tests.test_misbehaving import listening

STOPPED = """
import os, sys
from cosim.base.program import as_program
from cosim.simulation.row_stops import RowStops
from cosim.simulation import row_stops
from cosim.storage import results
from cosim.verbs.cli import entry

results.CHUNK, row_stops.MANY_VALUES, row_stops.SAME_PRESS = 4, 0, -1.0
signals, go_on = {signals}, RowStops.go_on
def stopped(self, rows):
    while signals:
        os.kill(os.getpid(), signals.pop())
    return go_on(self, rows)
RowStops.go_on = stopped
sys.argv[0] = "cosim"
as_program(entry)
"""

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals as POSIX has them")


def stopped(folder: Path, *signals: int) -> tuple[int, str]:
    """Run a command that gets signals after four of eleven rows; return exit code and stderr."""
    path = deeds_scenario(folder, "none", "none")
    words = ["run", str(path), "--out", str(folder / "results" / "out")]
    command = [sys.executable, "-c", STOPPED.format(signals=[int(number) for number in signals]), *words]
    prepare = None if sys.platform == "win32" else listening
    ended = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=60, check=False, preexec_fn=prepare)
    return ended.returncode, ended.stderr


def rows_in(folder: Path) -> int:
    """Return the number of rows."""
    return len((folder / "results.csv").read_text().splitlines()) - 1


def record_in(folder: Path) -> dict[str, Any]:
    """Return the manifest."""
    record: dict[str, Any] = json.loads((folder / "manifest.json").read_text())
    return record


def outcomes(folder: Path) -> dict[str, str]:
    """Return name and outcome of all results."""
    return {entry.name: entry.outcome for entry in entries(folder / "results")}


def test_a_stop_is_answered_at_once_and_all_rows_are_written_without_report(tmp_path: Path) -> None:
    code, told = stopped(tmp_path, signal.SIGINT)
    out = tmp_path / "results" / "out"
    assert code == 130
    assert told.index("their 11 rows are being written") < told.index("error: the report of the run")
    assert rows_in(out) == record_in(out)["rows"] == 11
    assert any(text.startswith("there is no report: ") for text in record_in(out)["warnings"])
    assert not (out / "report.html").exists()
    assert outcomes(tmp_path) == {"out": "ok, no report: interrupted from the keyboard"}


def test_a_second_stop_ends_the_rows_and_keeps_those_written(tmp_path: Path) -> None:
    code, told = stopped(tmp_path, signal.SIGINT, signal.SIGINT)
    out = tmp_path / "results" / "out"
    assert code == 130
    assert "error: the rows of the run at t = 0.3 s: interrupted" in told
    assert rows_in(out) == record_in(out)["rows"] == 4
    assert not (out / "report.html").exists()
    assert outcomes(tmp_path) == {"out": record_in(out)["status"]}
    assert "only 4 of 11 rows are in results.csv" in record_in(out)["status"]


def test_rows_of_a_killed_run_are_listed_and_kept_by_the_next(tmp_path: Path) -> None:
    assert stopped(tmp_path, signal.SIGKILL)[0] == -signal.SIGKILL
    out = tmp_path / "results" / "out"
    assert outcomes(tmp_path)["out"].startswith("failed: its rows are not all written")
    draft = next(out.glob(".results.csv.*"))
    draft.write_text("time,a\n0.0,1.0\n0.1,2.0\n0.2,3")  # a system writes what it likes of the last line
    code, told = stopped(tmp_path)
    assert code == 0
    assert "a run was killed while it wrote its rows" in told
    assert (out / "runs" / "0001" / "results.csv").read_text() == "time,a\n0.0,1.0\n0.1,2.0\n"
    assert outcomes(tmp_path)["out/0001"].startswith("failed: its rows are not all written")
    assert rows_in(out) == 11
    assert not draft.exists()


@pytest.mark.parametrize(
    ("content", "there", "kept"),
    [("", False, None), ("time,a\n0.0", False, None), ("t\n1\n", False, "r.csv"), ("t\n1\n", True, "runs/0001/r.csv")],
)
def test_rows_of_a_killed_command_replace_no_file(tmp_path: Path, content: str, there: bool, kept: str | None) -> None:
    (tmp_path / ".r.csv.123").write_text(content)
    if there:
        (tmp_path / "r.csv").write_text("mine")
    with folder_locks():
        found = rows_of_killed(tmp_path, "r")
    assert found == (None if kept is None else tmp_path / kept)
    assert not there or (tmp_path / "r.csv").read_text() == "mine"
