"""What a caller and its worker share: tables and progress in files, limits as people write them, folders, words."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest

from cosim.core import scratch
from cosim.core.errors import Crashed, SimulationError
from cosim.isolation.limits import BYTES, Limits, read_limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import (
    ADVANCE,
)
from cosim.isolation.watch import Watch

# -- limits -----------------------------------------------------------------------------------------


def test_limits_of_a_command_have_every_unit() -> None:
    for unit, seconds in {"ms": 0.0025, "s": 2.5, "min": 150.0, "h": 9000.0}.items():
        assert read_limits(f"step: 2.5 {unit}").step == pytest.approx(seconds)
    for unit, factor in BYTES.items():
        assert read_limits(f"{{memory: 1e2{unit}}}").memory == 100 * factor
    both = read_limits(" step: 10 s, total:1 min ")
    assert (both.step, both.total, both.loading) == (10.0, 60.0, 60.0)
    assert read_limits("load: 5").loading == 5.0
    assert read_limits("memory: 1 GB").loading is None
    assert read_limits("total: 1").loading == 60.0
    assert (BYTES["MiB"], BYTES["MB"]) == (1048576.0, 1e6)


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
        assert not own.running
        first = own.call(os.getpid)
        assert first != os.getpid()
        assert (own.call(os.getpid), own.starts) == (first, 1)
        folder = own.folder
        assert own.call(os.path.isdir, str(folder))
        assert own.call(os.getenv, "TMPDIR") == str(folder)  # what FMUs leave goes with the worker
        with pytest.raises(Crashed, match=r"^the run at t = 0 s: the worker ended the process, exit code 3$"):
            own.call(os._exit, 3)
        assert not own.running
        second = own.call(os.getpid)
        assert (second != first, own.starts) == (True, 2)
        assert not folder.exists()
        folder = own.folder
    assert not own.running
    assert not folder.exists()
    own.end()  # once more is no harm


def test_a_job_beyond_its_limits_is_ended_and_the_next_one_has_a_process_of_its_own() -> None:
    with Worker() as own:
        for limits, error in (
            (Limits(step=0.2), "stepping takes longer than 0.2 s"),
            (Limits(total=0.2), "stepping was stopped: the run takes longer than 0.2 s in all"),
            (Limits(memory=1e6), "stepping: .* MB, more than 1 MB"),
        ):
            pid = own.call(os.getpid)
            with pytest.raises(SimulationError, match=f"^tank at t = 0 s: {error}"):
                own.call(time.sleep, 600, watch=Watch(("tank",), limits=limits), doing=ADVANCE)
            assert not own.running
            with pytest.raises(ProcessLookupError):
                os.kill(pid, 0)
