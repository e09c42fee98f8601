"""Folders of results: each run is written once, listed with its state and changes, found, opened and removed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import cosim
from cosim.core.errors import CosimError, InputError
from cosim.verbs.cli import command_line
from tests.conftest import ROOT
from tests.deeds import deeds_scenario
from tests.test_verbs import desk as desk
from tests.users import command

SCENARIO = "name: tank\nduration: 1\nstep: 0.1\ncomponents:\n  ref: {block: reference, signals: {x: {start: 1}}}\n"
START = "components.ref.signals.x.start={}"
FILES = ["manifest.json", "results.csv"]
SOON = 60.0  # [s]


def do(*words: object, code: int = 0) -> str:
    """Return the output of a command."""
    done = CliRunner().invoke(command_line(), [*map(str, words)])
    ended = done.exception.exit_code if isinstance(done.exception, CosimError) else done.exit_code
    assert ended == code, (words, done.output, done.exception)
    return done.stdout


def run(*words: object, code: int = 0) -> str:
    """Run the scenario in this process."""
    return do("run", "tank.yaml", "--no-report", "--in-process", *words, code=code)


def listed(*words: object) -> list[dict[str, Any]]:
    """Return what `cosim list` says."""
    results: list[dict[str, Any]] = json.loads(do("list", "--json", *words))["results"]
    return results


def names(*words: object) -> list[str]:
    """Return the listed names."""
    return [entry["name"] for entry in listed(*words)]


def files_in(folder: Path) -> list[str]:
    """Return the files of a folder, from there."""
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current folder, with a scenario."""
    monkeypatch.chdir(tmp_path)
    Path("tank.yaml").write_text(SCENARIO)
    return tmp_path


@pytest.fixture
def runs(here: Path) -> Path:
    """Return the folder of three runs, of which the last changes two values."""
    for start, words in enumerate(([], [], ["--seed", "7"]), 1):
        run("--set", START.format(min(start, 2)), *words)
    return here / "results" / "tank"


def record(folder: Path, when: float, content: dict[str, Any], mark: str = "manifest.json") -> None:
    """Write a record as an earlier version did."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / mark).write_text(json.dumps(content))
    (folder / "results.csv").write_text("time,x\n0,1\n1,2\n")
    os.utime(folder / mark, (when, when))


# -- numbers --------------------------------------------------------------------------------------


def test_every_run_has_a_folder_of_its_own_and_is_listed_with_its_changes(runs: Path) -> None:
    assert files_in(runs) == [f"000{k}/{name}" for k in (1, 2, 3) for name in FILES]
    assert [(e["number"], e["name"], e["command"], e["outcome"], e["changes"]) for e in listed()] == [
        (1, "tank/0001", "run", "ok", {}),
        (2, "tank/0002", "run", "ok", {"components.ref.signals.x.start": 2.0}),
        (3, "tank/0003", "run", "ok", {"seed": 7}),
    ]
    (runs / "0004").write_text("a file of the user")
    (runs / "9999").mkdir()
    run()
    assert names("tank/1*") == ["tank/10000"]
    do("run", runs / "0003" / "manifest.json", "--no-report", "--in-process")
    assert (runs / "10001" / "results.csv").read_bytes() == (runs / "0003" / "results.csv").read_bytes()


def test_eight_commands_at_once_have_eight_numbers(here: Path) -> None:
    words = command("run", "tank.yaml", "--no-report", "--in-process", "-q")
    started = [subprocess.Popen([*words, "--seed", str(k)], env=environment()) for k in range(8)]
    assert [process.wait(SOON * 4) for process in started] == [0] * 8
    assert files_in(here / "results" / "tank") == [f"000{k}/{name}" for k in range(1, 9) for name in FILES]
    seeds = {json.loads((e / "manifest.json").read_text())["seed"] for e in (here / "results" / "tank").iterdir()}
    assert seeds == {*range(8)}


@pytest.mark.parametrize(
    ("name", "words", "file"),
    [
        ("tank", ["run", "run.yaml"], "manifest.json"),
        ("tank", ["simulate", "tank.fmu", "--stop", "1"], "scenario.yaml"),
        ("e1", ["replay", "e1.csv", "--plant", "tank.fmu"], "replay.json"),
        ("e1-and-v1", ["compare", "e1.csv", "v1.csv"], "comparison.json"),
        ("areas", ["sweep", "sweep.yaml", "--workers", "1"], "sweep.json"),
        ("base-linear", ["linearize", "base"], "linear.json"),
        pytest.param(
            "tank-fit",
            ["fit", "e1.csv", "--fmu", "tank.fmu", "--vary", "area"],
            "fit.json",
            marks=pytest.mark.thorough,
        ),
        pytest.param("study", ["refine", "study.yaml"], "refine.json", marks=pytest.mark.thorough),
    ],
)
def test_a_repeated_command_has_the_next_number_and_refuses_a_folder_with_files(
    desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, words: Sequence[str], file: str
) -> None:
    shutil.copytree(desk, tmp_path / "desk")
    monkeypatch.chdir(tmp_path / "desk")
    for number in ("0001", "0002"):
        do(*words, "--no-report")
        assert Path("results", name, number, file).is_file()
    assert not [*Path("results").rglob("started.json")]
    before = files_in(Path("results", name))
    Path("out").mkdir()
    Path("out/notes.txt").write_text("mine")
    do(*words, "--no-report", "--out", "out", code=2)
    assert files_in(Path("out")) == ["notes.txt"]
    do(*words, "--no-report", "--out", "out", "--force")
    assert {file, "notes.txt"} <= {*files_in(Path("out"))}
    assert files_in(Path("results", name)) == before


def test_force_replaces_results_and_no_file_of_the_user_or_of_the_input(here: Path) -> None:
    run("--out", "out", "--format", "mat")
    for name in ("mine.svg", "figures/mine.png", "refine.json", "model.yaml"):
        (here / "out" / name).parent.mkdir(exist_ok=True)
        (here / "out" / name).touch()
    run("--out", "out", "--force")
    assert files_in(here / "out") == ["figures/mine.png", "manifest.json", "mine.svg", "results.csv"]
    do("compare", "out", "out", "--out", "out", "--force", "--no-report")
    assert {*FILES, "comparison.json"} <= {*files_in(here / "out")}


def test_a_refused_or_faulty_command_leaves_no_folder(here: Path) -> None:
    run("--set", "components.ref.block=none", code=2)
    do("run", "none.yaml", code=2)
    do("replay", "none.csv", "--plant", "none.fmu", code=2)
    do("run", "tank.yaml", "--out", "tank.yaml", code=2)
    do("run", "tank.yaml", "--out", " ", code=2)
    assert [p.name for p in here.iterdir()] == ["tank.yaml"]
    with pytest.raises(InputError):
        cosim.run("tank.yaml", " ")


# -- kills ----------------------------------------------------------------------------------------


def environment() -> dict[str, str]:
    """Return the environment of a command."""
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def started(folder: Path, *words: object) -> subprocess.Popen[bytes]:
    """Return a run that takes long, when it has made its folder."""
    scenario = deeds_scenario(folder, "DoStep", "slow", 0, duration=1000.0)
    process = subprocess.Popen(command("run", scenario, "--no-report", "-q", *words), env=environment())
    end = time.monotonic() + SOON
    while time.monotonic() < end and not [*folder.rglob("started.json")]:
        time.sleep(0.02)
    return process


@pytest.mark.fresh
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_run_is_listed_while_it_goes_on_and_after_its_kill(here: Path) -> None:
    process = started(here)
    folder = here / "results" / "deeds"
    try:
        end = time.monotonic() + SOON
        while "scenario" not in (folder / "0001" / "started.json").read_text() and time.monotonic() < end:
            time.sleep(0.02)
        assert [(e["name"], e["command"], e["outcome"]) for e in listed()] == [("deeds/0001", "run", "running")]
        assert do("open", "--no-browser", code=2) == ""
        quick = ["run", "deeds.yaml", "--no-report", "--set", "components.bad.fmu=good.fmu", "--set", "duration=0.5"]
        for words in (["--out", folder / "0001", "--force"], ["--resume"]):
            do("run", folder / "0001" if "--resume" in words else "deeds.yaml", *words, code=2)
        do(*quick)  # the next number, while the first goes on
        assert [e["outcome"] for e in listed()].count("running") == 1
        assert "nothing is removed" in do("gc", "--yes")
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    outcomes = {e["name"]: (e["command"], e["outcome"]) for e in listed()}
    assert outcomes == {"deeds/0001": ("run", "interrupted"), "deeds/0002": ("run", "ok")}
    do("run", folder / "0001", "--resume", code=2)  # without a checkpoint
    assert listed("deeds/0001")[0]["outcome"] == "interrupted"
    do("run", "deeds.yaml", "--out", folder / "0001", code=2)  # not empty
    do(*quick, "--out", folder / "0001", "--force")
    assert listed("deeds/0001")[0]["outcome"] == "ok"


@pytest.mark.thorough
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_kill_at_any_time_leaves_a_listed_folder_and_a_later_run_another(here: Path) -> None:
    for k in range(12):
        process = subprocess.Popen(command("run", "tank.yaml", "-q"), env=environment())
        time.sleep(0.25 * k)
        process.kill()
        process.wait()
        folders = sorted(p.name for p in here.glob("results/tank/*"))
        assert folders == [f"{n:04d}" for n in range(1, len(folders) + 1)]
        assert sorted(names()) == [f"tank/{name}" for name in folders]
    assert {e["outcome"] for e in listed()} <= {"interrupted", "ok"}


@pytest.mark.parametrize(
    ("content", "outcome"),
    [
        ("", "interrupted"),
        ("{", "interrupted"),
        ('{"pid": "x"}', "interrupted"),
        ('{"pid": 1, "begun": "0", "host": "HOST", "command": "cosim refine"}', "interrupted"),
        ('{"pid": 1, "begun": "0", "host": "another machine"}', "running or interrupted"),
    ],
)
def test_the_state_of_a_folder_is_that_of_its_process(here: Path, content: str, outcome: str) -> None:
    import platform

    folder = here / "results" / "study" / "0001"
    folder.mkdir(parents=True)
    (folder / "started.json").write_text(content.replace("HOST", platform.node()))
    assert [(e["name"], e["outcome"]) for e in listed()] == [("study/0001", outcome)]
    shutil.rmtree(folder)
    folder.mkdir()  # killed between its folder and its first file
    assert [(e["name"], e["outcome"]) for e in listed()] == [("study/0001", "interrupted")]


def test_results_of_stopped_commands_are_unfinished(here: Path) -> None:
    for place, file in (("areas/0001", "runs.sqlite"), ("tank", "checkpoint/run.json")):
        path = here / "results" / place / file
        path.parent.mkdir(parents=True)
        path.write_text("{}")
    assert sorted((e["name"], e["command"], e["outcome"]) for e in listed()) == [
        ("areas/0001", "sweep", "unfinished"),
        ("tank", "run", "unfinished"),
    ]


# -- reading --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("2", ["tank/0002"]),
        ("tank", ["tank/0003"]),
        ("results/tank", ["tank/0003"]),
        ("results/tank/0001", ["tank/0001"]),
        ("tank/0001", ["tank/0001"]),
        ("tank/*", ["tank/0001", "tank/0002", "tank/0003"]),
        ("t*/*[13]", ["tank/0001", "tank/0003"]),
    ],
)
def test_results_are_found_by_number_name_path_and_pattern(runs: Path, text: str, found: list[str]) -> None:
    assert names(text) == names(text, text) == found
    if len(found) == 1:
        for words in (["report", text], ["open", text, "--no-browser"]):
            if words[0] == "open" or text.startswith("results/"):
                assert f"results/{found[0]}/report.html" in do(*words) or words[0] == "report"
            else:
                do("report", runs / found[0].removeprefix("tank/"))
        viewed = json.loads(do("view", text, "--prepare", "--json"))["runs"]
        assert [v["file"].removesuffix("/results.csv") for v in viewed] == [f"results/{found[0]}"]
        compared = json.loads(do("compare", text, "results/tank/0002", "--json", "--no-report"))
        assert compared["a"] == f"results/{found[0]}"
        assert compared["signals"][0]["largest"] == (1.0 if found[0].endswith("1") else 0.0)


def test_the_folder_of_runs_means_the_newest_to_every_reader(runs: Path) -> None:
    assert cosim.read(runs).folder == runs / "0003"
    assert cosim.read("results/tank").folder == Path("results/tank/0003")
    assert cosim.read("results/tank").manifest["seed"] == 7  # type: ignore[union-attr]
    assert do("report", "results/tank").strip() == "report:  results/tank/0003/report.html"
    do("run", "results/tank", "--until", "2", "--no-report", "--in-process")
    assert cosim.read("results/tank/0003").time[-1] == 2.0  # type: ignore[union-attr]
    assert len(listed()) == 3
    run()
    Path("tank").mkdir()  # a folder without results hides none
    assert do("open", "4", "--no-browser", code=2) == ""
    do("report", "results/tank")
    assert do("open", "tank", "--no-browser") == do("open", "--no-browser") == "report: results/tank/0004/report.html\n"


@pytest.mark.parametrize(
    "words",
    [
        ["open", "9"],
        ["list", "none"],
        ["list", "x/*"],
        ["open", "tank/*"],
        ["open", "2"],  # without a report
        ["list", "--results", "none"],
        ["gc", "--results", "none"],
        ["compare", "none.csv", "tank"],
        ["compare", "tank"],
        ["gc"],  # without an answer
    ],
)
def test_what_means_no_results_is_an_error_of_the_input(runs: Path, words: list[str]) -> None:
    do(*words, code=2)
    assert len(listed()) == 3


def test_removal_takes_earlier_runs_and_never_the_newest(runs: Path) -> None:
    (runs.parent / "mine").mkdir()
    (runs.parent / "mine" / "notes.txt").write_text("of the user")
    assert "nothing is removed" in do("gc", "--older", "1", "--yes")
    assert "nothing is removed" in do("gc", "tank", "--yes")
    size = sum((runs / "0001" / name).stat().st_size for name in FILES)
    assert json.loads(do("gc", "--keep", "1", "--yes", "--json").splitlines()[-4:] and do("list", "--json"))
    assert names() == ["tank/0002", "tank/0003"]
    assert size > 0
    assert json.loads("{" + do("gc", "tank/*", "--yes", "--json").partition("{")[2])["removed"] == ["tank/0002"]
    assert names() == ["tank/0003"]
    assert (runs.parent / "mine" / "notes.txt").is_file()
    run()
    assert names() == ["tank/0003", "tank/0004"]


def test_results_of_earlier_versions_are_read(here: Path) -> None:
    root, scenario = Path("results"), {"name": "tank", "components": {"tank": {"fmu": "t", "start": {"area": 0.5}}}}
    other = {**scenario, "components": {"tank": {"fmu": "t", "start": {"area": 0.6}}}}
    record(root / "tank" / "runs" / "0001", 1e9, {"scenario": scenario, "status": "ok"})
    record(root / "tank" / "runs" / "0002", 1e9 + 100, {"scenario": other, "criteria": [{"met": True}, {"met": False}]})
    record(root / "tank", 1e9 + 200, {"scenario": other, "status": "failed: x"})
    record(root / "sub" / "study", 1e9 + 50, {"verdict": "no_effect"}, "refine.json")
    (root / "link").symlink_to(here / "results" / "tank")
    for part in ("system/a", "figures", ".hidden"):
        record(root / "tank" / part, 1e9, {"status": "ok"})
    assert [(e["name"], e["outcome"], e["changes"]) for e in listed()] == [
        ("tank/runs/0001", "ok", {}),
        ("sub/study", "no_effect", {}),
        ("tank/runs/0002", "1 of 2 criteria met", {"components.tank.start.area": 0.6}),
        ("tank", "failed: x", {}),
    ]
    assert names("tank") == names("results/tank") == ["tank"]
    assert names("--results", "results/tank") == ["tank/runs/0001", "tank/runs/0002", "tank"]
    do("compare", "results/tank", "results/tank/runs/0001", "--no-report")
    assert len(json.loads(do("view", "tank*", "--prepare", "--json"))["runs"]) == 3
    do("report", "results/tank")
    assert (root / "tank" / "report.html").is_file()
    run()
    assert names("tank") == names("results/tank") == ["tank/0001"]
    do("gc", "--yes")
    assert [*names("t*"), *names("sub/*")] == ["tank", "tank/0001", "sub/study"]


def test_records_that_are_damaged_or_missing_are_listed_as_such(runs: Path) -> None:
    (runs / "0001" / "manifest.json").write_text("{")
    (runs / "0002" / "manifest.json").unlink()
    (runs / "0003" / "results.csv").unlink()
    outcomes = {"damaged record", "rows without a record", "rows are gone"}
    assert {e["outcome"] for e in listed()} == outcomes
    content = {"sweep": {}, "runs": 50, "failed": 2, "met_all": 40, "criteria": [{"name": "x", "met": 40, "of": 48}]}
    record(runs.parent / "areas", 1e9, content, "sweep.json")
    assert listed("areas")[0]["outcome"] == "50 runs, 2 failed, 40 met all criteria"
    record(runs / "0003", time.time(), {"schema_version": 99, "cosim_version": "9"})
    assert listed("tank")[0]["other_version"] == "9 (schema 99)"


@pytest.mark.parametrize("words", [["--version"], ["list"], ["list", "-h"], ["list", "tank*", "--results", "results"]])
def test_a_command_that_lists_or_answers_imports_nothing_heavy(here: Path, words: list[str]) -> None:
    """A list of a thousand runs takes half a second only without the imports of commands that compute."""
    record(here / "results" / "tank" / "0001", 1e9, {"status": "ok"})
    code = f"""
import sys
from cosim.__main__ import main
sys.argv = ["cosim", *{words!r}]
try:
    main()
finally:
    heavy = {{"numpy", "scipy", "matplotlib", "ruamel.yaml", "fmpy", "jinja2"}}
    print("imported:", sorted(heavy & sys.modules.keys()))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "imported: []"
