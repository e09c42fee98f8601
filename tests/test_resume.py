"""A stopped run goes on to the bytes of an uninterrupted one, a finished one is extended, a moved one repeated."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import cosim
from cosim.core.arrays import Array
from cosim.core.errors import InputError, Interrupted, SimulationError
from cosim.files.results import read_results
from cosim.files.state_file import pack, unpack
from cosim.master.observer import ObservedRun, Observer
from cosim.simulation.workflow import run
from tests import kills
from tests.instants import CONSTANT, instants_fmu
from tests.test_event_mode import RISES
from tests.test_event_mode import scenario as events_scenario
from tests.test_first_steps import told
from tests.typed import typed_fmu
from tests.walker import walker_fmu, walker_scenario

PAUSE = 3000.0  # wall time of a step [us], so that a run is stopped on its way


class Stop(Observer):
    """Stops a run from the keyboard after some rows."""

    def __init__(self, after: float) -> None:
        self.after = after

    def rows(self, time: Array, values: Array) -> None:
        if time[-1] >= self.after:
            self.after = math.inf  # rows after a stop are delivered too
            raise KeyboardInterrupt


def stopped(scenario: Path, folder: Path, overrides: list[str] | None = None, after: float = 0.3) -> Path:
    """Return the folder of a run that was stopped from the keyboard."""
    with pytest.raises(Interrupted):
        run(scenario, folder, overrides or [], observers=[Stop(after)], report=False)
    return folder


def check_equal(one: Path, other: Path) -> None:
    """Compare rows and manifest, apart from times and from what the command line set."""
    assert (one / "results.csv").read_bytes() == (other / "results.csv").read_bytes()
    manifests = [json.loads((folder / "manifest.json").read_text()) for folder in (one, other)]
    for manifest in manifests:
        for key in ("date", "set", "timings"):
            del manifest[key]
    assert manifests[0] == manifests[1]
    assert [*manifests[0]] == [*manifests[1]]


Walk = tuple[Path, Path, Path]


def made(folder: Path, loop: str) -> Walk:
    """Return a scenario, its uninterrupted run, and a run of it that was stopped."""
    scenario = walker_scenario(folder, python=loop == "Python", pause=PAUSE)
    whole = run(scenario, folder / "whole", report=False)
    assert whole.results.loop.startswith(loop)
    return scenario, folder / "whole", stopped(scenario, folder / "part")


@pytest.fixture(scope="module")
def in_c(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    return made(tmp_path_factory.mktemp("c"), "C")


@pytest.fixture(scope="module", params=["C", "Python"])
def walk(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Walk:
    return made(tmp_path_factory.mktemp("walk"), request.param)


def test_a_run_stopped_from_the_keyboard_goes_on_to_the_same_bytes(walk: Walk, tmp_path: Path) -> None:
    _, whole, part = walk
    said: list[str] = []
    again = shutil.copytree(part, tmp_path / "again")
    assert (whole / "results.csv").read_bytes().startswith((again / "results.csv").read_bytes())
    run(again, resume=True, report=False, tell=said.append)
    check_equal(again, whole)
    assert "saving" not in said[0]
    assert "other" in said[0]
    assert sorted(path.name for path in again.iterdir()) == ["manifest.json", "results.csv"]
    without = shutil.copytree(part, tmp_path / "without")
    shutil.rmtree(without / "checkpoint")  # all steps are made again
    cosim.run(without, resume=True, report=False, in_process=True)
    assert (without / "results.csv").read_bytes() == (whole / "results.csv").read_bytes()


def test_a_finished_run_is_extended_with_and_without_its_last_state(walk: Walk, tmp_path: Path) -> None:
    scenario, whole, _ = walk
    extended = shutil.copytree(whole, tmp_path / "extended")
    components = run(extended, until=1.3, report=False).manifest["scenario"]["components"]
    settings = ["duration=1.3"]
    if "decay" in components:  # by model exchange: the longest step of its solver is that of the run that is extended
        longest = components["decay"]["solver_step"]
        assert longest == pytest.approx(1.0 / 50, rel=1e-12)
        settings.append(f"components.decay.solver_step={longest!r}")
    longer = run(scenario, tmp_path / "longer", settings, report=False).folder
    check_equal(extended, longer)
    kept = run(scenario, tmp_path / "kept", ["checkpoint=10 min"], report=False).folder
    said: list[str] = []
    run(kept, until=1.3, report=False, tell=said.append)
    assert (kept / "results.csv").read_bytes() == (longer / "results.csv").read_bytes()
    assert "saving" not in said[0]


@pytest.mark.thorough  # runs stopped again and again go on above
def test_runs_killed_by_the_system_go_on_to_the_same_bytes() -> None:
    assert kills.main(1) == 0


BOUND = """name: bound
duration: 0.5
step: 0.01
checkpoint: 10 min
record: ["*.kicks"]
components:
  bound: {fmu: bound.fmu, start: {bound: 1}}
  free: {fmu: bound.fmu}
connections: [{from: free.y, to: bound.u}]
"""


def bound_scenario(folder: Path, version: str = "2") -> Path:
    """Return a scenario of two FMUs that save their state, of which one holds the end that it was told."""
    walker_fmu(folder / "bound.fmu", saves=True, version=version)
    path = folder / "bound.yaml"
    path.write_text(BOUND)
    return path


@pytest.mark.parametrize("version", ["2", "3"])
def test_an_fmu_whose_state_holds_the_end_is_stepped_again_in_a_longer_run(version: str, tmp_path: Path) -> None:
    scenario = bound_scenario(tmp_path, version)
    short = run(scenario, tmp_path / "short", report=False).folder
    longer = run(scenario, tmp_path / "longer", ["duration=0.8"], report=False).folder
    told: list[str] = []
    for end in (0.7, 0.8):
        run(short, until=end, report=False, tell=told.append)
    check_equal(short, longer)
    assert len(told) == 4
    assert all("bound" in text and "free" not in text for text in told)


@pytest.mark.parametrize("checkpoint", ["10 min", "null"])
def test_a_longer_run_that_fails_keeps_the_rows_of_the_finished_one(checkpoint: str, tmp_path: Path) -> None:
    settings = ["components.free.start.limit=0.6", f"checkpoint={checkpoint}"]
    folder = run(bound_scenario(tmp_path), tmp_path / "out", settings).folder
    before = (folder / "results.csv").read_bytes()
    for end in (0.8, 0.7):  # the second without a new row
        with pytest.raises(SimulationError, match=r"free at t = 0\.6 s") as failed:
            run(folder, until=end, report=False)
        assert failed.value.left == folder
        rows = (folder / "results.csv").read_bytes()
        assert rows.startswith(before)
        assert len(rows.splitlines()) == 62
        assert json.loads((folder / "manifest.json").read_text())["status"].startswith("failed: free")


# -- bad input ------------------------------------------------------------------------------------


def edit(name: str, change: Callable[[bytes], bytes]) -> Callable[[Path], Any]:
    """Return a function that changes a file of a run."""
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


VERSION = f'"{cosim.__version__}"'.encode()
DAMAGES: dict[str, Callable[[Path], Any]] = {
    "changed version": edit("checkpoint/run.json", lambda content: content.replace(VERSION, b'"0.1"')),
    "half-written state": edit("checkpoint/state", lambda content: content[:-100]),
    "changed row": edit("results.csv", lambda content: content.replace(b"\n0.05,", b"\n0.05,7", 1)),
    "changed FMU": edit("checkpoint/run.json", lambda content: content.replace(b"other.fmu", b"three.fmu")),
    "removed rows": lambda folder: (folder / "results.csv").unlink(),
    "cut rows, as of a killed run": lambda folder: (folder / "checkpoint" / "rows").write_bytes(bytes(20)),
    "damaged record": edit("checkpoint/run.json", lambda content: content[:-100]),
    "removed checkpoint and manifest": lambda folder: [*map(Path.unlink, [*folder.rglob("*.json")])],
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_folder_that_does_not_belong_together_is_refused_and_left_alone(
    in_c: Walk, tmp_path: Path, damage: str
) -> None:
    part = shutil.copytree(in_c[2], tmp_path / "part")
    DAMAGES[damage](part)
    before = {path: path.read_bytes() for path in part.rglob("*") if path.is_file()}
    for options in ({"resume": True}, {"until": 2.0}):
        with pytest.raises(InputError):
            run(part, report=False, **options)
    assert before == {path: path.read_bytes() for path in part.rglob("*") if path.is_file()}


def test_what_cannot_go_on_is_refused(in_c: Walk, tmp_path: Path) -> None:
    _, whole, part = in_c
    other = tmp_path / "other"
    for folder, options in (
        (whole, {"resume": True}),  # it is finished
        (whole, {"until": 1.0}),
        (whole, {"until": 1.0049}),  # between two communication points
        (part, {"until": 1.0049}),
        (whole, {"until": 2.0, "out": other}),
        (whole, {"until": 2.0, "set": {"noise": False}}),
        (other, {"resume": True}),
    ):
        with pytest.raises(InputError) as refused:
            cosim.run(folder, **options)
        assert refused.value.exit_code == 2
    assert not other.exists()


def test_a_state_that_an_fmu_does_not_restore_ends_the_run_with_its_rows_kept(tmp_path: Path) -> None:
    part = stopped(bound_scenario(tmp_path), tmp_path / "part", ["components.free.start.pause=3000"], after=0.2)
    state, rows = part / "checkpoint" / "state", (part / "results.csv").read_bytes()
    content = unpack(state.read_bytes())
    saved = bytearray(content["components"]["free"]["state"])
    saved[8] ^= 1  # the lowest bit of the output
    content["components"]["free"]["state"] = bytes(saved)
    state.write_bytes(pack(content))
    with pytest.raises(SimulationError) as failed:
        run(part, resume=True, report=False)
    assert (failed.value.component, failed.value.exit_code) == ("free", 4)
    assert (part / "results.csv").read_bytes() == rows


def test_an_fmu_that_does_not_repeat_itself_is_found(in_c: Walk, tmp_path: Path) -> None:
    part = shutil.copytree(in_c[2], tmp_path / "part")
    shutil.rmtree(part / "checkpoint")
    results = read_results(part / "results.csv")
    results.values[8, results.columns.index("other.y")] = 0.5
    results.write(part / "results.csv")
    with pytest.raises(SimulationError) as failed:
        run(part, resume=True, report=False)
    assert failed.value.component == "other"
    assert failed.value.time == pytest.approx(0.08)


# -- changes while a run is stepped, and event mode -----------------------------------------------


class Change(Stop):
    """Sets a parameter once, and stops a run later."""

    def begin(self, run: ObservedRun) -> None:
        assert run.control is not None
        run.control.set({"saving.gain": 3.0, "other.gain": 2.0})


def test_changes_by_an_observer_are_in_the_checkpoint(walk: Walk, tmp_path: Path) -> None:
    part = tmp_path / "part"
    with pytest.raises(Interrupted):
        run(walk[0], part, observers=[Change(0.4)], report=False)
    gone_on = run(part, resume=True, report=False)
    assert len(gone_on.manifest["changes"]) == 1
    again = run(part / "manifest.json", tmp_path / "again", report=False).folder
    assert (again / "results.csv").read_bytes() == (part / "results.csv").read_bytes()
    assert (part / "results.csv").read_bytes() != (walk[1] / "results.csv").read_bytes()


def test_a_run_with_event_mode_is_made_again_and_compared(tmp_path: Path) -> None:
    instants_fmu(tmp_path / "plain.fmu")
    instants_fmu(tmp_path / "clocked.fmu", CONSTANT)
    scenario = events_scenario(
        tmp_path, {"a": RISES, "b": {"fmu": "clocked.fmu"}}, ["a.x → b.w"], duration=4, step=0.001
    ).path
    part = stopped(scenario, tmp_path / "part", ["checkpoint=20 ms"], after=0.1)
    assert len((part / "results.csv").read_text().splitlines()) < 4002
    run(part, resume=True, report=False)
    run(part, until=5.0, report=False)
    longer = run(scenario, tmp_path / "longer", ["duration=5"], report=False)
    assert longer.results.loop == "Python: event mode"
    assert (part / "results.csv").read_bytes() == (longer.folder / "results.csv").read_bytes()


# -- a run repeated from its manifest, elsewhere than where it was made ----------------------------

QUICK = ("--stop", "0.2", "--step", "0.1", "--no-report", "--in-process")
OTHER = "time,r_in\n0,9\n0.1,9\n0.2,9\n"


@pytest.fixture
def moved(tmp_path: Path) -> Path:
    """A run, played from a recording, that was moved with its FMU and its recording beside its manifest."""
    old, new = tmp_path / "old", tmp_path / "new"
    old.mkdir()
    fmu, log = typed_fmu(old), old / "log.csv"
    log.write_text("time,r_in\n0,1\n0.1,2\n0.2,3\n")
    told("simulate", fmu, "--input", log, *QUICK, "--out", old / "run")
    shutil.copytree(old / "run", new)
    shutil.copy(fmu, new)
    shutil.copy(log, new)
    return new


@pytest.mark.parametrize("gone", [True, False])
def test_a_manifest_takes_files_from_beside_it_before_others_at_their_old_place(
    moved: Path, tmp_path: Path, gone: bool
) -> None:
    old = tmp_path / "old"
    if gone:
        shutil.rmtree(old)
    else:
        (old / "log.csv").write_text(OTHER)
    told("run", moved / "manifest.json", "--no-report", "--in-process", "--out", tmp_path / "again")
    assert (tmp_path / "again" / "results.csv").read_bytes() == (moved / "results.csv").read_bytes()
    assert told("check", moved / "manifest.json")


def test_a_file_with_another_content_or_that_is_nowhere_is_refused_by_name(moved: Path, tmp_path: Path) -> None:
    again = ("run", moved / "manifest.json", "--out", tmp_path / "again")
    shutil.rmtree(tmp_path / "old")
    log = (moved / "log.csv").read_text()
    (moved / "log.csv").write_text(OTHER)
    assert "new/log.csv" in told(*again, code=2)
    (moved / "log.csv").write_text(log)
    (moved / "typed.fmu").unlink()
    assert "typed.fmu; put it there, or into the folder of manifest.json" in told(*again, code=2)
    assert not (tmp_path / "again").exists()
