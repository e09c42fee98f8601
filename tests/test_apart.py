"""The craft is the example: where importing it raises, models of others are checked, replayed, refined and flown."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tank import LEAK, tank_study
from tests.test_drive import EXAMPLE, simulated

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


def cosim(folder: Path, *arguments: str) -> str:
    """Run a command where the craft cannot be imported; its output."""
    command = [sys.executable, "-c", APART, *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, (arguments, done.stdout, done.stderr)
    return done.stdout


@pytest.fixture(scope="module", params=["tank", pytest.param("drive", marks=pytest.mark.thorough)])
def bench(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with a model file, three logs and a study; and how the model is called."""
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == "tank":
        tank_study(folder)
        return folder, "tank.py:Tank"
    shutil.copy(EXAMPLE / "drive.py", folder)
    for seed, name in enumerate(("e1.csv", "e2.csv", "v1.csv")):
        simulated(folder / name, seed)
    (folder / "study.yaml").write_text(
        "model: drive.py:Drive\nlogs: {estimation: [e1.csv, e2.csv], validation: [v1.csv]}\n"
    )
    return folder, "drive.py:Drive"


MISSING = {"tank.py:Tank": {"leak"}, "drive.py:Drive": {"force_offset", "coulomb_friction"}}
FLIGHT = {"tank.py:Tank": [], "drive.py:Drive": ["--limit", "force=60", "--duration", "20"]}  # a tank is slow: 400 s


@pytest.mark.thorough
def test_a_model_of_another_is_checked_refined_replayed_and_flown_without_the_craft(bench: tuple[Path, str]) -> None:
    folder, model = bench
    assert "no fault" in cosim(folder, "check", model.partition(":")[0], "study.yaml")
    assert "no fault" in cosim(folder, "check", "--model", model, "e1.csv")
    cosim(folder, "refine", "study.yaml", "--out", "refined")
    found = json.loads((folder / "refined" / "refine.json").read_text())
    assert {e["name"] for e in found["effects"]} == MISSING[model], found["sentence"]
    if model == "tank.py:Tank":
        (low, high) = found["effects"][0]["parameters"]["rate"]["ci95"]
        assert low - (high - low) < LEAK < high + (high - low)
    cosim(folder, "build", "--model", model, "--out", "built")
    cosim(folder, "replay", "v1.csv", "--plant", "built/plant.fmu", "--out", "replayed")
    cosim(folder, "excite", model, *FLIGHT[model], "--out", "flown")
    rows = (folder / "flown" / "excitation.csv").read_text().count("\n") - 1
    assert rows == {"tank.py:Tank": 801, "drive.py:Drive": 4001}[model]
    cosim(folder, "run", "flown/excitation.yaml", "--out", "ran")
    for page in ("refined", "replayed", "ran"):
        text = (folder / page / "report.html").read_text(encoding="utf-8")
        words = re.sub(r"<script.*?</script>|<style.*?</style>", "", text, flags=re.DOTALL)
        assert not re.search(r"craft|duty|tilt|heading|psi", words, re.IGNORECASE), page
