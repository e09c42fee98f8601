"""Folders of results: each run is written once, listed with its state and changes, found, opened and removed."""

from __future__ import annotations

import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import cosim
from cosim.core.errors import InputError
from tests.deeds import deeds_scenario
from tests.test_first_steps import told
from tests.test_verbs import desk as desk
from tests.users import ENVIRONMENT, command

SCENARIO = "name: tank\nduration: 1\nstep: 0.1\ncomponents:\n  ref: {block: reference, signals: {x: {start: 1}}}\n"
START = "components.ref.signals.x.start={}"
FILES = ["manifest.json", "results.csv"]
SOON = 60.0  # [s]


def do(*words: object, code: int = 0) -> str:
    """Return the output of a command, whose words may stand in one text."""
    return told(*" ".join(map(str, words)).split(), code=code)


def run(*words: object, code: int = 0) -> str:
    """Run the scenario in this process."""
    return do("run tank.yaml --no-report --in-process", *words, code=code)


def listed(*words: object) -> list[dict[str, Any]]:
    """Return what `cosim list` says."""
    results: list[dict[str, Any]] = json.loads(do("list --json", *words))["results"]
    return results


def names(*words: object) -> list[str]:
    """Return the listed names."""
    return [entry["name"] for entry in listed(*words)]


def outcomes(*words: object) -> dict[str, str]:
    """Return the states of the listed."""
    return {entry["name"]: entry["outcome"] for entry in listed(*words)}


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
    for start, words in enumerate(("", "", "--seed 7"), 1):
        run("--set", START.format(min(start, 2)), words)
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
    assert [(e["number"], e["name"], e["command"], e["outcome"]) for e in listed()] == [
        (k, f"tank/000{k}", "run", "ok") for k in (1, 2, 3)
    ]
    assert [e["changes"] for e in listed()] == [{}, {"components.ref.signals.x.start": 2.0}, {"seed": 7}]
    (runs / "0004").write_text("a file of the user")
    (runs / "9999").mkdir()
    run()
    assert names("tank/1*") == ["tank/10000"]
    do("run --no-report --in-process", runs / "0003" / "manifest.json")
    assert (runs / "10001" / "results.csv").read_bytes() == (runs / "0003" / "results.csv").read_bytes()


def test_eight_commands_at_once_have_eight_numbers(here: Path) -> None:
    words = command("run", "tank.yaml", "--no-report", "--in-process", "-q")
    started = [subprocess.Popen([*words, "--seed", str(k)], env=ENVIRONMENT) for k in range(8)]
    assert [process.wait(SOON * 4) for process in started] == [0] * 8
    folder = here / "results" / "tank"
    assert files_in(folder) == [f"000{k}/{name}" for k in range(1, 9) for name in FILES]
    seeds = [json.loads((each / "manifest.json").read_text())["seed"] for each in folder.iterdir()]
    assert sorted(seeds) == [*range(8)]


@pytest.mark.parametrize(
    ("name", "words", "file"),
    [
        ("tank", "run run.yaml", "manifest.json"),
        ("tank", "simulate tank.fmu --stop 1", "scenario.yaml"),
        ("e1", "replay e1.csv --plant tank.fmu", "replay.json"),
        ("e1-and-v1", "compare e1.csv v1.csv", "comparison.json"),
        ("areas", "sweep sweep.yaml --workers 1", "sweep.json"),
        ("base-linear", "linearize base", "linear.json"),
    ],
)
def test_a_repeated_command_has_the_next_number_and_refuses_a_folder_with_files(
    desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, words: str, file: str
) -> None:
    shutil.copytree(desk, tmp_path / "desk")
    monkeypatch.chdir(tmp_path / "desk")
    for number in ("0001", "0002"):
        do(words, "--no-report")
        assert Path("results", name, number, file).is_file()
    assert not [*Path("results").rglob("started.json")]
    before = files_in(Path("results", name))
    Path("out").mkdir()
    Path("out/notes.txt").write_text("mine")
    do(words, "--no-report --out out", code=2)
    assert files_in(Path("out")) == ["notes.txt"]
    do(words, "--no-report --out out --force")
    assert {file, "notes.txt"} <= {*files_in(Path("out"))}
    assert files_in(Path("results", name)) == before


def test_force_replaces_results_and_no_file_of_the_user_or_of_the_input(here: Path) -> None:
    run("--out out --format mat")
    for name in ("mine.svg", "figures/mine.png", "refine.json", "model.yaml"):
        (here / "out" / name).parent.mkdir(exist_ok=True)
        (here / "out" / name).touch()
    run("--out out --force")
    assert files_in(here / "out") == ["figures/mine.png", "manifest.json", "mine.svg", "results.csv"]
    do("compare out out --out out --force --no-report")
    assert {*FILES, "comparison.json"} <= {*files_in(here / "out")}


def test_a_refused_or_faulty_command_leaves_no_folder(here: Path) -> None:
    run("--set components.ref.block=none", code=2)
    do("replay none.csv --plant none.fmu", code=2)
    run("--out tank.yaml", code=2)
    with pytest.raises(InputError):
        cosim.run("tank.yaml", " ")
    assert [p.name for p in here.iterdir()] == ["tank.yaml"]


# -- kills ----------------------------------------------------------------------------------------


def started(folder: Path, *words: object) -> subprocess.Popen[bytes]:
    """Return a run that takes long, when it has made its folder."""
    scenario = deeds_scenario(folder, "DoStep", "slow", 0, duration=1000.0)
    process = subprocess.Popen(command("run", scenario, "--no-report", "-q", *words), env=ENVIRONMENT)
    end = time.monotonic() + SOON
    while time.monotonic() < end and not [*folder.rglob("started.json")]:
        time.sleep(0.02)
    return process


@pytest.mark.fresh
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_run_is_listed_while_it_goes_on_and_after_its_kill(here: Path) -> None:
    process = started(here)
    folder = here / "results" / "deeds"
    quick = "run deeds.yaml --no-report --set components.bad.fmu=good.fmu --set duration=0.5"
    try:
        end = time.monotonic() + SOON
        while "}" not in (folder / "0001" / "started.json").read_text() and time.monotonic() < end:
            time.sleep(0.02)
        assert outcomes() == {"deeds/0001": "running"}
        do("open --no-browser", code=2)
        do("run deeds.yaml --force --out", folder / "0001", code=2)
        do("run --resume", folder / "0001", code=2)
        do(quick)  # the next number, while the first goes on
        assert outcomes() == {"deeds/0001": "running", "deeds/0002": "ok"}
        assert "nothing to remove" in do("gc --yes")
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    do("run --resume", folder / "0001", code=2)  # without a checkpoint
    do("run deeds.yaml --out", folder / "0001", code=2)  # not empty
    assert outcomes() == {"deeds/0001": "interrupted", "deeds/0002": "ok"}
    do(quick, "--force --out", folder / "0001")
    assert outcomes() == {"deeds/0001": "ok", "deeds/0002": "ok"}


@pytest.mark.parametrize(
    ("content", "outcome"),
    [
        ("", "interrupted"),
        ("{", "interrupted"),
        ('{"pid": 1, "begun": "0", "host": "HOST", "command": "cosim refine"}', "interrupted"),
        ('{"pid": 1, "begun": "0", "host": "another machine"}', "running or interrupted"),
    ],
)
def test_the_state_of_a_folder_is_that_of_its_process(here: Path, content: str, outcome: str) -> None:
    folder = here / "results" / "study" / "0001"
    folder.mkdir(parents=True)
    assert outcomes() == {"study/0001": "interrupted"}  # killed between its folder and its first file
    (folder / "started.json").write_text(content.replace("HOST", platform.node()))
    assert outcomes() == {"study/0001": outcome}


def test_results_of_stopped_commands_are_unfinished(here: Path) -> None:
    for place, file in (("areas/0001", "runs.sqlite"), ("tank", "checkpoint/run.json")):
        path = here / "results" / place / file
        path.parent.mkdir(parents=True)
        path.write_text("{}")
    assert outcomes() == {"areas/0001": "unfinished", "tank": "unfinished"}


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
        do("report", runs.parent / found[0])
        assert do("open --no-browser", text) == f"report: results/{found[0]}/report.html\n"
        viewed = json.loads(do("view --prepare --json", text))["runs"]
        assert [v["file"] for v in viewed] == [f"results/{found[0]}/results.csv"]
        compared = json.loads(do("compare --json --no-report", text, "results/tank/0002"))
        assert compared["a"] == f"results/{found[0]}"


def test_the_folder_of_runs_means_the_newest_to_every_reader(runs: Path) -> None:
    assert cosim.read(runs).folder == runs / "0003"
    assert cosim.read("results/tank").folder == Path("results/tank/0003")
    assert do("report", "results/tank").strip() == "report:  results/tank/0003/report.html"
    do("run results/tank --until 2 --no-report --in-process")
    assert cosim.read("results/tank/0003").time[-1] == 2.0  # type: ignore[union-attr]
    run()
    Path("tank").mkdir()  # a folder without results hides none
    do("open 4 --no-browser", code=2)  # without a report
    do("report", "results/tank")
    assert do("open tank --no-browser") == do("open --no-browser") == "report: results/tank/0004/report.html\n"


@pytest.mark.parametrize(
    "words",
    [
        "open 9",
        "list none",
        "list x/*",
        "open tank/*",
        "list --results none",
        "compare none.csv tank",
        "compare tank",
        "gc",
    ],
)
def test_what_means_no_results_is_an_error_of_the_input(runs: Path, words: str) -> None:
    do(words, code=2)
    assert len(listed()) == 3


def test_removal_takes_earlier_runs_and_never_the_newest(runs: Path) -> None:
    (runs.parent / "mine").mkdir()
    (runs.parent / "mine" / "notes.txt").write_text("of the user")
    assert "nothing to remove" in do("gc --older 1 --yes")
    assert "nothing to remove" in do("gc tank --yes")
    do("gc --keep 1 --yes")
    assert names() == ["tank/0002", "tank/0003"]
    assert json.loads("{" + do("gc tank/* --yes --json").partition("{")[2])["removed"] == ["tank/0002"]
    assert names() == ["tank/0003"]
    assert (runs.parent / "mine" / "notes.txt").is_file()
    run()
    assert names() == ["tank/0003", "tank/0004"]


def test_results_in_subfolders_are_listed(here: Path) -> None:
    root = Path("results")
    scenario, other = ({"name": "tank", "components": {"tank": {"start": {"area": area}}}} for area in (0.5, 0.6))
    record(root / "tank" / "runs" / "0001", 1e9, {"scenario": scenario, "status": "ok"})
    record(root / "tank" / "runs" / "0002", 1e9 + 100, {"scenario": other, "criteria": [{"met": True}, {"met": False}]})
    record(root / "tank", 1e9 + 200, {"scenario": other, "status": "failed: x"})
    (root / "link").symlink_to(here / "results" / "tank")
    for part in ("system/a", "figures", ".hidden"):
        record(root / "tank" / part, 1e9, {"status": "ok"})
    wanted = {"tank/runs/0001": "ok", "tank/runs/0002": "1 of 2 criteria met", "tank": "failed: x"}
    assert [*outcomes().items()] == [*wanted.items()]
    assert listed("tank/runs/0002")[0]["changes"] == {"components.tank.start.area": 0.6}
    assert names("tank") == names("results/tank") == ["tank"]
    run()
    assert names("tank") == names("results/tank") == ["tank/0001"]
    do("gc --yes")
    assert names("t*") == ["tank/runs/0002", "tank", "tank/0001"]


def test_records_that_are_damaged_or_missing_are_listed_as_such(runs: Path) -> None:
    (runs / "0001" / "manifest.json").write_text("{")
    (runs / "0002" / "manifest.json").unlink()
    (runs / "0003" / "results.csv").unlink()
    content = {"sweep": {}, "runs": 50, "failed": 2, "met_all": 40, "criteria": [{"name": "x", "met": 40, "of": 48}]}
    record(runs.parent / "areas", 1e9, content, "sweep.json")
    wanted = {"damaged record", "rows without a record", "rows are gone", "50 runs, 2 failed, 40 met all criteria"}
    assert {*outcomes().values()} == wanted


@pytest.mark.parametrize("words", [["--version"], ["list", "-h"], ["list", "tank*", "--results", "results"]])
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
