"""One command at a time writes into a folder, and every command says which folder that is."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import cosim
from cosim.base.drafts import draft_of
from cosim.base.errors import InputError
from cosim.base.scratch import lock_descriptor
from cosim.comparison.report_again import report_of
from cosim.loading.build_native import build_native
from cosim.storage import folder_lock
from cosim.storage.files import check_writable
from cosim.storage.folder_lock import folder_locks, take_folder
from cosim.verbs.cli import app
from tests.conftest import ROOT
from tests.deeds import deeds_fmu, deeds_scenario
from tests.logs import write_log
from tests.users import OTHER, command, shared_folder

Verb = Callable[[Path, Path], Any]  # of the folder with its inputs and of --out
VERBS: dict[str, Verb] = {
    "run": lambda given, out: cosim.run(given / "scenario.yaml", out),
    "simulate": lambda given, out: cosim.simulate(given / "good.fmu", out),
    "replay": lambda given, out: cosim.replay(given / "log.csv", out, given / "good.fmu"),
    "fit": lambda given, out: cosim.fit([given / "log.csv"], given / "good.fmu", out),
    "refine": lambda given, out: cosim.refine(ROOT / "examples" / "hovercraft" / "study.yaml", out),
    "compare": lambda given, out: cosim.compare(given / "log.csv", given / "log.csv", out),
    "excite": lambda given, out: cosim.excite("base", out, ["friction"]),
    "identify": lambda given, out: cosim.identify(ROOT / "examples" / "bench" / "protocol.yaml", out),
    "linearize": lambda given, out: cosim.linearize("base", out),
    "sweep": lambda given, out: cosim.sweep(given / "sweep.yaml", out),
    "build": lambda given, out: cosim.build(out),
    "consistency": lambda given, out: CliRunner().invoke(
        app, ["consistency", "--out", str(out)], catch_exceptions=False, standalone_mode=False
    ),
}
FILES = {"export-ssp", "graph", "init"}  # whose --out is one file, which is replaced as a whole


@pytest.fixture
def given(tmp_path: Path) -> Path:
    time_ = 0.1 * np.arange(200)
    write_log(tmp_path / "log.csv", {"time": time_, "u0": 0.0 * time_, "u1": np.sin(time_), "y1": np.cos(time_)})
    deeds_fmu(tmp_path / "good.fmu")
    deeds_scenario(tmp_path, "none", "none").rename(tmp_path / "scenario.yaml")
    (tmp_path / "sweep.yaml").write_text("scenario: scenario.yaml\nvary: {seed: {values: [1, 2]}}\n")
    return tmp_path


@pytest.fixture
def held(tmp_path: Path) -> Iterator[Path]:
    """A folder into which another command writes."""
    (folder := tmp_path / "held").mkdir()
    lock = os.open(folder / folder_lock.LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o600)
    lock_descriptor(lock)
    yield folder
    os.close(lock)


def commands_with_out() -> set[str]:
    group = typer.main.get_command(app)
    return {n for n, c in group.commands.items() if any(p.name == "out" for p in c.params)}  # type: ignore[attr-defined]


def test_every_command_that_writes_a_folder_is_among_those_tried_here() -> None:
    assert commands_with_out() == {*VERBS} | FILES


@pytest.mark.parametrize("verb", VERBS)
def test_a_folder_into_which_another_command_writes_is_refused(verb: str, given: Path, held: Path) -> None:
    with pytest.raises(InputError, match="held: another command writes into this folder now; wait for its end, or give "
                                         "another folder as --out") as refused:  # fmt: skip
        VERBS[verb](given, held)
    assert refused.value.exit_code == 2
    assert [path.name for path in held.iterdir()] == [folder_lock.LOCK_FILE]


def test_the_page_of_a_run_is_not_made_again_while_another_command_writes_it(given: Path, held: Path) -> None:
    cosim.run(given / "scenario.yaml", given / "out", report=False)
    for file in (given / "out").iterdir():
        file.rename(held / file.name)
    with pytest.raises(InputError, match="another command writes into this folder now"):
        report_of(held)


def test_native_fmus_are_not_built_where_another_command_writes(held: Path) -> None:
    with pytest.raises(InputError, match="another command writes into this folder now"):
        build_native(held)


@pytest.mark.thorough  # every verb is refused above; after a kill: test_row_stops
@pytest.mark.fresh
def test_of_two_commands_one_writes_and_one_is_refused_and_a_kill_leaves_no_lock(tmp_path: Path) -> None:
    slow = deeds_scenario(tmp_path, "DoStep", "slow", 0, duration=1000.0)
    (tmp_path / "quick").mkdir()
    quick, out = deeds_scenario(tmp_path / "quick", "none", "none"), tmp_path / "out"
    given = {"env": {**os.environ, "PYTHONPATH": str(ROOT)}, "stderr": subprocess.PIPE, "text": True}
    first = subprocess.Popen(command("run", slow, "--out", out, "--no-report"), **given)
    for _ in range(600):
        if list(out.glob(".rows-*")):
            break
        time.sleep(0.05)
    words = command("run", quick, "--out", out, "--no-report", "--force")
    second = subprocess.run(words, check=False, timeout=60, **given)
    assert (second.returncode, first.poll()) == (2, None)
    assert second.stderr.startswith(f"{out}: another command writes into this folder now;")
    first.send_signal(signal.SIGKILL)
    first.communicate()
    assert subprocess.run(words, check=False, timeout=60, **given).returncode == 0


def test_the_lock_ends_with_the_verb_and_is_shared_by_the_verbs_in_it(tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    with folder_locks():
        assert take_folder(out)
        with folder_locks():
            assert take_folder(out)
        lock = os.open(out / folder_lock.LOCK_FILE, os.O_RDWR)
        with pytest.raises(BlockingIOError):
            lock_descriptor(lock)
    assert not out.parent.exists()  # made for the lock, and nothing was written
    os.close(lock)
    with folder_locks():
        assert take_folder(out)
        (out / "results.csv").touch()
    assert [p.name for p in out.iterdir()] == ["results.csv"]


def test_who_may_only_read_a_folder_cannot_hold_it(tmp_path: Path) -> None:
    if os.name == "nt" or os.geteuid() != 0 or not shutil.which("flock"):
        pytest.skip("only root can act as another user")
    with shared_folder() as place:
        (folder := place / "out").mkdir(mode=0o755)
        stranger = subprocess.Popen(["flock", folder, "sleep", "60"], user=OTHER, group=OTHER, extra_groups=[])
        try:
            while not is_locked(folder):
                assert stranger.poll() is None
                time.sleep(0.02)
            with folder_locks():
                assert take_folder(folder)
                assert is_locked(folder / folder_lock.LOCK_FILE)
                assert (folder / folder_lock.LOCK_FILE).stat().st_mode & 0o777 == 0o600
        finally:
            stranger.kill()
            stranger.wait()


def test_those_who_share_a_folder_share_its_lock(tmp_path: Path) -> None:
    if os.name == "nt":
        pytest.skip("no groups")
    tmp_path.chmod(0o770)
    with folder_locks():
        assert take_folder(tmp_path)
        assert (tmp_path / folder_lock.LOCK_FILE).stat().st_mode & 0o777 == 0o660


def is_locked(path: Path) -> bool:
    lock = os.open(path, os.O_RDONLY)
    try:
        lock_descriptor(lock)
    except BlockingIOError:
        return True
    finally:
        os.close(lock)
    return False


def test_a_lock_that_a_stranger_left_among_temporary_files_is_not_trusted(tmp_path: Path) -> None:
    if os.name == "nt" or os.geteuid() != 0:
        pytest.skip("only root can give files to another user")
    with shared_folder() as place:
        (file := place / folder_lock.LOCK_FILE).touch(0o666)
        os.chown(file, OTHER, OTHER)
        lock = os.open(file, os.O_RDWR)
        lock_descriptor(lock)
        with folder_locks():
            assert not take_folder(place)  # written without a lock
        os.close(lock)


def test_a_file_in_place_of_the_lock_that_is_none_blocks_nothing(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / folder_lock.LOCK_FILE)
    with folder_locks():
        assert not take_folder(tmp_path)


def test_a_disk_without_locks_is_written_without_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def without(descriptor: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(folder_lock, "lock_descriptor", without)
    with folder_locks():
        assert not take_folder(tmp_path)
        check_writable(tmp_path, ["results.csv"])
    assert list(tmp_path.iterdir()) == []


def test_drafts_of_a_killed_command_are_removed_by_the_next_one_and_nothing_else(tmp_path: Path) -> None:
    kept = [".results.csv.bak", ".other.csv.12", "results.csv.12", ".results.csv.12.old"]
    for name in (".results.csv.12345", *kept):
        (tmp_path / name).touch()
    with folder_locks():
        check_writable(tmp_path, ["results.csv", "manifest.json"])
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(kept)


def test_what_only_another_user_may_replace_is_refused_before_any_work(monkeypatch: pytest.MonkeyPatch) -> None:
    if os.name == "nt" or os.geteuid() != 0:
        pytest.skip("only root can give files to another user")
    with shared_folder() as place:
        (place / "results.csv").touch()
        os.chown(place / "results.csv", OTHER, OTHER)
        check_writable(place, ["results.csv"])  # root may
        monkeypatch.setattr(os, "geteuid", lambda: OTHER + 1)
        with pytest.raises(
            InputError, match=r"results\.csv: belongs to another user, and only its owner may replace it"
        ):
            check_writable(place, ["results.csv", "manifest.json"])
        monkeypatch.undo()


def test_what_cannot_take_its_place_at_the_end_is_kept_beside_it(tmp_path: Path) -> None:
    def write() -> None:
        with draft_of(tmp_path / "results.csv") as draft:
            draft.write_text("rows")
            (tmp_path / "results.csv").mkdir()

    with pytest.raises(OSError, match=r"cannot be replaced .*; what was to take its place is .*results-kept\.csv"):
        write()
    assert (tmp_path / "results-kept.csv").read_text() == "rows"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["results-kept.csv", "results.csv"]


# -- no name at all -------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize("blank", ["", "  "])
@pytest.mark.parametrize("name", sorted(commands_with_out()))
def test_a_blank_out_is_refused_by_every_command(name: str, blank: str, tmp_path: Path) -> None:
    for option in (["--out", blank], [f"--out={blank}"], ["-o", blank]):
        done = CliRunner().invoke(app, [name, *option])
        assert done.exit_code == 2
        assert "is blank; give a name, or . for the current folder" in done.output


@pytest.mark.parametrize("verb", sorted({*VERBS} - {"consistency"}))
def test_a_blank_out_is_refused_in_python(
    verb: str, given: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (here := tmp_path / "here").mkdir()
    monkeypatch.chdir(here)
    with pytest.raises(InputError, match=r"^(out|folder): is blank; give the name of a file or folder$"):
        VERBS[verb](given, "")  # type: ignore[arg-type]
    assert list(here.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
def test_a_file_with_another_name_keeps_its_permissions_as_a_lock(tmp_path: Path) -> None:
    (key := tmp_path / "key").write_text("private")
    key.chmod(0o600)
    (shared := tmp_path / "shared").mkdir()
    shared.chmod(0o777)
    os.link(key, shared / folder_lock.LOCK_FILE)
    with folder_lock.folder_locks():
        folder_lock.take_folder(shared)
    assert key.stat().st_mode & 0o777 == 0o600
