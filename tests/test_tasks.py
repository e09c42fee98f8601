"""The six tasks of examples/tanks/tasks.sh, with the FMUs and the log of another tool."""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT

TANKS = ROOT / "examples" / "tanks"
MOST = (7, 5, 1, 3, 2, 2)  # commands of each task
TASKS = [part.splitlines() for part in (TANKS / "tasks.sh").read_text(encoding="utf-8").split("\n# ")[2:]]
COMMANDS = [[line for line in lines[1:] if line] for lines in TASKS]
LEAVES = (
    ["runs-1-2-3/0001/comparison.json", "Tank_Controller/0003/results.csv"],
    ["e1/0001/residual.csv", "Tank-fit/0001/fitted.fmu", "study/0001/plant.fmu"],
    ["Tank_Controller/0004/sweep.parquet"],
    ["../Tank_Controller.ssp"],
    [],
    ["../level.png"],
)


def test_no_task_takes_more_commands_than_a_user_has_patience_for() -> None:
    assert [len(lines) <= most for lines, most in zip(COMMANDS, MOST, strict=True)] == [True] * 6


@pytest.mark.thorough
def test_six_tasks_run_without_a_stop(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    for name in ("tank.py", "level_control.py", "make_logs.py", "sweep.yaml", "script.py"):
        shutil.copy(TANKS / name, tmp_path)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {name: value for name, value in os.environ.items() if name not in {"DISPLAY", "WAYLAND_DISPLAY"}}
    settings: dict[str, Any] = {"shell": True, "cwd": tmp_path, "env": {**environment, "PATH": path}}

    def run(*lines: str) -> None:
        for line in lines:
            if line.startswith("cosim view"):  # which serves its page until a user ends it
                with subprocess.Popen(f"exec {line}", stderr=subprocess.PIPE, text=True, **settings) as view:
                    assert view.stderr is not None
                    assert any("http://" in text for text in view.stderr)
                    view.terminate()
                    assert view.wait(60) in {0, 4}
            else:
                subprocess.run(line, check=True, timeout=400, **settings)

    run("pythonfmu build -f tank.py", "pythonfmu build -f level_control.py", "python make_logs.py .")
    book = openpyxl.Workbook()
    with (tmp_path / "e1.csv").open(newline="") as stream:
        for k, row in enumerate(csv.reader(stream)):
            book.active.append([float(cell) if k and cell else cell or None for cell in row])
    book.save(tmp_path / "e1.xlsx")
    for lines, names in zip(COMMANDS, LEAVES, strict=True):
        run(*lines)
        assert [name for name in names if not (tmp_path / "results" / name).exists()] == []
