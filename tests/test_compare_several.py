"""Any number of runs against a baseline: labels, inputs that differ, criteria, verdicts, limits of a page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import cosim
from cosim.comparison.several import ComparedRuns
from cosim.core.errors import CriterionMissed, InputError
from cosim.files.results import Results
from cosim.verbs.cli import command_line

TIME = np.linspace(0, 1, 101)
SCENARIO = "name: s\nduration: 1\nstep: 0.1\ncomponents:\n  ref: {block: reference, signals: {x: {start: 1}}}\n"
CRITERION = "criteria: {peak: {of: ref.x, max: 2.5}}\n"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose results have three runs of a scenario with other start values."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "s.yaml").write_text(SCENARIO + CRITERION, encoding="utf-8")
    for start in (1, 3, 2):
        content = {"set": {"components.ref.signals.x.start": start}, "report": False, "in_process": True}
        cosim.run(folder / "s.yaml", folder / "results" / "s" / f"000{start}", **content)  # type: ignore[arg-type]
    return folder


def _invoke(words: Sequence[str]) -> Any:
    return CliRunner().invoke(command_line(), ["compare", *words])


def test_the_command_compares_runs_of_a_pattern(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(runs)
    (runs / "results" / "s-sweep").mkdir(exist_ok=True)
    (runs / "results" / "s-sweep" / "sweep.json").write_text("{}")  # results without rows
    done = _invoke(["s*", "--baseline", "3", "--out", "out", "--json"])
    assert done.exit_code == 0, done.output
    content = json.loads(done.output)
    assert [r["label"] for r in content["runs"]] == [
        f"run {k} (ref.signals.x.start = {v})" for k, v in ((1, 1), (2, 3), (3, 2))
    ]
    assert content["baseline"] == "run 3 (ref.signals.x.start = 2)"
    assert content["inputs"] == [{"kind": "scenario", "name": "ref.signals.x.start", "values": [1.0, 3.0, 2.0]}]
    (criterion,) = content["criteria"]
    assert [o["met"] for o in criterion["outcomes"]] == [True, False, True]
    assert [d and d["largest"] for d in content["signals"][0]["differences"]] == [1.0, 1.0, None]
    page = (runs / "out" / "report.html").read_text(encoding="utf-8")
    assert "<h1>2 runs against run 3</h1>" in page
    assert page.count("run 1 (ref.signals.x.start = 1)") > 2  # also in the legends of few runs
    assert "peak of ref.x, at most 2.50" in page


def test_a_tolerance_gives_a_verdict_over_all_runs(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(runs)
    missed = _invoke(["1", "2", "3", "--out", "judged", "--tol", "0.1", "--no-report"])
    assert isinstance(missed.exception, CriterionMissed)
    assert "run 2 (ref.signals.x.start = 3): 1 signal beyond the tolerance" in str(missed.exception)
    assert not (runs / "judged" / "report.html").exists()
    refused = _invoke(["1", "3", "2", "--out", "judged"])
    assert isinstance(refused.exception, InputError)  # a comparison of others is there


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["1"], "is one run; name at least two"),
        (["1", "2", "--baseline", "s/*"], "3 runs match; name one as the baseline"),
        (["1", "9"], "no results with the number 9"),
        (["1", "none"], "none: no such folder or file"),
        (["1", "x*"], "no results match"),
    ],
)
def test_what_cannot_be_compared_is_one_message(
    runs: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], message: str
) -> None:
    monkeypatch.chdir(runs)
    error = _invoke(words).exception
    assert isinstance(error, InputError)
    assert message in str(error)


def test_python_compares_lists_of_folders_numbers_and_results(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(runs)
    here = cosim.run("s.yaml", report=False, in_process=True)
    found = cosim.compare([1, "results/s/0003", here], baseline=here)
    assert isinstance(found, ComparedRuns)
    assert found.labels[0].startswith("run 1 (")
    assert found.baseline == 2
    assert found.comparisons[0].same
    frame = pytest.importorskip("pandas") and found.to_pandas()
    assert frame.loc["ref.x"].tolist() == [0.0, 2.0]
    assert len(found.plot("ref.x").axes) == 1
    assert "ref.x" in repr(found)
    with pytest.raises(InputError, match="3 runs match; give a list"):
        cosim.compare("s/*")


# -- results that are not as they should be -----------------------------------------------------------


def _rows(folder: Path, gain: float, record: str = "", names: tuple[str, ...] = ("a.x",)) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    Results(TIME, names, np.outer(TIME, gain + np.arange(len(names)))).write(folder / "results.csv")
    (folder / "manifest.json").write_text(record, encoding="utf-8")
    return folder


ODD = '{"scenario": [1], "criteria": "x", "units": [1], "beside": 3, "versions": "no", "git": [1], "fmus": ["a"], %s}'


def test_results_of_other_versions_and_half_written_ones_are_compared_by_their_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "results"
    _rows(root / "new", 1.0, ODD % '"schema_version": 99, "cosim_version": "99.0"')
    _rows(root / "cut", 2.0, '{"scenario": {"na')
    _rows(root / "empty", 3.0)
    (_rows(root / "gone", 4.0, "{}") / "results.csv").unlink()
    (_rows(root / "torn", 5.0, "{}") / "results.csv").write_text("time,a.x\n0,1\n0.1")
    done = _invoke(["*", "--baseline", "new", "--out", "out", "--json"])
    assert done.exit_code == 0, done.output
    content = json.loads(done.stdout)
    assert sorted(r["label"].partition("(")[2] for r in content["runs"]) == ["cut)", "empty)", "new)"]
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "results/torn/results.csv:3:1: has 1 cell, the header 2" in page
    for name, message in (("gone", "holds no rows"), ("torn", "has 1 cell, the header 2")):
        error = _invoke(["new", name]).exception
        assert message in str(error)
