"""FMUs that crash, hang or grow, stopped runs and full disks: a one-line message, and the rows so far are kept."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import CosimError, InputError, SimulationError
from cosim.core.scratch import LOCK
from cosim.files.folders import STARTED
from cosim.files.run_entries import entries
from cosim.files.table import read_columns
from cosim.isolation.worker import PROGRESS
from cosim.residuals.workflow import replay
from cosim.simulation.workflow import run
from cosim.verbs.checks import check as check_files
from tests.cases import some
from tests.deeds import deeds_fmu, deeds_scenario
from tests.full_disk import full_disk
from tests.logs import write_log
from tests.users import ENVIRONMENT
from tests.warm import cosim

LIMITS = "{step: 300 ms, load: 2 s, memory: 500 MB}"
LARGE = "{memory: 300 MB}"
LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="crashes, processes and signals as on Linux")
# call, deed, its number, limits → message, exit code, fewest and most rows
STOPS = [
    ("DoStep", "segfault", 5, "", "at t = 0.4 s: fmi2DoStep crashed: .*SIGSEGV", 4, 5, 5),
    ("DoStep", "exit", 5, "", "at t = 0.4 s: fmi2DoStep ended the process, exit code 0", 4, 5, 5),
    ("SetReal", "abort", 8, "", "at t = .* s: fmi2SetReal crashed: .*SIGABRT", 4, 1, 10),  # initialization sets it too
    ("load", "segfault", 1, "", "at t = 0 s: loading crashed: .*SIGSEGV", 4, 0, 0),
    ("FreeInstance", "free", 1, "", "at t = 1 s: fmi2FreeInstance crashed: .*SIGABRT", 4, 11, 11),
    ("DoStep", "hang", 5, LIMITS, "at t = 0.4 s: fmi2DoStep takes longer than 0.3 s", 124, 5, 5),
    ("DoStep", "log", 5, LIMITS, "at t = 0.4 s: fmi2DoStep takes longer than 0.3 s", 124, 5, 5),
    ("DoStep", "print", 5, LIMITS, "at t = 0.4 s: fmi2DoStep takes longer than 0.3 s", 124, 5, 5),
    # loading is apart and has a limit of its own
    ("Instantiate", "sleep", 1, "{total: 50 ms, load: 400 ms}", "at t = 0 s: fmi2Instantiate .*0.4 s", 124, 0, 0),
    ("DoStep", "slow", 0, "{total: 300 ms}", ".*longer than 0.3 s in all", 124, 2, 9999),
    ("DoStep", "memory", 5, LARGE, "at t = 0.4 s: fmi2DoStep: .* 300 MB", 4, 5, 5),
    # processes that an FMU starts are found at times of their own
    ("DoStep", "grow", 5, LARGE, "at t = .* 300 MB", 4, 5, 11),
    ("DoStep", "orphan", 5, LARGE, "at t = .* 300 MB", 4, 5, 11),
]


def rows_in(folder: Path) -> int:
    return read_columns(folder / "results.csv").rows


def own_process(path: Path) -> Path:
    path.write_text(path.read_text().replace("{fmu: bad.fmu}", "{fmu: bad.fmu, process: own}"))
    return path


@pytest.mark.fresh
@LINUX
@pytest.mark.parametrize(
    ("call", "deed", "at", "limits", "words", "code", "fewest", "most"),
    [pytest.param(*stop, marks=[pytest.mark.thorough] if stop[3] in ("", LIMITS) else []) for stop in STOPS],
)
def test_a_crash_a_hang_and_growth_in_any_call_are_told_and_the_rows_before_are_kept(
    tmp_path: Path, call: str, deed: str, at: int, limits: str, words: str, code: int, fewest: int, most: int,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    path = deeds_scenario(tmp_path, call, deed, at, duration=1000.0 if deed == "slow" else 1.0, limits=limits)
    with pytest.raises(SimulationError, match=f"^bad {words}") as stopped:
        run(own_process(path) if deed == "orphan" else path, tmp_path / "out", report=False)
    assert stopped.value.exit_code == code
    assert "\n" not in str(stopped.value)
    assert fewest <= len((tmp_path / "out" / "results.csv").read_text().splitlines()) - 1 <= most
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["status"] == f"failed: {stopped.value}"
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["manifest.json", "results.csv"]
    shown = capsys.readouterr().err
    assert len(shown) < 70_000  # of an endless output
    assert ("left out" in shown) == (deed == "print")


@LINUX
@pytest.mark.parametrize(
    ("call", "deed", "process"),
    [
        ("DoStep", "closes", "own"),
        ("DoStep", "writes", ""),  # the rows too are out of its reach
        ("DoStep", "reads", ""),
        ("DoStep", "redirects", ""),
        ("Instantiate", "closes_all", ""),
    ],
)
def test_an_fmu_that_uses_descriptors_of_others_ends_the_run_and_is_named(
    tmp_path: Path, call: str, deed: str, process: str
) -> None:
    path = deeds_scenario(tmp_path, call, deed, 5 if call == "DoStep" else 1)
    done = cosim("run", own_process(path) if process else path, "--out", "out", "--no-report", cwd=tmp_path)
    assert done.returncode == 4
    (told,) = (line for line in done.stderr.splitlines() if not line.startswith("not a message"))
    assert re.search(r"error: (good or )?bad at t = ", told)
    kept = read_columns(tmp_path / "out" / "results.csv")
    assert kept.rows == 5 if process else 5 <= kept.rows <= 11
    assert kept["bad.y0"].tolist() == [*map(float, range(kept.rows))]


def waited_for(what: Callable[[], object]) -> None:
    for _ in range(300):
        if what():
            return
        time.sleep(0.05)
    raise AssertionError("it does not happen")


@pytest.mark.fresh  # so that the mark is in the environment of the worker
@LINUX
def test_a_process_that_an_fmu_starts_ends_with_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEED_MARK", str(tmp_path))
    assert len(run(deeds_scenario(tmp_path, "DoStep", "child", 3), tmp_path / "out", report=False).results.time) == 11

    def is_marked(path: Path) -> bool:
        with contextlib.suppress(OSError):
            return f"DEED_MARK={tmp_path}".encode() in path.read_bytes().split(b"\0")
        return False

    waited_for(lambda: not any(map(is_marked, Path("/proc").glob("[0-9]*/environ"))))


def test_a_process_that_an_fmu_starts_in_a_session_of_its_own_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEED_AWAY", str(tmp_path / "pid"))
    assert len(run(deeds_scenario(tmp_path, "DoStep", "away", 3), tmp_path / "out", report=False).results.time) == 11
    os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)  # it holds the worker's streams open for a minute


# -- a run that is stopped, also while its rows are written ---------------------------------------

PROGRAM = """
import os, signal, sys, time
from cosim.verbs.cli import entry
from cosim.files.results import Results
from cosim.core.program import as_program

def stopping(what):
    def again(*arguments, **more):
        for _ in range(3):
            os.kill(os.getpid(), {number})
            time.sleep(0.01)
        return what(*arguments, **more)
    return again

Results.write = stopping(Results.write)
sys.argv[0] = "cosim"
as_program(entry)
"""

IGNORING = """
import os, sys, time
from cosim.verbs.cli import entry
from cosim.core.program import as_program

class Stop:
    def __del__(self):
        os.kill(os.getpid(), {number})

class Finder:
    def find_spec(self, *_):
        if os.path.exists(sys.argv[-1] + "/manifest.json"):  # the report follows
            sys.meta_path.remove(self)
            Stop()
            time.sleep(0.1)

sys.meta_path.insert(0, Finder())
sys.argv[0] = "cosim"
as_program(entry)
"""


def listening() -> None:
    """Also where the suite runs in the background of a shell, which has its children ignore these."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def begun(*words: object, number: int = signal.SIGINT) -> subprocess.Popen[str]:
    """A command that gets three signals whenever it writes rows."""
    command = [sys.executable, "-c", PROGRAM.format(number=int(number)), *map(str, words)]
    return subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True, preexec_fn=listening)


def rows_made(pid: int) -> int:
    """Rows that the worker of a caller has made, by the file that both have mapped."""
    mapped = re.search(rf"/\S*cosim-work-\S*/{PROGRESS}", Path(f"/proc/{pid}/maps").read_text())
    return int.from_bytes(Path(mapped[0]).read_bytes()[:8], sys.byteorder) if mapped else 0


def workers_of(pid: int) -> list[int]:
    found = subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True, check=False).stdout
    return [int(word) for word in found.split()]


def runs(pid: int) -> bool:
    with contextlib.suppress(FileNotFoundError):
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    return False


def stepping(folder: Path, deed: str, number: int = signal.SIGINT) -> subprocess.Popen[str]:
    """A run that has made rows."""
    path = deeds_scenario(folder, "DoStep", deed, 0 if deed == "slow" else 3, duration=1000.0)
    process = begun("run", path, "--out", folder / "out", number=number)
    try:
        waited_for(lambda: rows_made(process.pid) >= 3)
    except BaseException:
        process.terminate()
        raise
    return process


@LINUX
@pytest.mark.parametrize(
    ("number", "deed", "code"),
    some([(signal.SIGINT, "slow", 130), (signal.SIGTERM, "hang", 4), (signal.SIGHUP, "slow", 4)], every=3),
)
def test_a_run_that_is_stopped_again_and_again_leaves_its_rows_and_no_process(
    tmp_path: Path, number: signal.Signals, deed: str, code: int
) -> None:
    process = stepping(tmp_path, deed, number)
    children = workers_of(process.pid)
    for _ in range(3):
        process.send_signal(number)
        time.sleep(0.05)
    _, told = process.communicate(timeout=60)
    assert process.returncode == code
    assert told.startswith("error: the run at t = ")
    assert rows_in(tmp_path / "out") >= 3
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["status"].startswith("failed: the run at t = ")
    assert children
    assert not any(map(runs, children))


@LINUX
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 4)])
def test_a_stop_that_arrives_where_python_ignores_exceptions_stops_the_run(
    tmp_path: Path, number: signal.Signals, code: int
) -> None:
    path = deeds_scenario(tmp_path, "none", "none")
    command = [
        sys.executable,
        "-c",
        IGNORING.format(number=int(number)),
        "run",
        str(path),
        "--out",
        str(tmp_path / "out"),
    ]
    done = subprocess.run(
        command, env=ENVIRONMENT, capture_output=True, text=True, check=False, preexec_fn=listening, timeout=60
    )
    assert (done.returncode, "Traceback" in done.stderr) == (code, False)
    assert rows_in(tmp_path / "out") == 11
    assert not (tmp_path / "out" / "report.html").exists()


@LINUX
def test_no_worker_outlives_a_caller_that_is_killed_nor_does_what_it_unpacked(tmp_path: Path) -> None:
    process = stepping(tmp_path, "children")  # the FMU starts a process of its own
    (worker,) = workers_of(process.pid)
    waited_for(lambda: workers_of(worker))
    grandchildren = workers_of(worker)
    process.kill()
    process.communicate()
    waited_for(lambda: not any(map(runs, [worker, *grandchildren])))
    assert {p.name for p in (tmp_path / "out").iterdir()} <= {STARTED}
    left = Path(tempfile.gettempdir()).glob("cosim-work-*")
    assert not [p for p in left if (p / LOCK).exists() and str(worker) in p.name]


@LINUX
@pytest.mark.parametrize(("verb", "options"), some([("run", []), ("simulate", ["--in-process"])], every=2))
def test_all_rows_are_kept_of_a_run_that_is_stopped_after_its_last(
    tmp_path: Path, verb: str, options: list[str]
) -> None:
    path, out = deeds_scenario(tmp_path, "none", "none"), tmp_path / "results" / "out"
    process = begun(verb, path if verb == "run" else tmp_path / "good.fmu", "--out", out, *options)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted from the keyboard" in told
    record = json.loads((out / "manifest.json").read_text())
    assert rows_in(out) == record["rows"] >= 11
    assert record["status"] == "ok"
    assert not (out / "report.html").exists()
    assert [entry.outcome for entry in entries(tmp_path / "results")] == [
        "ok, no report: interrupted from the keyboard"
    ]


@LINUX
def test_a_kill_while_rows_are_written_leaves_an_interrupted_run(tmp_path: Path) -> None:
    words = ["run", deeds_scenario(tmp_path, "none", "none"), "--out", tmp_path / "results" / "out"]
    process = begun(*words, number=signal.SIGKILL)
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL
    assert [entry.outcome for entry in entries(tmp_path / "results")] == ["interrupted"]
    assert cosim(*words).returncode == 2  # not empty


@pytest.mark.fresh  # so that the worker has the limit
@pytest.mark.thorough
@LINUX
@pytest.mark.parametrize("size", [30_000, 400_000])  # less than the rows while they are made; less than they print as
def test_a_full_disk_ends_a_run(tmp_path: Path, size: int) -> None:
    path = deeds_scenario(tmp_path, "none", "none", duration=500.0)
    with full_disk(size), pytest.raises(CosimError, match="the disk is full") as stopped:
        run(path, tmp_path / "out")
    assert stopped.value.exit_code == 4
    assert (tmp_path / "out" / "manifest.json").exists()


# -- replay, check and limits as they are written -------------------------------------------------


def measured_log(folder: Path) -> Path:
    time_ = 0.1 * np.arange(200)
    return write_log(folder / "log.csv", {"time": time_, "u0": 0.0 * time_, "u1": np.sin(time_), "y1": np.cos(time_)})


@pytest.mark.parametrize(
    ("deed", "words", "code"),
    [("segfault", "crashed: segmentation fault", 4), ("hang", "takes longer than 0.3 s", 124)],
)
def test_a_replay_keeps_the_rows_before_a_crash_and_a_limit(
    tmp_path: Path, deed: str, words: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    (temporary := tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))  # where others replay nothing meanwhile
    log, fmu = measured_log(tmp_path), deeds_fmu(tmp_path / "bad.fmu", "DoStep", deed, 100)
    with pytest.raises(SimulationError, match=f"plant at t = 9.9 s: fmi2DoStep {words}") as stopped:
        replay(log, tmp_path / "out", fmu, limits="{step: 300 ms}")
    assert stopped.value.exit_code == code
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["replay.json", "results.csv"]
    assert rows_in(tmp_path / "out") == 100
    assert not list(temporary.glob("cosim-replay-rows-*"))


def test_a_run_and_a_replay_are_the_same_in_a_worker_and_in_process(tmp_path: Path) -> None:
    path, log = deeds_scenario(tmp_path, "none", "none"), measured_log(tmp_path)
    for k in range(2):
        run(path, tmp_path / f"run{k}", report=False, in_process=bool(k))
        replay(log, tmp_path / f"replay{k}", tmp_path / "good.fmu", in_process=bool(k))
    for folder, name in (("run", "results.csv"), ("replay", "results.csv"), ("replay", "report.html")):
        one, other = ((tmp_path / f"{folder}{k}" / name).read_text() for k in range(2))
        assert one == other.replace("replay1", "replay0")  # the page names its folder


def test_check_of_a_scenario_ends_at_its_limits(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"fmi2ExitInitializationMode takes longer than 0.3 s") as refused:
        check_files(deeds_scenario(tmp_path, "ExitInitializationMode", "sleep", limits=LIMITS))
    assert refused.value.exit_code == 124


def test_a_limit_that_is_none_is_refused_at_its_place(tmp_path: Path) -> None:
    for value in ("10 parsecs", "-1 s", "0", "1e999", "1..2 s", "true"):
        with pytest.raises(InputError, match=r"deeds.yaml:\d+:\d+: limits.step is ") as refused:
            run(deeds_scenario(tmp_path, "none", "none", limits=f"{{step: {value}}}"), tmp_path / "out")
        assert refused.value.exit_code == 2
    with pytest.raises(InputError, match="--limits"):
        replay(measured_log(tmp_path), tmp_path / "out", tmp_path / "good.fmu", limits="stp: 1 s")
