"""The craft is the example: where importing it raises, models of others are checked, replayed, refined and flown."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tank import LEAK, tank_study

CRAFT = ("plant", "controller", "fmus.plant_fmu", "fmus.controller_fmu", "fmus.recipes", "fmus.report", "benchmarks")
APART = f"""
import sys

class Closed:
    def find_spec(self, name, path=None, target=None):
        if any(name == room or name.startswith(room + ".") for room in {CRAFT!r}):
            raise ImportError(f"{{name}} is the craft's")

sys.meta_path.insert(0, Closed())
from cosim.verbs.cli import entry
sys.argv = ["cosim", *sys.argv[1:]]
entry()
"""


def cosim(folder: Path, arguments: str) -> str:
    """Run a command where the craft cannot be imported; its output."""
    command = [sys.executable, "-c", APART, *arguments.split()]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, (arguments, done.stdout, done.stderr)
    return done.stdout


@pytest.mark.thorough
def test_a_model_of_another_is_checked_refined_replayed_and_flown_without_the_craft(tmp_path: Path) -> None:
    tank_study(tmp_path)
    assert "no fault" in cosim(tmp_path, "check tank.py study.yaml")
    assert "no fault" in cosim(tmp_path, "check --model tank.py:Tank e1.csv")
    cosim(tmp_path, "refine study.yaml --out refined")
    (effect,) = json.loads((tmp_path / "refined" / "refine.json").read_text())["effects"]
    assert effect["name"] == "leak"
    low, high = effect["parameters"]["rate"]["ci95"]
    assert low - (high - low) < LEAK < high + (high - low)
    cosim(tmp_path, "build --model tank.py:Tank --out built")
    cosim(tmp_path, "replay v1.csv --plant built/plant.fmu --out replayed")
    cosim(tmp_path, "excite tank.py:Tank --out flown")
    assert (tmp_path / "flown" / "excitation.csv").read_text().count("\n") == 802  # a tank is slow: 400 s
    cosim(tmp_path, "run flown/excitation.yaml --out ran")
    for page in ("refined", "replayed", "ran"):
        text = (tmp_path / page / "report.html").read_text(encoding="utf-8")
        words = re.sub(r"<script.*?</script>|<style.*?</style>", "", text, flags=re.DOTALL)
        assert not re.search(r"craft|duty|tilt|heading|psi", words, re.IGNORECASE), page
