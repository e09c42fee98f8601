"""docs/own_model.md as a newcomer follows it: the page's table, logs of one that rubs, refine, and refine again."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from cosim.experiment.rigs import inputs_to_limit
from cosim.fmi.building.file import read_model
from cosim.refinement.refinement import Refinement
from cosim.refinement.workflow import refine
from cosim.verbs.checks import check as check_files
from plant.hovercraft import Hovercraft
from tests.table import RUBS, TABLE, table_log


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the page's table, three logs, a study and what came of it."""
    folder = tmp_path_factory.mktemp("own") / "bench"
    folder.mkdir()
    (folder / "table.py").write_text(TABLE, encoding="utf-8")
    for seed, name in enumerate("abc"):
        table_log(folder / f"{name}.csv", seed)
    logs = "logs:\n  estimation: [a.csv, b.csv]\n  validation: [c.csv]\n"
    (folder / "study.yaml").write_text(f"model: table.py:Table\n{logs}")
    (folder / "again.yaml").write_text(f"model: out/model.yaml\n{logs}")
    r = refine(folder / "study.yaml", folder / "out")
    assert r.record["verdict"] == "effect_found", r.record["sentence"]
    (low, high) = r.record["effects"][0]["parameters"]["level"]["ci95"]
    assert low - (high - low) < RUBS < high + (high - low)
    return folder


@pytest.fixture(scope="module")
def again(bench: Path, tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    """The refined table, refined once more, its results in another place than the file of the table."""
    return refine(bench / "again.yaml", tmp_path_factory.mktemp("elsewhere"))


@pytest.mark.thorough
def test_the_table_of_the_page_refined_has_nothing_missing(again: Refinement) -> None:
    assert again.record["verdict"] == "no_effect"


@pytest.mark.thorough
def test_what_a_refine_wrote_is_a_model_that_can_be_checked(bench: Path) -> None:
    assert check_files([bench / "out" / "model.yaml"]) == []


@pytest.mark.thorough
def test_a_refined_model_moves_with_the_file_it_is_of(bench: Path, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere"
    shutil.copytree(bench, moved)
    assert read_model(moved / "out" / "model.yaml").source == f"{moved.resolve() / 'table.py'}:Table"


@pytest.mark.thorough
def test_where_the_file_is_in_another_place_its_whole_path_is_said(bench: Path, again: Refinement) -> None:
    assert f"model: {bench.resolve() / 'table.py'}:Table\n" in (again.folder / "model.yaml").read_text()


@pytest.mark.thorough
def test_of_a_model_of_ones_own_one_says_how_far_its_inputs_may_go(bench: Path) -> None:
    assert inputs_to_limit(read_model(bench / "out" / "model.yaml").model) == ("torque",)
    assert inputs_to_limit(Hovercraft()) == ()
