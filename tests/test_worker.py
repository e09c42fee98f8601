"""What a caller and its worker share: tables and progress in files, limits as people write them, folders, words."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from cosim.core import scratch
from cosim.core.errors import Crashed
from cosim.isolation.limits import read_limits
from cosim.isolation.process import Worker

# -- limits -----------------------------------------------------------------------------------------


def test_limits_of_a_command_have_every_unit() -> None:
    for unit, seconds in {"ms": 0.0025, "s": 2.5, "min": 150.0, "h": 9000.0}.items():
        assert read_limits(f"step: 2.5 {unit}").step == pytest.approx(seconds)
    for unit, size in {"GB": 1e9, "MB": 1e6, "MiB": 1048576.0}.items():
        assert read_limits(f"{{memory: 1e2{unit}}}").memory == 100 * size
    both = read_limits(" step: 10 s, total:1 min ")
    assert (both.step, both.total, both.loading) == (10.0, 60.0, 60.0)
    assert read_limits("load: 5").loading == 5.0
    assert read_limits("memory: 1 GB").loading is None


# -- folders ----------------------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform == "win32", reason="locks of POSIX")
def test_a_folder_is_swept_once_nobody_holds_it(tmp_path: Path) -> None:
    first = scratch.scratch("cosim-x-", tmp_path)
    other = tmp_path / "cosim-y-1"
    other.mkdir()
    (other / scratch.LOCK).touch(0o600)
    second = scratch.scratch("cosim-x-", tmp_path)
    assert first.path.exists()  # it is held
    assert other.exists()  # it has another name
    assert first._lock is not None
    os.close(first._lock)  # as where its process was killed
    scratch.sweep(tmp_path, "cosim-x-")
    assert not first.path.exists()
    assert second.path.exists()
    second.remove()
    assert not second.path.exists()
    second.remove()


# -- a worker at work ---------------------------------------------------------------------------------


def test_jobs_are_done_by_one_process_elsewhere_and_after_a_crash_by_another() -> None:
    with Worker("json") as own:
        first, folder = own.call(os.getpid), own.folder
        assert own.call(os.getpid) == first != os.getpid()
        assert own.call(os.getenv, "TMPDIR") == str(folder)  # what FMUs leave goes with the worker
        with pytest.raises(Crashed, match=r"the worker ended the process, exit code 3$"):
            own.call(os._exit, 3)
        assert own.call(os.getpid) != first
        assert not folder.exists()
        folder = own.folder
    assert not folder.exists()
    own.end()  # once more is no harm
