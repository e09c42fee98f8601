"""The master against plain functions in its order, and what it does when a component fails."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cosim
from controller.loop import Loop
from controller.settings import Settings
from cosim.core.errors import SimulationError
from cosim.files.table import read_columns
from cosim.model import Stepper
from plant.hovercraft import Hovercraft
from tests.cart import cart_fmu

H = 0.02


def test_gauss_seidel_equals_plain_functions_in_the_order_plant_noise_controller(project: Path) -> None:
    results = cosim.run(project / "scenarios" / "regulate.yaml", in_process=True)
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


def test_a_failing_fmu_stops_the_run_with_name_and_time(project: Path) -> None:
    fails = "if current_time > 0.07: raise RuntimeError('the bearing seized')"
    other = {"other": {"fmu": str(cart_fmu(project, first=fails))}, "plant": {"fmu": str(project / "build/plant.fmu")}}
    wire, out = {"from": "plant.tilt_right_actual", "to": "other.force"}, project / "out"
    with pytest.raises(SimulationError, match="the bearing seized") as caught:
        cosim.run({"name": "a", "duration": 1, "step": H, "components": other, "connections": [wire]}, out)
    assert (caught.value.exit_code, caught.value.component) == (4, "other")
    assert caught.value.time == pytest.approx(0.08)  # the start of the fifth step
    assert read_columns(out / "results.csv").rows == 5  # t = 0 … 0.08 s are kept
    assert '"status": "failed: ' in (out / "manifest.json").read_text()
