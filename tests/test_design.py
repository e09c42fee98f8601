"""`design: {model: …}`: the controller designed for a refined craft, what enters its five states, and what it gains."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller.closed_loop import ClosedLoop
from controller.design_model import design_model
from controller.gains import Settings
from controller.synthesis import lqr_gain, numbers_of
from cosim.base.registry import rig_of
from cosim.fmi.fmu_build import build
from cosim.loading.file import own_model
from cosim.scenario.controller_design import designed_values
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.workflow import run
from fmus.recipes import plant_recipe
from plant.hovercraft import Hovercraft

CRAFT = Hovercraft()
HEAVIER: dict[str, float | bool] = {"mass": 1.0, "friction": 0.4, "yaw_damping.coefficient": 0.02}


@pytest.fixture
def project(project: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The project, from the folder of its scenarios: names of files in overrides are from here."""
    monkeypatch.chdir(project / "scenarios")
    return project


def model_file(project: Path, text: str) -> Path:
    path = project / "scenarios" / "model.yaml"
    path.write_text(text)
    return path


def settings_of(craft: Hovercraft) -> Settings:
    return replace(Settings(), **numbers_of(craft))


def test_the_base_craft_gives_the_design_model_of_the_thesis() -> None:
    # T_N is printed with five digits, the duty with six
    for found, printed in zip(design_model(settings_of(CRAFT)), design_model(Settings()), strict=True):
        assert found == pytest.approx(printed, rel=1e-5, abs=1e-12)


def test_a_lag_of_second_order_counts_by_its_mean_delay_and_a_delay_adds_to_it() -> None:
    slow = {"actuator_second_order.natural_frequency": 14.0, "actuator_second_order.damping_ratio": 0.5}
    assert numbers_of(CRAFT.with_values(slow))["lag"] == pytest.approx(2 * 0.5 / 14.0, rel=1e-9)  # 2ζ/ωₙ
    late = CRAFT.with_values(slow | {"actuator_delay.time": 0.06})
    assert numbers_of(late)["lag"] == pytest.approx(2 * 0.5 / 14.0 + 0.06, rel=1e-9)


def test_what_opposes_motion_counts_by_force_over_speed_at_the_working_speed() -> None:
    # at 0.4 m/s and 1 rad/s: 0.25 + 0.5·0.4 + 0.04/0.4 N s/m and 0.004 + 0.003/1 N m s; a slope is no friction
    craft = CRAFT.with_values(
        {
            "quadratic_drag.coefficient": 0.5,
            "coulomb_friction.force": 0.04,
            "yaw_damping.coefficient": 0.004,
            "yaw_coulomb_friction.moment": 0.003,
            "table_tilt.x": 0.003,
        }
    )
    numbers = numbers_of(craft)
    assert numbers["friction"] == pytest.approx(0.55, rel=1e-9)
    assert numbers["yaw_damping"] == pytest.approx(0.007, rel=1e-9)


def test_yaw_that_is_damped_already_is_damped_less_by_the_controller() -> None:
    damped = CRAFT.with_values({"yaw_damping.coefficient": 0.02})
    assert abs(lqr_gain(settings_of(damped))[0, 3]) < abs(lqr_gain(Settings())[0, 3])


def test_numbers_of_the_model_reach_the_component_and_those_given_win(project: Path) -> None:
    model_file(project, "parameters: {mass: 0.9, lag: 0.12}\n")
    scenario = project / "scenarios" / "regulate.yaml"
    values = designed_values(ScenarioFile(scenario, ["design.model=model.yaml"]))["controller"]
    assert (values["mass"], values["lag"], values["thrust_nominal"]) == (0.9, 0.0884, 2.4973)  # the scenario's own
    freed = ["design={model: model.yaml, estimator: lagged}"]
    values = designed_values(ScenarioFile(scenario, freed))["controller"]
    assert (values["mass"], values["lag"], values["estimator"]) == (0.9, pytest.approx(0.12), "lagged")
    again = designed_values(ScenarioFile(scenario, freed))["controller"]  # from the cache
    assert again == values


def test_a_design_is_cached_by_the_content_of_its_model(project: Path) -> None:
    scenario = project / "scenarios" / "regulate.yaml"
    gains = []
    for mass in (0.7, 1.4):
        model_file(project, f"parameters: {{mass: {mass}}}\n")
        gains.append(designed_values(ScenarioFile(scenario, ["design={model: model.yaml}"]))["controller"]["k_1_2"])
    assert gains[0] != gains[1]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "no such file"),
        ("parameters: {mass: -1, izzz: 2}\n", 'no parameter "izzz"; did you mean "izz"?'),
        ("model: DRIVE:Drive\nparameters: {}\n", "no controller is designed for it here"),
    ],
)
def test_a_model_that_cannot_be_designed_for_is_a_fault_of_the_scenario(
    project: Path, text: str | None, words: str
) -> None:
    drive = Path(__file__).parent.parent / "examples" / "drive" / "drive.py"
    if text:
        model_file(project, text.replace("DRIVE", str(drive)))
    file = ScenarioFile(project / "scenarios" / "regulate.yaml", ["design.model=model.yaml"])
    assert designed_values(file) == {}
    assert any(words in str(fault) for fault in file.faults)


def test_options_of_no_designer_are_faults_wherever_they_stand(project: Path) -> None:
    scenario = project / "scenarios" / "regulate.yaml"
    file = ScenarioFile(scenario, ["design.lagg=0.1", "design.q=[1]"])
    assert designed_values(file) == {}
    told = " ".join(map(str, file.faults))
    assert 'unknown key "lagg"; did you mean "lag"?' in told
    assert 'unknown key "q"' in told


def test_what_is_made_from_the_craft_is_designed_for_as_the_craft(project: Path) -> None:
    text = "from plant.hovercraft import Hovercraft\n\n\nclass Mine(Hovercraft):\n    pass\n"
    (project / "scenarios" / "mine.py").write_text(text)
    scenario, base = project / "scenarios" / "regulate.yaml", model_file(project, "parameters: {}\n").name
    mine, of_base = (
        designed_values(ScenarioFile(scenario, [f"design={{model: {model}}}"])) for model in ("'mine.py:Mine'", base)
    )
    assert mine == of_base
    assert rig_of(type(own_model("mine.py:Mine", scenario.parent)), None) is ClosedLoop


def test_a_manifest_says_what_was_designed_for_defaults_too(project: Path) -> None:
    scenario = project / "scenarios" / "regulate.yaml"
    run(scenario, project / "out", ["duration=1.0", "design={R: [2, 1]}", "criteria={}"], report=False)
    design = json.loads((project / "out" / "manifest.json").read_text())["design"]
    assert design == {"component": "controller", "Q": [1.0, 0.5, 0.1, 0.01, 0.0], "R": [2.0, 1.0]}


@pytest.mark.thorough
def test_a_controller_designed_for_the_refined_craft_brings_it_home(project: Path) -> None:
    build(plant_recipe(HEAVIER), project / "build" / "plant.fmu")
    model_file(project, "parameters:\n" + "".join(f"  {name}: {value}\n" for name, value in HEAVIER.items()))
    designs: dict[str, list[str]] = {"old": [], "new": ["design={model: model.yaml}"]}
    for seed in (1, 2, 3):
        end, heading = {}, {}
        for name, design in designs.items():
            scenario = project / "scenarios" / "regulate.yaml"
            outcome = run(scenario, project / name, [*design, f"seed={seed}"], report=False)
            end[name] = abs(outcome.results["plant.x"][-1])
            heading[name] = np.abs(outcome.results["plant.psi"][75:]).max()  # after 1.5 s
        # position is dead reckoning with the model's numbers: what they miss in 1 m stays
        assert end["new"] < 0.05 < 0.2 < end["old"]
        assert heading["new"] < heading["old"]
    manifest = json.loads((project / "new" / "manifest.json").read_text())
    assert Path(manifest["design"]["model"]).resolve() == project / "scenarios" / "model.yaml"
    assert "design" not in manifest["scenario"]  # repeated from its numbers, whatever becomes of the model file
    assert manifest["scenario"]["components"]["controller"]["start"]["mass"] == 1.0
