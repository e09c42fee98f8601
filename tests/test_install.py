"""An install that is not editable, used outside of the checkout: what was not packaged is missing there."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.table import TABLE, table_log

ROOT = Path(__file__).resolve().parent.parent
EXAMPLE = "examples/hovercraft/pyproject.toml"
PARTS = ("plant", "controller", "fmus", "cosim", "pyproject.toml", "README.md", "LICENSE", EXAMPLE)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The packages as `pip install .` puts them, without their dependencies, which are installed already."""
    if importlib.util.find_spec("setuptools") is None or importlib.util.find_spec("pip") is None:
        pytest.skip("needs pip and setuptools in the environment")
    source, target = (tmp_path_factory.mktemp(name) for name in ("source", "site"))
    for part in PARTS:
        here = ROOT / part
        if here.is_dir():
            shutil.copytree(here, source / part, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            (source / part).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(here, source / part)
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    projects = [str(source), str((source / EXAMPLE).parent)]
    subprocess.run([*command, "--target", str(target), *projects], check=True, capture_output=True, timeout=300)
    return target


def cosim(site: Path, folder: Path, *arguments: str, **environment: str) -> str:
    """Run a command of the installed package; its output."""
    done = subprocess.run(
        [sys.executable, "-m", "cosim", *arguments], cwd=folder, capture_output=True, text=True, timeout=300,
        env={**os.environ, "PYTHONPATH": str(site), **environment},
    )  # fmt: skip
    assert done.returncode == 0, (arguments, done.stdout, done.stderr)
    return done.stdout


@pytest.mark.thorough
def test_every_package_and_its_data_is_installed(site: Path) -> None:
    kinds = (".py", ".c", ".j2", ".css", ".js", ".json", ".txt", ".png", ".typed")
    for package in PARTS[:4]:
        for path in (ROOT / package).rglob("*"):
            if (path.suffix in kinds and "__pycache__" not in path.parts) or path.name == "py.typed":
                assert (site / path.relative_to(ROOT)).is_file(), path.relative_to(ROOT)


@pytest.mark.thorough
def test_the_installed_package_builds_runs_and_refines_outside_of_the_checkout(site: Path, tmp_path: Path) -> None:
    where = [sys.executable, "-c", "import cosim, fmus; print(cosim.__file__, fmus.__file__)"]
    environment = {**os.environ, "PYTHONPATH": str(site)}
    told = subprocess.run(where, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout
    assert told.split() == [str(site / name / "__init__.py") for name in ("cosim", "fmus")]
    shutil.copytree(ROOT / "scenarios", tmp_path / "scenarios")
    cosim(site, tmp_path, "build", "--model", "hovercraft", "--out", "build")
    cosim(site, tmp_path, "run", "scenarios/regulate.yaml", "--out", "ran")
    assert "data-craft" in (tmp_path / "ran" / "report.html").read_text(encoding="utf-8")
    (tmp_path / "table.py").write_text(TABLE, encoding="utf-8")
    for seed, name in enumerate("ab"):
        table_log(tmp_path / f"{name}.csv", seed)
    (tmp_path / "study.yaml").write_text("model: table.py:Table\nlogs: {estimation: [a.csv], validation: [b.csv]}\n")
    cosim(site, tmp_path, "refine", "study.yaml", "--out", "refined")
    assert json.loads((tmp_path / "refined" / "refine.json").read_text())["verdict"] == "effect_found"
    cosim(site, tmp_path, "replay", "b.csv", "--plant", "refined/plant.fmu", "--out", "replayed")
