"""A run repeated from its manifest, elsewhere than where it was made."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.test_first_steps import told
from tests.typed import typed_fmu

QUICK = ("--stop", "0.2", "--step", "0.1", "--no-report", "--in-process")


@pytest.fixture
def moved(tmp_path: Path) -> Path:
    """A run, played from a recording, that was moved with its FMU and its recording beside its manifest."""
    old, new = tmp_path / "old", tmp_path / "new"
    old.mkdir()
    fmu, log = typed_fmu(old), old / "log.csv"
    log.write_text("time,r_in\n0,1\n0.1,2\n0.2,3\n")
    told("simulate", fmu, "--input", log, *QUICK, "--out", old / "run")
    shutil.copytree(old / "run", new)
    shutil.copy(fmu, new)
    shutil.copy(log, new)
    return new


def test_a_manifest_takes_files_that_have_gone_from_beside_it(moved: Path, tmp_path: Path) -> None:
    shutil.rmtree(tmp_path / "old")
    told("run", moved / "manifest.json", "--no-report", "--in-process", "--out", tmp_path / "again")
    assert (tmp_path / "again" / "results.csv").read_bytes() == (moved / "results.csv").read_bytes()
    assert told("check", moved / "manifest.json")


def test_the_file_of_the_run_beside_a_manifest_goes_before_another_at_its_old_place(
    moved: Path, tmp_path: Path
) -> None:
    (tmp_path / "old" / "log.csv").write_text("time,r_in\n0,9\n0.1,9\n0.2,9\n")
    told("run", moved / "manifest.json", "--no-report", "--in-process", "--out", tmp_path / "again")
    assert (tmp_path / "again" / "results.csv").read_bytes() == (moved / "results.csv").read_bytes()


def test_a_file_beside_a_manifest_with_another_content_is_refused_by_name(moved: Path, tmp_path: Path) -> None:
    (tmp_path / "old" / "log.csv").unlink()
    (moved / "log.csv").write_text("time,r_in\n0,9\n0.1,9\n0.2,9\n")
    assert "new/log.csv" in told("run", moved / "manifest.json", "--out", tmp_path / "again", code=2)
    assert not (tmp_path / "again").exists()


def test_a_file_that_is_nowhere_is_told_with_where_to_put_it(moved: Path, tmp_path: Path) -> None:
    (fmu,) = moved.glob("*.fmu")
    fmu.unlink()
    (tmp_path / "old" / fmu.name).unlink()
    said = told("run", moved / "manifest.json", "--out", tmp_path / "again", code=2)
    assert f"put it there, or {fmu.name} beside manifest.json" in said
