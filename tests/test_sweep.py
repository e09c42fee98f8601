"""Sweeps: designs, runs, what is gone on with after a kill, parts, a cluster that loses a worker, what is refused."""

from __future__ import annotations

import json
import os
import shlex
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.core.errors import InputError, SweepFailed, SweepStopped
from cosim.fmi.building.file import load_model
from cosim.fmi.fmu_build import build
from cosim.simulation.workflow import run
from cosim.sweeps.reading import read_sweep, repeat_command
from cosim.sweeps.sampling import Factor, columns_of, distribution, sensitivity
from cosim.sweeps.store import read_table, signal_of
from cosim.sweeps.workflow import sweep
from cosim.verbs.cli import command_line
from tests.full_disk import full_disk
from tests.tank import MODEL

ROOT = Path(__file__).resolve().parent.parent
TABLE = "sweep.parquet"
TANKS = """
name: tanks
duration: 5
step: 0.5
seed: 1
components:
  tank: {fmu: tank.fmu, start: {level_start: 2}}
  next: {fmu: tank.fmu}
  source: {block: reference, signals: {inflow: {unit: m3/s, start: 0.02, changes: [{at: 2, to: 0.03}]}}}
connections:
  - {from: source.inflow, to: tank.inflow}
  - {from: tank.level, to: next.inflow, factor: 0.01, noise: {variance: 1.0e-6, bias: 0.001}}
criteria:
  peak: {of: next.level, max: 1.0001}
  final_error: {of: tank.level, to: 1.0, max: 1.0}
"""
VARY = """
scenario: tanks.yaml
runs: 30
seed: 2
vary:
  tank.area: {log_uniform: [0.2, 2]}
  tank.level_start: {normal: [2, 0.2]}
  next.leak.rate: {values: [0, 0.005]}
  seed: {each: 5}
"""
FEW = VARY.replace("runs: 30", "runs: 5")


@pytest.fixture(scope="module")
def tank_fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tank")
    (folder / "tank.py").write_text(MODEL)
    return build(load_model(f"{folder / 'tank.py'}:Tank", folder).recipe(), folder / "tank.fmu")


@pytest.fixture
def tanks(tmp_path: Path, tank_fmu: Path) -> Callable[..., Path]:
    """Writes a sweep of two tanks and says where it stands."""
    (tmp_path / "tank.fmu").symlink_to(tank_fmu)

    def written(vary: str = VARY, more: str = "") -> Path:
        (tmp_path / "tanks.yaml").write_text(TANKS + more)
        (tmp_path / "sweep.yaml").write_text(vary)
        return tmp_path / "sweep.yaml"

    return written


def swept(path: Path, out: str, **options: Any) -> Any:
    return sweep(path, path.parent / out, **{"in_process": True, "report": False, **options})


def exit_code(*words: object) -> int:
    done = CliRunner().invoke(command_line(), [*map(str, words)])
    return int(getattr(done.exception, "exit_code", done.exit_code))


def places_of(path: Path) -> list[tuple[int, int]]:
    with pytest.raises(InputError) as caught:
        read_sweep(path)
    return [(f.line, f.column) for f in caught.value.faults]


# -- runs --------------------------------------------------------------------------------------------


def test_a_run_of_a_sweep_is_the_run_of_its_scenario_with_its_values(tanks: Callable[..., Path]) -> None:
    path = tanks(FEW)
    study = swept(path, "out")
    table, about = read_table(study.folder / TABLE)
    row = table.slice(7, 1).to_pydict()
    given = {name: row[name][0] for name in ("tank.area", "tank.level_start", "next.leak.rate")}
    overrides = [f"components.{n.partition('.')[0]}.start.{n.partition('.')[2]}={v}" for n, v in given.items()]
    alone = run(path.parent / "tanks.yaml", path.parent / "alone", [*overrides, f"seed={row['seed'][0]}"], report=False)
    assert row["peak of next.level"] == [alone.manifest["criteria"][0]["value"]]
    assert about["times"] == alone.results.time.tolist()
    assert signal_of(table, "next.level")[7].tolist() == alone.results["next.level"].tolist()
    words = shlex.split(repeat_command(study.sweep, 7))
    assert exit_code(*words[1:], "--out", path.parent / "again", "--no-report") in (0, 5)
    again = json.loads((path.parent / "again" / "manifest.json").read_text())
    assert again["criteria"][0]["value"] == row["peak of next.level"][0]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_run_that_crashes_its_process_or_takes_too_long_fails_alone(tmp_path: Path, workers: int) -> None:
    misbehaving = MODEL.replace("from dataclasses", "import os, time\nfrom dataclasses").replace(
        "            (level,) = state\n",
        "            (level,) = state\n            if self.area == 9.0: os.abort()\n"
        "            if self.area == 8.0: time.sleep(60)\n",
    )
    (tmp_path / "tank.py").write_text(misbehaving)
    build(load_model(f"{tmp_path / 'tank.py'}:Tank", tmp_path).recipe(), tmp_path / "tank.fmu")
    head = "name: one\nduration: 2\nstep: 0.5\nlimits: {step: 2 s}\ncomponents: {tank: {fmu: tank.fmu}}\n"
    (tmp_path / "one.yaml").write_text(head)
    (tmp_path / "sweep.yaml").write_text("scenario: one.yaml\nvary: {tank.area: {values: [9.0, 1, 8.0, 2]}}\n")
    study = swept(tmp_path / "sweep.yaml", "out", workers=workers, in_process=False, report=True)
    assert study.record["failed"] == 2
    crash, slow = study.record["failures"]
    assert (crash["run"], slow["run"]) == (0, 2)
    assert "fmi2DoStep crashed" in crash["why"]
    assert "fmi2DoStep" in slow["why"]
    table, _ = read_table(study.folder / TABLE)
    assert [status == "ok" for status in table.column("status").to_pylist()] == [False, True, False, True]
    assert "Run 2:" in (study.folder / "report.html").read_text()


def test_a_sweep_of_which_no_run_ends_is_a_failure(tanks: Callable[..., Path]) -> None:
    path = tanks("scenario: tanks.yaml\nvary: {tank.draw.flow: {values: [1.0e-1, -1.0e-1]}}\n")
    text = (path.parent / "tanks.yaml").read_text()
    (path.parent / "tanks.yaml").write_text(text.replace("factor: 0.01,", "factor: 1.0e+308, offset: 1.0e+308,"))
    for resume in (False, True):  # the second time from sweep.json
        with pytest.raises(SweepFailed) as failed:
            swept(path, "out", resume=resume)
        assert failed.value.exit_code == 4


def test_an_fmu_and_a_list_of_the_scenario_vary(tanks: Callable[..., Path], tank_fmu: Path) -> None:
    path = tanks(
        "scenario: tanks.yaml\nsignals: [next.level]\nvary:\n"
        "  components.tank.fmu: {values: [tank.fmu, other.fmu]}\n"
        "  components.source.signals.inflow.changes: {values: [[{at: 1, to: 0.1}], [{at: 1, to: 0}]]}\n"
    )
    assert places_of(path) == [(5, 55), (5, 75)]  # a list holds numbers, true or false, or text
    path = tanks(
        "scenario: tanks.yaml\nsignals: [tank.level]\nvary:\n"
        "  components.tank.fmu: {values: [tank.fmu, other.fmu]}\n"
        "  components.tank.feedthrough: {values: [[], [inflow]]}\n  tank.level_start: {values: [2, 3]}\n"
    )
    assert places_of(path) == [(5, 42)]
    (path.parent / "other.fmu").symlink_to(tank_fmu)
    path = tanks(
        "scenario: tanks.yaml\nsignals: [tank.level]\nvary:\n"
        "  components.tank.fmu: {values: [tank.fmu, other.fmu]}\n  tank.level_start: {values: [2, 3]}\n"
    )
    levels = signal_of(read_table(swept(path, "out").folder / TABLE)[0], "tank.level")
    assert levels[0].tolist() == levels[2].tolist() != levels[1].tolist()


# -- kept and gone on with ---------------------------------------------------------------------------


def runs_in(folder: Path) -> int:
    """How many runs are kept."""
    try:
        with closing(sqlite3.connect(f"file:{folder / 'runs.sqlite'}?mode=ro", uri=True)) as base:
            return int(base.execute("SELECT count(*) FROM made").fetchone()[0])
    except sqlite3.Error:
        return 0


@contextmanager
def command(*words: object) -> Iterator[subprocess.Popen[bytes]]:
    """The command line in a group of processes of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    line = [sys.executable, "-m", "cosim", *map(str, words)]

    def heed_interrupts() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell's background job ignores it, and its children do

    process = subprocess.Popen(
        line,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=heed_interrupts,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("how", ["killed", "Ctrl-C"])
def test_a_stopped_sweep_is_gone_on_with_and_its_table_is_that_of_one_that_was_not(
    tanks: Callable[..., Path], how: str
) -> None:
    path = tanks(VARY.replace("runs: 30", "runs: 12") + "set: {duration: 500}\n")
    folder = path.parent / "out"
    with command("sweep", path, "--out", folder, "--workers", 2, "--no-report") as process:
        deadline = time.monotonic() + 100
        while runs_in(folder) < 6 and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.02)
        if how == "killed":
            process.kill()
        else:
            os.killpg(process.pid, signal.SIGINT)  # as a terminal does
            _, told = process.communicate(timeout=100)
            assert process.returncode == 130
            assert len(told.splitlines()) == 1, told.decode()
    kept = runs_in(folder)
    assert 6 <= kept < 24, "it was stopped on its way"
    with pytest.raises(InputError):
        swept(path, "out")
    assert swept(path, "out", resume=True).made == 24 - kept
    assert swept(path, "whole").made == 24
    assert (folder / TABLE).read_bytes() == (path.parent / "whole" / TABLE).read_bytes()
    assert not (folder / "runs.sqlite").exists()
    assert swept(path, "out", resume=True).made == 0


def test_parts_are_joined_to_the_table_of_a_whole_sweep(tanks: Callable[..., Path]) -> None:
    path = tanks(FEW)
    out = path.parent / "out"

    part = ("sweep", path, "--workers", 1, "--json", "--out", out)
    first = CliRunner().invoke(command_line(), [*map(str, part), "--part", "1/3"])
    assert (first.exit_code, json.loads(first.output)["runs"]) == (0, 4)
    assert exit_code(*part, "--join") == 2  # runs are missing
    for each in ("2/3", "3/3", "2/3"):
        assert exit_code(*part, "--part", each) == 0
    assert exit_code(*part, "--join") == 0
    assert swept(path, "whole").record["runs"] == json.loads((out / "sweep.json").read_text())["runs"] == 10
    assert (out / TABLE).read_bytes() == (path.parent / "whole" / TABLE).read_bytes()
    assert sorted(p.name for p in out.iterdir()) == ["report.html", "sweep.json", TABLE]
    assert exit_code(*part[:-1], out / "two", "--part", "1/2") == 0
    assert swept(path, "out/two", resume=True).made == 5  # what no part has made
    for wrong in (["--part", "0/3"], ["--part", "4/3"], ["--part", "x"], ["--part", "1/2", "--join"]):
        assert exit_code(*part[:-1], path.parent / "wrong", *wrong) == 2
    assert exit_code("sweep", path, "--part", "1/2") == 2  # of which folder?


def test_the_runs_of_another_sweep_are_not_gone_on_with(tanks: Callable[..., Path]) -> None:
    swept(tanks(VARY.replace("runs: 30", "runs: 2")), "out")
    path = tanks(VARY.replace("runs: 30", "runs: 3"))
    for options in ({}, {"resume": True}):
        with pytest.raises(InputError):
            swept(path, "out", **options)
    assert swept(path, "out", force=True).made == 6


@pytest.mark.skipif(os.name == "nt", reason="no limits of files")
def test_a_sweep_on_a_full_disk_keeps_its_runs_and_goes_on_when_there_is_room(tanks: Callable[..., Path]) -> None:
    path = tanks("scenario: tanks.yaml\nruns: 40\nvary: {tank.level_start: {normal: [2, 0.2]}}\n")
    with full_disk(10_000), pytest.raises(OSError, match="space"):  # before the first run
        swept(path, "out")
    with full_disk(24_000), pytest.raises(SweepStopped) as stopped:
        swept(path, "out", resume=True)
    assert stopped.value.exit_code == 4
    assert 0 < (kept := runs_in(path.parent / "out")) < 40
    study = swept(path, "out", resume=True)
    assert (study.made, study.record["runs"], study.record["failed"]) == (40 - kept, 40, 0)


# -- a cluster ---------------------------------------------------------------------------------------

SERVED = """
import asyncio, sys
{before}
from distributed import {kind}

async def main():
    async with {kind}({arguments}) as served:
        print(served.address, flush=True)
        await served.finished()

asyncio.run(main())
"""


@contextmanager
def served(folder: Path, kind: str, arguments: str, before: str = "") -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A scheduler or a worker of dask in a folder of its own, and its address."""
    folder.mkdir()
    code = SERVED.format(kind=kind, arguments=arguments, before=before)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", code],
        cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        yield process, process.stdout.readline().strip()
    finally:
        process.kill()
        process.communicate()


@pytest.mark.filterwarnings("ignore")
def test_a_cluster_in_empty_folders_loses_a_worker_and_makes_the_same_table(
    tanks: Callable[..., Path], tmp_path: Path
) -> None:
    pytest.importorskip("distributed")
    path = tanks(VARY.replace("runs: 30", "runs: 12") + "set: {duration: 500}\n")
    scheduler = served(tmp_path / "scheduler", "Scheduler", "host='127.0.0.1', port=0, dashboard=False")
    with scheduler as (_, address):
        worker = f"{address!r}, nthreads=1, local_directory='.'"
        with (
            served(tmp_path / "one", "Worker", worker) as (lost, _),
            served(tmp_path / "two", "Worker", worker),
        ):
            seen = []

            def progress(done: int, count: int) -> None:
                seen.append(done)
                if done == 4:
                    assert list((tmp_path / "one").rglob("tank.fmu"))
                    lost.kill()

            there = swept(path, "there", dask=address, in_process=False, progress=progress)
    assert seen == list(range(1, 25))
    assert (there.made, there.record["failed"]) == (24, 0)
    assert not list((tmp_path / "two").rglob("tank.fmu"))
    here = swept(path, "here")
    assert (there.folder / TABLE).read_bytes() == (here.folder / TABLE).read_bytes()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("workers", [None, 0, 1])
def test_a_cluster_that_cannot_make_runs_is_told_before_anything_runs(
    tanks: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, workers: int | None
) -> None:
    pytest.importorskip("distributed")
    scheduler = served(tmp_path / "scheduler", "Scheduler", "host='127.0.0.1', port=0, dashboard=False")
    with scheduler as (_, address):
        stranger = 'sys.modules["cosim"] = None'  # importing it fails, as where it is not installed
        worker = served(tmp_path / "one", "Worker", f"{address!r}, nthreads=1, local_directory='.'", stranger)
        if workers is None:
            monkeypatch.setattr("cosim.sweeps.pool.ANSWER", 0.2)
            path = tanks(FEW + "dask: tcp://127.0.0.1:9\n")
            with pytest.raises(InputError) as told:
                swept(path, "out", in_process=False)
            assert [(f.line, f.column) for f in told.value.faults] == [(10, 7)]
        elif workers == 0:
            with pytest.raises(InputError):
                swept(tanks(FEW), "out", in_process=False, dask=address)
        else:
            with worker, pytest.raises(InputError) as told:
                swept(tanks(FEW), "out", in_process=False, dask=address)
            assert len(str(told.value).splitlines()) == 1
    assert not list((tmp_path / "out").glob("*"))


# -- designs and statistics --------------------------------------------------------------------------


def uniform(*names: str) -> list[Factor]:
    return [Factor(name, drawn=distribution("uniform", (0, 1), None)) for name in names]


@pytest.mark.parametrize("sampling", ["latin-hypercube", "sobol", "random", "saltelli"])
def test_a_design_is_that_of_its_seed(sampling: Any) -> None:
    factors = [*uniform("a"), Factor("b", drawn=distribution("normal", (0, 2), None))]
    one, again, other = (columns_of(factors, 64, sampling, seed) for seed in (1, 1, 2))
    assert one == again != other
    assert 0 <= min(one["a"]) < max(one["a"]) <= 1
    if sampling == "latin-hypercube":
        assert sorted(int(64 * v) for v in one["a"]) == list(range(64))  # one value in each part


def test_each_row_that_is_drawn_goes_with_every_listed_value_and_seeds_are_counted_on() -> None:
    factors = [*uniform("a"), Factor("b", values=[1, 2]), Factor("c", values="xyz"), Factor("seed", first=7)]
    columns = columns_of(factors, 4, "random", 1)
    assert len(set(zip(*(columns[n] for n in "abc"), strict=True))) == len(columns["a"]) == 4 * 2 * 3
    assert columns["seed"] == list(range(7, 31))


@pytest.mark.parametrize("saltelli", [True, False])
def test_a_sensitivity_names_what_an_outcome_depends_on(saltelli: bool) -> None:
    columns = columns_of(uniform("strong", "weak", "idle"), 640, "saltelli" if saltelli else "latin-hypercube", 4)
    y = np.array(columns["strong"]) + 0.5 * np.array(columns["weak"])
    found = sensitivity("y", y, columns, saltelli=saltelli, seed=1)
    assert found is not None
    assert found.factors == ("strong", "weak", "idle")
    # of a sum the shares of the variance are 1 : 0.25 : 0; within what 640 runs can tell
    assert [first for first, _ in found.first] == pytest.approx([0.8, 0.2, 0.0], abs=0.1)
    assert bool(found.total) is saltelli


# -- what is refused ---------------------------------------------------------------------------------

FAULTS = [  # entry of `vary`, and the text at the place of its fault
    ("tank.are: {uniform: [1, 2]}", "tank.are"),
    ("tank.area: {uniform: [2, 1]}", "[2, 1]"),
    ("next.area: {normal: [1, 0]}", "[1, 0]"),
    ("tank.leak.rate: {uniform: [0, 3]}", "3"),
    ("tank.level: {values: [1]}", "tank.level"),  # an output
    ("tank.inflow: {values: [1]}", "tank.inflow"),  # connected
    ("source.inflow: {values: [1]}", "source.inflow"),  # no FMU
    ("nxt.area: {values: [1]}", "nxt.area"),
    ("duration: {values: [10]}", "duration"),
    ("step: {values: [0.5, 0.3]}", "0.3"),
    ("seed: {values: [0.5]}", "{values"),
    ("next.leak.rate: {values: [1], count: 3}", "{values"),
    ("tank.draw.flow: {count: 2}", "2"),
    ("tank.area: {normal: [1, 1]}", "[1, 1]"),  # drawn beyond the bounds of the variable
    ("tank.area: {grid: {from: 1, to: 2, count: 1000000000}}", "tank.area"),
    ("seed: {count: 1000000000}", "seed"),
    ("connections.1.noise.variance: {normal: [1.0e-6, 4.0e-7]}", "[1.0e-6"),  # negative ones
]


@pytest.mark.parametrize(("entry", "at"), FAULTS)
def test_a_faulty_factor_is_refused_at_its_place(tanks: Callable[..., Path], entry: str, at: str) -> None:
    (place,) = places_of(tanks(f"scenario: tanks.yaml\nvary:\n  {entry}\n"))
    assert place[0] == 3
    assert f"  {entry}"[place[1] - 1 :].startswith(at)
