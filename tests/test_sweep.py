"""Sweeps: designs, runs on arrays and through FMUs, what is gone on with after a kill, what is refused."""

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
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.base.errors import InputError, SweepFailed, SweepStopped
from cosim.fmi.fmu_build import build
from cosim.fmi.native.compiler import compiler
from cosim.loading.file import load_model
from cosim.simulation.workflow import run
from cosim.sweeps import twins
from cosim.sweeps.reading import read_sweep
from cosim.sweeps.run_chunks import RunResult, make_runs
from cosim.sweeps.run_statistics import sensitivity, share_interval
from cosim.sweeps.sampling import Factor, columns_of, distribution
from cosim.sweeps.store import DATABASE, TABLE, Database, read_table, signal_of
from cosim.sweeps.sweep_result import Swept, repeat_command
from cosim.sweeps.workflow import EQUAL, sweep
from cosim.verbs.cli import app
from tests.full_disk import full_disk
from tests.tank import MODEL

ROOT = Path(__file__).resolve().parent.parent
TANKS = """
name: tanks
duration: 50
step: 0.5
seed: 1
components:
  tank: {fmu: tank.fmu, start: {level_start: 2}}
  next: {fmu: tank.fmu}
  source: {block: reference, signals: {inflow: {unit: m3/s, start: 0.02, changes: [{at: 20, to: 0.03}]}}}
connections:
  - {from: source.inflow, to: tank.inflow}
  - {from: tank.level, to: next.inflow, factor: 0.01, noise: {variance: 1.0e-6, bias: 0.001}}
criteria:
  peak: {of: next.level, max: 1.0}
  final_error: {of: tank.level, to: 1.0, max: 1.0}
"""
VARY = """
scenario: tanks.yaml
runs: 40
seed: 2
vary:
  tank.area: {log_uniform: [0.2, 2]}
  tank.level_start: {normal: [2, 0.2]}
  next.leak.rate: {values: [0, 0.005]}
  seed: {each: 5}
"""
FAULT = "faults: [{on: next.inflow, kind: bias, value: 0.001, from: 10}]\n"  # which arrays do not have


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


@pytest.fixture
def craft(tmp_path: Path, plant_fmu: Path, controller_fmu: Path) -> Path:
    """The regulator beside its FMUs."""
    (tmp_path / "plant.fmu").symlink_to(plant_fmu)
    (tmp_path / "controller.fmu").symlink_to(controller_fmu)
    text = (ROOT / "scenarios" / "regulate.yaml").read_text().replace("../build/", "")
    (tmp_path / "craft.yaml").write_text(text)
    return tmp_path / "craft.yaml"


def apart(one: list[RunResult], other: list[RunResult]) -> float:
    """The largest difference of a signal between runs made in two ways."""
    assert [m.status for m in one] == [m.status for m in other] == ["ok"] * len(one)
    return max(float(np.abs(a.signals - b.signals).max()) for a, b in zip(one, other, strict=True))


def faults_of(path: Path) -> list[str]:
    with pytest.raises(InputError) as caught:
        read_sweep(path)
    return [f"{f.line}:{f.column} {f.message}" for f in caught.value.faults]


# -- runs --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compiled", [True, False])
def test_runs_of_tanks_on_arrays_are_those_through_their_fmus(tanks: Callable[..., Path], compiled: bool) -> None:
    if compiled and compiler() is None:
        pytest.skip("no C compiler")
    study = read_sweep(tanks())
    job, asked = replace(study.job, whole=True, compiled=compiled), [study.request_run(k) for k in (0, 33, 79)]
    on_arrays = make_runs(job, asked, "arrays")
    assert {m.through for m in on_arrays} == {"arrays"}
    assert apart(on_arrays, make_runs(job, asked, "fmus")) < 1e-12  # one rounding of sin, pow and their like a substep


@pytest.mark.thorough
@pytest.mark.parametrize("compiled", [True, False])
def test_runs_of_the_craft_with_play_delay_and_filters_of_their_own_are_those_through_its_fmus(
    tmp_path: Path, plant_fmu: Path, controller_fmu: Path, compiled: bool
) -> None:
    if compiled and compiler() is None:
        pytest.skip("no C compiler")
    (tmp_path / "plant.fmu").symlink_to(plant_fmu)
    (tmp_path / "controller.fmu").symlink_to(controller_fmu)
    text = (ROOT / "scenarios" / "regulate.yaml").read_text().replace("../build/", "")
    (tmp_path / "craft.yaml").write_text(text)
    or_none = "" if compiled else "0, "  # each set of effects that act takes a second to compile
    (tmp_path / "sweep.yaml").write_text(
        "scenario: craft.yaml\nruns: 1\nset: {duration: 0.5, criteria: {}}\nvary:\n"
        "  plant.mass: {uniform: [0.65, 0.75]}\n"
        f"  plant.servo_backlash.width: {{values: [{or_none}0.02]}}\n"
        f"  plant.actuator_delay.time: {{values: [{or_none}0.033]}}\n"
        f"  plant.actuator_second_order.natural_frequency: {{values: [{or_none}16]}}\n"
        "  controller.measurement_variance_ax: {uniform: [0.03, 0.06]}\n"
        "  controller.estimator: {values: [lagged, consistent]}\n"
        "  controller.tilt_max: {values: [12 deg]}\n"
        "  seed: {each: 3}\n"
    )
    study = read_sweep(tmp_path / "sweep.yaml")
    job = replace(study.job, whole=True, compiled=compiled)
    on_arrays = make_runs(job, [study.request_run(k) for k in range(study.count)], "arrays")
    assert {m.through for m in on_arrays} == {"arrays"}
    some = [0, 1] if compiled else [0, 5, 15]  # every value of each
    through = make_runs(job, [study.request_run(k) for k in some], "fmus")
    assert apart([on_arrays[k] for k in some], through) < EQUAL  # as every sweep is held to
    assert apart([on_arrays[0]], [on_arrays[1]]) > 1e-6  # the runs do differ


def test_a_run_of_a_sweep_is_the_run_of_its_scenario_with_its_values(tanks: Callable[..., Path]) -> None:
    path = tanks(VARY.replace("runs: 40", "runs: 5"))
    study = sweep(path, path.parent / "out", in_process=True, report=False)
    table, about = read_table(study.folder / TABLE)
    row = table.slice(7, 1).to_pydict()
    given = {name: row[name][0] for name in ("tank.area", "tank.level_start", "next.leak.rate")}
    overrides = [f"components.{n.partition('.')[0]}.start.{n.partition('.')[2]}={v}" for n, v in given.items()]
    alone = run(path.parent / "tanks.yaml", path.parent / "alone", [*overrides, f"seed={row['seed'][0]}"], report=False)
    assert row["peak of next.level"] == pytest.approx([alone.manifest["criteria"][0]["value"]], rel=1e-12)
    assert about["times"] == alone.results.time.tolist()
    # straight from the same noise, and one rounding a step of other functions
    assert signal_of(table, "next.level")[7] == pytest.approx(alone.results["next.level"], rel=1e-12)


def test_what_equations_cannot_be_had_of_runs_through_the_fmus_and_it_is_said(tanks: Callable[..., Path]) -> None:
    path = tanks(VARY.replace("runs: 40", "runs: 2"), FAULT)
    study = sweep(path, path.parent / "out", in_process=True, report=False)
    assert study.record["way"] == "fmus"
    assert "faults are injected" in study.sentences[-1]
    assert set(read_table(study.folder / TABLE)[0].column("through").to_pylist()) == {"fmus"}


def test_equations_that_are_not_those_of_the_fmu_are_not_used(
    tanks: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def other(path: Path, name: str) -> Any:
        model, stepper, space = found(path, name)
        wrong = {n: getattr(space, n) for n in ("sqrt", "maximum")} | {"sqrt": lambda x: space.sqrt(x) + 1e-6}
        return model, stepper, SimpleNamespace(**wrong)

    found = twins.model_of
    monkeypatch.setattr(twins, "model_of", other)
    path = tanks(VARY.replace("runs: 40", "runs: 3"))
    study = sweep(path, path.parent / "out", in_process=True, report=False)
    assert study.record["way"] == "fmus"
    assert "apart from those through the FMUs" in study.record["why"]


def test_a_native_fmu_brings_the_defaults_that_it_declares(tank_fmu: Path) -> None:
    declared = {"area": "0.9", "leak.rate": "0.01", "draw.flow": "0.0", "level": None, "level_start": "3"}
    variables = [SimpleNamespace(name=n, causality="parameter", start=v) for n, v in declared.items()]
    found = twins.model_of(tank_fmu, "TankPlant")
    assert found is not None
    given = twins._changed_defaults(found[0], SimpleNamespace(modelVariables=variables))
    assert given == {"area": 0.9, "leak.rate": 0.01}  # those of the model are 0.5 and, of its effects, none


def test_a_run_that_crashes_its_process_fails_alone(tmp_path: Path) -> None:
    crashing = MODEL.replace("from dataclasses", "import os\nfrom dataclasses").replace(
        "            (level,) = state\n", "            (level,) = state\n            if self.area == 9.0: os.abort()\n"
    )
    (tmp_path / "tank.py").write_text(crashing)
    build(load_model(f"{tmp_path / 'tank.py'}:Tank", tmp_path).recipe(), tmp_path / "tank.fmu")
    event = "events: [{at: 1, set: {tank.inflow: 0.02}}]\n"  # which arrays do not have
    head = "name: one\nduration: 2\nstep: 0.5\ncomponents: {tank: {fmu: tank.fmu}}\n"
    (tmp_path / "one.yaml").write_text(head + event)
    (tmp_path / "sweep.yaml").write_text("scenario: one.yaml\nvary: {tank.area: {values: [1, 9.0]}}\n")
    study = sweep(tmp_path / "sweep.yaml", tmp_path / "out", workers=1)
    assert study.record["failed"] == 1
    (failure,) = study.record["failures"]
    assert failure["run"] == 1
    assert failure["why"].startswith("tank at t = 0 s: fmi2DoStep crashed: abort")
    assert failure["code"].startswith("E-ISO-")
    assert "Run 1:" in (study.folder / "report.html").read_text()


def test_a_sweep_of_which_no_run_ends_is_a_failure(tanks: Callable[..., Path]) -> None:
    path = tanks("scenario: tanks.yaml\nset: {duration: 5}\nvary: {tank.draw.flow: {values: [1.0e-1, -1.0e-1]}}\n")
    text = (path.parent / "tanks.yaml").read_text()
    (path.parent / "tanks.yaml").write_text(text.replace("factor: 0.01,", "factor: 1.0e+308, offset: 1.0e+308,"))
    for _ in range(2):  # the second time from sweep.json
        with pytest.raises(SweepFailed, match="all 2 runs failed; run 0: "):
            sweep(path, path.parent / "out", in_process=True, report=False, resume=True)


@pytest.mark.parametrize(
    ("check", "code"),
    [
        ({"agrees": True, "apart": 0.0}, "N-SWP-041"),
        ({"agrees": False, "apart": 1.0}, "W-SWP-038"),
        ({"apart": 1e-12}, "N-SWP-041"),
        ({"apart": 1e-3}, "W-SWP-038"),
        ({"apart": None}, "W-SWP-038"),  # infinite
        ({}, "W-SWP-045"),
    ],
)
def test_a_record_without_a_verdict_is_judged_by_its_difference_or_not_compared(
    tanks: Callable[..., Path], check: dict[str, object], code: str
) -> None:
    record = {"way": "arrays", "through_fmus": 0, "runs": 1, "check": {"sentence": "compared", **check}}
    swept = Swept(read_sweep(tanks()), Path("out"), record, 1)
    assert swept.check.code == code
    assert (swept.check == "compared") == (code != "W-SWP-045")


# -- kept and gone on with ---------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_sweep_that_was_killed_is_gone_on_with_and_its_table_is_that_of_one_that_was_not(
    tanks: Callable[..., Path],
) -> None:
    path = tanks(VARY.replace("runs: 40", "runs: 20"), FAULT)
    folder = path.parent / "killed"
    command = [
        sys.executable,
        "-m",
        "cosim.verbs.cli",
        "sweep",
        str(path),
        "--out",
        str(folder),
        "--workers",
        "1",
        "--no-report",
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + 60
    while (kept := runs_in(folder)) < 8 and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = runs_in(folder)
    assert 8 <= kept < 40, "it was killed on its way"
    assert not (folder / TABLE).exists()
    with pytest.raises(InputError):
        sweep(path, folder, in_process=True, report=False)
    after = sweep(path, folder, in_process=True, report=False, resume=True)
    assert after.made == 40 - kept
    whole = sweep(path, path.parent / "whole", in_process=True, report=False)
    assert whole.made == 40
    assert (folder / TABLE).read_bytes() == (path.parent / "whole" / TABLE).read_bytes()
    assert sweep(path, folder, in_process=True, report=False, resume=True).made == 0


def runs_in(folder: Path) -> int:
    """How many runs are kept."""
    if not (folder / DATABASE).exists():
        return 0
    base = sqlite3.connect(folder / DATABASE)
    try:
        return int(base.execute("SELECT count(*) FROM made").fetchone()[0])
    except sqlite3.Error:
        return 0
    finally:
        base.close()


def test_the_runs_of_another_sweep_are_not_gone_on_with(tanks: Callable[..., Path]) -> None:
    path = tanks(VARY.replace("runs: 40", "runs: 2"))
    sweep(path, path.parent / "out", in_process=True, report=False)
    tanks(VARY.replace("runs: 40", "runs: 3"))
    for resume in (False, True):
        with pytest.raises(InputError):
            sweep(path, path.parent / "out", in_process=True, report=False, resume=resume)
    assert sweep(path, path.parent / "out", in_process=True, report=False, force=True).made == 6


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
def test_a_dask_cluster_makes_the_same_table(tanks: Callable[..., Path]) -> None:
    distributed = pytest.importorskip("distributed")
    path = tanks(VARY.replace("runs: 40", "runs: 10"))
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        there = sweep(path, path.parent / "there", dask=cluster.scheduler_address, report=False)
    here = sweep(path, path.parent / "here", in_process=True, report=False)
    assert there.made == 20
    assert (there.folder / TABLE).read_bytes() == (here.folder / TABLE).read_bytes()


STRANGER = """
import asyncio, sys
sys.modules["cosim"] = None  # importing it fails, as where it is not installed
from distributed import Worker

async def main():
    async with Worker(sys.argv[1]) as worker:
        await worker.finished()

asyncio.run(main())
"""


@pytest.mark.filterwarnings("ignore")
def test_dask_workers_that_cannot_import_the_package_are_told_in_one_message(tanks: Callable[..., Path]) -> None:
    distributed = pytest.importorskip("distributed")
    path = tanks(VARY.replace("runs: 40", "runs: 10"))
    with distributed.LocalCluster(n_workers=0, processes=False, protocol="tcp", dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        worker = subprocess.Popen([sys.executable, "-c", STRANGER, address], stderr=subprocess.DEVNULL)
        try:
            with distributed.Client(address) as client:
                client.wait_for_workers(1, timeout=60)
            with pytest.raises(InputError, match=r"--dask: .* has 1 worker of 1 without cosim .*install cosim") as told:
                sweep(path, path.parent / "there", dask=address, report=False)
            assert len(str(told.value).splitlines()) == 1
        finally:
            worker.kill()
            worker.wait()


# -- designs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("sampling", ["latin-hypercube", "sobol", "random", "saltelli"])
def test_a_design_is_that_of_its_seed(sampling: Any) -> None:
    factors = [
        Factor("a", drawn=distribution("uniform", (1, 3), None)),
        Factor("b", drawn=distribution("normal", (0, 2), None)),
    ]
    one, again, other = (columns_of(factors, 64, sampling, seed) for seed in (1, 1, 2))
    assert one == again != other
    assert 1 <= min(one["a"]) < max(one["a"]) <= 3


def test_a_latin_hypercube_has_one_value_in_each_part() -> None:
    (values,) = columns_of(
        [Factor("a", drawn=distribution("uniform", (0, 10), None))], 10, "latin-hypercube", 3
    ).values()
    assert sorted(int(v) for v in values) == list(range(10))


def test_each_row_that_is_drawn_goes_with_every_listed_value_and_seeds_are_counted_on() -> None:
    factors = [
        Factor("a", drawn=distribution("uniform", (0, 1), None)),
        Factor("b", values=[1, 2]),
        Factor("c", values="xyz"),
        Factor("seed", first=7),
    ]
    columns = columns_of(factors, 4, "random", 1)
    assert len(columns["a"]) == 4 * 2 * 3
    assert len(set(zip(*(columns[n] for n in "abc"), strict=True))) == 24
    assert columns["seed"] == list(range(7, 31))


def test_a_normal_distribution_is_cut_where_it_is_told_to() -> None:
    values = distribution("normal", (0, 1), (-0.5, 2))(np.linspace(0.001, 0.999, 99))
    assert -0.5 < values.min() < -0.4
    assert 1.5 < values.max() < 2


# -- statistics --------------------------------------------------------------------------------------


def test_the_interval_of_a_share_is_wilsons() -> None:
    # 8 of 10, by the formula: (p + z²/2n ± z·√(p(1 − p)/n + z²/4n²))/(1 + z²/n), z = 1.96
    interval = share_interval(8, 10)
    assert interval == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert share_interval(0, 0) == (0.0, 1.0)


@pytest.mark.parametrize("saltelli", [True, False])
def test_a_sensitivity_names_what_an_outcome_depends_on(saltelli: bool) -> None:
    uniform = distribution("uniform", (0, 1), None)
    factors = [Factor(name, drawn=uniform) for name in ("strong", "weak", "idle")]
    columns = columns_of(factors, 640, "saltelli" if saltelli else "latin-hypercube", 4)
    y = np.array(columns["strong"]) + 0.5 * np.array(columns["weak"])
    found = sensitivity("y", y, columns, saltelli=saltelli, seed=1)
    assert found is not None
    assert found.factors == ("strong", "weak", "idle")
    # of a sum the shares of the variance are 1 : 0.25 : 0; within what 640 runs can tell
    assert [first for first, _ in found.first] == pytest.approx([0.8, 0.2, 0.0], abs=0.1)
    assert bool(found.total) is saltelli


def test_two_entries_that_lead_to_one_value_are_a_fault_that_names_both_lines(tanks: Callable[..., Path]) -> None:
    told = faults_of(
        tanks(
            "scenario: tanks.yaml\n"
            "set: {components.tank.start.area: 2, seed: 3, duration: 1}\n"
            "vary:\n"
            "  tank.area: {values: [1, 2]}\n"
            "  components.tank.start.area: {values: [3]}\n"
            "  connections.1.noise.variance: {uniform: [1.0e-6, 2.0e-6]}\n"
            "  connections.1.noise: {values: [off]}\n"
            "  connections.0.factor: {values: [1, 2]}\n"
            "  next.area: {values: [1, 2]}\n"
            "  seed: {count: 2}\n"
        )
    )
    twice = [t for t in told if "both set" in t or "both give" in t]
    assert sorted((t.split(" ")[0], t.split(" line ")[1][0]) for t in twice) == [
        ("2:7", "4"), ("2:7", "5"), ("5:3", "4"), ("7:3", "6")
    ]  # fmt: skip
    assert any('start.area and "tank.area" of line 4 both set components.tank.start.area' in t for t in twice)


def test_the_whole_may_be_set_where_a_part_varies_and_not_the_part_before_the_whole(tanks: Callable[..., Path]) -> None:
    whole = "components.tank.start: {area: 2, level_start: 1}"
    vary = "vary: {tank.area: {values: [1, 2]}}\n"
    study = read_sweep(tanks(f"scenario: tanks.yaml\nset: {{{whole}}}\n{vary}"))
    blocks = {stage.component.name: stage.component for stage in study.system.stages}
    assert blocks["tank"].start_values["level_start"] == 1.0  # type: ignore[attr-defined]
    (told,) = faults_of(
        tanks(
            f"scenario: tanks.yaml\nset: {{components.next.start.area: 3, components.next.start: {{area: 2}}}}\n{vary}"
        )
    )
    assert told.startswith("2:")
    assert "the later entry replaces the earlier one; set the whole first" in told


def test_the_least_that_is_drawn_of_a_path_is_tried_before_anything_runs(craft: Path) -> None:
    sweep_file = craft.parent / "sweep.yaml"
    sweep_file.write_text(
        "scenario: craft.yaml\nruns: 100\nvary:\n  connections.0.noise.variance: {normal: [1, 0.4]}\n"
    )
    (told,) = faults_of(sweep_file)
    assert told.startswith("4:42 connections.0.noise.variance would be -")
    assert told.endswith("cut it by within: [low, high]")


# -- what is refused ---------------------------------------------------------------------------------


def test_every_fault_of_a_sweep_is_told_at_once_with_its_place(tanks: Callable[..., Path]) -> None:
    path = tanks(
        "scenario: tanks.yaml\n"
        "signals: [tank.levl]\n"
        "vary:\n"
        "  tank.are: {uniform: [1, 2]}\n"
        "  tank.area: {uniform: [2, 1]}\n"
        "  next.area: {normal: [1, 0]}\n"
        "  tank.leak.rate: {uniform: [0, 3]}\n"
        "  tank.level: {values: [1]}\n"
        "  tank.inflow: {values: [1]}\n"
        "  source.inflow: {values: [1]}\n"
        "  nxt.area: {values: [1]}\n"
        "  duration: {values: [10]}\n"
        "  step: {values: [0.5, 0.3]}\n"
        "  seed: {values: [0.5]}\n"
        "  next.leak.rate: {values: [1], count: 3}\n"
    )
    told = faults_of(path)
    expected = [
        (2, "did you mean \"tank.level\""), (4, 'no variable "are"; did you mean "area"'), (5, "lower end first"),
        (6, "standard deviation of 0"), (7, "lies in [0, 1]"), (8, "is an output"), (9, "is connected"),
        (10, "is no FMU"), (11, 'is "nxt"'), (12, "one for all runs"), (13, "whole divisor"), (14, "whole numbers"),
        (15, "give one of"),
    ]  # fmt: skip
    for line, words in expected:
        assert any(t.startswith(f"{line}:") and words in t for t in told), (line, words, told)


@pytest.mark.parametrize(
    ("vary", "place"),
    [
        ("runs: 1000000000\nvary: {tank.area: {uniform: [1, 2]}}", "2:7"),
        ("vary: {tank.area: {grid: {from: 1, to: 2, count: 1000000000}}}", "2:8"),
        ("vary: {seed: {count: 1000000000}}", "2:8"),
        ("runs: 1000000000\nvary: {seed: {each: 1}}", "2:7"),
    ],
)
def test_a_sweep_of_a_thousand_million_runs_is_refused_before_it_is_made(
    tanks: Callable[..., Path], vary: str, place: str
) -> None:
    (told,) = faults_of(tanks(f"scenario: tanks.yaml\n{vary}\n"))
    assert told.startswith(f"{place} 1e+09 runs are more than the 1,000,000")


def test_what_is_drawn_beyond_the_bounds_of_its_variable_is_refused_with_the_cure(tanks: Callable[..., Path]) -> None:
    (told,) = faults_of(tanks("scenario: tanks.yaml\nruns: 50\nvary: {tank.area: {normal: [1, 1]}}\n"))
    assert told.startswith("3:28 ")
    assert "within: [low, high]" in told


def test_a_dask_address_that_does_not_answer_is_told_before_anything_runs(
    tanks: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("cosim.sweeps.workers.ANSWER", 0.2)
    path = tanks(VARY + "dask: tcp://127.0.0.1:9\n")
    with pytest.raises(InputError, match=r"sweep.yaml:10:7: no dask scheduler answers at tcp://127.0.0.1:9"):
        sweep(path, path.parent / "out", in_process=True)
    assert not list((path.parent / "out").glob("*"))


def test_faults_of_the_scenario_are_told_at_their_own_place(tanks: Callable[..., Path]) -> None:
    path = tanks(VARY, "noize: on\n")
    with pytest.raises(InputError, match=r"tanks.yaml:16:1: unknown key \"noize\""):
        read_sweep(path)


def test_a_scenario_is_no_sweep_and_the_command_for_it_is_named(tanks: Callable[..., Path]) -> None:
    path = tanks()
    with pytest.raises(InputError, match=r"is a scenario, not a sweep.*cosim run"):
        read_sweep(path.parent / "tanks.yaml")


# -- the page ----------------------------------------------------------------------------------------


def test_the_page_has_criteria_bands_sensitivities_and_the_check(tanks: Callable[..., Path]) -> None:
    path = tanks()
    study = sweep(path, path.parent / "out", in_process=True)
    page = (study.folder / "report.html").read_text()
    assert "built-in" not in page
    criterion = study.record["criteria"][0]
    for words in (f"{criterion['met']} of 80", "PAWN", "tank.area", "20 random runs repeated"):
        assert words in page
    record = json.loads((study.folder / "sweep.json").read_text())
    assert record["check"]["apart"] <= EQUAL
    assert record["runs"] == 80


def test_the_page_of_a_sweep_opens_with_its_answer_and_links_to_runs_that_fail(tanks: Callable[..., Path]) -> None:
    path = tanks()
    study = sweep(path, path.parent / "out", in_process=True)
    table, _ = read_table(study.folder / TABLE)
    met = np.all([table.column(f"{c['name']} met").to_pylist() for c in study.record["criteria"]], axis=0)
    assert study.record["met_all"] == int(met.sum())
    page = html.unescape((study.folder / "report.html").read_text())
    opening = page[page.index("<h1>") : page.index("<section")]
    assert f"{study.record['met_all']} of 80 runs" in opening
    assert study.sentences[0] in opening
    linked = [int(k) for k in re.findall(r'href="#run-(\d+)"', opening)]
    assert linked
    assert all(not met[k] and f'id="run-{k}"' in page for k in linked)
    assert page.count('class="share"') >= len(study.record["criteria"])
    assert re.search(r"aria-label=\"peak of next.level over (tank|next)\.", page)  # a scatter plot


def test_the_command_beside_a_run_of_a_sweep_repeats_it(tanks: Callable[..., Path]) -> None:
    path = tanks(VARY.replace("runs: 40", "runs: 5"))
    study = sweep(path, path.parent / "out", in_process=True, report=False)
    table, _ = read_table(study.folder / TABLE)
    words = shlex.split(repeat_command(study.sweep, 7))
    options = [*words[2:], "--out", str(path.parent / "again"), "--no-report"]
    done = CliRunner().invoke(app, ["run", *options])
    assert done.exit_code in (0, 5), done.output
    (criterion, *_) = json.loads((path.parent / "again" / "manifest.json").read_text())["criteria"]
    assert criterion["value"] == pytest.approx(table.column("peak of next.level").to_pylist()[7], rel=1e-12)


def test_of_few_runs_the_page_says_that_sensitivities_need_more(tanks: Callable[..., Path]) -> None:
    path = tanks(VARY.replace("runs: 40", "runs: 5"))
    study = sweep(path, path.parent / "out", in_process=True)
    page = (study.folder / "report.html").read_text()
    assert "Too few runs for sensitivities: 10 completed, 50 are needed." in page


@pytest.mark.skipif(os.name == "nt", reason="links and pipes of POSIX")
@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_a_database_that_is_no_file_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "runs.sqlite"
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to(tmp_path / "elsewhere.sqlite")
    with pytest.raises(InputError, match=r"runs\.sqlite: is no file of a sweep"):
        Database(tmp_path, "key")
    assert not (tmp_path / "elsewhere.sqlite").exists()


@pytest.mark.skipif(os.name == "nt", reason="no limits of files")
def test_a_sweep_on_a_full_disk_keeps_its_runs_and_goes_on_when_there_is_room(
    tanks: Callable[..., Path], tmp_path: Path
) -> None:
    vary = "runs: 1100\nsignals: [tank.level]\nsamples: 51\nvary: {tank.level_start: {normal: [2, 0.2]}}\n"
    path, out = tanks(f"scenario: tanks.yaml\n{vary}"), tmp_path / "out"
    with full_disk(10_000), pytest.raises(OSError, match="space"):  # before the first run
        sweep(path, out, in_process=True, report=False)
    with full_disk(500_000), pytest.raises(SweepStopped) as stopped:
        sweep(path, out, in_process=True, report=False, resume=True)
    assert stopped.value.exit_code == 4
    with Database(out, read_sweep(path).key) as base:
        kept = len(base.numbers())
    assert 0 < kept < 1100
    swept = sweep(path, out, in_process=True, report=False, resume=True)
    assert (swept.made, swept.record["runs"], swept.record["failed"]) == (1100 - kept, 1100, 0)
