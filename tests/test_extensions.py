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

import numpy as np
import pytest

from tests.tank import MODEL, tank_log

ROOT = Path(__file__).resolve().parent.parent
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
from cosim.report.html_tables import Row
from cosim.simulation.report.component_page import ComponentPage
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
LOGS = re.search(
    r"```text\n# acme/logs.py.*?\n(.*?)```", (ROOT / "docs" / "extending.md").read_text("utf-8"), re.DOTALL
)
PAGE = '{% extends "run.html.j2" %}\n{% block subject %}<p id="acme">A tank by {{ maker }}</p>{% endblock %}\n'


TANK_RUN = "name: tank\nduration: 10\nstep: 0.5\ncomponents: {tank: {fmu: build/plant.fmu}}\n"


def command(*arguments: object, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a cosim command with more on the path."""
    return subprocess.run(
        [sys.executable, "-m", "cosim", *map(str, arguments)], cwd=folder, capture_output=True, text=True, timeout=300,
        env={**os.environ, **environment},
    )  # fmt: skip


def installed(project: Path, target: Path) -> Path:
    """Install a project into a folder, offline and without its dependencies."""
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--target", str(target), str(project)], check=True, capture_output=True, timeout=300)
    return target


def need_setuptools() -> None:
    """Skip where nothing can be installed; importing setuptools here would replace the process's distutils."""
    if find_spec("setuptools") is None:
        pytest.skip("setuptools, which installs the package, is not there")


@pytest.fixture(scope="module")
def acme(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package of a third party, installed."""
    need_setuptools()
    project, target = tmp_path_factory.mktemp("project"), tmp_path_factory.mktemp("acme")
    (project / "acme").mkdir()
    (project / "pyproject.toml").write_text(PYPROJECT)
    (project / "acme" / "__init__.py").write_text('"""Tanks."""\n')
    (project / "acme" / "tank.py").write_text(MODEL, encoding="utf-8")
    (project / "acme" / "registered.py").write_text(REGISTERED)
    assert LOGS is not None
    (project / "acme" / "logs.py").write_text(LOGS[1])
    (project / "acme" / "tank.html.j2").write_text(PAGE)
    return installed(project, target)


def registering(folder: Path, name: str, group: str, point: str) -> Path:
    """A distribution of which there is nothing but what it registers."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{point}\n")
    return folder


def test_a_third_party_registers_a_model_a_page_and_a_command(acme: Path, tmp_path: Path) -> None:
    path = str(acme)
    (tmp_path / "tank.yaml").write_text("model: acme_tank\nparameters: {area: 0.6}\n")
    built = command("build", "--model", "tank.yaml", folder=tmp_path, PYTHONPATH=path)
    assert built.returncode == 0, built.stderr
    (tmp_path / "run.yaml").write_text(TANK_RUN)
    ran = command("run", "run.yaml", folder=tmp_path, PYTHONPATH=path)
    assert ran.returncode == 0, ran.stderr
    assert "A tank by Acme" in (tmp_path / "results" / "tank" / "0001" / "report.html").read_text(encoding="utf-8")
    told = command("tank-volume", "2.0", folder=tmp_path, PYTHONPATH=path)
    assert told.stdout == "volume: 1.0 m3\n", told.stderr
    help_page = command("--help", folder=tmp_path, PYTHONPATH=path).stdout
    assert "Tanks" in help_page
    assert "tank-volume" in help_page
    (tmp_path / "book.json").write_text('{"tank_book": 1}')
    assert "book.json: note: a tank book" in command("check", "book.json", folder=tmp_path, PYTHONPATH=path).stdout
    refused = command("run", "book.json", folder=tmp_path, PYTHONPATH=path).stderr
    assert "is a tank book, not a scenario or a manifest: `cosim tank-volume LEVEL` tells volumes" in refused
    python = "import cosim; print(cosim.tank_volume(2.0), cosim.read('.').startswith('the book of'))"
    done = subprocess.run(
        [sys.executable, "-c", python], cwd=tmp_path, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join((path, str(ROOT)))},
    )  # fmt: skip
    assert done.stdout == "1.0 True\n", done.stderr


def test_a_third_party_registers_a_format_of_logs(acme: Path, tmp_path: Path) -> None:
    """The page's example: each verb takes the format, and each fault of such a file is told as of any other."""
    rows = np.column_stack((np.arange(3.0), [1.0, 2.0, 3.0]))
    (tmp_path / "a.acme").write_bytes(b"ACME" + rows.tobytes())
    (tmp_path / "a.csv").write_text("time,level\n0,1\n1,2\n2,3\n")
    same = command("compare", "a.csv", "a.acme", "--tol", "0", folder=tmp_path, PYTHONPATH=str(acme))
    assert same.returncode == 0, same.stderr
    (tmp_path / "back.acme").write_bytes(b"ACME" + rows[::-1].tobytes())
    done = command("compare", "a.csv", "back.acme", folder=tmp_path, PYTHONPATH=str(acme))
    assert done.returncode == 2
    assert "back.acme:2:1: time 1 s does not increase" in done.stderr


def test_two_packages_under_one_name_are_an_error_that_names_both(tmp_path: Path) -> None:
    site = tmp_path / "site"
    for name in ("first", "second"):
        registering(site, name, "cosim.models", f"twice = {name}:MODEL")
    (tmp_path / "m.yaml").write_text("model: twice\nparameters: {}\n")
    done = command("check", "m.yaml", folder=tmp_path, PYTHONPATH=str(site))
    assert done.returncode == 2
    assert '"twice" is registered by first and second; uninstall one of them' in done.stderr


# -- the framework alone --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment that holds the framework and its dependencies, and no example."""
    need_setuptools()
    place = tmp_path_factory.mktemp("alone")
    source = place / "source"
    shutil.copytree(ROOT / "cosim", source / "cosim", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    venv.create(place / "env", with_pip=False, symlinks=True)
    (site,) = (place / "env").glob("lib/python*/site-packages")
    own = ("fmu_cosim", "__editable__", "cosim", "plant", "controller", "fmus")
    for folder in map(Path, sys.path):
        if folder.name == "site-packages":
            for entry in folder.iterdir():
                if not entry.name.startswith(own) and entry.suffix != ".pth" and not (site / entry.name).exists():
                    (site / entry.name).symlink_to(entry)
    installed(source, site)
    return place / "env" / "bin" / "python"


@pytest.fixture
def rooms(tmp_path: Path) -> Path:
    """A folder whose own plant.py, controller.py and fmus.py must never be imported."""
    for name in ("plant", "controller", "fmus"):
        (tmp_path / f"{name}.py").write_text(f"raise RuntimeError('{name}.py of the user was imported')\n")
    return tmp_path


@pytest.mark.thorough
def test_the_framework_alone_serves_foreign_fmus_beside_files_of_the_users_names(
    alone: Path, rooms: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    from cosim.fmi.building.file import load_model
    from cosim.fmi.fmu_build import build

    (rooms / "tank.py").write_text(MODEL, encoding="utf-8")
    build(load_model("tank.py:Tank", rooms).recipe(), rooms / "tank.fmu")
    tank_log(rooms / "log.csv", 1, seconds=60.0)

    def cosim(*arguments: str, code: int = 0) -> str:
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        done = subprocess.run(
            [str(alone), "-m", "cosim", *arguments], cwd=rooms, capture_output=True, text=True, timeout=300,
            env=environment,
        )  # fmt: skip
        assert done.returncode == code, (arguments, done.stdout, done.stderr)
        assert "Traceback" not in done.stderr
        return done.stdout + done.stderr

    cosim("info", "tank.fmu")
    cosim("init", "tank.fmu", "--out", "run.yaml")
    cosim("check", "run.yaml", "tank.fmu", "tank.py", "log.csv")
    cosim("run", "run.yaml", "--out", "one")
    cosim("run", "run.yaml", "--out", "two", "--set", "components.tank.start.area=0.6")
    cosim("simulate", "tank.fmu", "--stop", "5", "--out", "three")
    cosim("compare", "one", "two", "--out", "compared")
    cosim("report", "one")
    cosim("graph", "run.yaml")
    cosim("export-ssp", "run.yaml", "--out", "run.ssp")
    cosim("replay", "log.csv", "--plant", "tank.fmu", "--out", "replayed")
    cosim("linearize", "tank.py:Tank", "--at", "level=1,inflow=0.02", "--out", "linear")
    cosim("build", "--model", "tank.py:Tank")
    for kind in ("scenario", "study", "model", "sweep"):
        json.loads(cosim("schema", kind))
    help_text = cosim("--help")
    assert "identify" not in help_text
    assert "consistency" not in help_text
    # what needs the example says what to name instead
    assert 'no model "base" is installed; name a' in cosim("replay", "log.csv", code=2)
    assert "name one: a model.yaml" in cosim("build", code=2)
    (rooms / "study.yaml").write_text("model: base\nlogs: {estimation: [log.csv]}\n")
    assert "study.yaml:1:8: " in cosim("check", "study.yaml", code=2)
