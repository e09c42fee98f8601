"""Results of each command are kept when it is repeated, interrupted too, and listed with outcome and changed inputs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import cosim
from cosim.base.errors import CosimError, Interrupted
from cosim.history.entries import Entry, entries
from cosim.residuals import workflow as replaying
from cosim.simulation.workflow import run
from cosim.verbs.cli import app
from tests.test_resume import PAUSE, Stop
from tests.test_verbs import desk as desk
from tests.walker import walker_scenario

AREA = "components.tank.start.area={}"


def _do(*words: str) -> Any:
    done = CliRunner().invoke(app, [*words])
    assert done.exit_code == 0 or isinstance(done.exception, CosimError), (words, done.output, done.exception)
    return done


@pytest.fixture
def here(desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The desk of the tests of verbs, as current folder."""
    folder = tmp_path / "desk"
    shutil.copytree(desk, folder)
    monkeypatch.chdir(folder)
    return folder


def _listed(name: str) -> list[Entry]:
    return [entry for entry in entries() if entry.name.partition("/")[0] == name]


@pytest.mark.parametrize(
    ("name", "first", "second", "changes"),
    [
        ("tank", ["run", "run.yaml"], ["--set", AREA.format(0.7)], {"components.tank.start.area": 0.7}),
        pytest.param(
            "tank",
            ["simulate", "tank.fmu", "--stop", "1"],
            ["--set", "area=0.7"],
            {"components.tank.start.area": 0.7},
            marks=pytest.mark.thorough,
        ),
        pytest.param(
            "e1",
            ["replay", "e1.csv", "--plant", "tank.fmu"],
            ["--start", "area=0.7"],
            {"start.area": 0.7},
            marks=pytest.mark.thorough,
        ),
        pytest.param("areas", ["sweep", "sweep.yaml", "--workers", "1"], ["--force"], {}, marks=pytest.mark.thorough),
        ("e1-and-v1", ["compare", "e1.csv", "v1.csv"], ["--tol", "9"], {"tolerance": 9.0}),
    ],
)
def test_a_repeated_command_keeps_its_results_and_the_list_tells_them_apart(
    here: Path, name: str, first: list[str], second: list[str], changes: dict[str, Any]
) -> None:
    if first[0] == "sweep":
        pytest.importorskip("SALib")
    _do(*first, "--no-report")
    kept = {path.name: path.read_bytes() for path in (here / "results" / name).iterdir() if path.is_file()}
    _do(*first, *second, "--no-report")
    earlier, newest = _listed(name)
    assert (earlier.name, newest.name) == (f"{name}/0001", name)
    for path in earlier.folder.iterdir():  # Relative paths of YAML files are adapted to the new place.
        assert path.suffix == ".yaml" or path.read_bytes() == kept[path.name]
    assert {*kept} == {path.name for path in earlier.folder.iterdir()}
    assert dict(newest.changes) == changes
    assert [entry.verb for entry in (earlier, newest)] == [first[0], first[0]]
    listed = json.loads(_do("list", f"{name}*", "--json").output)["results"]
    assert [(r["name"], r["changes"]) for r in listed] == [(f"{name}/0001", {}), (name, changes)]


def test_a_named_folder_keeps_its_earlier_results_too(here: Path) -> None:
    words = ["run", "run.yaml", "--no-report", "--in-process", "--out", "results/sub/tank"]
    for area in (0.5, 0.6, 0.7):
        _do(*words, "--set", AREA.format(area))
    earlier, middle, newest = entries()
    assert [e.name for e in (earlier, middle, newest)] == ["sub/tank/0001", "sub/tank/0002", "sub/tank"]
    assert [e.is_newest for e in (earlier, middle, newest)] == [False, False, True]
    assert dict(newest.changes) == {"components.tank.start.area": 0.7}
    assert "removed: 2 earlier runs" in _do("gc", "--yes").output
    cosim.run("run.yaml", out="elsewhere", report=False)
    cosim.run("run.yaml", out="elsewhere", report=False)
    assert Path("elsewhere/runs/0001/manifest.json").is_file()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "words"),
    [("tank-fit", ["fit", "e1.csv", "--fmu", "tank.fmu", "--vary", "area"]), ("study", ["refine", "study.yaml"])],
)
def test_results_of_long_commands_are_kept_too(here: Path, name: str, words: Sequence[str]) -> None:
    for _ in range(2):
        _do(*words, "--no-report")
    assert [entry.name for entry in _listed(name)] == [f"{name}/0001", name]
    assert all(entry.outcome for entry in _listed(name))


def test_an_interrupted_run_keeps_the_earlier_one_and_is_listed(here: Path) -> None:
    scenario = walker_scenario(here, pause=PAUSE)  # slow enough to be stopped on its way
    run(scenario, None, ["components.saving.start.pause=0"], report=False)
    with pytest.raises(Interrupted):
        run(scenario, None, ["seed=7"], observers=[Stop(0.1)], report=False)
    earlier, newest = entries()
    assert earlier.name == f"{newest.name}/0001"
    assert "interrupted" in newest.outcome
    assert dict(newest.changes) == {"components.saving.start.pause": PAUSE, "seed": 7}


def test_an_interrupted_replay_keeps_the_earlier_one_and_is_listed(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["replay", "e1.csv", "--plant", "tank.fmu", "--no-report"]
    _do(*words)

    def stop(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(replaying, "compare", stop)
    _do(*words)
    assert [(entry.name, bool(entry.outcome)) for entry in _listed("e1")] == [("e1/0001", True), ("e1", True)]
    assert _listed("e1")[-1].outcome == "stopped"


def test_a_stopped_sweep_and_a_killed_run_are_unfinished(here: Path) -> None:
    for place, file in (("areas", "runs.sqlite"), ("tank", "checkpoint/run.json")):
        path = here / "results" / place / file
        path.parent.mkdir(parents=True)
        path.write_text("{}")
    assert [(e.name, e.verb, e.outcome) for e in entries()] == [
        ("areas", "sweep", "unfinished"), ("tank", "run", "unfinished"),
    ]  # fmt: skip


def test_a_sweep_is_listed_with_its_runs(tmp_path: Path) -> None:
    folder = tmp_path / "areas"
    folder.mkdir()
    record = {"sweep": {}, "runs": 50, "failed": 2, "met_all": 40, "criteria": [{"name": "x", "met": 40, "of": 48}]}
    (folder / "sweep.json").write_text(json.dumps(record))
    assert entries(tmp_path)[0].outcome == "50 runs, 2 failed, 40 met all criteria"


@pytest.mark.parametrize(
    ("words", "file", "stage"),
    [
        (["refine", "study.yaml"], "study/refine.json", "cosim.refinement.workflow.attribute"),
        (["fit", "e1.csv", "--fmu", "tank.fmu"], "tank-fit/fit.json", "cosim.calibration.workflow.refuse_own_step"),
    ],
)
def test_an_interrupted_search_leaves_the_earlier_results(
    here: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], file: str, stage: str
) -> None:
    stopped: list[bool] = []

    def stop(*_: Any, **__: Any) -> Any:
        stopped.append(True)
        raise KeyboardInterrupt

    earlier = here / "results" / file
    earlier.parent.mkdir(parents=True)
    earlier.write_text('{"verdict": "no_effect", "study": "study.yaml", "fmu": "tank.fmu"}')
    monkeypatch.setattr(stage, stop)
    assert CliRunner().invoke(app, [*words, "--no-report"]).exit_code != 0
    assert stopped
    assert json.loads(earlier.read_text())["verdict"] == "no_effect"
    assert not (earlier.parent / "runs").exists()
    assert [entry.outcome for entry in entries()] == ["no_effect"]


def test_a_record_of_a_later_version_is_named(here: Path) -> None:
    for gain in ("0.6", "0.7"):
        _do("run", "run.yaml", "--set", AREA.format(gain), "--no-report")
    manifest = here / "results" / "tank" / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"schema_version": 1', '"schema_version": 99'))
    for words in (["compare", "1", "2", "--no-report"], ["run", str(manifest), "--out", "again", "--no-report"]):
        assert "has the schema version 99, written by cosim 0.1.0; 1 is known here" in _do(*words).output
