"""Model exchange with failing calls, dense events and solver failures: a one-line message, earlier rows kept."""

from __future__ import annotations

import gc
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.blocks import solvers
from cosim.core.arrays import Array
from cosim.core.errors import SimulationError
from cosim.files.results import Results
from cosim.fmi.native.compiler import NoCompiler
from cosim.logs.log import Log
from cosim.residuals.drive import Drive
from cosim.simulation.workflow import run
from tests.blind.fmu_build import build
from tests.bounce1 import bounce_fmu
from tests.decay import DEEDS, decay_fmu
from tests.known.couplings import VDP
from tests.known.kit import Model


def alone(folder: Path, fmu: Path, step: float = 0.1, duration: float = 1.0, **more: Any) -> Results:
    """Run one FMU."""
    file = folder / "s.yaml"
    components = {"a": {"fmu": str(fmu)} | more}
    file.write_text(json.dumps({"name": "s", "step": step, "duration": duration, "components": components}))
    return run(file, folder / "out", report=False, in_process=True, force=True).results


def decayed(folder: Path, deed: str, solver: str = "cvode") -> Results:
    return alone(folder, decay_fmu(folder / "decay.fmu"), start={"deed": DEEDS.index(deed)}, solver=solver)


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
        ("no number", r"der\(x\) is nan", 5),
        ("no bound", "bound", 3),
        ("always due", "gives t = -1 s as the time of its next event", 0),
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
    with pytest.raises(SimulationError, match=rf"^a at t = .* s: .*({words})") as stopped:
        decayed(tmp_path, deed, solver.split()[0])
    assert stopped.value.exit_code == 4
    assert len((tmp_path / "out" / "results.csv").read_text().splitlines()) - 1 == rows
    assert capfd.readouterr().err == ""  # nor does CVODE print what it thinks of it


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="no list of open files here")
def test_many_runs_by_cvode_leave_no_file_open(tmp_path: Path) -> None:
    count = []
    for _ in range(2):
        for _ in range(20):
            decayed(tmp_path, DEEDS[0])
        gc.collect()
        count.append(len(os.listdir("/proc/self/fd")))
    assert count[1] <= count[0]


@pytest.mark.parametrize("version", [2, 3])
def test_rates_from_c_and_from_python_give_the_same_bytes(
    tmp_path: Path, version: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    fmu = build(tmp_path / "drive.fmu", "drive", version)
    time, units = 0.01 * np.arange(101), {"torque": "N.m"}
    log = Log(tmp_path / "log.csv", time, {"torque": np.sin(7.0 * time)}, {}, units, 0.01, units, {})

    def run_drive() -> Array:
        with Drive(log, fmu) as drive:
            return drive.run(0, 100, {})

    compiled = run_drive()
    without_compiler(monkeypatch)
    assert np.array_equal(compiled, run_drive())
    assert np.ptp(compiled[:, 0]) > 0.01


def test_an_event_that_is_due_at_the_start_is_handled_there(tmp_path: Path) -> None:
    events = decayed(tmp_path, "due at once")["a.events"]
    # two updates at 0 s, one at 0.15 s, and one where y crosses 0.8
    assert events.tolist() == [2, 2, 3, *[4] * 8]


def test_a_system_that_needs_too_many_steps_is_refused_with_the_cure(tmp_path: Path) -> None:
    fmu, stiff = VDP.fmu(2, "me"), {"start": {"mu": 1000.0}, "tolerance": 1e-7}
    with pytest.raises(SimulationError, match=r"max_steps.*solver: solve_ivp"):
        alone(tmp_path, fmu, 10.0, 1500.0, **stiff)
    with pytest.raises(SimulationError, match=r"solve_ivp.*max_steps"):
        alone(tmp_path, fmu, 10.0, 1500.0, **stiff, solver="solve_ivp", max_steps=3)
    assert len(alone(tmp_path, fmu, 10.0, 1500.0, **stiff, max_steps=3000).time) == 151


@pytest.mark.parametrize("solver", ["cvode", "solve_ivp"])
def test_many_events_within_a_step_are_no_fault(tmp_path: Path, solver: str) -> None:
    """x' = ±1 by a carrier of 200 Hz: 20 state events in each communication step."""
    carrier = "0.5 - cos(2 * M_PI * 200 * time)"
    variables, rates = "x = 0, discrete local high = 0", "x' = high > 0 ? 1 : -1"
    pwm = Model(variables, rates, zeros=(carrier,), event=f"high = {carrier} > 0;")
    results = alone(tmp_path, pwm.fmu(2, "me"), 0.05, 0.1, solver=solver, solver_step=5e-4)
    assert results["a.x"] == pytest.approx([0.0, 0.05 / 3, 0.1 / 3], abs=1e-5)  # high for 2/3 of each period


def test_a_call_of_fmi_1_that_fails_is_told_with_the_words_of_the_fmu(tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match=r"a at t = 0\.(2\d*|3) s: fmi1GetDerivatives returned Error: it has a"):
        alone(tmp_path, bounce_fmu(tmp_path / "bounce.fmu"), start={"fail_at": 0.3})
