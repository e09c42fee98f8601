"""A machine that several users share: nobody's files stop, mislead or are trusted by another user's commands."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from cosim.core.scratch import LOCK, sweep
from cosim.fmi.native.compiler import compiler
from tests.conftest import ROOT
from tests.deeds import deeds_fmu, deeds_scenario
from tests.users import OTHER, command, cosim, other_user, shared_folder

pytestmark = [pytest.mark.fresh, pytest.mark.skipif(os.name == "nt", reason="users as Unix has them")]


@pytest.fixture
def shared() -> Iterator[Path]:
    with shared_folder() as folder:
        yield folder


def environment(temporary: Path, **more: str) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(temporary), **more}


def said(done: subprocess.CompletedProcess[str]) -> list[str]:
    """Return what a command says on stderr beside free inputs, and a font cache that takes long on a busy machine."""
    expected = ("warning: not connected", "Matplotlib is building the font cache")
    return [line for line in done.stderr.splitlines() if not line.startswith(expected)]


# -- temporary folders ----------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["cosim-work-x", "cosim-x", ".rows-x", "cosim-replay-rows-x"])
def test_folders_of_another_user_stop_no_command(shared: Path, name: str) -> None:
    user = other_user(TMPDIR=str(shared))
    closed, open_ = shared / name, shared / f"{name}-open"
    closed.mkdir(mode=0o700)
    open_.mkdir()
    open_.chmod(0o777)
    (open_ / LOCK).touch()
    fmu = deeds_fmu(shared / "good.fmu")
    for words in (["check", fmu], ["simulate", fmu, "--out", shared / "out", "--stop", "0.1", "--no-report"]):
        done = cosim(*words, **user)
        assert (done.returncode, said(done)) == (0, [])
    assert {closed, open_} <= set(shared.iterdir())  # the other user's, whoever that is


def test_a_link_to_a_folder_is_not_swept(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / LOCK).touch()
    (tmp_path / "work-x").symlink_to(mine)
    sweep(tmp_path, "work-")
    assert (mine / LOCK).exists()


@pytest.mark.thorough  # without processes: test_misbehaving
def test_the_folder_of_a_process_is_swept_after_it_was_killed(tmp_path: Path) -> None:
    path = deeds_scenario(tmp_path, "DoStep", "slow", 0, duration=1000.0)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    given = environment(temporary)
    words = command("run", path, "--in-process", "--out", tmp_path / "out", "--no-report")
    process = subprocess.Popen(words, env=given)
    for _ in range(600):
        if list(temporary.glob("**/modelDescription.xml")):
            break
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert list(temporary.iterdir())
    assert cosim("check", deeds_fmu(tmp_path / "good.fmu"), env=given).returncode == 0
    assert not list(temporary.iterdir())


# -- the cache ------------------------------------------------------------------------------------

PLANTED = """
import os, sys
from pathlib import Path
import cosim.files.cache as cache
from cosim.fmi.native.compiler import compiler, load_library
print(load_library("int answer(void) { return 42; }").answer())
print(cache.cache_folder())
"""


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Return a home folder whose cache holds a library that answers 43 in place of 42, by its right name."""
    if compiler() is None:
        pytest.skip("no C compiler")
    (tmp_path / "home").mkdir(mode=0o755)
    given = environment(tmp_path, XDG_CACHE_HOME=str(tmp_path / "home"))
    subprocess.run([sys.executable, "-c", PLANTED], env=given, check=True, capture_output=True)
    folder = tmp_path / "home" / "cosim"
    (library,) = folder.glob("*.so")
    source = tmp_path / "evil.c"
    source.write_text("int answer(void) { return 43; }")
    subprocess.run([*(compiler() or ()), "-shared", "-fPIC", "-o", tmp_path / "evil.so", source], check=True)
    digest = hashlib.sha256((tmp_path / "evil.so").read_bytes()).hexdigest()[:32]
    evil = folder / f"{library.name.partition('-')[0]}-{digest}.so"
    library.unlink()
    shutil.copyfile(tmp_path / "evil.so", evil)
    evil.chmod(0o644)
    return tmp_path / "home"


def answer(home: Path) -> tuple[str, Path, str]:
    """Return what the library says, the cache that was used, and the note."""
    given = environment(home.parent, XDG_CACHE_HOME=str(home))
    done = subprocess.run([sys.executable, "-c", PLANTED], env=given, check=True, capture_output=True, text=True)
    said, folder = done.stdout.split()
    return said, Path(folder), done.stderr


def test_the_cache_is_for_its_user_alone_and_used_again(home: Path) -> None:
    assert (home / "cosim").stat().st_mode & 0o777 == 0o700
    assert answer(home) == ("43", home / "cosim", "")  # the user's own file, by its right name: that is the cache


def test_a_cache_that_others_can_write_is_not_used_and_one_note_says_so(home: Path) -> None:
    (home / "cosim").chmod(0o777)
    said, folder, note = answer(home)
    assert (said, folder.is_relative_to(home)) == ("42", False)
    assert len(note.splitlines()) == 1
    assert "chmod go-w" in note


@pytest.mark.skipif(os.name == "nt" or os.geteuid() != 0, reason="only root can give files to another user")
def test_a_cache_of_another_user_is_not_used(home: Path) -> None:
    os.chown(home / "cosim", OTHER, OTHER)
    said, folder, _ = answer(home)
    assert (said, folder.is_relative_to(home)) == ("42", False)


@pytest.mark.thorough
@pytest.mark.parametrize("home", [{"HOME": "/"}, {"HOME": ""}, {"HOME": "/nonexistent"}])
def test_a_home_folder_that_is_none_is_not_used(shared: Path, home: dict[str, str]) -> None:
    user, fmu = other_user(TMPDIR=str(shared), **home), deeds_fmu(shared / "foreign.fmu")
    for words in (["simulate", fmu, "--out", shared / "a", "--stop", "0.1"], ["report", shared / "a", "--figures"]):
        done = cosim(*words, **user)
        assert (done.returncode, said(done)) == (0, []), words
    assert not list(shared.glob("cosim-*"))


@pytest.mark.thorough
def test_a_user_without_a_home_folder_runs_everything_without_a_word_of_a_library(
    shared: Path, native_fmus: Path
) -> None:
    user = other_user(TMPDIR=str(shared))
    for name in ("plant-native.fmu", "controller-native.fmu"):
        shutil.copy(native_fmus / name, shared / name)
    fmu = deeds_fmu(shared / "foreign.fmu")
    commands = [
        ["check", fmu, shared / "plant-native.fmu"],
        ["simulate", fmu, "--out", shared / "a", "--stop", "0.1"],
        ["simulate", shared / "plant-native.fmu", "--out", shared / "b", "--stop", "0.1", "--step", "0.02"],
        ["compare", shared / "b", shared / "b", "--out", shared / "c"],
        ["report", shared / "b", "--figures"],
        ["build", "--out", shared / "d", "--native", "--model", "base"],
    ]
    for words in commands:
        done = cosim(*words, **user)
        assert (done.returncode, said(done)) == (0, []), words
    assert not list(shared.glob("cosim-*"))
