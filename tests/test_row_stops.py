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

from cosim.files.run_entries import entries
from tests.deeds import deeds_scenario
from tests.test_misbehaving import listening

STOPPED = """
import os, sys
from cosim.core.program import as_program
from cosim.files.results import Results
from cosim.verbs.cli import entry

write = Results.write
def stopped(self, path, *more):
    for number in {signals}:
        os.kill(os.getpid(), number)
    write(self, path, *more)
Results.write = stopped
sys.argv[0] = "cosim"
as_program(entry)
"""

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals as POSIX has them")


def stopped(folder: Path, *signals: int) -> tuple[int, str]:
    """Run a command that gets signals before its rows are written; return exit code and stderr."""
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


@pytest.mark.parametrize("count", [1, 2])
def test_rows_are_all_written_after_a_stop_without_report(tmp_path: Path, count: int) -> None:
    code, _ = stopped(tmp_path, *[signal.SIGINT] * count)
    out = tmp_path / "results" / "out"
    assert code == 130
    assert rows_in(out) == record_in(out)["rows"] == 11
    assert record_in(out)["no_report"]
    assert not (out / "report.html").exists()
    assert outcomes(tmp_path) == {"out": "ok, no report: interrupted from the keyboard"}


def test_a_kill_while_rows_are_written_leaves_an_interrupted_run(tmp_path: Path) -> None:
    assert stopped(tmp_path, signal.SIGKILL)[0] == -signal.SIGKILL
    assert outcomes(tmp_path) == {"out": "interrupted"}
    assert stopped(tmp_path)[0] == 2  # not empty
