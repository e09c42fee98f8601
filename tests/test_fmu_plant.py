"""The plant FMU agrees with the plain equations and rejects invalid values."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.model import Stepper
from plant.hovercraft import OUTPUTS, Hovercraft
from tests.hosts_fmpy import Instance, extracted, refused
from tests.independent import excitation, flown

STEP = 0.02  # [s], Fig 4.8
NAMES = [q.name for q in OUTPUTS]
COMMANDS = ("duty_right", "duty_left", "tilt_right", "tilt_left")
BOTH = pytest.mark.parametrize("which", ["plant_fmu", "native_plant"])

MOVING = {"x_start": 1.0, "y_start": -0.2, "x_world_start": 0.5, "psi_start": 1.0, "vx_start": 0.3, "vy_start": 0.1,
          "psi_dot_start": -0.4, "phi_start": 0.02, "tilt_right_start": 0.05}  # fmt: skip
EFFECTS: dict[str, float | bool] = {
    "coulomb_friction.force": 0.05,
    "actuator_delay.time": 0.033,  # no multiple of a substep
    "actuator_delay.tilt_right_start": 0.1,
    "servo_backlash.width": 0.03,
    "servo_backlash.play_left_start": -0.05,
    "actuator_second_order.natural_frequency": 15.0,
    "actuator_second_order.damping_ratio": 0.4,
    "actuator_second_order.tilt_rate_right_start": 0.5,
    "battery_sag.drop": 0.2,
}


def trajectory(plant: Instance, values: dict[str, Any], count: int) -> list[list[float]]:
    """Outputs of an FMU at the start and after each step."""
    rows = [plant.initialize(values).outputs()]
    for k, command in enumerate(excitation(count).tolist()):
        rows.append(plant.step(STEP * k, STEP, dict(zip(COMMANDS, command, strict=True))))
    return [[row[name] for name in NAMES] for row in rows]


@pytest.mark.parametrize(
    "values", [{}, {**MOVING, **EFFECTS}, {**MOVING, "roll_ground_effect": False, "mass": 0.9, "lag": 0.12}]
)
def test_the_fmu_moves_as_the_equations_do(plant_fmu: Path, values: dict[str, Any]) -> None:
    with Instance(plant_fmu) as plant:
        got = trajectory(plant, values, 500)
    model = Hovercraft().with_values({n: v for n, v in values.items() if not n.endswith("_start")})
    start = {n.removesuffix("_start"): v for n, v in values.items() if n.endswith("_start")}
    want = flown(Stepper(model), excitation(500), start)
    # the FMU evaluates the same expressions on the same floats: 1e-12 allows for nothing but another libm
    np.testing.assert_allclose(np.transpose(got), [want[name] for name in NAMES], rtol=1e-12, atol=0)
    assert np.ptp(got, axis=0).min() > 1e-4  # every output has moved


@BOTH
def test_outputs_follow_every_set_in_initialization_mode_and_reset_leads_back(which: str, fmu: Path) -> None:
    with Instance(fmu) as plant:
        plant.begin()
        for x, vx, mass in ((1.0, 0.2, 0.705), (-2.0, 0.4, 1.41)):
            plant.set({"x_start": x, "vx_start": vx, "mass": mass})
            outputs = plant.outputs()
            assert (outputs["x"], outputs["vx"]) == (x, vx)
            assert outputs["ax"] == pytest.approx(-0.25 * vx / mass, rel=1e-15)  # eq 5.9, tilts at zero
        runs = []
        for values in ({}, {**MOVING, **EFFECTS}, {}):
            plant.call("reset")
            runs.append(trajectory(plant, values, 50))
        assert runs[0] == runs[2] != runs[1]


BARE = """
import json, sys
job = json.load(sys.stdin)
sys.path.insert(0, job["resources"])  # as pythonfmu does
module = __import__(open(job["resources"] + "/slavemodule.txt").read().strip())
slave = getattr(module, job["class"])(instance_name="bare", resources=job["resources"], logger=None, visible=False)
slave.setup_experiment(0.0, None, None)
slave.enter_initialization_mode()
slave.set_real(list(map(int, job["values"])), list(job["values"].values()))
slave.exit_initialization_mode()
rows = [slave.get_real(job["outputs"])]
for k, command in enumerate(job["commands"]):
    slave.set_real(job["inputs"], command)
    assert slave.do_step(0.02 * k, 0.02)
    rows.append(slave.get_real(job["outputs"]))
foreign = [n for n, m in sys.modules.items() if "-packages" in (getattr(m, "__file__", None) or "")]
json.dump({"rows": rows, "foreign": foreign}, sys.stdout)
"""


def test_the_plant_runs_on_the_standard_library_alone(plant_fmu: Path) -> None:
    values: dict[str, Any] = {**MOVING, **EFFECTS}
    with Instance(plant_fmu) as plant:
        references = {n: v.valueReference for n, v in plant.variables.items()}
        rows = trajectory(plant, values, 50)
    job = {
        "resources": str(Path(extracted(plant_fmu)) / "resources"),
        "class": plant.description.coSimulation.modelIdentifier,
        "values": {references[n]: v for n, v in values.items()},
        "inputs": [references[n] for n in COMMANDS],
        "outputs": [references[n] for n in NAMES],
        "commands": excitation(50).tolist(),
    }
    # -I -S: no site-packages, no environment; numpy and its like are not to be found
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", BARE], input=json.dumps(job), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"rows": rows, "foreign": []}


# -- guards -------------------------------------------------------------------------------------


FIXED = "is a fixed parameter; set it before the end of initialization"
# whether a step has been made, values that are set, the length of a step, and what is said
GUARDS: list[tuple[bool, dict[str, Any], float | None, str]] = [
    (False, {"tilt_right": math.nan}, None, "tilt_right is set to nan"),
    (False, {"mass": math.inf}, None, "mass is set to inf"),
    (True, {"tilt_left": -math.inf}, None, "tilt_left is set to -inf"),
    *((True, {}, length, " s at t = ") for length in (0.0, -0.02, math.nan, math.inf)),
    *((True, {name: True}, None, f"{name} {FIXED}") for name in ("mass", "x_start", "roll_ground_effect")),
    (True, {"x": 1.0}, None, "x is an output"),
    (False, {"lag": 0.0}, None, "[0.005, 2] s"),
    (False, {"servo_backlash.width": -0.5}, None, "[0, 0.5] rad"),
    (False, {}, STEP, "initialization"),
    (True, {"duty_right": 1e308}, STEP, "finite"),  # "math domain error" says nothing to who set the duty
]


@BOTH
@pytest.mark.parametrize(("begun", "values", "length", "said"), GUARDS, ids=str)
def test_what_makes_no_sense_is_refused(
    which: str, begun: bool, values: dict[str, float], length: float | None, said: str, fmu: Path
) -> None:
    def call(plant: Instance) -> None:
        if begun:
            plant.call("exitInitializationMode")
            plant.step(0.0, STEP)
        plant.set(values)
        if length is not None:
            plant.step(STEP * begun, length)
        plant.outputs()

    assert said in refused(fmu, {}, call).replace(".0;", ";")
