"""A machine that several users share: nobody's files stop, mislead or are trusted by another user's commands."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from cosim.core.scratch import LOCK, sweep
from cosim.fmi.native.compiler import compiler
from tests.conftest import ROOT
from tests.deeds import deeds_fmu
from tests.users import OTHER, cosim, other_user, shared_folder

pytestmark = [pytest.mark.fresh, pytest.mark.skipif(os.name == "nt", reason="users as Unix has them")]


@pytest.fixture
def shared() -> Iterator[Path]:
    with shared_folder() as folder:
        yield folder


def environment(temporary: Path, **more: str) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(temporary), **more}


def is_quiet(done: subprocess.CompletedProcess[str]) -> bool:
    """Of a command that succeeds: free inputs are told, and a font cache that takes long on a busy machine."""
    expected = ("warning: not connected", "Matplotlib is building the font cache")
    return done.returncode == 0 and all(line.startswith(expected) for line in done.stderr.splitlines())


# -- temporary folders ----------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["cosim-work-x", "cosim-replay-rows-x"])
def test_folders_of_another_user_stop_no_command(shared: Path, name: str) -> None:
    user = other_user(TMPDIR=str(shared))
    closed, open_ = shared / name, shared / f"{name}-open"
    closed.mkdir(mode=0o700)
    open_.mkdir()
    open_.chmod(0o777)
    (open_ / LOCK).touch()
    fmu = deeds_fmu(shared / "good.fmu")
    assert is_quiet(cosim("simulate", fmu, "--out", shared / "out", "--stop", "0.1", "--no-report", **user))
    assert {closed, open_} <= set(shared.iterdir())  # the other user's, whoever that is


def test_a_link_to_a_folder_is_not_swept(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / LOCK).touch()
    (tmp_path / "work-x").symlink_to(mine)
    sweep(tmp_path, "work-")
    assert (mine / LOCK).exists()


# -- the cache ------------------------------------------------------------------------------------

PLANTED = """
import cosim.files.cache as cache
from cosim.fmi.native.compiler import load_library
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


@pytest.mark.parametrize("who", ["me", "others can write", "another user"])
def test_a_cache_is_for_its_user_alone_and_used_again(home: Path, who: str) -> None:
    folder = home / "cosim"
    assert folder.stat().st_mode & 0o777 == 0o700
    if who == "others can write":
        folder.chmod(0o777)
    elif who == "another user":
        if os.geteuid() != 0:
            pytest.skip("only root can give files to another user")
        os.chown(folder, OTHER, OTHER)
    given = environment(home.parent, XDG_CACHE_HOME=str(home))
    done = subprocess.run([sys.executable, "-c", PLANTED], env=given, check=True, capture_output=True, text=True)
    answer, used = done.stdout.split()
    # the user's own file, by its right name, is the cache
    assert (answer, Path(used).is_relative_to(home)) == (("43", True) if who == "me" else ("42", False))
    assert len(done.stderr.splitlines()) == (0 if who == "me" else 1)


@pytest.mark.thorough
@pytest.mark.parametrize("home", [{}, {"HOME": "/"}, {"HOME": "/nonexistent"}])
def test_a_user_without_a_home_folder_runs_everything_without_a_word_of_a_library(
    shared: Path, native_fmus: Path, home: dict[str, str]
) -> None:
    user = other_user(TMPDIR=str(shared), **home)
    native = shutil.copy(native_fmus / "plant-native.fmu", shared / "plant-native.fmu")
    fmu = deeds_fmu(shared / "foreign.fmu")
    for words in (
        ["check", fmu, native],
        ["simulate", native, "--out", shared / "b", "--stop", "0.1", "--step", "0.02"],
        ["compare", shared / "b", shared / "b", "--out", shared / "c"],
        ["report", shared / "b"],
        ["build", "--out", shared / "d", "--native", "--model", "base"],
    ):
        assert is_quiet(cosim(*words, **user)), words
    assert not list(shared.glob("cosim-*"))
