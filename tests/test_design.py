"""`cosim build --design`: start values of the controllers, for the craft as it is and for a refined one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

import cosim
from controller.design_model import design_model
from controller.settings import GAINS, Settings
from controller.synthesis import numbers_of
from cosim.core.errors import InputError
from cosim.fmi.building.build import build_native
from cosim.fmi.fmu_build import build
from cosim.sweeps.store import TABLE, read_table
from fmus.recipes import plant_recipe
from plant.hovercraft import Hovercraft
from tests.cases import some

ROOT = Path(__file__).resolve().parent.parent
CRAFT = Hovercraft()
HEAVIER: dict[str, float | bool] = {"mass": 1.0, "friction": 0.4, "yaw_damping.coefficient": 0.02}
POLES, INTEGRAL = "controller-pole.fmu", "controller-lqi.fmu"
PREDICTIVE, TIME_VARIANT = "controller-mpc.fmu", "controller-ltv-mpc.fmu"


def settings_of(craft: Hovercraft) -> Settings:
    return replace(Settings(), **numbers_of(craft))


def designed(folder: Path, text: str, model: str = "hovercraft", controller: str = "controller.fmu") -> dict[str, Any]:
    """The start values of a controller, and the warnings of its design."""
    (folder / "design.yaml").write_text(f"controllers: [{controller}]\n{text}", encoding="utf-8")
    warnings: list[str] = []
    cosim.build(folder / "built", model, design=folder / "design.yaml", tell=warnings.append)
    return {**starts_of(folder / "built" / controller), "warnings": warnings}


def starts_of(fmu: Path) -> Mapping[str, Any]:
    variables = fmpy.read_model_description(str(fmu), validate=False).modelVariables
    return {v.name: v.start if v.type == "String" else float(v.start) for v in variables if v.causality == "parameter"}


def test_the_base_craft_gives_the_design_model_of_the_thesis() -> None:
    # T_N is printed with five digits, the duty with six
    for found, printed in zip(design_model(settings_of(CRAFT)), design_model(Settings()), strict=True):
        assert found == pytest.approx(printed, rel=1e-5, abs=1e-12)


def test_the_shipped_design_gives_the_gains_of_the_thesis(tmp_path: Path) -> None:
    cosim.build(tmp_path, "hovercraft", design=ROOT / "examples" / "hovercraft" / "design.yaml")
    starts, K = starts_of(tmp_path / "controller.fmu"), np.array(Settings().gain_matrix).ravel()
    assert [starts[name] for name in GAINS] == pytest.approx(K.tolist(), rel=1e-12)


def test_numbers_of_the_model_reach_the_fmu_and_those_given_win(tmp_path: Path) -> None:
    (tmp_path / "model.yaml").write_text("parameters: {mass: 0.9, lag: 0.12}\n")
    model = str(tmp_path / "model.yaml")
    starts = designed(tmp_path, "estimator: lagged\n", model)
    assert (starts["mass"], starts["lag"], starts["estimator"]) == (0.9, pytest.approx(0.12), "lagged")
    given = designed(tmp_path, "lag: 88.4 ms\nthrust_nominal: 2.4973 N\n", model)
    assert (given["mass"], given["lag"], given["thrust_nominal"]) == (0.9, 0.0884, 2.4973)
    assert given["k_1_2"] != starts["k_1_2"]


@pytest.mark.parametrize("controller", [POLES, INTEGRAL, PREDICTIVE, TIME_VARIANT])
def test_each_law_is_designed_for_a_refined_craft(controller: str, tmp_path: Path) -> None:
    (tmp_path / "model.yaml").write_text("parameters: {mass: 0.9, ixx: 0.012, izz: 0.02}\n")
    refined = designed(tmp_path, "", str(tmp_path / "model.yaml"), controller)
    changed = "k_1_4" if controller in (POLES, INTEGRAL) else "ixx"
    assert (refined["mass"], refined["izz"]) == (0.9, 0.02)
    assert refined[changed] != designed(tmp_path, "", controller=controller)[changed]


def test_a_designed_fmu_flies_as_one_that_is_given_its_start_values(project: Path, native_fmus: Path) -> None:
    starts = designed(project, "Q: [2, 0.5, 0.1, 0.01, 0]\nestimator: lagged\n")
    set_ = {name: starts[name] for name in (*GAINS, "estimator")}
    build_native(project / "built", "hovercraft", design=project / "design.yaml")
    for given, own in (
        ("build/controller.fmu", "built/controller.fmu"),
        (native_fmus / "controller-native.fmu", "built/controller-native.fmu"),
    ):
        one, other = (
            cosim.run(
                project / "scenarios" / "regulate.yaml",
                project / "out",
                force=True,
                set={"duration": 2, "criteria": {}, "components.controller.fmu": str(project / fmu), **more},
                report=False,
                in_process=True,
            )
            for fmu, more in (
                (given, {f"components.controller.start.{name}": v for name, v in set_.items()}),
                (own, {}),
            )
        )
        assert one.to_pandas().equals(other.to_pandas())


def test_a_sweep_over_designs_names_their_fmus(project: Path) -> None:
    for weight in (1, 400):
        designed(project, f"R: [{weight}, {weight}]")
        (project / "built").rename(project / f"tilt{weight}")
    (project / "sweep.yaml").write_text(
        "scenario: scenarios/regulate.yaml\nset: {duration: 0.1, criteria: {}, noise: off}\n"
        "signals: [controller.tilt_right]\n"
        "vary: {components.controller.fmu: {values: [tilt1/controller.fmu, tilt400/controller.fmu]}}\n"
    )
    swept = cosim.sweep(project / "sweep.yaml", project / "out", in_process=True, report=False)
    table, _ = read_table(swept.folder / TABLE)
    light, heavy = (tilts[0] for tilts in table.column("controller.tilt_right").to_pylist())
    assert abs(heavy) < 0.9 * abs(light)


# key → controller, and values that it cannot have; @ stands before the value at fault, without one it is the whole
NUMBER = ("fast", "[1]", "{a: 1}", ".nan", ".inf", "-1", "0", "true")
WRONG: dict[str, tuple[str, tuple[str, ...]]] = {
    "Q": ("controller.fmu", ("1", "wide", "[1, 0.5, 0.1, 0.01]", "[1, 0.5, 0.1, 0.01, 0, 0]",
                             "[1, 0.5, @-0.1, 0.01, 0]",
                             "[1, 0.5, @.nan, 0.01, 0]", "[1, @half, 0.1, 0.01, 0]", "[1, 0.5, 0.1, 0.01, @[0]]",
                             "[0, 0, 0, 0, 0]", "[1.0e+12, 0.5, 0.1, 0.01, 0]")),
    "R": ("controller.fmu", ("1", "[1]", "[1, 1, 1]", "[1, @0]", "[@-1, 1]", "[@.inf, 1]", "[@one, 1]",
                             "[1.0e-12, 1.0e-12]")),
    "poles": (POLES, ("-2", "fast", "[-2, -4]", "[-2, -4, -11, -4, -5, -6]", "[-2, @.nan, -11, -4, -5]",
                      "[-2, @fast, -11, -4, -5]", "[@2, -4, -11, -4, -5]", "[-2, -4, @-4, -4, -5]",
                      "[-2, -4, -11, @-4+1j, -5]", "[-2, -4, -11, -40, @-50]", "[-2, -4, @-1.0e+9, -4, -5]",
                      "[-2, -4, -11, @0, -5]", "[-2, -4, -11, @-0.0005, -5]", "[-2, -4, -11, -15, @-16]")),
    "Q_integral": (INTEGRAL, ("0.3", "[0.3]", "[0.3, 0.1, 1]", "[@0, 0.1]", "[0.3, @-0.1]", "[0.3, @.nan]")),
    "Q_lateral": (PREDICTIVE, ("1", "[1]", "[1, @-0.5]", "[1, @.nan]", "[@0, 0.5]", "[1, @1.0e+7]")),
    "R_duty": (PREDICTIVE, (*NUMBER, "1.0e+7")),
    "duty_limits": (PREDICTIVE, ("6", "[6]", "[6, 6.5, 7]", "[@-6, 7]", "[6, @.nan]", "[6, @101]", "[@6.5, 7]",
                                 "[6, @6.2]")),
    "speed_max": (PREDICTIVE, (*NUMBER[::3], "1000")),
    "horizon": (PREDICTIVE, (*NUMBER[::3], "50", "0.01")),
    "estimator": ("controller.fmu", ("kalman", "3", "[lagged]", "true")),
    "thrust_nominal": ("controller.fmu", (*NUMBER, "1000")),
    "lag": ("controller.fmu", (*NUMBER[::3], "1000", "3 N")),
    "Qq": ("controller.fmu", ("[1]",)),
}  # fmt: skip
CASES = [(controller, f"{key}: {value}") for key, (controller, values) in WRONG.items() for value in values]
CASES += [(TIME_VARIANT, f"{key}: {values[-1]}") for key, (of, values) in WRONG.items() if of == PREDICTIVE]
CASES += [(PREDICTIVE, "R: [1, 2]"), (TIME_VARIANT, "R: [1, 2]"), (PREDICTIVE, "Q: [@0, 1, 1, 1, 0]"),
          (TIME_VARIANT, "thrust_nominal: 30")]  # fmt: skip


@pytest.mark.parametrize(("controller", "line"), some(CASES, every=3))
def test_a_value_that_a_key_cannot_have_is_one_fault_at_its_place(controller: str, line: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refusal:
        designed(tmp_path, line.replace("@", ""), controller=controller)
    assert refusal.value.exit_code == 2
    (fault,) = refusal.value.faults
    key = line.partition(":")[0]
    column = line.index("@") + 1 if "@" in line else 1 if key == "Qq" else len(key) + 3
    assert (fault.line, fault.column) == (2, column)
    assert key in fault.message
    assert not (tmp_path / "built" / "plant.fmu").exists()


def test_a_scenario_with_a_design_names_the_command_instead(project: Path) -> None:
    path = project / "scenarios" / "old.yaml"
    path.write_text((project / "scenarios" / "regulate.yaml").read_text() + "design: {R: [1, 1]}\n")
    with pytest.raises(InputError) as refusal:
        cosim.run(path, project / "out")
    (fault,) = refusal.value.faults
    assert (fault.line, fault.column, refusal.value.exit_code) == (len(path.read_text().splitlines()), 1, 2)
    assert "cosim build --model MODEL --design FILE" in fault.message


@pytest.mark.thorough
def test_a_controller_designed_for_the_refined_craft_brings_it_home(project: Path) -> None:
    build(plant_recipe(HEAVIER), project / "build" / "plant.fmu")
    (project / "model.yaml").write_text("parameters:\n" + "".join(f"  {n}: {v}\n" for n, v in HEAVIER.items()))
    designed(project, "", str(project / "model.yaml"))
    for seed in (1, 2, 3):
        end, heading = {}, {}
        for fmu in ("build", "built"):
            set_ = {"components.controller.fmu": str(project / fmu / "controller.fmu")}
            results = cosim.run(project / "scenarios" / "regulate.yaml", project / f"{fmu}-{seed}", set=set_, seed=seed)
            end[fmu] = abs(results["plant.x"][-1])
            heading[fmu] = np.abs(results["plant.psi"][75:]).max()  # after 1.5 s
        # position is dead reckoning with the model's numbers: what they miss in 1 m stays
        assert end["built"] < 0.05 < 0.2 < end["build"]
        assert heading["built"] < heading["build"]
