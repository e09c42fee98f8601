"""Every verb through the shipped start: `cosim VERB …` in a process of its own, with worker processes of its own.

A verb without --out writes to results/NAME: the files of an earlier run there move to results/NAME/runs/0001, files of
the user stay.
"""

from __future__ import annotations

import inspect
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cosim.base.registry import resolve
from cosim.fmi.fmu_build import build
from cosim.loading.file import load_model
from cosim.storage.artefact import artefacts
from cosim.verbs import verbs
from tests.tank import MODEL, tank_log
from tests.test_identify_craft import at_rest, protocol

ROOT = Path(__file__).resolve().parent.parent
RUN = "name: tank\nduration: 1\nstep: 0.5\ncomponents: {tank: {fmu: tank.fmu}}\n"
STUDY = "model: tank.py:Tank\ncandidates: [leak]\nlogs: {estimation: [e1.csv], validation: [v1.csv]}\n"
SWEEP = "name: areas\nscenario: run.yaml\nruns: 2\nvary: {tank.area: {values: [0.5, 0.6]}}\n"
CASES = {  # verb → its words, and a file that it writes
    "run": ("run.yaml", "results/tank/results.csv"),
    "build": ("--model tank.py:Tank", "build/plant.fmu"),
    "export-ssp": ("run.yaml", "tank.ssp"),
    "check": ("run.yaml tank.fmu tank.py e1.csv", ""),
    "replay": ("e1.csv --plant tank.fmu", "results/e1/residual.csv"),
    "fit": ("e1.csv --fmu tank.fmu --vary area=0.3..2", "results/tank-fit/fit.json"),
    "refine": ("study.yaml --no-report", "results/study/refine.json"),
    "excite": ("tank.py:Tank --against leak --limit level=1 --duration 50", "results/Tank-excitation/excitation.csv"),
    "info": ("tank.fmu", ""),
    "init": ("tank.fmu --out first.yaml", "first.yaml"),
    "simulate": ("tank.fmu --stop 1", "results/tank/results.csv"),
    "compare": ("e1.csv v1.csv", "results/e1-and-v1/comparison.json"),
    "report": ("ran", "ran/report.html"),
    "list": ("", ""),
    "open": ("reported --no-browser", ""),
    "view": ("ran --prepare", ""),
    "gc": ("--yes", ""),
    "graph": ("run.yaml", "run.svg"),
    "schema": ("scenario", ""),
    "linearize": ("tank.py:Tank --at level=1,inflow=0.02", "results/Tank-linear/linear.json"),
    "consistency": ("--runs 2 --steps 100 --no-report", "results/consistency/consistency.json"),
    "sweep": ("sweep.yaml --workers 1 --force", "results/areas/sweep.json"),
    "identify": ("craft.yaml", "results/a-craft/identify.json"),
}
WRITES_OVER = {"excite", "identify", "linearize"}  # in Python: docs/python.md
NEEDS = {"sweep": ("pyarrow", "SALib")}


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
    import cosim

    cosim.run(folder / "run.yaml", folder / "ran", report=False)
    (folder / "reported").mkdir()
    (folder / "reported" / "report.html").write_text("<html></html>")
    return folder


def shipped(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command as it is installed."""
    return subprocess.run(
        [sys.executable, "-m", "cosim", *words], cwd=folder, capture_output=True, text=True, timeout=300,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip


def earlier_run(folder: Path, verb: str) -> list[str]:
    """Put files that a verb declares into its folder, as an earlier run of it would, and one of the user."""
    folder.mkdir(parents=True)
    (folder / "notes.txt").write_text("of the user")
    name = "cosim run" if verb == "simulate" else f"cosim {verb}"
    files = {file.replace("*", "any") for a in artefacts() if a.verb == name for file in a.files}
    assert files, f"{name} declares no files"
    for file in files:
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / file).write_text("{}")
    return sorted(files)


def test_every_verb_has_a_case() -> None:
    assert set(CASES) == {name for name, verb in verbs() if verb.command}


@pytest.mark.parametrize("name", [name for name, verb in verbs() if verb.command and verb.function])
def test_an_option_has_the_default_of_the_function_in_python(name: str) -> None:
    verb = dict(verbs())[name]
    option, argument = (
        {key.rstrip("_"): p.default for key, p in inspect.signature(resolve(place)).parameters.items()}
        for place in (verb.command, verb.function)
    )
    if name in WRITES_OVER:
        assert (option.pop("force"), argument.pop("force")) == (False, True)
    both = [key for key in option if argument.get(key, inspect.Parameter.empty) is not inspect.Parameter.empty]
    assert {key: option[key] or None for key in both} == {key: argument[key] or None for key in both}


@pytest.mark.parametrize("verb", CASES)
def test_a_verb_works_as_shipped_and_moves_an_earlier_run_aside(desk: Path, tmp_path: Path, verb: str) -> None:
    for library in NEEDS.get(verb, ()):
        pytest.importorskip(library)
    words, file = CASES[verb]
    folder = tmp_path / "desk"
    shutil.copytree(desk, folder)
    result = folder / file
    before = earlier_run(result.parent, verb) if file.startswith("results/") else []
    done = shipped(folder, verb, *words.split())
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout
    assert "Traceback" not in done.stderr
    assert result.exists()
    if before:
        assert result.read_text(encoding="utf-8") != "{}"
        kept = result.parent / "runs" / "0001"
        moved = sorted(p.relative_to(kept).as_posix() for p in kept.rglob("*") if p.is_file())
        assert moved == before
        assert {(kept / name).read_text() for name in before} == {"{}"}
        assert (result.parent / "notes.txt").read_text() == "of the user"
        assert sorted(p.name for p in (result.parent / "runs").iterdir()) == [".last", "0001"]
    else:
        assert not (folder / "results").exists()


# -- earlier runs -------------------------------------------------------------------------------------


def test_runs_are_kept_by_default_and_with_out(desk: Path, tmp_path: Path) -> None:
    import cosim
    from cosim.simulation.workflow import run

    folder = tmp_path / "desk"
    shutil.copytree(desk, folder)
    here = os.getcwd()
    os.chdir(folder)
    try:
        for area in (0.5, 0.6, 0.7):
            run("run.yaml", None, [f"components.tank.start.area={area}"], report=False)
        run("run.yaml", "results/tank", ["components.tank.start.area=0.8"], report=False)
    finally:
        os.chdir(here)
    areas = [
        json.loads((folder / "results" / "tank" / place / "manifest.json").read_text())["scenario"]["components"][
            "tank"
        ]["start"]["area"]
        for place in ("runs/0001", "runs/0002", "runs/0003", ".")
    ]
    assert areas == [0.5, 0.6, 0.7, 0.8]
    assert cosim.read(folder / "results" / "tank" / "runs" / "0002").manifest["scenario"]["name"] == "tank"
