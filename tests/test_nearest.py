"""`--nearest`: where a refine is named, the model that came nearest in it, with `build` and `run`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cosim.core.errors import InputError
from cosim.fmi.building.build import build
from cosim.fmi.description import read_description
from cosim.simulation.workflow import run
from cosim.verbs.cli import command_line


def refine_left(folder: Path, grade: str | None = "nearest", fmu: Path | None = None) -> Path:
    """What a refine of the craft leaves: 0.8 kg in model.yaml, 0.9 kg in nearest.yaml; the nearest FMU is as named."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "refine.json").write_text(json.dumps({"grade": grade} if grade else {"verdict": "no_effect"}))
    (folder / "model.yaml").write_text("parameters: {mass: 0.8}\n")
    if fmu is not None:
        shutil.copy(fmu, folder / "plant.fmu")
    if grade != "claimed" and grade is not None:
        (folder / "nearest.yaml").write_text("parameters: {mass: 0.9}\n")
        if fmu is not None:
            shutil.copy(fmu, folder / "nearest.fmu")
    return folder


def mass_of(fmu: Path) -> float:
    return float(next(v.start for v in read_description(fmu).modelVariables if v.name == "mass"))


@pytest.mark.thorough
@pytest.mark.parametrize("named", ["", "refine.json", "model.yaml", "nearest.yaml"])
def test_build_takes_the_nearest_model_of_a_refine_however_it_is_named(tmp_path: Path, named: str) -> None:
    refined = refine_left(tmp_path / "refined")
    done = CliRunner().invoke(
        command_line(), ["build", "--model", str(refined / named), "--nearest", "--out", str(tmp_path / "built")]
    )
    assert done.exit_code == 0, done.output
    assert mass_of(tmp_path / "built" / "plant.fmu") == 0.9


@pytest.mark.thorough
def test_without_it_a_refine_is_its_refined_model(tmp_path: Path) -> None:
    refined = refine_left(tmp_path / "refined")
    build(tmp_path / "built", str(refined))
    assert mass_of(tmp_path / "built" / "plant.fmu") == 0.8


@pytest.mark.thorough
def test_where_all_is_claimed_the_refined_model_is_the_nearest(tmp_path: Path) -> None:
    refined = refine_left(tmp_path / "refined", "claimed")
    build(tmp_path / "built", str(refined / "refine.json"), nearest=True)
    assert mass_of(tmp_path / "built" / "plant.fmu") == 0.8


@pytest.mark.parametrize(
    ("named", "words"),
    [
        ("none", "is of no refine, so there is no nearest model; name the folder that `cosim refine` left"),
        ("alone/model.yaml", "is of no refine, so there is no nearest model; name the folder that `cosim refine` left"),
        ("base", "base is of no refine"),
        ("older", "holds no nearest.yaml; refine its study again, or leave nearest out"),
        (None, "--model: is missing; name one: "),
    ],
)
def test_where_there_is_no_nearest_model_build_says_so_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, named: str | None, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    refine_left(tmp_path / "older", None)
    (tmp_path / "alone").mkdir()
    (tmp_path / "alone" / "model.yaml").write_text("parameters: {mass: 0.8}\n")
    with pytest.raises(InputError) as refused:
        build("built", named, nearest=True)
    (line,) = str(refused.value).splitlines()
    assert words in line
    assert refused.value.exit_code == 2
    assert not Path("built").exists()


@pytest.mark.thorough
def test_a_run_takes_the_nearest_plant(project: Path, plant_fmu: Path) -> None:
    refined = refine_left(project / "refined", fmu=plant_fmu)
    settings = ["duration=0.1", "criteria={}", f"components.plant.fmu={project}/refined/plant.fmu"]
    scenario = project / "scenarios" / "regulate.yaml"
    record = run(scenario, project / "out", settings, nearest=True, report=False).manifest
    assert record["fmus"]["plant"]["path"] == str(refined / "nearest.fmu")
    as_it_was = run(scenario, project / "out", settings, report=False).manifest
    assert as_it_was["fmus"]["plant"]["path"] == str(refined / "plant.fmu")
    again = run(project / "out" / "manifest.json", project / "again", report=False).manifest
    assert again["scenario"] == as_it_was["scenario"]
