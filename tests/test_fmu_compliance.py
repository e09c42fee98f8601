"""What both FMUs say of themselves: valid, complete, and true."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fmpy.validation import validate_fmu

from tests.hosts_fmpy import Instance, description_of

STATES = {
    "x": "m", "y": "m", "x_world": "m", "y_world": "m", "psi": "rad", "vx": "m/s", "vy": "m/s", "psi_dot": "rad/s",
    "phi": "rad", "phi_dot": "rad/s", "thrust_right": "N", "thrust_left": "N", "tilt_right": "rad", "tilt_left": "rad",
}  # fmt: skip
COMMANDS = {"duty_right": "%", "duty_left": "%", "tilt_right": "rad", "tilt_left": "rad"}
POSE = ("x", "y", "x_world", "y_world", "psi", "phi", "vx", "vy", "psi_dot", "phi_dot")

# name: (unit, start), tables "Parameters" and "Effects the base lacks" of the model
PLANT_PARAMETERS: dict[str, str] = {
    "mass": "kg",  # §5.2
    "izz": "kg.m2",  # eq 5.3
    "ixx": "kg.m2",  # eq 5.4
    "arm": "m",  # §5.2
    "propeller_radius": "m",  # §3.5
    "height": "m",  # §4.4
    "thrust_offset": "gf",  # eq 4.20
    "thrust_slope": "gf/%",  # eq 4.20
    "ground_effect_exponent": "1",  # eq 4.28
    "lag": "s",  # eq 4.29
    "friction": "N.s/m",  # §5.5
    "gravity": "m/s2",
    "duty_nominal": "%",  # eqs 4.20 and 5.36
    "table_roll_stiffness": "N.m/rad",  # §4.2
    "table_roll_damping": "N.m.s/rad",
    "roll_ground_effect": "",
    # effects: dormant at their start value
    "coulomb_friction.force": "N",
    "stribeck_friction.force": "N",
    "stribeck_friction.static_force": "N",
    "stribeck_friction.speed": "m/s",
    "quadratic_drag.coefficient": "N.s2/m2",
    "yaw_damping.coefficient": "N.m.s/rad",
    "yaw_coulomb_friction.moment": "N.m",
    "actuator_second_order.natural_frequency": "rad/s",
    "actuator_second_order.damping_ratio": "1",
    "actuator_delay.time": "s",
    "servo_rate_limit.rate": "rad/s",
    "servo_backlash.width": "rad",
    "servo_dead_band.width": "rad",
    "tilt_offset.right": "rad",
    "tilt_offset.left": "rad",
    "thrust_asymmetry.ratio": "1",
    "battery_sag.drop": "1",
    "battery_sag.time": "s",
    "inflow_thrust_loss.coefficient": "s/m",
    "com_offset.right": "m",
    "table_tilt.x": "rad",
    "table_tilt.y": "rad",
    "coriolis.gain": "1",
    # what acts until the delay has passed, and what else effects remember
    "actuator_delay.duty_right_start": "%",
    "actuator_delay.duty_left_start": "%",
    "actuator_delay.tilt_right_start": "rad",
    "actuator_delay.tilt_left_start": "rad",
    "servo_backlash.play_right_start": "rad",
    "servo_backlash.play_left_start": "rad",
    "actuator_second_order.tilt_rate_right_start": "rad/s",
    "actuator_second_order.tilt_rate_left_start": "rad/s",
    **{f"{name}_start": unit for name, unit in STATES.items()},
}
ESTIMATE = {"x_hat": "m", "vx_hat": "m/s", "psi_hat": "rad", "psi_dot_hat": "rad/s", "a_hat": "m/s2"}
GAIN_UNITS = ("rad/m", "rad.s/m", "1", "s", "rad.s2/m")  # tilt [rad] per unit of x, vx, psi, psi_dot, a
GAINS = {f"k_{i}_{j}": unit for i in (1, 2) for j, unit in enumerate(GAIN_UNITS, 1)}
VARIABLES = {
    "plant_fmu": {
        "input": COMMANDS,
        "output": {
            **{name: STATES[name] for name in POSE},
            "ax": "m/s2", "thrust_right": "N", "thrust_left": "N", "tilt_right_actual": "rad",
            "tilt_left_actual": "rad",
        },
        "parameter": PLANT_PARAMETERS,
    },
    "controller_fmu": {
        "input": {
            "psi": "rad", "psi_dot": "rad/s", "ax": "m/s2", "x_ref": "m", "psi_ref": "rad",
            "x_meas": "m", "y_meas": "m", "fix": "1",
        },
        "output": {**COMMANDS, **ESTIMATE, "x_sigma": "m", "psi_sigma": "rad"},
        "parameter": {
            **GAINS,
            **{f"{name}_start": unit for name, unit in ESTIMATE.items()},
            "estimator": "", "tilt_max": "rad", "duty_nominal": "%",
        },
    },
}  # fmt: skip
BOTH = pytest.mark.parametrize("which", ["plant_fmu", "controller_fmu"])


@pytest.fixture
def fmu(which: str, request: pytest.FixtureRequest) -> Path:
    path: Path = request.getfixturevalue(which)
    return path


@BOTH
def test_fmpy_finds_no_fault(fmu: Path) -> None:
    assert validate_fmu(str(fmu)) == []


@BOTH
def test_fmutool_finds_no_fault(fmu: Path) -> None:
    command = [sys.executable, "-m", "fmu_manipulation_toolbox", "-input", str(fmu), "-check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert "compliant with FMI-2.0" in said
    assert not re.search(r"ERROR|WARNING|FATAL|CRITICAL", said), said


@BOTH
def test_variables_are_those_other_tools_rely_on(fmu: Path, which: str) -> None:
    found: dict[str, dict[str, str]] = {"input": {}, "output": {}, "parameter": {}}
    for v in description_of(fmu).modelVariables:
        found[v.causality][v.name] = v.unit or ""
    want = VARIABLES[which]
    assert found["input"] == want["input"]
    assert found["output"] == want["output"]
    if which == "controller_fmu":  # "noise variances, model numbers" are free to be named, and only those
        extra = {n for n in found["parameter"] if "variance" in n} | {
            "mass", "izz", "arm", "friction", "lag", "thrust_nominal", "yaw_damping", "sample_time", "fix_latency"
        }  # fmt: skip
        assert len(extra) == 8 + 1 + 9  # V and W of eqs 5.46 and 5.47 have eight entries, a fix has one
        found["parameter"] = {n: unit for n, unit in found["parameter"].items() if n not in extra}
    assert found["parameter"] == want["parameter"]


# Exponents of (kg, m, s, rad) and the factor to SI of each symbol a unit's name may be made of.
SYMBOLS = {
    "1": ((0, 0, 0, 0), 1.0), "%": ((0, 0, 0, 0), 0.01), "kg": ((1, 0, 0, 0), 1.0), "m": ((0, 1, 0, 0), 1.0),
    "s": ((0, 0, 1, 0), 1.0), "rad": ((0, 0, 0, 1), 1.0), "N": ((1, 1, -2, 0), 1.0), "gf": ((1, 1, -2, 0), 9.80665e-3),
}  # fmt: skip


@BOTH
def test_a_unit_is_defined_as_its_name_reads(fmu: Path) -> None:
    for unit in description_of(fmu).unitDefinitions:
        exponents, factor = [0, 0, 0, 0], 1.0
        for sign, side in zip((1, -1), unit.name.split("/"), strict=False):
            for symbol, power in re.findall(r"([A-Za-z%]+|1)(\d?)", side):
                dimension, size = SYMBOLS[symbol]
                n = sign * int(power or 1)
                exponents = [e + n * d for e, d in zip(exponents, dimension, strict=True)]
                factor *= size**n
        base = unit.baseUnit
        assert [base.kg, base.m, base.s, base.rad] == exponents, unit.name
        assert base.factor == pytest.approx(factor, rel=1e-15), unit.name  # one or two roundings


# -- model structure ----------------------------------------------------------------------------


def declared(unknowns: list[Any]) -> dict[str, set[str]]:
    assert all(u.dependencies is not None for u in unknowns)
    return {u.variable.name: {v.name for v in u.dependencies} for u in unknowns}


def union(*maps: dict[str, set[str]]) -> dict[str, set[str]]:
    return {output: set().union(*(m[output] for m in maps)) for output in maps[0]}


def changed(before: dict[str, float], after: dict[str, float], rtol: float = 0.0) -> set[str]:
    return {n for n in before if not math.isclose(before[n], after[n], rel_tol=rtol, abs_tol=rtol)}


def perturbed(value: Any) -> Any:
    return not value if isinstance(value, bool) else value + 0.01 * abs(value) + 1e-3


# Nothing is zero, symmetric or saturated here, so that whatever an output depends on shows.
GENERIC_CONTROLLER = {"x_hat_start": 0.3, "vx_hat_start": 0.2, "psi_hat_start": 0.1, "psi_dot_hat_start": -0.15,
                      "a_hat_start": 0.4, "x_ref": 0.45, "psi_ref": 0.2}  # fmt: skip
MEASURED = {"psi": 0.12, "psi_dot": -0.1, "ax": 0.5, "x_ref": 0.5, "psi_ref": 0.25, "x_meas": 0.3, "y_meas": 0.1}


def sample_dependencies(fmu: Path, estimator: str) -> dict[str, set[str]]:
    """Outputs that change at a sample when each input is another one."""
    with Instance(fmu) as controller:
        controller.initialize({**GENERIC_CONTROLLER, "estimator": estimator})
        for k in range(3):
            controller.step(0.02 * k, 0.02, {**MEASURED, "fix": 1.0})
        state = controller.serialized()
        fixed = {**MEASURED, "fix": 2.0}  # a new one
        base = controller.step(0.06, 0.02, fixed)
        found: dict[str, set[str]] = {output: set() for output in base}
        for name, value in fixed.items():
            controller.restore(state)
            other = 1.0 if name == "fix" else perturbed(value)  # no new fix
            # the axes do not couple; between them the filter's matrix products leave rounding, 1e-16 or so
            for output in changed(base, controller.step(0.06, 0.02, {**fixed, name: other}), 1e-14):
                found[output].add(name)
    return found


def test_controller_outputs_change_with_exactly_the_inputs_declared(controller_fmu: Path) -> None:
    # The estimator is a parameter and the declaration serves all three: in Appendix F the acceleration has no
    # memory, so that the accelerometer moves a_hat alone; with the lag it moves x_hat and vx_hat too.
    found = [sample_dependencies(controller_fmu, e) for e in ("appendix_f", "lagged", "consistent")]
    assert union(*found) == declared(description_of(controller_fmu).outputs)


def test_plant_outputs_change_through_states_only(plant_fmu: Path) -> None:
    assert set(map(frozenset, declared(description_of(plant_fmu).outputs).values())) == {frozenset()}
    with Instance(plant_fmu) as plant:
        plant.begin({"vx_start": 0.3, "tilt_right_start": 0.1})
        for phase in ("initialization", "step"):
            before = plant.outputs()
            for name, value in {"duty_right": 6.7, "duty_left": 6.2, "tilt_right": 0.2, "tilt_left": -0.1}.items():
                plant.set({name: value})
                assert plant.outputs() == before, (phase, name)
            if phase == "initialization":
                plant.call("exitInitializationMode")
        assert changed(before, plant.step(0.0, 0.02)) == set(before)


# Every effect awake at a generic value, s = 0.36 m/s and t = 3.7 s chosen so that no exponential is out of sight.
GENERIC_PLANT: dict[str, float | bool] = {
    "mass": 0.8, "izz": 0.012, "ixx": 0.01, "arm": 0.18, "propeller_radius": 0.13, "height": 0.1,
    "thrust_offset": -2000.0, "thrust_slope": 350.0, "ground_effect_exponent": 2.1, "lag": 0.1, "friction": 0.3,
    "gravity": 9.7, "duty_nominal": 6.5, "table_roll_stiffness": 4.0, "table_roll_damping": 0.3,
    "roll_ground_effect": True, "coulomb_friction.force": 0.05, "stribeck_friction.force": 0.04,
    "stribeck_friction.static_force": 0.09, "stribeck_friction.speed": 0.4, "quadratic_drag.coefficient": 0.1,
    "yaw_damping.coefficient": 0.02, "yaw_coulomb_friction.moment": 0.01,
    "actuator_second_order.natural_frequency": 14.0, "actuator_second_order.damping_ratio": 0.6,
    "actuator_delay.time": 0.05, "servo_rate_limit.rate": 2.0, "servo_backlash.width": 0.02,
    "servo_dead_band.width": 0.01, "tilt_offset.right": 0.03, "tilt_offset.left": -0.02,
    "thrust_asymmetry.ratio": 0.06, "battery_sag.drop": 0.2, "battery_sag.time": 12.0,
    "inflow_thrust_loss.coefficient": 0.3, "com_offset.right": 0.01, "table_tilt.x": 0.01, "table_tilt.y": 0.02,
    "coriolis.gain": 0.9, "actuator_delay.duty_right_start": 6.6, "actuator_delay.duty_left_start": 6.3,
    "actuator_delay.tilt_right_start": 0.02, "actuator_delay.tilt_left_start": 0.03,
    "servo_backlash.play_right_start": 0.015, "servo_backlash.play_left_start": 0.025,
    "actuator_second_order.tilt_rate_right_start": 0.1, "actuator_second_order.tilt_rate_left_start": 0.2,
    "x_start": 1.1, "y_start": 0.2, "x_world_start": 0.7, "y_world_start": 0.4, "psi_start": 0.5, "vx_start": 0.3,
    "vy_start": 0.2, "psi_dot_start": 0.6, "phi_start": 0.05, "phi_dot_start": 0.1, "tilt_right_start": 0.08,
    "tilt_left_start": 0.11,
}  # fmt: skip
THRUST_STARTS = {"thrust_right_start": 1.9, "thrust_left_start": 2.1}


def initial_dependencies(fmu: Path, point: dict[str, Any], names: set[str], start_time: float) -> dict[str, set[str]]:
    """Outputs that change in initialization mode when each of `names` is set to another value."""
    found: dict[str, set[str]] = {}
    with Instance(fmu) as instance:
        base = instance.begin(point, start_time).outputs()
        for name in names:
            value = instance.get([name])[0]
            value = bool(value) if instance.variables[name].type == "Boolean" else value
            instance.set({name: perturbed(value)})
            for output in changed(base, instance.outputs()):
                found.setdefault(output, set()).add(name)
            instance.set({name: value})
            assert instance.outputs() == base, name
    return {output: found.get(output, set()) for output in base}


def test_plant_initial_outputs_change_with_exactly_the_values_declared(plant_fmu: Path) -> None:
    assert set(GENERIC_PLANT) | set(THRUST_STARTS) == set(PLANT_PARAMETERS)
    names = {*GENERIC_PLANT, *COMMANDS}
    given = initial_dependencies(plant_fmu, GENERIC_PLANT | THRUST_STARTS, names | set(THRUST_STARTS), 3.7)
    follows = initial_dependencies(plant_fmu, GENERIC_PLANT, names, 3.7)  # thrusts follow from the nominal duty
    assert union(given, follows) == declared(description_of(plant_fmu).initialUnknowns)


def test_controller_initial_outputs_change_with_exactly_the_values_declared(controller_fmu: Path) -> None:
    variables = description_of(controller_fmu).modelVariables
    names = {v.name for v in variables if v.causality != "output" and v.type == "Real"}
    free = initial_dependencies(controller_fmu, GENERIC_CONTROLLER, names, 0.0)
    saturated = initial_dependencies(controller_fmu, GENERIC_CONTROLLER | {"x_ref": 9.0}, names, 0.0)
    assert union(free, saturated) == declared(description_of(controller_fmu).initialUnknowns)
