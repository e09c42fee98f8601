"""Results that are removed while they are read, cut, of another version of cosim, or without their version."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from cosim.core.version import __version__
from cosim.files.results import read_results
from tests.test_first_steps import invoked, told


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Results of three names, as current folder of results."""
    monkeypatch.chdir(tmp_path)
    for name in ("one", "two", "three"):
        _write(tmp_path / "results" / name)
    return tmp_path / "results"


def _write(folder: Path, **record: Any) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.csv").write_text("time,a.x\n0.0,0.0\n0.5,0.25\n1.0,0.125\n")
    about = {"schema_version": 1, "cosim_version": __version__, "scenario": {"name": folder.name}, "rows": 3}
    (folder / "manifest.json").write_text(json.dumps({**about, **record}))


@pytest.mark.parametrize(
    ("record", "says"),
    [
        ('{"criteria": "all"}', ": criteria "),
        ('{"criteria": [{"of": "a.x", "met": "no"}]}', ": criteria "),
        ('{"scenario": {"name": "two", "components": {"a": 3}}}', ": scenario "),
        ('{"rows": "3"}', ": rows "),
        ('{"units": {"a.x": 1}}', ": units "),
    ],
)
def test_a_value_of_the_wrong_type_in_a_record_is_named_and_the_rest_goes_on(
    root: Path, record: str, says: str
) -> None:
    _write(root / "two", **json.loads(record))
    (root / "two" / "report.html").write_text("<html>")
    for words in (
        "list",
        "list --json",
        "gc two* --yes",
        "open two --no-browser",
        "compare one two --no-report --out o",
    ):
        done = invoked(*words.split())
        assert done.exit_code == 0, (words, done.exception)
        (line,) = [line for line in done.stderr.splitlines() if "two/manifest.json" in line and "is not used" in line]
        assert says in line
        assert "results/one" not in done.stderr


def test_a_run_says_how_many_rows_it_wrote(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("s.yaml").write_text(
        "name: s\nduration: 1\nstep: 0.1\ncomponents:\n  ref: {block: reference, signals: {x: {start: 1}}}\n"
    )
    told("run", "s.yaml", "--in-process", "--no-report")
    file = Path("results/s/0001/manifest.json")
    record = json.loads(file.read_text())
    assert record["rows"] == read_results(Path("results/s/0001/results.csv")).time.size == 11
    del record["schema_version"]
    file.write_text(json.dumps(record))
    assert invoked("run", str(file), "--in-process", "--no-report", "--out", "again").exit_code == 0


def test_results_of_another_version_are_marked(root: Path) -> None:
    assert "of cosim" not in invoked("list").stdout
    _write(root / "two", cosim_version="99.0")
    _write(root / "three", cosim_version="99.1", schema_version=99)
    assert "of cosim" in invoked("list").stdout
    marks = {row["name"]: row["other_version"] for row in json.loads(invoked("list", "--json").stdout)["results"]}
    assert marks == {"one": None, "two": "99.0", "three": "99.1 (schema 99)"}
    said = invoked("compare", "one", "two", "--no-report").stderr
    assert f"note: results/two/manifest.json was written by cosim 99.0, and this is {__version__}" in said
    (root / "three" / "report.html").write_text("<html>")
    said = invoked("open", "three", "--no-browser").stderr
    assert "version 99" in said
    assert "cosim 99.1" in said
