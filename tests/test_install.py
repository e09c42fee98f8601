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

from tests.conftest import ROOT
from tests.table import TABLE, table_log

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


@pytest.mark.thorough
def test_the_installed_package_builds_runs_and_refines_outside_of_the_checkout(site: Path, tmp_path: Path) -> None:
    def done(*words: str) -> str:
        given = {"env": {**os.environ, "PYTHONPATH": str(site)}, "cwd": tmp_path, "text": True, "timeout": 300}
        return subprocess.run([sys.executable, *words], check=True, stdout=subprocess.PIPE, **given).stdout

    told = done("-c", "import cosim, fmus; print(cosim.__file__, fmus.__file__)")
    assert told.split() == [str(site / name / "__init__.py") for name in ("cosim", "fmus")]
    shutil.copytree(ROOT / "scenarios", tmp_path / "scenarios")
    (tmp_path / "table.py").write_text(TABLE, encoding="utf-8")
    for seed, name in enumerate("ab"):
        table_log(tmp_path / f"{name}.csv", seed)
    (tmp_path / "study.yaml").write_text("model: table.py:Table\nlogs: {estimation: [a.csv], validation: [b.csv]}\n")
    for words in (
        "build --model hovercraft --out build",
        "run scenarios/regulate.yaml --out ran",
        "refine study.yaml --out refined",
        "replay b.csv --plant refined/plant.fmu --out replayed",
    ):
        done("-m", "cosim", *words.split())
    assert "data-craft" in (tmp_path / "ran" / "report.html").read_text(encoding="utf-8")
    assert json.loads((tmp_path / "refined" / "refine.json").read_text())["verdict"] == "effect_found"
