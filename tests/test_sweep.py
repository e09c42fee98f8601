"""Sweeps: designs, runs, what is gone on with after a kill, parts, a cluster that loses a worker, what is refused."""

from __future__ import annotations

import html
import json
import os
import re
import shlex
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.core.errors import InputError, SweepFailed, SweepStopped
from cosim.files.results import read_results
from cosim.fmi.building.file import load_model
from cosim.fmi.fmu_build import build
from cosim.pages.runs import find_runs
from cosim.sweeps.reading import read_sweep, repeat_command
from cosim.sweeps.sampling import Factor, columns_of, distribution, sensitivity
from cosim.sweeps.store import read_table, signal_of
from cosim.sweeps.workflow import sweep
from tests.compiled import library, pack
from tests.full_disk import full_disk
from tests.known.kit import Model
from tests.lag import DESCRIPTION as LAG
from tests.tank import MODEL
from tests.test_first_steps import invoked, told
from tests.users import ENVIRONMENT

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


def tank_of(model: str, folder: Path) -> Path:
    (folder / "tank.py").write_text(model)
    return build(load_model(f"{folder / 'tank.py'}:Tank", folder).recipe(), folder / "tank.fmu")


@pytest.fixture(scope="module")
def tank_fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tank_of(MODEL, tmp_path_factory.mktemp("tank"))


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
    done = invoked(*words)
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
    columns = table.to_pydict()
    assert len({*zip(columns["tank.area"], columns["next.leak.rate"], strict=True)}) == 10  # each with every listed one
    assert columns["seed"] == [*range(5, 15)]
    row = {name: values[7] for name, values in columns.items()}
    alone = path.parent / "alone"
    words = shlex.split(repeat_command(study.sweep, 7))
    assert exit_code(*words[1:], "--out", alone, "--no-report") in (0, 5)
    manifest = json.loads((alone / "manifest.json").read_text())
    assert manifest["scenario"]["components"]["tank"]["start"]["area"] == row["tank.area"]
    assert (manifest["scenario"]["seed"], manifest["criteria"][0]["value"]) == (row["seed"], row["peak of next.level"])
    results = read_results(alone / "results.csv")
    assert about["times"] == results.time.tolist()
    assert signal_of(table, "next.level")[7].tolist() == results["next.level"].tolist()


def test_a_sweep_shows_itself_in_a_notebook(tanks: Callable[..., Path]) -> None:
    pytest.importorskip("pandas")
    study = swept(tanks(VARY.replace("max: 1.0001", "max: 1")), "out", report=True)
    (frame,) = re.findall(r'<iframe [^>]*srcdoc="([^"]*)"', study._repr_html_())
    assert html.unescape(frame).count("<figure") == 2  # a histogram of each criterion
    assert study.plot()._repr_png_().startswith(b"\x89PNG")
    assert len(study.to_pandas()) == len(cosim.read(study.folder).criteria["peak of next.level"]) == 60
    page = (study.folder / "report.html").read_text()
    assert page.count("<polyline") == 60  # runs in parallel coordinates
    met = len(re.findall('<polyline class="met"', page))
    assert 0 < met == study.record["met_all"] < 60


@pytest.mark.parametrize("workers", [1, 2])
def test_a_run_that_crashes_its_process_or_takes_too_long_fails_alone(tmp_path: Path, workers: int) -> None:
    misbehaves = "(level,) = state\n            {9.0: os.abort, 8.0: lambda: time.sleep(60)}.get(self.area, int)()\n"
    model = MODEL.replace("from dataclasses", "import os, time\nfrom dataclasses").replace(
        "(level,) = state\n", misbehaves
    )
    tank_of(model, tmp_path)
    head = "name: one\nduration: 2\nstep: 0.5\nlimits: {step: 2 s}\ncomponents: {tank: {fmu: tank.fmu}}\n"
    (tmp_path / "one.yaml").write_text(head)
    (tmp_path / "sweep.yaml").write_text("scenario: one.yaml\nvary: {tank.area: {values: [9.0, 1, 8.0, 2]}}\n")
    study = swept(tmp_path / "sweep.yaml", "out", workers=workers, in_process=False)
    assert [failure["run"] for failure in study.record["failures"]] == [0, 2]
    assert "fmi2DoStep crashed" in study.record["failures"][0]["why"]
    table, _ = read_table(study.folder / TABLE)
    assert [status == "ok" for status in table.column("status").to_pylist()] == [False, True, False, True]


def test_a_name_whose_newest_results_are_a_sweep_is_viewed(
    tanks: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tanks(FEW)
    monkeypatch.chdir(tmp_path)
    cosim.run("tanks.yaml", "results/tank/0001", report=False, in_process=True)
    study = swept(path, "results/tank/0002")

    assert study.record["runs"] == 10
    runs = json.loads(told("view", "tank", "--prepare", "--json"))["runs"]
    assert [run["name"] for run in runs] == [f"tank/0002 run {k}" for k in range(10)]
    places, notes = find_runs(["tank"], Path("results"))
    table, _ = read_table(study.folder / TABLE)
    for place, levels in zip(places, signal_of(table, "tank.level"), strict=True):
        assert place.rows is not None
        assert place.rows.read("tank.level").tolist() == levels.tolist()
    assert len(notes) == 1


@pytest.mark.parametrize(
    ("before", "returned"),
    [("", "m"), ("m->r[Y] = made++ ? 5 : 0;", "m"), ("", "made++ ? 0 : m"), ("if (made++) abort();", "m")],
    ids=["forgets", "remembers", "refuses", "crashes"],
)
@pytest.mark.parametrize("in_process", [True, False])
def test_each_run_is_as_with_a_library_of_its_own(tmp_path: Path, before: str, returned: str, in_process: bool) -> None:
    """A library has a count of its instances, on which all but the first act."""
    if in_process and "abort" in before:
        pytest.skip("ends this process")
    source, last = Path(__file__).with_name("lag.c").read_text(), 'return strcmp(g, "lag") ? 0 : m;'
    assert last in source
    source = source.replace("C fmi2Instantiate", "static int made;\nC fmi2Instantiate")
    (tmp_path / "lag.c").write_text(source.replace(last, f"{before} return {returned};"))
    pack(tmp_path / "lag.fmu", LAG, library(tmp_path / "lag.c", "-ffp-contract=off"))
    (tmp_path / "lag.yaml").write_text("name: lag\nduration: 2\nstep: 0.5\ncomponents: {lag: {fmu: lag.fmu}}\n")
    (tmp_path / "sweep.yaml").write_text(
        "scenario: lag.yaml\nsignals: [lag.y]\nvary: {lag.bias: {grid: {from: 1, to: 9, count: 9}}}\n"
    )
    study = swept(tmp_path / "sweep.yaml", "out", workers=1, in_process=in_process)
    assert study.record["failed"] == 0
    levels = signal_of(read_table(study.folder / TABLE)[0], "lag.y")
    rise = 1.0 - 0.5 ** np.arange(5)  # of Euler's rule with half the time constant
    assert levels.tolist() == (np.arange(1.0, 10.0)[:, np.newaxis] * rise).tolist()


@pytest.mark.parametrize("in_process", [True, False])
def test_a_library_that_keeps_a_parameter_of_an_earlier_run_is_loaded_for_each_run(
    tmp_path: Path, in_process: bool
) -> None:
    model = Model(
        "parameter p = 1, y = 0",
        functions="static double kept; static int has;\n",
        step="if (!has) { kept = p; has = 1; } y = kept;",
        name="keeps",
    )
    (tmp_path / "keeps.yaml").write_text(
        f"name: keeps\nduration: 1\nstep: 0.5\ncomponents: {{a: {{fmu: {model.fmu()}}}}}\n"
    )
    (tmp_path / "sweep.yaml").write_text(
        "scenario: keeps.yaml\nsignals: [a.y]\nvary: {a.p: {values: [1, 2, 3, 4, 5]}}\n"
    )
    study = swept(tmp_path / "sweep.yaml", "out", workers=1, in_process=in_process)
    levels = signal_of(read_table(study.folder / TABLE)[0], "a.y")
    assert levels[:, -1].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]


@pytest.mark.parametrize("functions", ["static double kept; static int has;\n", "static __thread double kept, has;\n"])
def test_instances_of_an_fmu_do_not_share_the_variables_of_its_library(tmp_path: Path, functions: str) -> None:
    step = "if (!has) { kept = p; has = 1; } y = kept;"
    model = Model("parameter p = 1, y = 0", functions=functions, step=step, name="own")
    parts = "".join(f"  m{k}: {{fmu: {model.fmu()}, start: {{p: {k}}}}}\n" for k in range(1, 4))
    (tmp_path / "own.yaml").write_text(f"name: own\nduration: 1\nstep: 0.5\ncomponents:\n{parts}")
    results = read_results(cosim.run(tmp_path / "own.yaml", tmp_path / "out", report=False).folder / "results.csv")
    assert [results[f"m{k}.y"][-1] for k in range(1, 4)] == [1.0, 2.0, 3.0]


def test_an_fmu_that_is_replaced_by_another_one_is_unpacked_again(tmp_path: Path) -> None:
    (tmp_path / "one.yaml").write_text("name: one\nduration: 1\nstep: 0.5\ncomponents: {m: {fmu: m.fmu}}\n")
    for value in ("3", "4"):
        model = Model("parameter p = 1, y = 0", step=f"y = {value};", name=f"is{value}")
        (tmp_path / "m.fmu").write_bytes(model.fmu().read_bytes())
        run = cosim.run(tmp_path / "one.yaml", tmp_path / value, report=False, in_process=True)
        assert run["m.y"][-1] == float(value)


def test_a_sweep_of_which_no_run_ends_is_a_failure(tanks: Callable[..., Path]) -> None:
    path = tanks("scenario: tanks.yaml\nvary: {tank.draw.flow: {values: [1.0e-1, -1.0e-1]}}\n")
    text = (path.parent / "tanks.yaml").read_text()
    (path.parent / "tanks.yaml").write_text(text.replace("factor: 0.01,", "factor: 1.0e+308, offset: 1.0e+308,"))
    with pytest.raises(SweepFailed) as failed:
        swept(path, "out")
    assert failed.value.exit_code == 4


def test_the_fmu_of_a_scenario_varies_and_its_faults_have_their_places(
    tanks: Callable[..., Path], tank_fmu: Path
) -> None:
    entries = "components.tank.fmu: {values: [tank.fmu, other.fmu]}, tank.level_start: {values: [2, 3]}"
    path = tanks(f"scenario: tanks.yaml\nsignals: [tank.level]\nvary: {{{entries}}}\n")
    assert places_of(path) == [(3, 49)]
    (path.parent / "other.fmu").symlink_to(tank_fmu)
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


def listening() -> None:
    """Also where the suite runs in the background of a shell, which has its children ignore it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_stopped_sweep_is_gone_on_with_and_its_table_is_that_of_one_that_was_not(
    tanks: Callable[..., Path], number: signal.Signals
) -> None:
    path = tanks(VARY.replace("runs: 30", "runs: 12") + "set: {duration: 500}\n")
    folder = path.parent / "out"
    words: list[Any] = ["-m", "cosim", "sweep", path, "--out", folder, "--workers", "2", "--no-report"]
    streams: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "start_new_session": True}
    with subprocess.Popen([sys.executable, *words], env=ENVIRONMENT, preexec_fn=listening, **streams) as process:
        deadline = time.monotonic() + 100
        while runs_in(folder) < 6 and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.02)
        if number == signal.SIGKILL:
            process.kill()
        else:
            os.killpg(process.pid, number)  # as a terminal does
            _, said = process.communicate(timeout=100)
            assert (process.returncode, len(said.splitlines())) == (130, 1), said
    kept = runs_in(folder)
    assert 6 <= kept < 24, "it was stopped on its way"
    assert swept(path, "out", resume=True).made == 24 - kept
    assert (folder / TABLE).read_bytes() == (swept(path, "whole").folder / TABLE).read_bytes()
    assert not (folder / "runs.sqlite").exists()
    tanks()  # another sweep
    for options in ({}, {"resume": True}):
        with pytest.raises(InputError):
            swept(path, "out", **options)


def test_parts_become_the_table_of_a_whole_sweep(tanks: Callable[..., Path]) -> None:
    path = tanks(FEW)
    out = path.parent / "out"
    part = ("sweep", path, "--workers", 1, "--out", out)
    for words, code in (
        (["--part", "1/3"], 0),
        (["--part", "2/3"], 0),
        (["--part", "3/3"], 0),
        (["--part", "2/3"], 0),
        (["--resume"], 0),
        (["--part", "0/3", "--force"], 2),
        (["--part", "1/2", "--resume"], 2),
    ):
        assert exit_code(*part, *words) == code, words
    assert (out / TABLE).read_bytes() == (swept(path, "whole").folder / TABLE).read_bytes()
    assert sorted(p.name for p in out.iterdir()) == ["report.html", "sweep.json", TABLE]
    assert exit_code(*part[:-1], out / "two", "--part", "1/2") == 0
    assert swept(path, "out/two", resume=True).made == 5  # what no part has made
    assert exit_code("sweep", path, "--part", "1/2") == 2  # of which folder?


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
    assert (study.made, study.record["failed"]) == (40 - kept, 0)


# -- a cluster ---------------------------------------------------------------------------------------

SERVED = """
import asyncio, sys
from distributed import Scheduler, Worker

async def main():
    async with {kind}({arguments}) as served:
        print(served.address, flush=True)
        await served.finished()

asyncio.run(main())
"""


@contextmanager
def served(folder: Path, kind: str, arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A scheduler or a worker of dask in a folder of its own, and its address."""
    folder.mkdir()
    code = SERVED.format(kind=kind, arguments=arguments)
    words = [sys.executable, "-W", "ignore", "-c", code]
    process = subprocess.Popen(words, cwd=folder, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True)
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
    with ExitStack() as stack:
        arguments = "host='127.0.0.1', port=0, dashboard=False"
        _, address = stack.enter_context(served(tmp_path / "scheduler", "Scheduler", arguments))
        arguments = f"{address!r}, nthreads=1, local_directory='.'"
        lost, _ = stack.enter_context(served(tmp_path / "one", "Worker", arguments))
        stack.enter_context(served(tmp_path / "two", "Worker", arguments))
        seen = []

        def progress(done: int, count: int) -> None:
            seen.append(done)
            if done == 4:
                assert list((tmp_path / "one").rglob("tank.fmu"))
                lost.kill()

        there = swept(path, "there", dask=address, in_process=False, progress=progress)
    assert seen == list(range(1, 25))
    assert there.record["failed"] == 0
    assert not list((tmp_path / "two").rglob("tank.fmu"))
    assert (there.folder / TABLE).read_bytes() == (swept(path, "here").folder / TABLE).read_bytes()


# -- designs and statistics --------------------------------------------------------------------------


def uniform(*names: str) -> list[Factor]:
    return [Factor(name, drawn=distribution("uniform", (0, 1), None)) for name in names]


@pytest.mark.parametrize("sampling", ["saltelli", "latin-hypercube"])
def test_a_sensitivity_names_what_an_outcome_depends_on(sampling: Any) -> None:
    columns = columns_of(uniform("strong", "weak", "idle"), 640, sampling, 4)
    y = np.array(columns["strong"]) + 0.5 * np.array(columns["weak"])
    found = sensitivity("y", y, columns, saltelli=sampling == "saltelli", seed=1)
    assert found is not None
    # of a sum the shares of the variance are 1 : 0.25 : 0; within what 640 runs can tell
    assert [first for first, _ in found.first] == pytest.approx([0.8, 0.2, 0.0], abs=0.1)


# -- what is refused ---------------------------------------------------------------------------------

FAULTS = [  # entry of `vary`, and the text at the place of its fault
    ("tank.are: {uniform: [1, 2]}", "tank.are"),
    ("tank.area: {uniform: [2, 1]}", "[2, 1]"),
    ("tank.leak.rate: {uniform: [0, 3]}", "3"),
    ("tank.level: {values: [1]}", "tank.level"),  # an output
    ("tank.inflow: {values: [1]}", "tank.inflow"),  # connected
    ("duration: {values: [10]}", "duration"),
    ("step: {values: [0.5, 0.3]}", "0.3"),
    ("tank.area: {normal: [1, 1]}", "[1, 1]"),  # drawn beyond the bounds of the variable
    ("tank.area: {grid: {from: 1, to: 2, count: 1000000000}}", "tank.area"),
    ("connections.1.noise.variance: {normal: [1.0e-6, 4.0e-7]}", "[1.0e-6"),  # negative ones
]


@pytest.mark.parametrize(("entry", "at"), FAULTS)
def test_a_faulty_factor_is_refused_at_its_place(tanks: Callable[..., Path], entry: str, at: str) -> None:
    (place,) = places_of(tanks(f"scenario: tanks.yaml\nvary:\n  {entry}\n"))
    assert place[0] == 3
    assert f"  {entry}"[place[1] - 1 :].startswith(at)


def test_a_value_that_is_both_set_and_varied_is_refused(tanks: Callable[..., Path]) -> None:
    for given, varied in (("tank.area: 1", "tank.area: {values: [1]}"), ("seed: 3", "seed: {values: [1, 2]}")):
        (place,) = places_of(tanks(f"scenario: tanks.yaml\nset: {{{given}}}\nvary:\n  {varied}\n"))
        assert place[0] == 4
    assert read_sweep(tanks("scenario: tanks.yaml\nset: {seed: 3}\nvary:\n  seed: {count: 2}\n")).count == 2
