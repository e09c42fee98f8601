"""The plant FMU is the plain equations, and refuses what makes no sense."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.model import Moment, Stepper
from plant.hovercraft import OUTPUTS, Hovercraft
from tests.hosts_fmpy import Instance, extracted, refused

STEP = 0.02  # [s], Fig 4.8
DUTY = 6.38763  # δ_N [%], eqs 4.20 and 5.36
NAMES = [q.name for q in OUTPUTS]
COMMANDS = ("duty_right", "duty_left", "tilt_right", "tilt_left")

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
    "battery_sag.time": 4.0,
}


def excitation(count: int) -> list[tuple[float, ...]]:
    """Commands (δ_R, δ_L, α_R, α_L) that move every state: three tones a tilt, duty in random steps of 0.5 s."""
    rng = np.random.default_rng(20120501)
    t = STEP * np.arange(count)
    tones = rng.uniform(0.3, 3.0, (2, 3))
    tilts = 0.07 * np.sin(2 * np.pi * tones[:, :, None] * t).sum(axis=1)
    duties = DUTY + np.repeat(rng.uniform(-0.3, 0.3, (2, count // 25 + 1)), 25, axis=1)[:, :count]
    return [tuple(row) for row in np.vstack([duties, tilts]).T.tolist()]


def equations(values: dict[str, Any], commands: list[tuple[float, ...]], steps: list[float]) -> np.ndarray:
    """Outputs of the plain equations at the start and after each step."""
    starts = {n.removesuffix("_start"): v for n, v in values.items() if n.endswith("_start")}
    model = Hovercraft().with_values({n: v for n, v in values.items() if not n.endswith("_start")})
    stepper = Stepper(model)
    moment = stepper.start(0.0, starts)
    rows, t = [stepper.output(0.0, moment.state, commands[0])], 0.0
    for command, h in zip(commands, steps, strict=True):
        moment = stepper.step(Moment(t, moment.state, moment.memory), command, h)
        t += h
        rows.append(stepper.output(moment.t, moment.state, command))
    return np.array(rows)


def trajectory(fmu: Path, values: dict[str, Any], commands: list[tuple[float, ...]], steps: list[float]) -> np.ndarray:
    """The same, of the FMU."""
    with Instance(fmu) as plant:
        rows, t = [plant.initialize(values).outputs()], 0.0
        for command, h in zip(commands, steps, strict=True):
            rows.append(plant.step(t, h, dict(zip(COMMANDS, command, strict=True))))
            t += h
    return np.array([[row[n] for n in NAMES] for row in rows])


# -- the same trajectory as the equations -------------------------------------------------------


@pytest.mark.parametrize(
    "values",
    [{}, MOVING, {**MOVING, **EFFECTS}, {**MOVING, "roll_ground_effect": False, "mass": 0.9, "lag": 0.12}],
    ids=["base", "moving", "effects", "parameters"],
)
def test_the_fmu_moves_as_the_equations_do(plant_fmu: Path, values: dict[str, Any]) -> None:
    commands, steps = excitation(500), [STEP] * 500
    got, want = trajectory(plant_fmu, values, commands, steps), equations(values, commands, steps)
    # the FMU evaluates the same expressions on the same floats: 1e-12 allows for nothing but another libm
    np.testing.assert_allclose(got, want, rtol=1e-12, atol=0)
    assert np.ptp(got, axis=0).min() > 1e-4  # every output has moved


# -- start values -------------------------------------------------------------------------------


@pytest.mark.parametrize("which", ["plant_fmu", "native_plant"])
def test_outputs_follow_every_set_in_initialization_mode(which: str, request: pytest.FixtureRequest) -> None:
    with Instance(request.getfixturevalue(which)) as plant:
        plant.begin()
        for x, vx in ((1.0, 0.2), (-2.0, 0.4)):
            plant.set({"x_start": x, "vx_start": vx})
            outputs = plant.outputs()
            assert (outputs["x"], outputs["vx"]) == (x, vx)
            assert outputs["ax"] == pytest.approx(-0.25 * vx / 0.705, rel=1e-15)  # eq 5.9, tilts at zero
        plant.set({"mass": 1.41})
        assert plant.outputs()["ax"] == pytest.approx(-0.25 * 0.4 / 1.41, rel=1e-15)


@pytest.mark.parametrize("which", ["plant_fmu", "native_plant"])
def test_reset_leads_back_to_the_start(which: str, request: pytest.FixtureRequest) -> None:
    commands = [dict(zip(COMMANDS, c, strict=True)) for c in excitation(50)]

    def run(values: dict[str, Any]) -> list[dict[str, float]]:
        plant.initialize(values)
        return [plant.outputs(), *(plant.step(STEP * k, STEP, c) for k, c in enumerate(commands))]

    with Instance(request.getfixturevalue(which)) as plant:
        first = run({})
        plant.call("reset")
        other = run({**MOVING, **EFFECTS})
        plant.call("reset")
        assert run({}) == first != other


# -- nothing but Python -------------------------------------------------------------------------

BARE = """
import json, sys
job = json.load(sys.stdin)
resources = job["resources"]
sys.path.insert(0, resources)  # as pythonfmu does
module = __import__(open(resources + "/slavemodule.txt").read().strip())
slave = getattr(module, job["class"])(instance_name="bare", resources=resources, logger=None, visible=False)
slave.setup_experiment(0.0, None, None)
slave.enter_initialization_mode()
slave.set_real(list(map(int, job["values"])), list(job["values"].values()))
slave.exit_initialization_mode()
rows = [slave.get_real(job["outputs"])]
for k in range(job["steps"]):
    slave.set_real([2, 3], [0.1, -0.05])
    assert slave.do_step(0.02 * k, 0.02)
    rows.append(slave.get_real(job["outputs"]))
foreign = [n for n, m in sys.modules.items() if "-packages" in (getattr(m, "__file__", None) or "")]
json.dump({"rows": rows, "foreign": foreign, "path": sys.path}, sys.stdout)
"""


def test_the_plant_runs_on_the_standard_library_alone(plant_fmu: Path) -> None:
    values: dict[str, Any] = {**MOVING, **EFFECTS}
    with Instance(plant_fmu) as plant:
        references = {n: v.valueReference for n, v in plant.variables.items()}
        rows = [plant.initialize(values).outputs()]
        rows += [plant.step(STEP * k, STEP, {"tilt_right": 0.1, "tilt_left": -0.05}) for k in range(50)]
    assert [references["tilt_right"], references["tilt_left"]] == [2, 3]
    job = {
        "resources": str(Path(extracted(plant_fmu)) / "resources"),
        "class": plant.description.coSimulation.modelIdentifier,
        "values": {references[n]: v for n, v in values.items()},
        "outputs": [references[n] for n in NAMES],
        "steps": 50,
    }
    # -I -S: no site-packages, no environment; numpy and its like are not to be found
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", BARE], input=json.dumps(job), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["foreign"] == []
    assert not any("-packages" in folder for folder in told["path"])
    assert told["rows"] == [[row[n] for n in NAMES] for row in rows]


# -- guards -------------------------------------------------------------------------------------


UNFIXED = {"mass": 0.8, "x_start": 1.0, "coulomb_friction.force": 0.1, "roll_ground_effect": False}
FIXED = "is a fixed parameter; set it before the end of initialization"
BOUNDS = {"mass": (-1.0, "[0.05, 20] kg"), "lag": (0.0, "[0.005, 2] s"), "friction": (11.0, "[0, 10] N.s/m"),
          "servo_backlash.width": (-0.1, "[0, 0.5] rad"), "actuator_delay.time": (0.6, "[0, 0.5] s")}  # fmt: skip
# whether a step has been made, then: values that are set, the length of a step, or a function with its arguments
GUARDS: list[tuple[bool, Any, str]] = [
    *((False, {name: value}, f"{name} is set to {value}; it is a finite number")
      for name in ("tilt_right", "duty_left", "mass", "vx_start") for value in (math.nan, math.inf, -math.inf)),
    *((True, {"tilt_left": value}, f"tilt_left is set to {value}") for value in (math.nan, math.inf)),
    *((True, h, f"step of {h} s at t = 0.02 s; a step is positive and finite")
      for h in (0.0, -0.02, math.nan, math.inf)),
    *((True, {name: value}, f"{name} {FIXED}") for name, value in UNFIXED.items()),
    *((begun, {"x": 1.0}, "x is an output") for begun in (False, True)),
    *((False, {name: value, "outputs": ends}, f"{name.rpartition('.')[2]} is {value}; it lies in {said}")
      for name, (value, said) in BOUNDS.items() for ends in (False, True)),
    (False, {"mass": 99.0, "arm": 0.0, "outputs": True}, "arm is 0.0; it lies in [0.01, 2] m"),
    (False, ("setReal", "roll_ground_effect", 0.5), "roll_ground_effect is Boolean, not Real"),
    (False, ("setBoolean", "mass", True), "mass is Real, not Boolean"),
    (False, ("getBoolean", "duty_right"), "duty_right is Real, not Boolean"),
    (False, STEP, "initialization"),
    (True, {"duty_right": 1e308, "step": STEP}, r"finite"),  # "math domain error" says nothing to who set the duty
]  # fmt: skip


@pytest.mark.parametrize("which", ["plant_fmu", "native_plant"])
@pytest.mark.parametrize(("begun", "what", "said"), GUARDS, ids=str)
def test_what_makes_no_sense_is_refused(
    which: str, begun: bool, what: Any, said: str, request: pytest.FixtureRequest
) -> None:
    def call(plant: Instance) -> None:
        if begun:
            plant.call("exitInitializationMode")
            plant.step(0.0, STEP)
        if isinstance(what, float):
            plant.step(STEP if begun else 0.0, what)
        elif isinstance(what, tuple):
            function, name, *values = what
            plant.call(function, [plant.variables[name].valueReference], *([values] if values else []))
            plant.outputs()
        else:
            plant.set({name: value for name, value in what.items() if name not in ("outputs", "step")})
            if "step" in what:
                plant.step(STEP, what["step"])
            plant.outputs() if what.get("outputs", begun) else plant.call("exitInitializationMode")

    told = refused(request.getfixturevalue(which), {}, call)
    assert re.sub(r"(\d)\.0\b", r"\1", said) in re.sub(r"(\d)\.0\b", r"\1", told)
