"""The master: order, timing, coupling, and what it does when a component fails."""

from __future__ import annotations

import math
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
    names = [f"plant.{q.name}" for q in Hovercraft.outputs]
    for k in range(len(results.time)):
        if k:
            moment = stepper.step(replace(moment, t=results.time[k - 1].item()), (duty, duty, *loop.command), H)
            loop.step([results[f"controller.{n}"][k].item() for n in ("psi", "psi_dot", "ax")], 0.0, 0.0)
        # the same operations in the same order; 1e-12 leaves room for another build of libm only
        expected = [*stepper.output(moment.t, moment.state, ()), loop.command[0], loop.estimate[0]]
        got = [results[n][k] for n in (*names, "controller.tilt_right", "controller.x_hat")]
        assert got == pytest.approx(expected, rel=1e-12, abs=1e-15)
    for name in ("tilt_right", "tilt_left", "duty_right"):  # row k holds the command that acts from then on
        assert np.array_equal(results[f"plant.{name}"], results[f"controller.{name}"])
    # u_0 = sat(-K·x̂_0): both tilts at the limit, for x = 1 m outweighs psi = 1 rad
    command, tilt = results["plant.tilt_right"], results["plant.tilt_right_actual"]
    assert (command[0], tilt[0]) == (pytest.approx(-np.radians(12)), 0.0)
    # 63.2 % of the way after τ; after one step 1 − e^(−Δt/τ) of it, eq 4.29 (RK4 error 1e-9)
    assert tilt[1] == pytest.approx(command[0] * (1 - np.exp(-H / 0.0884)), rel=1e-6)


def test_algorithm_and_order_decide_who_sees_whose_new_values(project: Path) -> None:
    biased = "connections.0.noise={variance: 0, bias: 0.5}"
    usual = results_of(project, biased)
    assert np.array_equal(results_of(project, biased, "order=[plant, controller]").values, usual.values)
    reverse = results_of(project, biased, "order=[controller, plant]")
    assert not np.array_equal(reverse["plant.psi"], usual["plant.psi"])
    jacobi = results_of(project, "noise=off", "algorithm=jacobi")
    # the controller's update at row k uses y_k under Gauss-Seidel, y_{k-1} under Jacobi
    loop = Loop(Settings(), (1.0, 0.0, 1.0, 0.0, 0.0), 0.0, 0.0)
    for k in range(1, 200):
        loop.step([jacobi[f"plant.{n}"][k - 1].item() for n in ("psi", "psi_dot", "ax")], 0.0, 0.0)
        assert jacobi["controller.psi_hat"][k] == pytest.approx(loop.estimate[2], rel=1e-12, abs=1e-15)
    difference = np.max(np.abs(results_of(project, "noise=off")["plant.psi"] - jacobi["plant.psi"]))
    assert 1e-4 < difference < 0.1  # one sample of delay: seen, and small
    for results in (usual, results_of(project, "algorithm=jacobi", biased)):  # noise adds no delay
        assert np.allclose(results["controller.psi"] - results["plant.psi"], 0.5, atol=1e-15)


def test_steps_are_counted_not_summed_and_the_plant_hovers_without_connections(project: Path) -> None:
    starts = ["components.controller.start.sample_time=0.1", "components.plant.start={}"]
    results = results_of(project, "step=0.1", "duration=100", "criteria={}", "connections=[]", *starts)
    assert len(results.time) == 1001
    assert (results.time[300], results.time[-1]) == (300 * 0.1, 100.0)
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
    assert any("other ended the simulation at t = 0.08 s" in text for text in outcome.manifest["warnings"])
    assert outcome.manifest["status"] == "ok"
