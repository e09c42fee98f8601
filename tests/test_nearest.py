"""`--nearest` of `build` and `run`: the nearest model of a refine instead of the refined one."""

from __future__ import annotations

from pathlib import Path

import pytest

from cosim.core.errors import InputError
from cosim.fmi.building.build import build
from cosim.fmi.description import read_description
from tests.test_first_steps import told


@pytest.fixture
def refined(tmp_path: Path) -> Path:
    """What a refine of the craft leaves: 0.8 kg in model.yaml, 0.9 kg in nearest.yaml."""
    folder = tmp_path / "refined"
    folder.mkdir()
    (folder / "refine.json").write_text('{"grade": "nearest"}')
    (folder / "model.yaml").write_text("parameters: {mass: 0.8}\n")
    (folder / "nearest.yaml").write_text("parameters: {mass: 0.9}\n")
    return folder


def mass_of(folder: Path) -> float:
    variables = read_description(folder / "plant.fmu").modelVariables
    return float(next(v.start for v in variables if v.name == "mass"))


@pytest.mark.thorough
def test_build_takes_the_nearest_model_of_a_refine_however_it_is_named(refined: Path, tmp_path: Path) -> None:
    for named in ("", "refine.json", "model.yaml", "nearest.yaml"):
        told("build", "--model", refined / named, "--nearest", "--out", tmp_path / f"of_{named}")
        assert mass_of(tmp_path / f"of_{named}") == 0.9
    build(tmp_path / "plain", str(refined))
    assert mass_of(tmp_path / "plain") == 0.8
    (refined / "refine.json").write_text('{"grade": "claimed"}')  # then the refined model is the nearest
    (refined / "nearest.yaml").unlink()
    build(tmp_path / "claimed", str(refined / "refine.json"), nearest=True)
    assert mass_of(tmp_path / "claimed") == 0.8


@pytest.mark.parametrize(
    ("named", "words"),
    [
        ("none", "none"),
        ("model.yaml", "model.yaml"),
        ("base", "base"),
        ("older", "nearest.yaml"),
        (None, "--model"),
    ],
)
def test_where_there_is_no_nearest_model_build_says_so_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, named: str | None, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("model.yaml").write_text("parameters: {mass: 0.8}\n")
    Path("older").mkdir()
    Path("older", "model.yaml").write_text("parameters: {mass: 0.8}\n")
    Path("older", "refine.json").write_text('{"verdict": "no_effect"}')
    with pytest.raises(InputError) as refused:
        build("built", named, nearest=True)
    (line,) = str(refused.value).splitlines()
    assert words in line
    assert refused.value.exit_code == 2
    assert not Path("built").exists()
