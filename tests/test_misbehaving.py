"""FMUs that crash, hang or grow, a run that is stopped and a disk that is full: told in one line, the rows kept."""

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
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import Crashed, InputError, SimulationError
from cosim.core.scratch import LOCK
from cosim.files.folders import STARTED
from cosim.files.table import read_columns
from cosim.isolation.worker import PROGRESS
from cosim.residuals.workflow import replay
from cosim.simulation.workflow import run
from cosim.verbs.checks import check as check_files
from tests.cases import some
from tests.conftest import ROOT
from tests.deeds import deeds_fmu, deeds_scenario
from tests.logs import write_log
from tests.warm import cosim

LIMITS = "{step: 300 ms, load: 2 s, memory: 500 MB}"
LINUX = sys.platform.startswith("linux")
COMMAND = [sys.executable, "-m", "cosim", "run"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


def workers_left() -> list[Path]:
    return list(Path(tempfile.gettempdir()).glob("cosim-work-*"))


def rows_in(folder: Path) -> int:
    return read_columns(folder / "results.csv").rows


FAULT = r"crashed: segmentation fault \(SIGSEGV\)"
ABORT = r"crashed: abort \(SIGABRT\)"
SLOW = r"takes longer than 0.3 s \(limits: step\)"
LARGE = "{memory: 300 MB}"
# call, deed, its number, limits → message after the name, exit code, fewest and most rows
STOPS = [
    ("DoStep", "segfault", 5, "", f"at t = 0.4 s: fmi2DoStep {FAULT}", 4, 5, 5),
    ("DoStep", "overflow", 5, "", f"at t = 0.4 s: fmi2DoStep {FAULT}", 4, 5, 5),
    ("DoStep", "free", 5, "", f"at t = 0.4 s: fmi2DoStep {ABORT}", 4, 5, 5),
    ("DoStep", "exit", 5, "", "at t = 0.4 s: fmi2DoStep ended the process, exit code 0", 4, 5, 5),
    ("SetReal", "abort", 8, "", f"at t = .* s: fmi2SetReal {ABORT}", 4, 1, 10),  # initialization sets it too
    ("Instantiate", "segfault", 1, "", f"at t = 0 s: fmi2Instantiate {FAULT}", 4, 0, 0),
    ("load", "segfault", 1, "", f"at t = 0 s: loading {FAULT}", 4, 0, 0),
    ("Terminate", "segfault", 1, "", f"at t = 1 s: fmi2Terminate {FAULT}", 4, 11, 11),
    ("FreeInstance", "free", 1, "", f"at t = 1 s: fmi2FreeInstance {ABORT}", 4, 11, 11),
    ("DoStep", "hang", 5, LIMITS, f"at t = 0.4 s: fmi2DoStep {SLOW}", 124, 5, 5),
    ("DoStep", "log", 5, LIMITS, f"at t = 0.4 s: fmi2DoStep {SLOW}", 124, 5, 5),
    ("DoStep", "print", 5, LIMITS, f"at t = 0.4 s: fmi2DoStep {SLOW}", 124, 5, 5),
    ("ExitInitializationMode", "sleep", 1, LIMITS, f"at t = 0 s: fmi2ExitInitializationMode {SLOW}", 124, 0, 0),
    ("FreeInstance", "sleep", 1, LIMITS, f"at t = 1 s: fmi2FreeInstance {SLOW}", 124, 11, 11),
    # loading is apart and has a limit of its own
    ("Instantiate", "sleep", 1, "{total: 50 ms, load: 400 ms}",
     r"at t = 0 s: fmi2Instantiate takes longer than 0.4 s \(limits: load\)", 124, 0, 0),
    ("DoStep", "slow", 0, "{total: 300 ms}", r".*longer than 0.3 s in all \(limits: total\)", 124, 2, 9999),
    ("DoStep", "memory", 5, LARGE, "at t = 0.4 s: fmi2DoStep: .* more than 300 MB", 4, 5, 5),
    # processes that an FMU starts are found at times of their own
    ("DoStep", "grow", 5, LARGE, "at t = .* more than 300 MB", 4, 5, 11),
    ("DoStep", "orphan", 5, LARGE, "at t = .* more than 300 MB", 4, 5, 11),
]  # fmt: skip


@pytest.mark.fresh
@pytest.mark.skipif(not LINUX, reason="crashes go by other names, resident sizes differ")
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
    assert isinstance(stopped.value, Crashed) == (code == 4 and limits == "")
    assert "\n" not in str(stopped.value)
    rows = len((tmp_path / "out" / "results.csv").read_text().splitlines()) - 1
    assert fewest <= rows <= most
    if not limits:
        assert str(stopped.value).startswith(f"bad at t = {0.1 * max(0, rows - 1):g} s: ")
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["status"] == f"failed: {stopped.value}"
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["manifest.json", "results.csv"]
    shown = capsys.readouterr().err
    assert len(shown) < 70_000  # of an endless output
    assert ("left out" in shown) == (deed == "print")


@pytest.mark.skipif(not LINUX, reason="descriptors as Linux has them")
@pytest.mark.parametrize(
    ("call", "deed", "process", "rows"),
    [
        ("DoStep", "closes", "own", 5),
        ("DoStep", "writes", "own", 5),
        ("DoStep", "reads", "own", 5),
        ("DoStep", "closes", "", 11),
        ("DoStep", "writes", "", 11),  # the rows too are out of its reach
        ("DoStep", "reads", "", 11),
        ("DoStep", "redirects", "", 11),
        ("Instantiate", "closes_all", "", 11),
        ("FreeInstance", "writes", "", 11),
    ],
)
def test_an_fmu_that_uses_descriptors_of_others_ends_the_run_and_is_named(
    tmp_path: Path, call: str, deed: str, process: str, rows: int
) -> None:
    path = deeds_scenario(tmp_path, call, deed, 5 if call == "DoStep" else 1)
    done = cosim("run", own_process(path) if process else path, "--out", "out", "--no-report", cwd=tmp_path)
    assert done.returncode == 4
    told = [line for line in done.stderr.splitlines() if not line.startswith("not a message")]
    assert len(told) == 1, told
    assert re.search(r"error: (good or )?bad at t = ", told[0])
    kept = read_columns(tmp_path / "out" / "results.csv")
    assert rows - 6 <= kept.rows <= 11 if not process else kept.rows == rows
    assert kept["bad.y0"].tolist() == [*map(float, range(kept.rows))]


def test_a_run_is_the_same_in_a_worker_and_in_process(tmp_path: Path) -> None:
    path = deeds_scenario(tmp_path, "none", "none")
    outcomes = [run(path, tmp_path / str(k), report=False, in_process=bool(k)) for k in range(2)]
    assert (tmp_path / "0" / "results.csv").read_bytes() == (tmp_path / "1" / "results.csv").read_bytes()
    assert outcomes[0].manifest["warnings"] == outcomes[1].manifest["warnings"]
    assert (outcomes[0].results.values == outcomes[1].results.values).all()


def test_an_fmu_changes_neither_folder_nor_environment_of_the_caller(tmp_path: Path) -> None:
    before = Path.cwd()
    run(deeds_scenario(tmp_path, "Instantiate", "folder"), tmp_path / "out", report=False)
    assert Path.cwd() == before
    assert "DEED" not in os.environ


@pytest.mark.fresh  # so that the mark is in the environment of the worker
@pytest.mark.skipif(not LINUX, reason="processes as Linux has them")
def test_a_process_that_an_fmu_starts_ends_with_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mark = f"DEED_MARK={tmp_path}"
    monkeypatch.setenv(*mark.split("=", 1))
    assert len(run(deeds_scenario(tmp_path, "DoStep", "child", 3), tmp_path / "out", report=False).results.time) == 11

    def marked() -> Iterator[str]:
        for path in Path("/proc").glob("[0-9]*/environ"):
            with contextlib.suppress(OSError):
                if mark.encode() in path.read_bytes().split(b"\0"):
                    yield path.parent.name

    waited_for(lambda: not [*marked()])


def test_a_process_that_an_fmu_starts_in_a_session_of_its_own_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEED_AWAY", str(tmp_path / "pid"))
    assert len(run(deeds_scenario(tmp_path, "DoStep", "away", 3), tmp_path / "out", report=False).results.time) == 11
    os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)  # it holds the worker's streams open for a minute


def own_process(path: Path) -> Path:
    path.write_text(path.read_text().replace("{fmu: bad.fmu}", "{fmu: bad.fmu, process: own}"))
    return path


# -- a run that is stopped ------------------------------------------------------------------------


def listening() -> None:
    """Also where the suite runs in the background of a shell, which has its children ignore these."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def started(folder: Path, deed: str) -> subprocess.Popen[str]:
    """A run in a process of its own that has made rows."""
    path = deeds_scenario(folder, "DoStep", deed, 0 if deed == "slow" else 3, duration=1000.0)
    command = [*COMMAND, str(path), "--out", str(folder / "out"), "--no-report"]
    process = subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True, preexec_fn=listening)
    try:
        waited_for(lambda: rows_made(process.pid) >= 3)
    except BaseException:
        process.terminate()
        raise
    return process


def rows_made(pid: int) -> int:
    """Rows that the worker of a caller has made, by the file that both have mapped."""
    mapped = re.search(rf"/\S*cosim-work-\S*/{PROGRESS}", Path(f"/proc/{pid}/maps").read_text())
    return int.from_bytes(Path(mapped[0]).read_bytes()[:8], sys.byteorder) if mapped else 0


def waited_for(what: object) -> None:
    for _ in range(300):
        if what():  # type: ignore[operator]
            return
        time.sleep(0.05)
    raise AssertionError("it does not happen")


def workers_of(pid: int) -> list[int]:
    found = subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True, check=False).stdout
    return [int(word) for word in found.split()]


def runs(pid: int) -> bool:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, 0)
        return not LINUX or Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    return False


@pytest.mark.thorough
@pytest.mark.skipif(not LINUX, reason="signals and processes as Linux has them")
@pytest.mark.parametrize(
    ("number", "deed", "code", "words"),
    [
        (signal.SIGINT, "slow", 130, "interrupted from the keyboard"),
        (signal.SIGTERM, "hang", 4, "ended by SIGTERM"),
        (signal.SIGHUP, "slow", 4, "ended by SIGHUP"),
    ],
)
def test_a_run_that_is_stopped_leaves_its_rows_and_no_process(
    tmp_path: Path, number: signal.Signals, deed: str, code: int, words: str
) -> None:
    process = started(tmp_path, deed)
    children = workers_of(process.pid)
    process.send_signal(number)
    _, told = process.communicate(timeout=20)
    assert process.returncode == code
    assert told.startswith("error: the run at t = ")
    assert told.endswith(f"{words}\n")
    assert len(told.splitlines()) == 1
    assert rows_in(tmp_path / "out") >= 3
    assert children
    assert not any(map(runs, children))
    left = {p.name for p in (tmp_path / "out").iterdir()}
    assert left - {"checkpoint"} == {"manifest.json", "results.csv"}  # from a run that can go on


@pytest.mark.skipif(not LINUX, reason="signals and processes as Linux has them")
def test_no_worker_outlives_a_caller_that_is_killed_nor_does_what_it_unpacked(tmp_path: Path) -> None:
    process = started(tmp_path, "children")  # the FMU starts a process of its own
    (worker,) = workers_of(process.pid)
    waited_for(lambda: workers_of(worker))
    grandchildren = workers_of(worker)
    process.kill()
    process.communicate()
    waited_for(lambda: not any(map(runs, [worker, *grandchildren])))
    assert {p.name for p in (tmp_path / "out").iterdir()} <= {STARTED}
    assert not [p for p in workers_left() if (p / LOCK).exists() and str(worker) in p.name]


# -- a full disk ----------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.skipif(not LINUX, reason="the shell's limit of file sizes")
@pytest.mark.parametrize("kilobytes", [100, 400])  # less than the rows while they are made; less than they print as
def test_a_full_disk_ends_a_run_and_keeps_the_rows_that_fit(tmp_path: Path, kilobytes: int) -> None:
    path = deeds_scenario(tmp_path, "none", "none", duration=500.0)
    command = " ".join(map(str, [*COMMAND, path, "--out", tmp_path / "out"]))
    # bash counts in 1024 bytes
    done = subprocess.run(
        ["bash", "-c", f"ulimit -f {kilobytes}; {command}"],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 4
    assert done.stderr.count("\n") == 1
    kept = rows_in(tmp_path / "out")
    assert 500 < kept < 5001
    assert f"{kept} of 5001 rows" in done.stderr
    assert (tmp_path / "out" / "manifest.json").exists()


# -- replay, refine and check ---------------------------------------------------------------------


def measured_log(folder: Path) -> Path:
    time_, path = 0.1 * np.arange(200), folder / "log.csv"
    return write_log(path, {"time": time_, "u0": 0.0 * time_, "u1": np.sin(time_), "y1": np.cos(time_)})


def test_a_replay_keeps_the_rows_before_a_crash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (temporary := tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))  # where others replay nothing meanwhile
    log, fmu = measured_log(tmp_path), deeds_fmu(tmp_path / "bad.fmu", "DoStep", "segfault", 100)
    with pytest.raises(SimulationError, match=r"plant at t = 9.9 s: fmi2DoStep crashed: segmentation fault") as stopped:
        replay(log, tmp_path / "out", fmu)
    assert stopped.value.exit_code == 4
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["replay.json", "results.csv"]
    assert rows_in(tmp_path / "out") == 100
    assert not list(temporary.glob("cosim-replay-rows-*"))


def test_a_replay_ends_at_its_limits_with_the_rows_before(tmp_path: Path) -> None:
    log, fmu = measured_log(tmp_path), deeds_fmu(tmp_path / "bad.fmu", "DoStep", "hang", 100)
    with pytest.raises(SimulationError, match=r"plant at t = 9.9 s: fmi2DoStep takes longer than 0.3 s") as stopped:
        replay(log, tmp_path / "out", fmu, limits="{step: 300 ms}")
    assert stopped.value.exit_code == 124
    assert rows_in(tmp_path / "out") == 100
    with pytest.raises(InputError, match=r"--limits: stp: no such limit \(known: step, total, load, memory\)"):
        replay(log, tmp_path / "out", fmu, limits="stp: 1 s")


def test_a_replay_is_the_same_in_a_worker_and_in_process(tmp_path: Path) -> None:
    log, fmu = measured_log(tmp_path), deeds_fmu(tmp_path / "good.fmu")
    for k in range(2):
        replay(log, tmp_path / str(k), fmu, in_process=bool(k))
    for name in ("results.csv", "residual.csv", "report.html"):
        assert (tmp_path / "0" / name).read_bytes() == (tmp_path / "1" / name).read_bytes()


def test_check_of_a_scenario_ends_at_its_limits(tmp_path: Path) -> None:
    path = deeds_scenario(tmp_path, "ExitInitializationMode", "sleep", limits=LIMITS)
    with pytest.raises(InputError, match=r"fmi2ExitInitializationMode takes longer than 0.3 s") as refused:
        check_files(path)
    assert refused.value.exit_code == 124


# -- limits as they are written -------------------------------------------------------------------


@pytest.mark.parametrize("value", some(["10 parsecs", "-1 s", "s", "0", "1e999", "1..2 s", "[]", "true"], every=3))
def test_a_limit_that_is_none_is_refused_at_its_place(tmp_path: Path, value: str) -> None:
    path = deeds_scenario(tmp_path, "none", "none", limits=f"{{step: {value}}}")
    with pytest.raises(InputError, match=r"deeds.yaml:\d+:\d+: limits.step is .*, 10 s for one") as refused:
        run(path, tmp_path / "out")
    assert refused.value.exit_code == 2


# -- stopped again while the rows are written -----------------------------------------------------

STOPPED_AGAIN = """
import os, signal, sys, time
import cosim.files.results, cosim.files.table
from cosim.verbs.cli import entry
from cosim.files.results import Results
from cosim.sweeps.store import Database
from cosim.core.program import as_program

def stopping(what):
    def again(*arguments, **more):
        for _ in range(3):
            os.kill(os.getpid(), signal.{number})
            time.sleep(0.01)
        return what(*arguments, **more)
    return again

Results.write, Database.add = stopping(Results.write), stopping(Database.add)
sys.argv[0] = "cosim"
as_program(entry)
"""


def stopped_again(*words: object, number: str = "SIGINT", first: int = 0) -> tuple[int, str]:
    """Run a command that gets three signals whenever it writes rows, and three of `first` once it has begun."""
    command = [sys.executable, "-c", STOPPED_AGAIN.format(number=number), *map(str, words)]
    process = subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True, preexec_fn=listening)
    if first:
        waited_for(lambda: rows_made(process.pid) >= 3)
        for _ in range(3):
            process.send_signal(first)
            time.sleep(0.05)
    _, told = process.communicate(timeout=60)
    return process.returncode, told


@pytest.mark.skipif(not LINUX, reason="signals and processes as Linux has them")
@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("report", ["--report", pytest.param("--no-report", marks=pytest.mark.thorough)])
def test_rows_of_a_run_outlast_being_stopped_again_and_again(
    tmp_path: Path, number: signal.Signals, report: str
) -> None:
    path = deeds_scenario(tmp_path, "DoStep", "slow", 0, duration=1000.0)
    words = ["run", path, "--out", tmp_path / "out", report]
    code, told = stopped_again(*words, number=number.name, first=number)
    assert code == {signal.SIGINT: 130, signal.SIGTERM: 4}[number]
    assert told.startswith("error: the run at t = ")
    assert rows_in(tmp_path / "out") >= 3
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["status"].startswith("failed: the run at t = ")


@pytest.mark.thorough
@pytest.mark.skipif(not LINUX, reason="signals and processes as Linux has them")
@pytest.mark.parametrize("in_process", [False, True])
@pytest.mark.parametrize("verb", ["run", "simulate"])
def test_all_rows_of_a_run_are_kept_that_is_stopped_after_its_last(tmp_path: Path, verb: str, in_process: bool) -> None:
    path = deeds_scenario(tmp_path, "none", "none")
    file = path if verb == "run" else deeds_fmu(tmp_path / "one.fmu")
    words = [verb, file, "--out", tmp_path / "out", *(["--in-process"] if in_process else [])]
    code, told = stopped_again(*words)
    assert code == 130
    assert "interrupted from the keyboard" in told
    assert rows_in(tmp_path / "out") >= 11
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["status"] == "ok"


@pytest.mark.skipif(not LINUX, reason="signals and processes as Linux has them")
@pytest.mark.thorough
def test_a_sweep_that_is_stopped_again_and_again_keeps_its_runs_and_says_so(tmp_path: Path) -> None:
    deeds_scenario(tmp_path, "none", "none").rename(tmp_path / "scenario.yaml")
    sweep_file = tmp_path / "sweep.yaml"
    sweep_file.write_text("scenario: scenario.yaml\nvary: {seed: {values: [1, 2, 3]}}\n")
    code, told = stopped_again("sweep", sweep_file, "--out", tmp_path / "out")
    assert code == 130
    assert re.search(r"error: stopped: 1 of 3 runs are kept in \S+runs.sqlite; --resume goes on with", told)
    words = ["sweep", str(sweep_file), "--out", str(tmp_path / "out"), "--no-report", "--resume"]
    done = subprocess.run([*COMMAND[:-1], *words],
                          env=ENVIRONMENT, capture_output=True, text=True, check=False)  # fmt: skip
    assert done.returncode == 0
    assert re.search(r"\b2, .*\b1$", done.stdout, re.MULTILINE)  # new ones, and those from before
