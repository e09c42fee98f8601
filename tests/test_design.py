"""`cosim build --design`: start values of the controllers, for the craft as it is and for a refined one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

import cosim
from controller.settings import GAINS, Settings
from controller.synthesis import Q_INTEGRAL, lqr_gain, numbers_of, placed_gain
from cosim.core.errors import InputError
from cosim.fmi.building.build import build_native
from plant.hovercraft import Hovercraft
from tests.conftest import ROOT

POLES, INTEGRAL = "controller-pole.fmu", "controller-lqi.fmu"
PREDICTIVE, TIME_VARIANT = "controller-mpc.fmu", "controller-ltv-mpc.fmu"


def designed(
    folder: Path, text: str, model: str = "hovercraft", controller: str = "controller.fmu"
) -> Mapping[str, Any]:
    """The start values of a controller."""
    (folder / "design.yaml").write_text(f"controllers: [{controller}]\n{text}", encoding="utf-8")
    cosim.build(folder / "built", model, design=folder / "design.yaml")
    return starts_of(folder / "built" / controller.partition(",")[0])


def starts_of(fmu: Path) -> Mapping[str, Any]:
    variables = fmpy.read_model_description(str(fmu), validate=False).modelVariables
    return {v.name: v.start if v.type == "String" else float(v.start) for v in variables if v.causality == "parameter"}


def test_the_shipped_design_gives_the_gains_of_the_thesis(tmp_path: Path) -> None:
    cosim.build(tmp_path, "hovercraft", design=ROOT / "examples" / "hovercraft" / "design.yaml")
    starts, K = starts_of(tmp_path / "controller.fmu"), np.ravel(Settings().gain_matrix)
    assert [starts[name] for name in GAINS] == pytest.approx(K.tolist(), rel=1e-12)


def test_numbers_of_the_model_reach_each_law_and_those_given_win(tmp_path: Path) -> None:
    (tmp_path / "model.yaml").write_text("parameters: {mass: 0.9, lag: 0.12, ixx: 0.012, izz: 0.02}\n")
    model = str(tmp_path / "model.yaml")
    starts = designed(
        tmp_path, "estimator: lagged\n", model, f"controller.fmu, {POLES}, {INTEGRAL}, {PREDICTIVE}, {TIME_VARIANT}"
    )
    assert starts["estimator"] == "lagged"
    numbers: dict[str, Any] = numbers_of(Hovercraft(mass=0.9, lag=0.12, ixx=0.012, izz=0.02))
    craft = Settings(**numbers)
    integral = lqr_gain(craft, Q_integral=Q_INTEGRAL)[:, :5]
    for fmu, gain in (("controller.fmu", lqr_gain(craft)), (POLES, placed_gain(craft)), (INTEGRAL, integral)):
        starts = starts_of(tmp_path / "built" / fmu)
        assert (starts["mass"], starts["lag"], starts["izz"]) == (0.9, pytest.approx(0.12), 0.02)
        assert [starts[name] for name in GAINS] == pytest.approx(gain.ravel().tolist(), rel=1e-9)
    for fmu in (PREDICTIVE, TIME_VARIANT):
        assert starts_of(tmp_path / "built" / fmu).items() >= {"mass": 0.9, "izz": 0.02, "ixx": 0.012}.items()
    given = designed(tmp_path, "lag: 88.4 ms\nthrust_nominal: 2.4973 N\n", model)
    assert (given["mass"], given["lag"], given["thrust_nominal"]) == (0.9, 0.0884, 2.4973)


def test_a_designed_fmu_flies_as_one_that_is_given_its_start_values(project: Path, native_fmus: Path) -> None:
    starts = designed(project, "Q: [2, 0.5, 0.1, 0.01, 0]\nestimator: lagged\n")
    build_native(project / "built", "hovercraft", design=project / "design.yaml")
    given = {f"components.controller.start.{name}": starts[name] for name in (*GAINS, "estimator")}

    def flown(fmu: Path, **more: Any) -> Any:
        settings = {"duration": 2, "criteria": {}, "components.controller.fmu": str(fmu), **more}
        scenario = project / "scenarios" / "regulate.yaml"
        run = cosim.run(scenario, project / "out", force=True, set=settings, report=False, in_process=True)
        return run.to_pandas()

    for plain in (project / "build" / "controller.fmu", native_fmus / "controller-native.fmu"):
        assert flown(plain, **given).equals(flown(project / "built" / plain.name))


# controller → lines with a value that their key cannot have; @ stands before one that is not the whole
WRONG = {
    "controller.fmu": [
        "Q: wide", "Q: [1, 0.5, 0.1, 0.01]", "Q: [1, 0.5, @-0.1, 0.01, 0]", "Q: [1, @half, 0.1, 0.01, 0]",
        "Q: [0, 0, 0, 0, 0]", "Q: [1.0e+12, 0.5, 0.1, 0.01, 0]", "R: [1, @0]", "R: [@.inf, 1]", "R: [1.0e-12, 1.0e-12]",
        "estimator: kalman", "thrust_nominal: true", "thrust_nominal: 1000", "lag: 3 N", "@Qq: [1]",
    ],
    POLES: [
        "poles: [-2, -4]", "poles: [-2, @.nan, -11, -4, -5]", "poles: [@2, -4, -11, -4, -5]",
        "poles: [-2, -4, @-4, -4, -5]", "poles: [-2, -4, -11, @-4+1j, -5]", "poles: [-2, -4, @-1.0e+9, -4, -5]",
        "poles: [-2, -4, -11, -15, @-16]",
    ],
    INTEGRAL: ["Q_integral: [0.3]", "Q_integral: [@0, 0.1]"],
    PREDICTIVE: [
        "Q_lateral: [1, @-0.5]", "Q_lateral: [1, @1.0e+7]", "R_duty: [1]", "R_duty: 0", "duty_limits: [6]",
        "duty_limits: [@6.5, 7]", "duty_limits: [6, @101]", "speed_max: 0", "horizon: 50", "horizon: 0.01", "R: [1, 2]",
        "Q: [@0, 1, 1, 1, 0]",
    ],
    TIME_VARIANT: ["duty_limits: [6, @6.2]", "thrust_nominal: 30"],
}  # fmt: skip


@pytest.mark.parametrize(("controller", "line"), [(of, line) for of, lines in WRONG.items() for line in lines])
def test_a_value_that_a_key_cannot_have_is_one_fault_at_its_place(controller: str, line: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refusal:
        designed(tmp_path, line.replace("@", ""), controller=controller)
    assert refusal.value.exit_code == 2
    (fault,) = refusal.value.faults
    assert (fault.line, fault.column) == (2, (line.index("@") if "@" in line else line.index(" ") + 1) + 1)
    assert line.partition(":")[0].strip("@") in fault.message
    assert not (tmp_path / "built" / "plant.fmu").exists()


def test_a_scenario_with_a_design_names_the_command_instead(project: Path) -> None:
    path = project / "scenarios" / "old.yaml"
    path.write_text((project / "scenarios" / "regulate.yaml").read_text() + "design: {R: [1, 1]}\n")
    with pytest.raises(InputError, match="cosim build --model MODEL --design FILE") as refusal:
        cosim.run(path, project / "out")
    (fault,) = refusal.value.faults
    assert (fault.line, fault.column, refusal.value.exit_code) == (len(path.read_text().splitlines()), 1, 2)
