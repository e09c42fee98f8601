"""What an installed package may register, and the framework without the worked example."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import venv
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import ROOT
from tests.tank import LEAK, MODEL, tank_study

PYPROJECT = """
[build-system]
requires = ["setuptools>=68"]
build-backend = "setuptools.build_meta"
[project]
name = "acme-tanks"
version = "1.0"
[project.entry-points."cosim.models"]
acme_tank = "acme.registered:TANK"
[project.entry-points."cosim.pages"]
acme_tank = "acme.registered:PAGE"
[project.entry-points."cosim.sources"]
acme = "acme.logs:SOURCE"
[project.entry-points."cosim.verbs"]
tank-volume = "acme.registered:VOLUME"
[tool.setuptools]
packages = ["acme"]
[tool.setuptools.package-data]
acme = ["*.j2"]
"""
REGISTERED = '''
from pathlib import Path

from acme import tank
from cosim.core.registry import ModelEntry, Page, Verb
from cosim.fmi.fmu_build import model_recipe
from cosim.report.template import Row
from cosim.simulation.report.recorded import ComponentPage
from cosim.files.artefact import Artefact

TANK = ModelEntry(name="acme_tank", model="acme.tank:Tank", recipe="acme.registered:tank_recipe")
PAGE = Page(frozenset({"inflow", "level"}), "acme.registered:subject")
VOLUME = Verb("acme.registered:command", "acme.registered:volume", "acme.registered:ARTEFACTS", group="Tanks")
ARTEFACTS = (
    Artefact(
        "a tank book", "`cosim tank-volume LEVEL` tells volumes", keys=(frozenset({"tank_book"}),),
        marks=("book.json",), check="acme.registered:check", reader="acme.registered:read",
    ),
)


def check(path, checking):
    return ["note: a tank book"]


def read(folder):
    return "the book of " + folder.name


def tank_recipe(values=None):
    return model_recipe(tank.Tank(), Path(tank.__file__), values)


def subject(run, drawing):
    return ComponentPage(Path(__file__).with_name("tank.html.j2"), {"maker": "Acme"}, [Row("Made by", "Acme")])


def volume(level: float) -> float:
    """Return the volume at a level."""
    return 0.5 * level


def command(level: float) -> None:
    """Print the volume of water at a level."""
    print(f"volume: {volume(level)} m3")
'''
EXTENDING = (ROOT / "docs" / "extending.md").read_text("utf-8")
(LOGS,) = re.findall(r"```text\n# acme/logs.py.*?\n(.*?)```", EXTENDING, re.DOTALL)
PAGE = '{% extends "run.html.j2" %}\n{% block subject %}<p id="acme">A tank by {{ maker }}</p>{% endblock %}\n'


TANK_RUN = "name: tank\nduration: 10\nstep: 0.5\ncomponents: {tank: {fmu: build/plant.fmu}}\n"


def python(*words: object, folder: Path, path: object = "", program: object = sys.executable) -> Any:
    """Run Python with more on its path."""
    environment = {**os.environ, "PYTHONPATH": str(path)}
    done = subprocess.run(
        [*map(str, (program, *words))], cwd=folder, capture_output=True, text=True, timeout=300, env=environment
    )
    assert "Traceback" not in done.stderr
    return done


def installed(project: Path, target: Path) -> Path:
    """Install a project into a folder, offline and without its dependencies."""
    if find_spec("setuptools") is None:  # importing it here would replace the process's distutils
        pytest.skip("setuptools, which installs the package, is not there")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--target", str(target), str(project)], check=True, capture_output=True, timeout=300)
    return target


@pytest.fixture(scope="module")
def acme(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package of a third party, installed."""
    project = tmp_path_factory.mktemp("project")
    (project / "acme").mkdir()
    (project / "pyproject.toml").write_text(PYPROJECT)
    for name, text in (
        ("__init__.py", '"""Tanks."""\n'),
        ("tank.py", MODEL),
        ("registered.py", REGISTERED),
        ("logs.py", LOGS),
        ("tank.html.j2", PAGE),
    ):
        (project / "acme" / name).write_text(text, encoding="utf-8")
    return installed(project, tmp_path_factory.mktemp("acme"))


def test_a_third_party_registers_a_model_a_page_and_a_command(acme: Path, tmp_path: Path) -> None:
    def cosim(*words: str) -> Any:
        return python("-m", "cosim", *words, folder=tmp_path, path=acme)

    (tmp_path / "tank.yaml").write_text("model: acme_tank\nparameters: {area: 0.6}\n")
    (tmp_path / "run.yaml").write_text(TANK_RUN)
    for words in (("build", "--model", "tank.yaml"), ("run", "run.yaml", "--out", "ran")):
        assert cosim(*words).returncode == 0
    assert "A tank by Acme" in (tmp_path / "ran" / "report.html").read_text(encoding="utf-8")
    assert cosim("tank-volume", "2.0").stdout == "volume: 1.0 m3\n"
    assert "tank-volume" in cosim("--help").stdout
    (tmp_path / "book.json").write_text('{"tank_book": 1}')
    assert "book.json: note: a tank book" in cosim("check", "book.json").stdout
    assert "is a tank book, not a scenario or a manifest" in cosim("run", "book.json").stderr
    code = "import cosim; print(cosim.tank_volume(2.0), cosim.read('.').startswith('the book of'))"
    assert python("-c", code, folder=tmp_path, path=f"{acme}{os.pathsep}{ROOT}").stdout == "1.0 True\n"


def test_a_third_party_registers_a_format_of_logs(acme: Path, tmp_path: Path) -> None:
    """The page's example: each verb takes the format, and each fault of such a file is told as of any other."""
    rows = np.column_stack((np.arange(3.0), [1.0, 2.0, 3.0]))
    for name, written in (("a", rows), ("back", rows[::-1])):
        (tmp_path / f"{name}.acme").write_bytes(b"ACME" + written.tobytes())
    (tmp_path / "a.csv").write_text("time,level\n0,1\n1,2\n2,3\n")
    for name, code in (("a", 0), ("back", 2)):
        words = ("compare", "a.csv", f"{name}.acme", "--tol", "0")
        done = python("-m", "cosim", *words, folder=tmp_path, path=acme)
        assert done.returncode == code
    assert "back.acme:2:1: time 1 s does not increase" in done.stderr


def test_two_packages_under_one_name_are_an_error_that_names_both(tmp_path: Path) -> None:
    for name in ("first", "second"):  # distributions of which there is nothing but what they register
        info = tmp_path / f"{name}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[cosim.models]\ntwice = {name}:MODEL\n")
    (tmp_path / "m.yaml").write_text("model: twice\nparameters: {}\n")
    done = python("-m", "cosim", "check", "m.yaml", folder=tmp_path, path=tmp_path)
    assert done.returncode == 2
    assert '"twice" is registered by first and second; uninstall one of them' in done.stderr


# -- the framework alone --------------------------------------------------------------------------


@pytest.mark.thorough
def test_the_framework_alone_serves_foreign_fmus_beside_files_of_the_users_names(tmp_path: Path) -> None:
    """In an environment that holds the framework and its dependencies, and no example."""
    source, environment, rooms = tmp_path / "source", tmp_path / "env", tmp_path / "rooms"
    shutil.copytree(ROOT / "cosim", source / "cosim", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    venv.create(environment, with_pip=False, symlinks=True)
    (site,) = environment.glob("lib/python*/site-packages")
    own = ("fmu_cosim", "__editable__", "cosim", "plant", "controller", "fmus")
    for entry in (entry for folder in sys.path if folder.endswith("site-packages") for entry in Path(folder).iterdir()):
        if not entry.name.startswith(own) and entry.suffix != ".pth" and not (site / entry.name).exists():
            (site / entry.name).symlink_to(entry)
    installed(source, site)
    rooms.mkdir()
    for name in ("plant", "controller", "fmus"):
        (rooms / f"{name}.py").write_text(f"raise RuntimeError('{name}.py of the user was imported')\n")
    tank_study(rooms)
    (rooms / "craft.yaml").write_text("model: base\nlogs: {estimation: [e1.csv]}\n")

    def cosim(words: str, code: int = 0) -> str:
        program = environment / "bin" / "python"
        done = python("-m", "cosim", *words.split(), folder=rooms, program=program)
        assert done.returncode == code, (words, done.stdout, done.stderr)
        return str(done.stdout + done.stderr)

    for words in (
        "build --model tank.py:Tank",
        "init build/plant.fmu --out run.yaml",
        "check run.yaml tank.py study.yaml",
        "check --model tank.py:Tank e1.csv",
        "run run.yaml --out one",
        "simulate build/plant.fmu --stop 5 --out three",
        "compare one three --out compared",
        "report one",
        "graph run.yaml",
        "export-ssp run.yaml --out run.ssp",
        "replay e1.csv --plant build/plant.fmu --out replayed",
        "linearize tank.py:Tank --at level=1,inflow=0.02 --out linear",
        "schema study",
        "refine study.yaml --out refined",
        "excite tank.py:Tank --out flown",
        "run flown/excitation.yaml --out ran",
    ):
        cosim(words)
    (effect,) = json.loads((rooms / "refined" / "refine.json").read_text())["effects"]
    low, high = effect["parameters"]["rate"]["ci95"]
    assert low - (high - low) < LEAK < high + (high - low)
    for page in ("refined", "replayed", "ran"):
        text = (rooms / page / "report.html").read_text(encoding="utf-8")
        words = re.sub(r"<script.*?</script>|<style.*?</style>", "", text, flags=re.DOTALL)
        assert not re.search(r"craft|duty|tilt|heading|psi", words, re.IGNORECASE), page
    assert "identify" not in cosim("--help")
    # what needs the example says what to name instead
    assert 'no model "base" is installed; give a model.yaml' in cosim("replay e1.csv", 2)
    assert "a model.yaml" in cosim("build", 2)
    assert "craft.yaml:1:8: " in cosim("check craft.yaml", 2)
