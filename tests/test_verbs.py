"""Every verb through the shipped start: `cosim VERB …` in a process of its own, with worker processes of its own.

A verb without --out writes to results/NAME/0001.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import cosim
from cosim.fmi.building.file import load_model
from cosim.fmi.fmu_build import build
from cosim.verbs import verbs
from tests.tank import MODEL, tank_log
from tests.test_identify_craft import at_rest, protocol
from tests.users import ENVIRONMENT

RUN = "name: tank\nduration: 1\nstep: 0.5\ncomponents: {tank: {fmu: tank.fmu}}\n"
STUDY = "model: tank.py:Tank\ncandidates: [leak]\nlogs: {estimation: [e1.csv], validation: [v1.csv]}\n"
SWEEP = "name: areas\nscenario: run.yaml\nruns: 2\nvary: {tank.area: {values: [0.5, 0.6]}}\n"
CASES = {  # verb → its words, and a file that it writes
    "run": ("run.yaml", "results/tank/0001/results.csv"),
    "build": ("--model tank.py:Tank", "build/plant.fmu"),
    "export-ssp": ("run.yaml", "tank.ssp"),
    "check": ("run.yaml tank.fmu tank.py e1.csv", ""),
    "replay": ("e1.csv --plant tank.fmu", "results/e1/0001/residual.csv"),
    "fit": ("e1.csv --fmu tank.fmu --vary area=0.3..2", "results/tank-fit/0001/fit.json"),
    "refine": ("study.yaml --no-report", "results/study/0001/refine.json"),
    "excite": ("tank.py:Tank --against leak --limit level=1 --duration 50 --out out", "out/excitation.csv"),
    "info": ("tank.fmu", ""),
    "init": ("tank.fmu --out first.yaml", "first.yaml"),
    "simulate": ("tank.fmu --stop 1", "results/tank/0001/results.csv"),
    "compare": ("e1.csv v1.csv", "results/e1-and-v1/0001/comparison.json"),
    "report": ("ran", "ran/report.html"),
    "list": ("", ""),
    "open": ("reported --no-browser", ""),
    "view": ("ran --prepare", ""),
    "gc": ("--yes", ""),
    "graph": ("run.yaml", "run.svg"),
    "schema": ("scenario", ""),
    "doctor": ("tank.fmu", ""),
    "linearize": ("tank.py:Tank --at level=1,inflow=0.02", "results/Tank-linear/0001/linear.json"),
    "consistency": ("--runs 2 --steps 100 --no-report", "results/consistency/0001/consistency.json"),
    "sweep": ("sweep.yaml --workers 1 --force", "results/areas/0001/sweep.json"),
    "identify": ("craft.yaml", "results/a-craft/0001/identify.json"),
}


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small FMU, its model, logs, a study, a scenario, a sweep and the folder of a run."""
    folder = tmp_path_factory.mktemp("desk")
    (folder / "tank.py").write_text(MODEL, encoding="utf-8")
    (folder / "study.yaml").write_text(STUDY)
    for seed, name in enumerate(("e1.csv", "v1.csv")):
        tank_log(folder / name, seed, seconds=60.0)
    build(load_model("tank.py:Tank", folder).recipe(), folder / "tank.fmu")
    (folder / "run.yaml").write_text(RUN)
    (folder / "sweep.yaml").write_text(SWEEP)
    at_rest(folder / "rest.csv", 1)
    protocol(folder, rest={"files": ["rest.csv"]})
    cosim.run(folder / "run.yaml", folder / "ran", report=False)
    (folder / "reported").mkdir()
    (folder / "reported" / "report.html").write_text("<html></html>")
    return folder


def test_every_verb_has_a_case() -> None:
    assert set(CASES) == {name for name, verb in verbs() if verb.command}


@pytest.mark.parametrize("verb", CASES)
def test_a_verb_works_as_shipped(desk: Path, tmp_path: Path, verb: str) -> None:
    for library in ("pyarrow", "SALib") if verb == "sweep" else ():
        pytest.importorskip(library)
    words, file = CASES[verb]
    folder = tmp_path / "desk"
    shutil.copytree(desk, folder)
    done = subprocess.run(
        [sys.executable, "-m", "cosim", verb, *words.split()], cwd=folder, capture_output=True, text=True,
        env=ENVIRONMENT,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout
    assert "Traceback" not in done.stderr
    assert (folder / file).exists()
    assert file.startswith("results/") or not (folder / "results").exists()
    if verb in {"replay", "refine"}:  # the answer first, in the words of the record
        lines = done.stdout.splitlines()
        record = json.loads((folder / file).with_name(f"{verb}.json").read_text(encoding="utf-8"))
        assert lines[0].startswith(f"verdict: {record['verdict'].replace('_', ' ')}")
        assert record["sentence"].startswith(lines[1])
        assert len(lines) <= 12
    if verb == "refine":  # what cannot be tested, before and after the search
        assert all(text in done.stderr and text in done.stdout for text in record["untested"])
        assert record["untested"]
