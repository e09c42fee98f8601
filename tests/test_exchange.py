"""Model exchange where calls fail, events crowd and times are large: told in a line, the rows before kept."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.blocks import model_exchange, solvers
from cosim.fmi.native.compiler import NoCompiler
from cosim.isolation import worker
from cosim.isolation.process import Worker
from cosim.isolation.rows import ADVANCE
from cosim.logs.log import Log
from cosim.master.master import StoppedRun, simulate
from cosim.residuals.drive import Drive
from cosim.residuals.workflow import replay
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.workflow import run
from cosim.storage.results import Results
from cosim.system.system import build_system
from tests.blind.fmu_build import build
from tests.decay import DEEDS, decay_fmu


def decayed(folder: Path, deed: str, solver: str = "cvode", **more: Any) -> Results:
    component = {"fmu": str(decay_fmu(folder / "decay.fmu")), "start": {"deed": DEEDS.index(deed)}, "solver": solver}
    path = folder / "decay.yaml"
    path.write_text(json.dumps({"name": "decay", "duration": 1, "step": 0.1, "components": {"a": component}} | more))
    file = ScenarioFile(path)
    return simulate(build_system(file), file.scenario.steps, file.scenario.step)


def without_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_function() -> Any:
        raise NoCompiler("no compiler")

    monkeypatch.setattr(solvers, "rates_function", no_function)


@pytest.mark.parametrize("solver", ["cvode", "cvode in Python", "solve_ivp"])
@pytest.mark.parametrize(
    ("deed", "words", "rows"),
    [
        ("error of step", "fmi2CompletedIntegratorStep returned Error", 5),
        ("error of update", "fmi2NewDiscreteStates returned Error", 5),
        ("error of derivative", "fmi2GetDerivatives returned Error", 5),
        ("discarded", "fmi2GetDerivatives returned Discard", 5),
        ("no number", r"the derivative der\(x\) is nan", 5),
        ("no bound", "whether a state grows without bound|a derivative jumps, or has no bound", 3),
        ("always due", "gives t = -1 s as the time of its next event, which is not in the future", 0),
    ],
)
def test_a_call_of_model_exchange_that_fails_is_told_and_the_rows_before_are_kept(
    tmp_path: Path,
    solver: str,
    deed: str,
    words: str,
    rows: int,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if solver == "cvode in Python":
        without_compiler(monkeypatch)
    with pytest.raises(StoppedRun, match=rf"^a at t = .* s: .*({words})") as stopped:
        decayed(tmp_path, deed, solver.split()[0])
    assert stopped.value.error.exit_code == 4
    assert len(stopped.value.results.time) == rows
    assert capfd.readouterr().err == ""  # nor does CVODE print what it thinks of it


@pytest.mark.parametrize("version", [2, 3])
def test_rates_from_c_and_from_python_give_the_same_bytes(
    tmp_path: Path, version: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    fmu = build(tmp_path / "drive.fmu", "drive", version)
    time = 0.01 * np.arange(101)
    units = {"torque": "N.m"}
    log = Log(tmp_path / "log.csv", time, {"torque": np.sin(7.0 * time)}, {}, units, 0.01, units, {})

    def run_drive() -> Array:
        with Drive(log, fmu) as drive:
            return drive.run(0, 100, {})

    compiled = run_drive()
    without_compiler(monkeypatch)
    assert np.array_equal(compiled, run_drive())
    assert np.ptp(compiled[:, 0]) > 0.01


@pytest.mark.parametrize("solver", ["cvode", "solve_ivp"])
@pytest.mark.parametrize(("start", "step"), [(0.0, 0.1), (1e6, 1e-3), (1.6e9, 0.1)])
def test_a_decay_is_the_same_whenever_it_starts(tmp_path: Path, solver: str, start: float, step: float) -> None:
    results = decayed(tmp_path, "nothing", solver, start_time=start, step=step, duration=10 * step, tolerance=1e-6)
    # 1e-6 a step of the solver, and times that are told apart by 2e-7 s at 1.6e9 s
    assert results["a.y"] == pytest.approx(np.exp(-(results.time - start)), abs=1e-5)


def test_a_step_that_no_double_tells_apart_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        StoppedRun, match=r"a step of 9.54e-07 s is too short at this time: doubles are 2.4e-07 s apart"
    ):
        decayed(tmp_path, "nothing", start_time=1.6e9, step=1e-6, duration=1e-5)


def test_events_that_follow_one_another_at_once_are_chattering(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model_exchange, "MOST_EVENTS", 20)
    with pytest.raises(StoppedRun, match=r"a at t = 0\.22\d* s: it chatters: 20 events within 1e-07 s"):
        decayed(tmp_path, "chatters", "solve_ivp")


def test_an_event_that_is_due_at_the_start_is_handled_there(tmp_path: Path) -> None:
    events = decayed(tmp_path, "due at once")["a.events"]
    # two updates at 0 s, one at 0.15 s, and one where y crosses 0.8
    assert events.tolist() == [2, 2, 3, *[4] * 8]


def test_a_log_is_replayed_through_an_fmu_for_model_exchange_alone(tmp_path: Path) -> None:
    time = 0.05 * np.arange(81)
    rows = (f"{t:.2f},{0.5},{0.5 + 1.5 * np.exp(-t):.17g}" for t in time)
    (tmp_path / "log.csv").write_text("\n".join(["time,u,y", *rows, ""]))
    fmu = decay_fmu(tmp_path / "decay.fmu")
    replay(tmp_path / "log.csv", tmp_path / "out", fmu, report=False, in_process=True)
    missed = np.loadtxt(tmp_path / "out" / "residual.csv", delimiter=",", skiprows=1, usecols=1)
    assert missed == pytest.approx(np.zeros(81), abs=1e-4)  # the solver's tolerance is 1e-5 a step


def test_an_error_that_nobody_foresaw_is_told_with_its_call_and_the_rows_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decay_fmu(tmp_path / "decay.fmu")
    path = tmp_path / "decay.yaml"
    path.write_text("{name: d, duration: 1, step: 0.1, components: {a: {fmu: decay.fmu}}}")

    def answered(worker: Worker, *arguments: Any, **more: Any) -> None:
        worker.progress.made[0], worker.progress.doing[0] = 3, ADVANCE
        raise NotSent("call", 3)

    monkeypatch.setattr(Worker, "call", answered)
    with pytest.raises(SimulationError, match=r"a at t = 0\.2 s: fmi2DoStep: NotSent: call: 3 \(--in-process"):
        run(path, tmp_path / "out", report=False)
    assert len((tmp_path / "out" / "results.csv").read_text().splitlines()) == 1 + 3


class NotSent(Exception):
    def __init__(self, call: str, status: int) -> None:
        super().__init__(f"{call}: {status}")


def raise_not_sent() -> None:
    raise NotSent("call", 3)


def test_an_error_that_cannot_be_sent_is_told_in_its_own_words(monkeypatch: pytest.MonkeyPatch) -> None:
    import copyreg
    import pickle

    monkeypatch.delitem(copyreg.dispatch_table, NotSent, raising=False)  # of dask, which makes all errors sendable
    _, error = pickle.loads(worker._answer(pickle.dumps((raise_not_sent, ()))))
    assert str(error) == "NotSent: call: 3"
    assert "raise_not_sent" in error.__notes__[0]
    assert "missing 1 required" not in error.__notes__[0]
