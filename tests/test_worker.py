"""What a caller and its worker share: tables and progress in files, limits as people write them, folders, words."""

from __future__ import annotations

import errno
import io
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.base import scratch
from cosim.base.errors import Crashed, InputError, SimulationError
from cosim.blocks.instance import MessageLog
from cosim.isolation import process, worker
from cosim.isolation.limits import BYTES, Limits, read_limits
from cosim.isolation.memory import resident
from cosim.isolation.process import Remote, Worker
from cosim.isolation.rows import (
    ADVANCE,
    CALLS,
    NOTHING,
    ExactFile,
    Rows,
    allocate,
    mapped_progress,
    mapped_table,
    read_table,
)
from cosim.isolation.watch import Watch
from cosim.isolation.worker import share_log


def test_a_table_in_a_file_is_read_back_as_far_as_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "table"
    allocate(path, 8 * 5 * 3)
    assert path.stat().st_size == 120
    table = mapped_table(path, 5, 3)
    assert not table.any()
    table[:] = np.arange(15.0).reshape(5, 3)
    assert read_table(path, 5, 3).tolist() == table.tolist()
    assert read_table(path, 2, 3).tolist() == [[0, 1, 2], [3, 4, 5]]
    for rows, columns in ((0, 3), (3, 0)):
        assert mapped_table(path, rows, columns).shape == read_table(path, rows, columns).shape == (rows, columns)
    assert Rows.in_memory(2, 3).table.shape == (2, 3)
    assert Rows.in_memory(2, 3).doing[0] == NOTHING


@pytest.mark.parametrize("size", [1, 1 << 20, (1 << 20) + 1, 3 << 20])
def test_room_is_made_also_where_a_disk_cannot_be_asked_for_it(
    tmp_path: Path, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "posix_fallocate", raising=False)
    allocate(tmp_path / "table", size)
    assert (tmp_path / "table").stat().st_size == size


def test_progress_is_the_same_for_both_who_map_it(tmp_path: Path) -> None:
    ours, theirs = mapped_progress(tmp_path / "progress"), mapped_progress(tmp_path / "progress")
    ours.made[0], ours.doing[0], ours.call = 3, 9, b"fmi2DoStep"
    assert (theirs.made[0], theirs.doing[0], theirs.call) == (3, 9, b"fmi2DoStep")


def test_a_row_that_is_not_written_whole_is_a_full_disk(tmp_path: Path) -> None:
    kept: Any = ExactFile(tmp_path / "beside")
    kept.append(("a",))
    kept.close()
    kept._stream = SimpleNamespace(write=lambda content: len(content) - 1)
    with pytest.raises(OSError, match="no room") as full:
        kept.append(("a",))
    assert full.value.errno == errno.ENOSPC


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


def test_every_fault_of_limits_is_told_as_that_of_the_option() -> None:
    with pytest.raises(InputError) as wrong:
        read_limits("step: 0 s, steps: 3, memory: 3 parsecs, total: 1e300")
    faults = wrong.value.faults
    assert len(faults) == 4
    assert all((f.file, f.line, f.column) == (Path("--limits"), 0, 0) for f in faults)
    assert "steps: no such limit (known: step, total, load, memory)" in {f.message for f in faults}
    assert not any("Value error" in f.message for f in faults)


# -- the process ------------------------------------------------------------------------------------


def test_what_a_process_holds_is_at_least_what_it_has_taken() -> None:
    before = resident(os.getpid())
    block = np.ones(8_000_000)
    assert resident(os.getpid()) - before > 0.8 * block.nbytes
    assert 1e6 < before < 1e11
    assert resident(2**22 + 1) == 0


@pytest.mark.skipif(shutil.which("ps") is None, reason="no ps here")
def test_what_a_process_holds_is_asked_of_ps_on_other_systems(monkeypatch: pytest.MonkeyPatch) -> None:
    here = resident(os.getpid())
    monkeypatch.setattr(sys, "platform", "darwin")
    assert 0.5 * here < resident(os.getpid()) < 2.0 * here
    assert resident(2**22 + 1) == 0


def test_what_is_printed_is_passed_on_up_to_a_bound(capsys: pytest.CaptureFixture[str]) -> None:
    with Worker() as own:
        own.call(exec, f"import os, sys; sys.stderr.write('x' * {process.MOST_OUTPUT}); sys.stderr.write('y' * 100)")
    told = capsys.readouterr().err
    assert (told.count("x"), told.count("yy")) == (process.MOST_OUTPUT, 0)


def test_the_last_words_of_an_fmu_are_one_line_of_511_bytes() -> None:
    mapped: Any = SimpleNamespace(words=b"")
    worker.progress = mapped
    try:
        words = MessageLog()
        share_log(SimpleNamespace(log=words))
        for text in ("a", "b\n  c", "d" * 600):
            words.append(text)
            assert mapped.words == " ".join(text.split()).encode()[:511]
    finally:
        del worker.progress


def test_the_environment_is_as_the_caller_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for value in ("before", None):
        monkeypatch.delenv("PYTHONPATH") if value is None else monkeypatch.setenv("PYTHONPATH", value)
        with Worker() as own:
            assert own.call(os.getenv, "PYTHONPATH") == value


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


def test_a_folder_that_does_not_go_at_once_is_tried_again_ten_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries: list[float] = []
    monkeypatch.setattr(scratch.time, "sleep", tries.append)
    monkeypatch.setattr(scratch.shutil, "rmtree", lambda *_, **__: None)
    scratch.remove(tmp_path)
    assert tries == [scratch.PAUSE] * scratch.RETRIES
    assert sum(tries) == pytest.approx(1.0)  # [s], no longer than a user waits for nothing
    tries.clear()
    scratch.remove(tmp_path / "gone")
    assert tries == []


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_group_is_ended_with_all_that_it_started() -> None:
    started = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], start_new_session=True)
    process._end_group(started, kill=False)
    assert started.returncode == -signal.SIGKILL
    process._end_group(started, kill=True)  # nothing is left of it


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


def test_an_error_of_a_job_is_raised_here_and_the_process_goes_on() -> None:
    with Worker() as own:
        pid = own.call(os.getpid)
        with pytest.raises(ValueError, match="invalid literal") as error:
            own.call(int, "x")
        assert [note.startswith("in a worker:\nTraceback") for note in error.value.__notes__] == [True]
        with pytest.raises(RuntimeError, match=r"^Local: x"):  # a class that this process cannot import
            own.call(exec, "class Local(Exception): pass\nraise Local('x')")
        assert own.call(os.getpid) == pid


def test_an_object_there_is_made_once_called_by_name_and_made_again_after_a_crash() -> None:
    with Worker() as own:
        one, other = Remote(own, list, "ab"), Remote(own, list, "xyz")
        assert not one.is_made
        one.call("append", "c")
        assert (one.call("__len__"), other.call("__len__"), own.starts) == (3, 3, 1)
        assert one.call("copy") == ["a", "b", "c"]
        with pytest.raises(ValueError, match="not in list"):
            one.call("remove", "z")
        with pytest.raises(Crashed):
            own.call(os._exit, 1)
        assert not one.is_made
        assert one.call("copy") == ["a", "b"]
        one.free("clear")
        assert not one.is_made
        assert one.call("copy") == ["a", "b"]


def test_an_argument_that_cannot_be_sent_is_answered_and_the_process_goes_on() -> None:
    here: Any = type("Here", (), {"__module__": "__main__"})  # as a class of a notebook: the worker cannot import it
    sys.modules["__main__"].Here = here  # type: ignore[attr-defined]
    with Worker() as own:
        pid = own.call(os.getpid)
        for argument in (lambda: 0, threading.Lock(), here()):
            with pytest.raises(InputError, match=r"the worker process: cannot take over an object .*--in-process"):
                own.call(str, argument)
        assert own.call(os.getpid) == pid


LAST_WORDS = "import os, sys; sys.stderr.write({words!r}); sys.stderr.flush(); {deed}"


@pytest.mark.parametrize(
    ("words", "deed", "told"),
    [
        ("one\n too hot \n\n", "os._exit(7)", "exit code 7; it said last: too hot"),
        ("", "os._exit(0)", "exit code 0"),
        ("x" * 300, "os._exit(1)", f"exit code 1; it said last: {'x' * 200}"),
        ("", "os.kill(os.getpid(), 9)", "(SIGKILL)"),
    ],
)
def test_a_crash_is_told_with_its_end_the_call_and_the_last_words(words: str, deed: str, told: str) -> None:
    watch = Watch(("tank", "pump"), time=lambda made, call: 2.5)
    with Worker() as own, pytest.raises(Crashed) as crash:
        own.call(exec, LAST_WORDS.format(words=words, deed=deed), watch=watch, doing=CALLS + ADVANCE)
    assert str(crash.value).startswith("pump at t = 2.5 s: stepping ")
    assert str(crash.value).endswith(told)


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


def test_progress_of_a_job_is_told_and_begins_anew_with_each() -> None:
    told = list[int]()
    code = "import time; from cosim.isolation import worker; worker.progress.made[0] = 4; time.sleep(0.5)"
    with Worker() as own:
        own.call(exec, code, watch=Watch(progress=told.append))
        assert told == [4]
        own.call(time.sleep, 0.2, watch=Watch(progress=told.append))
    assert told == [4]


@pytest.mark.skipif(sys.platform == "win32", reason="no process groups")
def test_a_worker_whose_caller_has_ended_writes_nothing_more_while_it_removes_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next command on the folder of checkpoints may have begun."""
    seen: list[str] = []
    monkeypatch.setattr(worker, "abandoned", threading.Event())
    monkeypatch.setattr(worker, "remove", lambda path: seen.append(f"removal, held: {worker.abandoned.is_set()}"))
    monkeypatch.setattr(os, "getpgid", lambda number: -1)
    monkeypatch.setattr(os, "_exit", lambda code: seen.append("end"))
    worker._read(io.BytesIO(), queue.SimpleQueue(), tmp_path)  # the stream has ended
    assert seen == ["removal, held: True", "end"]
    waits: list[float] = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        worker.abandoned.clear()

    monkeypatch.setattr(worker.time, "sleep", wait)
    worker.hold_if_abandoned()
    worker.hold_if_abandoned()
    assert len(waits) == 1


@pytest.mark.fresh
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux ends a worker with its parent")
def test_a_worker_outlasts_the_thread_that_started_it() -> None:
    with Worker() as apart:
        thread = threading.Thread(target=apart.call, args=(os.getpid,))
        thread.start()
        thread.join()
        time.sleep(0.1)
        assert apart.call(signal.alarm, 0) == 0  # the kernel's signal would have set the alarm to end it
