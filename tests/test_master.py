"""The master: order, timing, coupling, and what it does when a component fails."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller.loop import Loop
from controller.settings import Settings
from cosim.core.errors import SimulationError
from cosim.files.results import Results
from cosim.files.table import read_columns
from cosim.master.master import simulate
from cosim.model import Stepper
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.workflow import run
from cosim.system.system import build_system
from plant.hovercraft import Hovercraft
from tests.misbehaving import misbehaving_fmu

H = 0.02


def results_of(project: Path, *overrides: str, name: str = "regulate") -> Results:
    file = ScenarioFile(project / "scenarios" / f"{name}.yaml", overrides)
    return simulate(build_system(file), file.scenario.steps, file.scenario.step)


def test_gauss_seidel_equals_plain_functions_in_the_order_plant_noise_controller(project: Path) -> None:
    results = results_of(project)
    # the FMU's display unit takes 12 deg to radians by division, one rounding away from math.radians
    stepper, settings = Stepper(Hovercraft()), Settings(tilt_max=12 / (180 / math.pi))
    moment = stepper.start(0.0, {"x": 1.0, "psi": 1.0})
    loop = Loop(settings, (1.0, 0.0, 1.0, 0.0, 0.0), 0.0, 0.0)
    duty = settings.duty_nominal
    for k in range(len(results.time)):
        if k:
            moment = stepper.step(replace(moment, t=results.time[k - 1].item()), (duty, duty, *loop.command), H)
            loop.step([results[f"controller.{n}"][k].item() for n in ("psi", "psi_dot", "ax")], 0.0, 0.0)
        outputs = stepper.output(moment.t, moment.state, ())
        names = [f"plant.{q.name}" for q in Hovercraft.outputs]
        # the same operations in the same order; 1e-12 leaves room for another build of libm only
        assert [results[n][k] for n in names] == pytest.approx(outputs, rel=1e-12, abs=1e-15)
        assert results["controller.tilt_right"][k] == pytest.approx(loop.command[0], rel=1e-12, abs=1e-15)
        assert results["controller.x_hat"][k] == pytest.approx(loop.estimate[0], rel=1e-12, abs=1e-15)


def test_row_k_holds_the_command_that_acts_from_then_on(project: Path) -> None:
    results = results_of(project)
    for name in ("tilt_right", "tilt_left", "duty_right"):
        assert np.array_equal(results[f"plant.{name}"], results[f"controller.{name}"])
    # u_0 = sat(-K·x̂_0): both tilts at the limit, for x = 1 m outweighs psi = 1 rad
    assert results["controller.tilt_right"][0] == pytest.approx(-np.radians(12))
    assert results["plant.tilt_right_actual"][0] == 0.0
    # 63.2 % of the way after τ; after one step 1 − e^(−Δt/τ) of it, eq 4.29 (RK4 error 1e-9)
    expected = results["plant.tilt_right"][0] * (1 - np.exp(-H / 0.0884))
    assert results["plant.tilt_right_actual"][1] == pytest.approx(expected, rel=1e-6)


def test_jacobi_sees_the_values_of_the_step_before(project: Path) -> None:
    gauss_seidel = results_of(project, "noise=off")
    jacobi = results_of(project, "noise=off", "algorithm=jacobi")
    # the controller's update at row k uses y_k under Gauss-Seidel, y_{k-1} under Jacobi
    loop = Loop(Settings(), (1.0, 0.0, 1.0, 0.0, 0.0), 0.0, 0.0)
    for k in range(1, 200):
        loop.step([jacobi[f"plant.{n}"][k - 1].item() for n in ("psi", "psi_dot", "ax")], 0.0, 0.0)
        assert jacobi["controller.psi_hat"][k] == pytest.approx(loop.estimate[2], rel=1e-12, abs=1e-15)
    difference = np.max(np.abs(gauss_seidel["plant.psi"] - jacobi["plant.psi"]))
    assert 1e-4 < difference < 0.1  # one sample of delay: seen, and small


def test_noise_adds_no_delay_under_either_algorithm(project: Path) -> None:
    for algorithm in ("gauss-seidel", "jacobi"):
        results = results_of(project, f"algorithm={algorithm}", "connections.0.noise={variance: 0, bias: 0.5}")
        assert np.allclose(results["controller.psi"] - results["plant.psi"], 0.5, atol=1e-15)


def test_steps_are_counted_not_summed(project: Path) -> None:
    sample = "components.controller.start.sample_time=0.1"
    results = results_of(project, "step=0.1", "duration=100", "criteria={}", "connections=[]", sample)
    assert len(results.time) == 1001
    assert results.time[-1] == 100.0
    assert results.time[300] == 300 * 0.1


def test_start_time_shifts_the_clock_of_every_component(project: Path) -> None:
    overrides = ["start_time=5", "components.reference.signals.x_ref.changes=[{at: 6, to: 1}]"]
    results = results_of(project, *overrides)
    assert results.time[0] == 5.0
    assert results["reference.x_ref"][np.searchsorted(results.time, 6 - 1e-9)] == 1.0
    assert results["reference.x_ref"][np.searchsorted(results.time, 6 - 1e-9) - 1] == 0.0


def test_without_connections_the_plant_hovers(project: Path) -> None:
    results = results_of(project, "connections=[]", "components.plant.start={}")
    for name in ("x", "vx", "psi", "phi", "ax"):
        assert np.all(results[f"plant.{name}"] == 0.0)
    # T·Γ at the nominal duty is T_N of eq 5.36, to the digits it is printed with
    assert results["plant.thrust_right"][-1] == pytest.approx(2.4973, abs=5e-6)


SCENARIO = """
name: chain
duration: 1
step: 0.02
components:
  plant: {{fmu: ../build/plant.fmu}}
  other: {{fmu: {fmu}}}
connections:
  - {{from: plant.tilt_right_actual, to: other.u}}
"""


def other_scenario(project: Path, fault: str) -> Path:
    fmu = misbehaving_fmu(project, fault)
    path = project / "scenarios" / "chain.yaml"
    path.write_text(SCENARIO.format(fmu=fmu))
    return path


@pytest.mark.parametrize(
    ("fault", "component", "words"),
    [
        ("Raises", "other", "the bearing seized"),
        ("GivesNan", "other.z", "the value is nan"),
        ("GivesInf", "other.z", "the value is -inf"),
    ],
)
def test_a_failing_fmu_stops_the_run_with_name_variable_and_time(
    project: Path, fault: str, component: str, words: str
) -> None:
    path, out = other_scenario(project, fault), project / "out"
    with pytest.raises(SimulationError) as caught:
        run(path, out, report=False)
    assert caught.value.exit_code == 4
    assert caught.value.component == component
    assert words in str(caught.value)
    # the fifth step goes from 0.08 s to 0.10 s; a call that fails is told at its start, a value at its time
    assert caught.value.time == pytest.approx(0.10 if "." in component else 0.08)
    rows = read_columns(out / "results.csv")
    assert rows.rows == 5  # t = 0 … 0.08 s are kept
    assert rows["other.y"][-1] == 4.0
    assert '"status": "failed: ' in (out / "manifest.json").read_text()


def test_an_fmu_that_ends_the_simulation_ends_the_run_well(project: Path) -> None:
    out = project / "out"
    outcome = run(other_scenario(project, "Discards"), out, report=False)
    rows = read_columns(out / "results.csv")
    assert rows.rows == 5  # t = 0 … 0.08 s, where both have come to
    assert rows["other.y"][-1] == 4.0
    told = "other ended the simulation at t = 0.08 s: fmi2DoStep returned Discard: the FMU ended the simulation early"
    assert told in outcome.manifest["warnings"]
    assert outcome.manifest["status"] == "ok"


def test_an_fmu_without_a_library_for_this_platform_does_not_load(project: Path, tmp_path: Path) -> None:
    import zipfile

    lame = project / "build" / "lame.fmu"
    with zipfile.ZipFile(project / "build" / "plant.fmu") as whole, zipfile.ZipFile(lame, "w") as part:
        for name in whole.namelist():
            if not name.startswith("binaries/"):
                part.writestr(name, whole.read(name))
    shutil.move(lame, project / "build" / "plant.fmu")
    from cosim.core.errors import FmuError

    with pytest.raises(FmuError, match="does not load"):
        results_of(project)


@pytest.mark.thorough
def test_memory_holds_no_more_than_the_results(project: Path) -> None:
    import tracemalloc

    file = ScenarioFile(project / "scenarios" / "regulate.yaml", ["noise=off"])

    def peak(steps: int) -> int:
        tracemalloc.start()
        simulate(build_system(file), steps, H)
        high = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return high

    peak(100)
    rows = 1500
    grown = peak(100 + rows) - peak(100)
    columns = len(build_system(file).columns)
    # time and table are 8 bytes a number; as much again is allowed for what the interpreter keeps
    assert grown < 2 * 8 * rows * (columns + 1)


def test_an_order_decides_who_sees_whose_new_values(project: Path) -> None:
    usual = results_of(project, "noise=off")
    assert np.array_equal(results_of(project, "noise=off", "order=[plant, controller]").values, usual.values)
    reverse = results_of(project, "noise=off", "order=[controller, plant]")
    assert not np.array_equal(reverse["plant.psi"], usual["plant.psi"])
