"""The layout of the project: names of the public functions, files of the repository."""

from __future__ import annotations

import importlib
import subprocess
from pathlib import Path

import pytest

from tests.test_drive import EXAMPLE, simulated

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize("verb", ["build", "check", "excite", "refine", "replay", "run"])
def test_the_verbs_are_functions_of_the_package(verb: str) -> None:
    assert callable(getattr(importlib.import_module("cosim"), verb))


@pytest.mark.thorough
def test_the_verbs_take_paths_as_they_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cosim = importlib.import_module("cosim")
    assert {"build", "check", "excite", "refine", "replay", "run"} <= {*dir(cosim)}
    monkeypatch.chdir(tmp_path)
    simulated(Path("v1.csv"), 1)
    (plant,) = cosim.build("built", f"{EXAMPLE / 'drive.py'}:Drive")
    assert cosim.check(str(plant)) == cosim.check([plant]) == []
    cosim.replay("v1.csv", "replayed", "built/plant.fmu")
    Path("run.yaml").write_text(
        "name: drive\nduration: 1\nstep: 0.01\ncomponents: {drive: {fmu: built/plant.fmu, start: {force: 20}}}\n"
    )
    cosim.run("run.yaml", "ran")
    assert {path.parent.name for path in Path().glob("*/report.html")} == {"replayed", "ran"}


def test_what_the_package_does_not_have_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="levitate"):
        importlib.import_module("cosim").levitate  # noqa: B018


def test_files_that_are_made_are_not_committed() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("no checkout")
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    assert not [name for name in listed if name.endswith((".fmu", ".so", ".pyc", ".parquet"))]
