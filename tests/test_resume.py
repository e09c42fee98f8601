"""A stopped run goes on to the bytes of an uninterrupted one, and a finished run is extended."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import cosim
from cosim.core.arrays import Array
from cosim.core.errors import CosimError, InputError, Interrupted, SimulationError
from cosim.core.messages import Note
from cosim.files.state_file import pack, unpack
from cosim.master.observer import ObservedRun, Observer
from cosim.simulation.workflow import run
from tests.conftest import ROOT
from tests.instants import CONSTANT, instants_fmu
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
    """Compare rows and manifest, apart from times."""
    assert (one / "results.csv").read_bytes() == (other / "results.csv").read_bytes()
    manifests = [json.loads((folder / "manifest.json").read_text()) for folder in (one, other)]
    for manifest in manifests:
        del manifest["timings"]
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


@pytest.fixture(scope="module")
def in_python(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    return made(tmp_path_factory.mktemp("python"), "Python")


@pytest.fixture(params=["in_c", "in_python"])
def walk(request: pytest.FixtureRequest) -> Walk:
    loaded: Walk = request.getfixturevalue(request.param)
    return loaded


def test_a_run_stopped_from_the_keyboard_goes_on_to_the_same_bytes(walk: Walk, tmp_path: Path) -> None:
    _, whole, part = walk
    said: list[str] = []
    again = shutil.copytree(part, tmp_path / "again")
    rows = (again / "results.csv").read_bytes()
    assert (whole / "results.csv").read_bytes().startswith(rows)
    run(again, resume=True, report=False, tell=said.append)
    check_equal(again, whole)
    assert "saving" not in said[0]
    assert "other" in said[0]
    assert sorted(path.name for path in again.iterdir()) == ["manifest.json", "results.csv"]


def test_delays_and_dropouts_go_on_from_their_memory(tmp_path: Path) -> None:
    scenario, settings = walker_scenario(tmp_path, pause=PAUSE), [f"components.other.fmu={tmp_path}/saving.fmu"]
    whole = run(scenario, tmp_path / "whole", settings, report=False).folder
    part, said = stopped(scenario, tmp_path / "part", settings), list[str]()
    run(part, resume=True, report=False, tell=said.append)
    assert not any("again" in text for text in said)
    check_equal(part, whole)


def test_a_run_without_a_checkpoint_makes_all_steps_again(walk: Walk, tmp_path: Path) -> None:
    _, whole, part = walk
    again = shutil.copytree(part, tmp_path / "again")
    shutil.rmtree(again / "checkpoint")
    cosim.run(again, resume=True, report=False, in_process=True)
    assert (again / "results.csv").read_bytes() == (whole / "results.csv").read_bytes()


def test_a_finished_run_is_extended_with_and_without_its_last_state(walk: Walk, tmp_path: Path) -> None:
    scenario, whole, _ = walk
    extended = shutil.copytree(whole, tmp_path / "extended")
    record = run(extended, until=1.3, report=False).manifest["scenario"]
    settings = ["duration=1.3"]
    if "decay" in record["components"]:  # by model exchange: the longest step of its solver depends on the end
        before = json.loads((whole / "manifest.json").read_text())["scenario"]["duration"]
        longest = record["components"]["decay"]["solver_step"]
        assert longest == pytest.approx(before / 50, rel=1e-12)
        settings.append(f"components.decay.solver_step={longest!r}")
    longer = run(scenario, tmp_path / "longer", settings, report=False).folder
    check_equal(extended, longer)
    kept = run(scenario, tmp_path / "kept", ["checkpoint=10 min"], report=False).folder
    assert sorted(path.name for path in (kept / "checkpoint").iterdir()) == ["run.json", "state"]
    said: list[str] = []
    run(kept, until=1.3, report=False, tell=said.append)
    assert (kept / "results.csv").read_bytes() == (longer / "results.csv").read_bytes()
    assert "saving" not in said[0]


@pytest.mark.thorough
def test_a_component_in_its_own_process_goes_on(tmp_path: Path) -> None:
    scenario = walker_scenario(tmp_path, pause=PAUSE)
    own = ["components.saving.process=own", "components.other.process=own"]
    whole = run(scenario, tmp_path / "whole", own, report=False).folder
    part = stopped(scenario, tmp_path / "part", own)
    run(part, resume=True, report=False)
    check_equal(part, whole)


@pytest.mark.thorough  # runs stopped again and again go on above; rows of killed ones stay: test_row_stops
def test_runs_killed_by_the_system_go_on_to_the_same_bytes() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.kills", "1"], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    counts = json.loads(done.stdout)
    assert (counts["kills"], counts["wrong"]) == (1, 0)


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


def bound_scenario(folder: Path, version: str) -> Path:
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
    run(short, until=0.7, report=False, tell=told.append)
    run(short, until=0.8, report=False, tell=told.append)
    check_equal(short, longer)
    assert [*map(type, told)] == [Note] * 4
    assert all("bound" in text and "free" not in text for text in told)


@pytest.mark.parametrize("checkpoint", ["10 min", "null"])
def test_a_longer_run_that_fails_keeps_the_rows_of_the_finished_one(checkpoint: str, tmp_path: Path) -> None:
    scenario = bound_scenario(tmp_path, "2")
    settings = ["components.free.start.limit=0.6", f"checkpoint={checkpoint}"]
    folder = run(scenario, tmp_path / "out", settings).folder
    before = (folder / "results.csv").read_bytes()
    with pytest.raises(SimulationError, match=r"free at t = 0\.6 s") as failed:
        run(folder, until=0.8, report=False)
    assert failed.value.left == folder
    rows = (folder / "results.csv").read_bytes()
    assert rows.startswith(before)
    assert len(rows.splitlines()) == 62
    assert json.loads((folder / "manifest.json").read_text())["status"].startswith("failed: free")
    with pytest.raises(SimulationError):
        run(folder, until=0.7, report=False)  # without a new row
    assert (folder / "results.csv").read_bytes() == rows


# -- bad input ------------------------------------------------------------------------------------


def edit(name: str, change: Callable[[bytes], bytes]) -> Callable[[Path], Any]:
    """Return a function that changes a file of a run."""
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


def record(**keys: Any) -> Callable[[Path], Any]:
    """Return a function that changes keys of the record of a stopped run."""
    return edit("checkpoint/run.json", lambda content: json.dumps({**json.loads(content), **keys}).encode())


def changed_fmu(folder: Path) -> None:
    (other := folder.parent / "elsewhere.fmu").write_bytes(b"another")
    scenario = json.loads((folder / "checkpoint" / "run.json").read_text())["scenario"]
    scenario["components"]["other"]["fmu"] = str(other)
    record(scenario=scenario)(folder)


def removed_all(folder: Path) -> None:
    for path in [*folder.rglob("*.*"), folder / "checkpoint" / "state"]:
        path.unlink()


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "changed version": record(cosim_version="0.1"),
    "other format": edit("checkpoint/state", lambda content: pack({**unpack(content), "format": 99})),
    "half-written state": edit("checkpoint/state", lambda content: content[:-100]),
    "changed row": edit("results.csv", lambda content: content.replace(b"\n0.05,", b"\n0.05,7", 1)),
    "changed FMU": changed_fmu,
    "removed rows": lambda folder: (folder / "results.csv").unlink(),
    "cut rows, as of a killed run": lambda folder: (folder / "checkpoint" / "rows").write_bytes(bytes(20)),
    "damaged record": edit("checkpoint/run.json", lambda content: content[:-100]),
    "edited record": record(files=[]),
    "removed files": removed_all,
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("options", [{"resume": True}, {"until": 2.0}])
def test_a_folder_that_does_not_belong_together_is_refused_and_left_alone(
    in_c: Walk, tmp_path: Path, damage: str, options: dict[str, Any]
) -> None:
    part = shutil.copytree(in_c[2], tmp_path / "part")
    DAMAGES[damage](part)
    before = {path: path.read_bytes() for path in part.rglob("*") if path.is_file()}
    with pytest.raises(InputError) as refused:
        run(part, report=False, **options)
    assert refused.value.exit_code == 2
    assert before == {path: path.read_bytes() for path in part.rglob("*") if path.is_file()}


@pytest.mark.parametrize("options", [{"resume": True}, {"until": 1.0}, {"until": 0.5}])
def test_a_finished_run_has_nothing_to_resume(in_c: Walk, options: dict[str, Any]) -> None:
    with pytest.raises(InputError) as refused:
        run(in_c[1], report=False, **options)
    assert refused.value.exit_code == 2


def test_an_end_between_two_communication_points_is_refused(in_c: Walk) -> None:
    for folder, end, ends in ((in_c[1], 1.0049, r"give 1\.01 s"), (in_c[2], 1.0049, r"give 1 s or 1\.01 s")):
        with pytest.raises(InputError, match=rf"--until 1\.0049 s .* {ends}$") as refused:
            run(folder, until=end, report=False)
        assert refused.value.exit_code == 2


def test_a_run_that_goes_on_takes_no_other_settings(in_c: Walk, tmp_path: Path) -> None:
    for options in ({"out": tmp_path / "other"}, {"seed": 3}, {"set": {"noise": False}}):
        with pytest.raises(InputError) as refused:
            cosim.run(in_c[1], until=2.0, **options)  # type: ignore[arg-type]
        assert refused.value.exit_code == 2
    with pytest.raises(InputError):
        run(tmp_path / "none", resume=True)


def test_a_state_that_an_fmu_does_not_restore_ends_the_run_with_its_rows_kept(tmp_path: Path) -> None:
    part = stopped(bound_scenario(tmp_path, "2"), tmp_path / "part", ["components.free.start.pause=3000"], after=0.2)
    state = part / "checkpoint" / "state"
    content = unpack(state.read_bytes())
    saved = bytearray(content["components"]["free"]["state"])
    saved[8] ^= 1  # the lowest bit of the output
    content["components"]["free"]["state"] = bytes(saved)
    state.write_bytes(pack(content))
    rows = (part / "results.csv").read_bytes()
    with pytest.raises(SimulationError) as failed:
        run(part, resume=True, report=False)
    assert (failed.value.component, failed.value.exit_code) == ("free", 4)
    assert (part / "results.csv").read_bytes() == rows


def test_an_fmu_that_does_not_repeat_itself_is_found(in_c: Walk, tmp_path: Path) -> None:
    part = shutil.copytree(in_c[2], tmp_path / "part")
    shutil.rmtree(part / "checkpoint")
    rows = (part / "results.csv").read_text().splitlines()
    column = rows[0].split(",").index("other.y")
    cells = rows[9].split(",")
    rows[9] = ",".join([*cells[:column], "0.5", *cells[column + 1 :]])
    (part / "results.csv").write_text("\n".join(rows) + "\n")
    with pytest.raises(SimulationError) as failed:
        run(part, resume=True, report=False)
    assert failed.value.component == "other"
    assert failed.value.time == pytest.approx(0.08)


def test_a_new_run_in_the_folder_removes_the_checkpoint_of_another(in_c: Walk, tmp_path: Path) -> None:
    part = shutil.copytree(in_c[2], tmp_path / "part")
    changes = ["duration=0.1", "components.saving.start.pause=0", "events=[]", "faults=[]"]
    run(in_c[0], part, changes, report=False, force=True)
    assert not (part / "checkpoint").exists()
    with pytest.raises(CosimError, match="finished"):
        run(part, resume=True)


# -- changes while a run is stepped, and event mode -----------------------------------------------


class Change(Stop):
    """Sets a parameter once, and stops a run later."""

    def begin(self, run: ObservedRun) -> None:
        self.control = run.control

    def rows(self, time: Array, values: Array) -> None:
        if self.control is not None:
            self.control.set({"saving.gain": 3.0, "other.gain": 2.0})
            self.control = None
        super().rows(time, values)


def test_changes_by_an_observer_are_in_the_checkpoint(walk: Walk, tmp_path: Path) -> None:
    with pytest.raises(Interrupted):
        run(walk[0], tmp_path / "part", observers=[Change(0.4)], report=False)
    assert unpack((tmp_path / "part" / "checkpoint" / "state").read_bytes())["changes"]
    gone_on = run(tmp_path / "part", resume=True, report=False)
    assert len(gone_on.manifest["changes"]) == 1
    again = run(tmp_path / "part" / "manifest.json", tmp_path / "again", report=False)
    assert (
        (again.folder / "results.csv").read_bytes()
        == (gone_on.folder / "results.csv").read_bytes()
        != (walk[1] / "results.csv").read_bytes()
    )


def test_a_run_with_event_mode_is_made_again_and_compared(tmp_path: Path) -> None:
    instants_fmu(tmp_path / "plain.fmu")
    instants_fmu(tmp_path / "clocked.fmu", CONSTANT)
    components = {"a": {"fmu": "plain.fmu", "event_mode": True, "start": {"u": 3.0}}, "b": {"fmu": "clocked.fmu"}}
    content = {"name": "s", "duration": 4, "step": 0.001, "components": components}
    scenario = tmp_path / "s.json"
    scenario.write_text(json.dumps({**content, "connections": [{"from": "a.x", "to": "b.w"}]}))
    whole = run(scenario, tmp_path / "whole", report=False)
    assert whole.results.loop == "Python: event mode"
    part = stopped(scenario, tmp_path / "part", ["checkpoint=20 ms"], after=0.1)
    assert len((part / "results.csv").read_text().splitlines()) < 4002
    run(part, resume=True, report=False)
    assert (part / "results.csv").read_bytes() == (whole.folder / "results.csv").read_bytes()
    longer = run(scenario, tmp_path / "longer", ["duration=5"], report=False)
    run(part, until=5.0, report=False)
    assert (part / "results.csv").read_bytes() == (longer.folder / "results.csv").read_bytes()
