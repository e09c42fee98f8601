"""Results that are there: listed by age with their changes, found by number, name and pattern, opened and removed."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from cosim.base.errors import InputError
from cosim.history.entries import entries, find_entries
from cosim.history.inputs import changes_between
from cosim.history.removal import plan_removal, remove
from cosim.history.selection import select_results
from cosim.verbs.cli import app

SCENARIO = {"name": "tank", "duration": 1.0, "components": {"tank": {"fmu": "tank.fmu", "start": {"area": 0.5}}}}


def _write(folder: Path, time: float, content: dict[str, Any], mark: str = "manifest.json") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / mark).write_text(json.dumps(content), encoding="utf-8")
    os.utime(folder / mark, (time, time))
    return folder


def _scenario(**start: float) -> dict[str, Any]:
    tank = {"fmu": "tank.fmu", "start": {"area": 0.5, **start}}
    return {**SCENARIO, "components": {"tank": tank}}


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three runs of a tank, a refinement between them, a folder of the user and a link."""
    monkeypatch.chdir(tmp_path)
    root = Path("results")
    met = [{"met": True}, {"met": False}]
    _write(root / "tank" / "runs" / "0001", 1e9, {"scenario": SCENARIO, "status": "ok"})
    _write(root / "study", 1e9 + 50, {"verdict": "no_effect", "schema_version": 1}, "refine.json")
    _write(root / "tank" / "runs" / "0002", 1e9 + 100, {"scenario": _scenario(area=0.6), "criteria": met})
    _write(root / "tank", 1e9 + 200, {"scenario": _scenario(area=0.6, outlet=0.1), "status": "failed: x"})
    (root / "mine").mkdir()
    (root / "mine" / "notes.txt").write_text("of the user")
    (root / "link").symlink_to(tmp_path / "results" / "tank")
    return root


def test_results_are_numbered_by_age_with_outcome_and_changes(results: Path) -> None:
    listed = [(e.number, e.name, e.verb, e.outcome, dict(e.changes)) for e in entries(results)]
    assert listed == [
        (1, "tank/0001", "run", "ok", {}),
        (2, "study", "refine", "no_effect", {}),
        (3, "tank/0002", "run", "1 of 2 criteria met", {"components.tank.start.area": 0.6}),
        (4, "tank", "run", "failed: x", {"components.tank.start.outlet": 0.1}),
    ]
    assert [e.label for e in entries(results)[2:]] == ["run 3 (tank.area = 0.6)", "run 4 (tank.outlet = 0.1)"]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("3", ["tank/0002"]),
        ("tank", ["tank"]),
        ("results/tank/runs/0001", ["tank/0001"]),
        ("tank/*", ["tank/0001", "tank/0002"]),
        ("s*", ["study"]),
    ],
)
def test_results_are_found_by_number_name_and_pattern(results: Path, text: str, names: list[str]) -> None:
    assert [e.name for e in find_entries([text])] == names
    assert [e.name for e in find_entries([text, text])] == names


@pytest.mark.parametrize(("text", "message"), [("9", "up to 4"), ("tnak", 'did you mean "tank"'), ("x/*", "match")])
def test_a_name_without_results_is_one_message(results: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_entries([text])


def test_removal_takes_earlier_runs_and_never_the_newest(results: Path) -> None:
    every = entries(results)
    assert [e.name for e in plan_removal(every, keep=1).entries] == ["tank/0001"]
    assert not plan_removal(every, older=1e6).entries
    reverse = find_entries(["tank/0002", "tank/0001"])  # the latest stay, in whatever order they are named
    assert [e.name for e in plan_removal(every, keep=1, chosen=reverse).entries] == ["tank/0001"]
    assert not plan_removal(every, keep=1, chosen=reverse[:1]).entries
    plan = plan_removal(every)
    assert [e.name for e in plan.entries] == ["tank/0001", "tank/0002"]
    assert plan.size == sum(p.stat().st_size for e in plan.entries for p in e.folder.iterdir())
    assert remove(plan.entries) == plan
    assert [e.name for e in entries(results)] == ["study", "tank"]
    assert (results / "tank" / "runs" / ".last").read_text() == "2\n"  # no later run is called 2
    assert (results / "mine" / "notes.txt").exists()
    again = remove(plan.entries)
    assert not again.entries
    assert "is gone already" in again.warnings[0]


def test_the_commands_list_open_and_remove(results: Path) -> None:
    listed = CliRunner().invoke(app, ["list"])
    assert listed.output.splitlines()[4].split()[:1] == ["4"]
    content = json.loads(CliRunner().invoke(app, ["list", "tank*", "--json"]).output)
    assert [r["name"] for r in content["results"]] == ["tank", "tank/0001", "tank/0002"] or content["results"]
    (results / "tank" / "report.html").write_text("<html>")
    opened = CliRunner().invoke(app, ["open", "4", "--no-browser"])
    assert opened.output.strip() == "report: results/tank/report.html"
    refused = CliRunner().invoke(app, ["gc"])
    assert isinstance(refused.exception, InputError)
    assert "add --yes" in str(refused.exception)
    assert len(entries(results)) == 4
    assert "removed: 2 earlier runs" in CliRunner().invoke(app, ["gc", "--yes"]).output
    assert "nothing is removed" in CliRunner().invoke(app, ["gc", "--yes"]).output


def test_results_in_folders_within_are_listed_but_not_in_parts_of_results(results: Path) -> None:
    met = {"scenario": SCENARIO, "status": "ok"}
    for k, place in enumerate(("sub/x", "sub/x/runs/0004", "tank/firm", "a/b/c/d", "a/b/c/d/e", "sub/.hidden/y")):
        _write(results / place, 1.5e9 + k, met)
    _write(results / "tank" / "runs" / "0002" / "z", 1.5e9, met)
    (results / "tank" / "system").mkdir()
    (results / "tank" / "system" / "manifest.json").write_text("{}")
    assert [e.name for e in entries(results) if e.time >= 1.5e9] == ["sub/x", "sub/x/0004", "tank/firm", "a/b/c/d"]
    assert [e.name for e in find_entries(["sub/x", "tank/firm"])] == ["sub/x", "tank/firm"]
    assert [e.name for e in plan_removal(entries(results)).entries] == ["tank/0001", "tank/0002", "sub/x/0004"]


def test_the_folder_named_as_out_is_listed_with_its_earlier_runs(results: Path) -> None:
    listed = entries(results / "tank")
    assert [(e.name, e.is_newest) for e in listed] == [("tank/0001", False), ("tank/0002", False), ("tank", True)]
    assert [e.name for e in find_entries(["tank/*"], results / "tank")] == ["tank/0001", "tank/0002"]
    assert len(remove(plan_removal(listed).entries).entries) == 2
    assert [e.name for e in entries(results / "tank")] == ["tank"]


def test_a_folder_without_results_does_not_hide_results_of_its_name(results: Path) -> None:
    Path("tank").mkdir()
    Path("tank/model.mo").touch()
    (results / "tank" / "report.html").write_text("<html>")
    assert [s.path for s in select_results(["tank", "3"])] == [results / "tank", results / "tank" / "runs" / "0002"]
    assert CliRunner().invoke(app, ["open", "tank", "--no-browser"]).output == "report: results/tank/report.html\n"
    Path("tank/results.csv").touch()
    assert [s.path for s in select_results(["tank"])] == [Path("tank")]
    Path("mine").mkdir()
    assert "holds no results" in str(CliRunner().invoke(app, ["open", "mine"]).exception)


def test_the_name_of_newest_results_does_not_remove_and_says_which_name_would(results: Path) -> None:
    done = CliRunner().invoke(app, ["gc", "tank", "study", "--yes"])
    assert "the newest results of a name stay; name its earlier runs as 'tank/*' 'study/*'" in done.output


def test_results_without_a_report_and_several_results_are_named(results: Path) -> None:
    for words, message in (
        (["open", "2"], "has no report.html"),
        (["open", "results/mine"], "holds no results of a command"),
        (["open", "tank/*"], "2 results match: 1 tank/0001"),
        (["list", "--results", "nowhere"], "no such folder"),
        (["gc", "--results", "nowhere"], "no such folder"),
        (["compare", "4", "3"], "holds no rows"),
    ):
        error = CliRunner().invoke(app, words).exception
        assert isinstance(error, InputError)
        assert message in str(error)


def test_a_damaged_record_is_listed_as_such(results: Path) -> None:
    (results / "tank" / "manifest.json").write_text("{")
    assert [e.outcome for e in entries(results) if e.name == "tank"] == ["damaged record"]


def test_runs_are_compared_by_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:

    monkeypatch.chdir(tmp_path)
    Path("s.yaml").write_text(
        "name: s\nduration: 1\nstep: 0.1\ncomponents:\n  ref: {block: reference, signals: {x: {start: 1}}}\n"
    )
    runner = CliRunner()
    for words in (["s.yaml"], ["s.yaml", "--set", "components.ref.signals.x.start=3"]):
        assert runner.invoke(app, ["run", *words, "--no-report", "--in-process"]).exit_code == 0
    done = runner.invoke(app, ["compare", "1", "2", "--json"])
    assert done.exit_code == 0, done.output
    content = json.loads(done.output)
    assert content["signals"][0]["largest"] == 2.0
    assert "run 2 (ref.signals.x.start = 3)" in Path("results/runs-1-2/report.html").read_text()
    assert runner.invoke(app, ["run", "s.yaml", "--no-report", "--in-process"]).exit_code == 0
    again = runner.invoke(app, ["compare", "1", "2"])  # run 2 has moved to an earlier run
    assert again.exit_code == 0, again.output
    assert Path("results/runs-1-2/runs/0001/comparison.json").is_file()
    Path("results").rename("other")
    done = runner.invoke(app, ["compare", "1", "2", "--results", "other", "--json", "--no-report"])
    assert json.loads(done.output)["signals"][0]["largest"] == 2.0


def test_a_path_that_is_not_there_is_told_as_a_path_beside_other_results(results: Path) -> None:
    error = CliRunner().invoke(app, ["compare", "none.csv", "tank"]).exception
    assert isinstance(error, InputError)
    assert "none.csv: no such folder or file" in str(error)
    several = CliRunner().invoke(app, ["compare", "tank/*", "tank"]).exception
    assert "tank" in str(several)


@pytest.mark.parametrize("words", [["--version"], ["list"], ["list", "-h"], ["list", "tank*", "--results", "results"]])
def test_a_command_that_lists_or_answers_imports_nothing_heavy(results: Path, words: list[str]) -> None:
    """A list of a thousand runs takes half a second only without the imports of commands that compute."""
    code = f"""
import sys
from cosim.__main__ import main
sys.argv = ["cosim", *{words!r}]
try:
    main()
finally:
    heavy = {{"numpy", "scipy", "pydantic", "matplotlib", "ruamel.yaml", "fmpy", "jinja2", "rich"}}
    print("imported:", sorted(heavy & sys.modules.keys()))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "imported: []"


def test_rows_without_a_record_are_listed_with_an_unknown_command(results: Path) -> None:
    rows = results / "mine" / "results.csv"
    rows.write_text("time,x\n0,1\n1,2\n")
    os.utime(rows, (2e9, 2e9))
    (results / "tank" / "runs" / "0001" / "manifest.json").rename(results / "tank" / "runs" / "0001" / "results.txt")
    listed = entries(results)
    assert [(e.name, e.verb, e.outcome, dict(e.changes)) for e in listed[2:]] == [
        ("tank", "run", "failed: x", {"components.tank.start.outlet": 0.1}),
        ("mine", "", "rows without a record", {}),
    ]
    done = CliRunner().invoke(app, ["list"])
    assert "rows without a record" in done.output
    assert "0001" not in done.output  # results.txt is no table


def test_changes_are_inputs_of_unequal_branches_only() -> None:
    before = {"a": {"b": 1, "c": {"d": 2}}, "rows": [{"x": 1}, {"x": 2}], "gone": {"e": 3}, "kind": {"f": 1}}
    after = {"a": {"b": 1, "c": {"d": 5}}, "rows": [{"x": 1}, {"x": 3}], "new": 0, "kind": "plain"}
    assert changes_between(before, after) == {
        "a.c.d": 5, "rows[1].x": 3, "new": 0, "kind": "plain", "gone.e": None, "kind.f": None,
    }  # fmt: skip
    assert changes_between(after, after) == {}


def test_runs_that_cannot_be_removed_are_named_and_not_counted(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = shutil.rmtree

    def refuse(folder: Path) -> None:
        if folder.name == "0001":
            raise OSError(errno.EROFS, "Read-only file system")
        real(folder)

    monkeypatch.setattr(shutil, "rmtree", refuse)
    done = CliRunner().invoke(app, ["gc", "--yes", "--json"])
    assert json.loads(done.stdout)["removed"] == ["tank/0002"]
    assert isinstance(done.exception, InputError)
    assert "runs/0001: cannot be removed: Read-only file system" in str(done.exception)
