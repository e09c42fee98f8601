"""Model descriptions of plant and controller FMU: valid, complete and correct."""

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
from tests.test_effects import EVERYTHING, MEMORY, MOVING, named

COMMANDS = {"duty_right": "%", "duty_left": "%", "tilt_right": "rad", "tilt_left": "rad"}
ESTIMATE = {"x_hat": "m", "vx_hat": "m/s", "psi_hat": "rad", "psi_dot_hat": "rad/s", "a_hat": "m/s2"}
GAIN_UNITS = ("rad/m", "rad.s/m", "1", "s", "rad.s2/m")  # tilt [rad] per unit of x, vx, psi, psi_dot, a
GAINS = {f"k_{i}_{j}": unit for i in (1, 2) for j, unit in enumerate(GAIN_UNITS, 1)}
INPUTS = {
    "psi": "rad", "psi_dot": "rad/s", "ax": "m/s2", "x_ref": "m", "psi_ref": "rad", "x_meas": "m", "y_meas": "m",
    "fix": "1",
}  # fmt: skip
BOTH = pytest.mark.parametrize("which", ["plant_fmu", "controller_fmu"])


@BOTH
def test_two_checkers_find_no_fault(fmu: Path) -> None:
    assert validate_fmu(str(fmu)) == []
    command = [sys.executable, "-m", "fmu_manipulation_toolbox", "-input", str(fmu), "-check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert "compliant with FMI-2.0" in said
    assert not re.search(r"ERROR|WARNING|FATAL|CRITICAL", said), said


def units(fmu: Path, causality: str) -> dict[str, str]:
    return {v.name: v.unit or "" for v in description_of(fmu).modelVariables if v.causality == causality}


def test_variables_of_the_controller_are_those_other_tools_rely_on(controller_fmu: Path) -> None:
    """Those of the plant: tests/data/native_plant_variables.txt."""
    assert units(controller_fmu, "input") == INPUTS
    assert units(controller_fmu, "output") == COMMANDS | ESTIMATE | {"x_sigma": "m", "psi_sigma": "rad"}
    found = units(controller_fmu, "parameter")
    fixed = {**GAINS, **{f"{name}_start": unit for name, unit in ESTIMATE.items()}, "estimator": "", "tilt_max": "rad"}
    assert fixed.items() <= found.items()
    assert len([name for name in found if "variance" in name]) == 8 + 1  # V and W of eqs 5.46 and 5.47, and a fix
    assert found.keys() - fixed == {
        *(name for name in found if "variance" in name), "duty_nominal", "mass", "izz", "arm", "friction", "lag",
        "thrust_nominal", "yaw_damping", "sample_time", "fix_latency",
    }  # fmt: skip


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


THRUSTS = {"thrust_right_start": 1.9, "thrust_left_start": 2.1}
# Every effect awake at a generic value, v = 0.22 m/s and t = 3.7 s chosen so that no exponential is out of sight.
GENERIC_PLANT: dict[str, float] = named(EVERYTHING) | {f"{name}_start": v for name, v in (MOVING | MEMORY).items()}
GENERIC_PLANT |= {"height": 0.1, "stribeck_friction.speed": 0.4, "battery_sag.time": 12.0}
GENERIC_PLANT = {name: value for name, value in GENERIC_PLANT.items() if name not in THRUSTS}


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
    names = {*units(plant_fmu, "parameter"), *COMMANDS}
    given = initial_dependencies(plant_fmu, GENERIC_PLANT | THRUSTS, names, 3.7)
    follows = initial_dependencies(plant_fmu, GENERIC_PLANT, names - {*THRUSTS}, 3.7)  # from the nominal duty
    assert union(given, follows) == declared(description_of(plant_fmu).initialUnknowns)


def test_controller_initial_outputs_change_with_exactly_the_values_declared(controller_fmu: Path) -> None:
    variables = description_of(controller_fmu).modelVariables
    names = {v.name for v in variables if v.causality != "output" and v.type == "Real"}
    free = initial_dependencies(controller_fmu, GENERIC_CONTROLLER, names, 0.0)
    saturated = initial_dependencies(controller_fmu, GENERIC_CONTROLLER | {"x_ref": 9.0}, names, 0.0)
    assert union(free, saturated) == declared(description_of(controller_fmu).initialUnknowns)
