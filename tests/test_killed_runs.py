"""Killed commands leave a row in the list, between the runs before and after, and numbers of results are given once."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from typer.testing import CliRunner

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.history.entries import RUNNING, Entry, entries, find_entries
from cosim.history.numbers import NUMBERS
from cosim.history.removal import plan_removal, remove
from cosim.master.observer import Observer
from cosim.simulation import workflow
from cosim.simulation.workflow import run
from cosim.storage.folder_lock import folder_locks
from cosim.storage.folders import begin_unrecorded, check_overwritable, keep_earlier
from cosim.storage.started import KILLED, STARTED
from cosim.verbs.cli import app

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a fork of this process")
SCENARIO = "name: tank\nduration: 1\nstep: 0.1\ncomponents:\n  ref: {block: reference, signals: {x: {start: 1}}}\n"


class Kill(Observer):
    """Kills its process after some rows."""

    def rows(self, time: Array, values: Array) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


class Look(Observer):
    """Lists the results while the run goes on."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, str]] = []

    def rows(self, time: Array, values: Array) -> None:
        self.seen = [(e.name, e.outcome) for e in entries()]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("tank.yaml").write_text(SCENARIO)
    return Path("results/tank")


def _run(*observers: Observer, seed: int = 1) -> None:
    run("tank.yaml", None, [f"seed={seed}"], observers=observers, report=False, in_process=True)


def _in_killed_fork(work: Any) -> None:
    pid = os.fork()
    if pid == 0:
        try:
            work()
        finally:
            os._exit(1)
    assert os.WTERMSIG(os.waitpid(pid, 0)[1]) == signal.SIGKILL


def _kill(seed: int) -> None:
    _in_killed_fork(lambda: _run(Kill(), seed=seed))


def _listed() -> list[tuple[int, str, str]]:
    return [(e.number, e.lasting_name, e.outcome) for e in entries()]


def _only(text: str) -> Entry:
    (entry,) = find_entries([text])
    return entry


def test_each_killed_run_is_listed_in_its_place_with_its_inputs(here: Path) -> None:
    _kill(1)  # before any results
    assert _listed() == [(1, "tank/0001", KILLED)]
    _run(seed=2)
    _kill(3)
    _kill(4)
    expected = [(1, "tank/0001", KILLED), (2, "tank/0002", "ok"), (3, "tank/0003", KILLED), (4, "tank/0004", KILLED)]
    assert _listed() == expected
    assert [dict(e.changes) for e in entries()][1:] == [{"seed": 2}, {"seed": 3}, {"seed": 4}]
    _run(seed=5)
    assert _listed() == [*expected, (5, "tank/0005", "ok")]
    assert [e.name for e in entries()] == ["tank/0001", "tank/0002", "tank/0003", "tank/0004", "tank"]
    assert not (here / STARTED).exists()
    run(here / "runs" / "0003" / "manifest.json", None, report=False, in_process=True)  # a killed run can be repeated
    assert json.loads((here / "manifest.json").read_text())["seed"] == 3


def test_a_killed_run_leaves_the_results_before_it_where_they_are(here: Path) -> None:
    _run(seed=1)
    kept = (here / "results.csv").read_bytes()
    _kill(2)
    assert (here / "results.csv").read_bytes() == kept
    assert not (here / "runs").exists()
    with pytest.raises(InputError, match="another scenario"):  # A refused command moves nothing.
        run("tank.yaml", here, ["name=other"], force=False, in_process=True)
    assert [e.name for e in entries()] == ["tank", "tank/0002"]
    assert not plan_removal(entries()).entries
    _run(seed=3)
    assert (here / "runs" / "0001" / "results.csv").read_bytes() == kept
    assert [e.name for e in plan_removal(entries()).entries] == ["tank/0001", "tank/0002"]


def test_a_run_is_listed_while_it_goes_on_and_leaves_no_trace_of_it(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = Look()
    _run(look)
    assert look.seen == [("tank/0001", RUNNING)]
    assert {p.name for p in here.iterdir()} == {"results.csv", "manifest.json"}
    assert "killed" not in (here / "manifest.json").read_text()
    monkeypatch.setattr(workflow, "_step", Mock(side_effect=InputError.at(here, "no such FMU")))
    with pytest.raises(InputError, match="no such FMU"):
        _run(seed=2)
    assert [(e.name, e.outcome) for e in entries()] == [("tank", "ok")]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["open", "1"], "because its command was killed"),
        (["view", "1", "--no-browser"], f"no rows to draw (status: {KILLED})"),
        (["compare", "1", "2"], f"holds no rows (status: {KILLED})"),
        (["report", "results/tank/runs/0001"], f"holds no rows (status: {KILLED})"),
    ],
)
def test_commands_say_that_a_run_was_killed(here: Path, words: list[str], message: str) -> None:
    _kill(1)
    _run(seed=2)
    error = CliRunner().invoke(app, words).exception
    assert isinstance(error, InputError)
    assert message in str(error)


def test_a_killed_command_without_an_own_record_is_listed_with_its_verb(here: Path) -> None:
    @folder_locks()
    def work() -> None:
        check_overwritable(here, "cosim fit")
        begin_unrecorded(here, "cosim fit", ())
        os.kill(os.getpid(), signal.SIGKILL)

    _in_killed_fork(work)
    assert [(e.verb, e.outcome) for e in entries()] == [("fit", KILLED)]
    _run()
    assert [(e.name, e.verb) for e in entries()] == [("tank/0001", "fit"), ("tank", "run")]


def test_numbers_stay_when_runs_move_are_removed_or_become_the_newest(here: Path) -> None:
    for seed in (1, 2, 3):
        _run(seed=seed)
    assert [(e.number, e.name) for e in entries()] == [(1, "tank/0001"), (2, "tank/0002"), (3, "tank")]
    assert _only("3") == _only("tank/0003") == _only("tank")
    _run(seed=4)
    assert _only("3").name == _only("tank/0003").name == "tank/0003"
    remove(find_entries(["1", "2"]))
    _run(seed=5)
    assert _listed() == [(3, "tank/0003", "ok"), (4, "tank/0004", "ok"), (5, "tank/0005", "ok")]
    with pytest.raises(InputError, match="number 2, tank/0002, were removed"):
        find_entries(["2"])
    for text in ("0", "9", "9" * 5000):
        with pytest.raises(InputError, match="up to 5"):
            find_entries([text])
    assert Path("results", NUMBERS).read_text().splitlines() == [f"tank/000{k}" for k in range(1, 6)]


@pytest.mark.parametrize("damage", ["tank/0001\ntan", "tank/0001\ntank/0001\n", "\udcff\n\ntank/0001\n"])
def test_numbers_survive_a_damaged_file(here: Path, damage: str) -> None:
    _run(seed=1)
    _run(seed=2)
    file = Path("results", NUMBERS)
    file.write_text(damage, errors="surrogateescape")
    numbers = [e.number for e in entries()]
    assert len({*numbers}) == 2
    assert [e.number for e in entries()] == numbers
    file.unlink()
    file.symlink_to("elsewhere")
    assert [e.number for e in entries()] == [1, 2]  # without a file
    assert not Path("results/elsewhere").exists()


def test_rows_that_cannot_be_read_without_their_end_are_removed_with_a_note(here: Path) -> None:
    here.mkdir(parents=True)
    for name in (".results.parquet.123", ".results.csv.123"):
        (here / name).write_bytes(b"PAR1")
    told: list[str] = []
    run("tank.yaml", None, report=False, in_process=True, tell=told.append)
    assert len(told) == 1
    assert "results.parquet" in told[0]
    assert not [*here.glob(".results*")]


def test_an_earlier_run_that_a_full_disk_keeps_from_moving_stays(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _run(seed=1)
    kept = {path.name: path.read_bytes() for path in here.iterdir() if path.is_file()}

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(workflow, "keep_earlier", full)
    told: list[str] = []
    done = run("tank.yaml", None, ["seed=2"], report=False, in_process=True, tell=told.append)
    assert {path.name: path.read_bytes() for path in here.iterdir() if path.is_file()} == kept
    assert json.loads((done.folder / "manifest.json").read_text())["seed"] == 2
    assert str(done.folder) in told[0]
    shutil.rmtree(done.folder)


def test_a_killed_command_and_the_next_of_another_verb(here: Path) -> None:
    _run(seed=1)
    _kill(2)
    with folder_locks():
        check_overwritable(here, "cosim run")
        keep_earlier(here, "cosim run")
    assert [(e.lasting_name, e.outcome) for e in entries()] == [("tank/0001", "ok"), ("tank/0002", KILLED)]
