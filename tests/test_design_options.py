"""Every key of `design:` with values that it cannot have: one fault each, at the value, named as it was written."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.designer import DESIGNER
from controller.variants import INTEGRAL, POLES, PREDICTIVE, TIME_VARIANT
from cosim.base.errors import InputError
from cosim.fmi.fmu_build import build
from cosim.scenario.controller_design import designed_values
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system
from fmus.recipes import integral_recipe, poles_recipe, predictive_recipe, time_variant_recipe
from tests.cases import some

FMUS = {
    "": "controller",
    POLES: "controller-pole",
    INTEGRAL: "controller-lqi",
    PREDICTIVE: "controller-mpc",
    TIME_VARIANT: "controller-ltv-mpc",
}
NUMBER = ("fast", "[1]", "{a: 1}", ".nan", ".inf", "-1", "0", "true")
ALSO = NUMBER[::3]  # of another number, which is read alike
# key → law, and what it cannot be; @ stands before the value that is at fault, without one the whole is
WRONG: dict[str, tuple[str, tuple[str, ...]]] = {
    "component": ("", ("3", "[controller]", "9controller", "nobody")),
    "model": ("", ("3", "[a]", "nowhere.yaml")),
    "nearest": ("", ("2.5", "maybe", "on")),
    "Q": ("", ("1", "wide", "[1, 0.5, 0.1, 0.01]", "[1, 0.5, 0.1, 0.01, 0, 0]", "[1, 0.5, @-0.1, 0.01, 0]",
               "[1, 0.5, @.nan, 0.01, 0]", "[1, @half, 0.1, 0.01, 0]", "[1, 0.5, 0.1, 0.01, @[0]]",
               "[0, 0, 0, 0, 0]", "[1.0e+12, 0.5, 0.1, 0.01, 0]")),
    "R": ("", ("1", "[1]", "[1, 1, 1]", "[1, @0]", "[@-1, 1]", "[@.inf, 1]", "[@one, 1]", "[1.0e-12, 1.0e-12]")),
    "poles": (POLES, ("-2", "fast", "[-2, -4]", "[-2, -4, -11, -4, -5, -6]", "[-2, @.nan, -11, -4, -5]",
                      "[-2, @fast, -11, -4, -5]", "[@2, -4, -11, -4, -5]", "[-2, -4, @-4, -4, -5]",
                      "[-2, -4, -11, @-4+1j, -5]", "[-2, -4, -11, -40, @-50]", "[-2, -4, @-1.0e+9, -4, -5]")),
    "Q_integral": (INTEGRAL, ("0.3", "[0.3]", "[0.3, 0.1, 1]", "[@0, 0.1]", "[0.3, @-0.1]", "[0.3, @.nan]")),
    "Q_lateral": (PREDICTIVE, ("1", "[1]", "[1, @-0.5]", "[1, @.nan]", "[@0, 0.5]", "[1, @1.0e+7]")),
    "R_duty": (PREDICTIVE, (*NUMBER, "1.0e+7")),
    "duty_limits": (PREDICTIVE, ("6", "[6]", "[6, 6.5, 7]", "[@-6, 7]", "[6, @.nan]", "[6, @101]", "[@6.5, 7]",
                                 "[6, @6.2]")),
    "speed_max": (PREDICTIVE, (*ALSO, "1000")),
    "horizon": (PREDICTIVE, (*ALSO, "50", "0.01")),
    "estimator": ("", ("kalman", "3", "[lagged]", "true")),
    "thrust_nominal": ("", (*NUMBER, "1000")),
    "lag": ("", (*ALSO, "1000")),
    "Qq": ("", ("[1]",)),
}  # fmt: skip
CASES = [(key, law, value) for key, (law, values) in WRONG.items() for value in values]
CASES += [(key, TIME_VARIANT, values[-1]) for key, (law, values) in WRONG.items() if law == PREDICTIVE]
LINE = 10


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, plant_fmu: Path, controller_fmu: Path) -> Path:
    made = tmp_path_factory.mktemp("options")
    (made / "plant.fmu").symlink_to(plant_fmu)
    (made / "controller.fmu").symlink_to(controller_fmu)
    recipes = poles_recipe, integral_recipe, predictive_recipe, time_variant_recipe
    for law, recipe in zip((POLES, INTEGRAL, PREDICTIVE, TIME_VARIANT), recipes, strict=True):
        build(recipe(), made / f"{FMUS[law]}.fmu")
    return made


def scenario(folder: Path, law: str, *options: str) -> Path:
    """The regulator with this design, its options from line 10 on."""
    path = Path(__file__).resolve().parent.parent / "scenarios" / "regulate.yaml"
    text = path.read_text(encoding="utf-8").replace("../build/", "").replace("controller.fmu", f"{FMUS[law]}.fmu")
    first, last = text.index("design:"), text.index("components:")
    design = "".join(f"  {option}\n" for option in options)
    (folder / "mine.yaml").write_text(f"{text[:first]}design:\n{design}{text[last:]}", encoding="utf-8")
    return folder / "mine.yaml"


def faults_of(path: Path) -> InputError:
    try:
        file = ScenarioFile(path)
        build_system(file, designed_values(file))
    except InputError as error:
        return error
    pytest.fail(f"{path} is taken")


def test_every_key_of_a_design_is_tried() -> None:
    assert WRONG.keys() == {*DESIGNER.options, "component", "model", "nearest", "Qq"}


@pytest.mark.parametrize(
    ("key", "law", "value"),
    some(CASES, every=3),
)
def test_a_value_that_an_option_cannot_have_is_one_fault_at_its_place(
    folder: Path, key: str, law: str, value: str
) -> None:
    error = faults_of(scenario(folder, law, f"{key}: {value.replace('@', '')}"))
    assert error.exit_code == 2
    told = [fault for fault in error.faults if "which no controller" not in fault.message]
    assert len(told) == 1, told
    column = 3 if key == "Qq" else 5 + len(key) + max(0, value.find("@"))
    assert (told[0].line, told[0].column) == (LINE, column)
    assert key in told[0].message
    assert "controller." not in told[0].message


def test_faults_of_several_options_are_told_at_once(folder: Path) -> None:
    path = scenario(folder, PREDICTIVE, "horizon: 50", "duty_limits: [6, 200]", "R: [1, 2]", "lag: 99")
    assert [(f.line, f.message.split(":")[0]) for f in faults_of(path).faults] == [
        (LINE, "horizon"), (LINE + 1, "duty_limits"), (LINE + 2, "R"), (LINE + 3, "lag")
    ]  # fmt: skip


def test_an_estimator_that_is_given_twice_is_a_contradiction_at_the_start_value(folder: Path) -> None:
    path = scenario(folder, "", "estimator: lagged")
    path.write_text(path.read_text(encoding="utf-8").replace("tilt_max: 12 deg", "estimator: consistent"))
    (fault,) = faults_of(path).faults
    assert path.read_text(encoding="utf-8").splitlines()[fault.line - 1][fault.column - 1 :].startswith("consistent")
    assert fault.message == "estimator is consistent here and lagged in design: leave one of them out"
    path.write_text(path.read_text(encoding="utf-8").replace("consistent", "lagged"), encoding="utf-8")
    file = ScenarioFile(path)
    assert designed_values(file)["controller"]["estimator"] == "lagged"


def test_a_number_that_design_and_component_take_differently_is_a_warning(folder: Path) -> None:
    path = scenario(folder, "", "lag: 0.0884")
    path.write_text(path.read_text(encoding="utf-8").replace("tilt_max: 12 deg", "lag: 0.1"), encoding="utf-8")
    file = ScenarioFile(path)
    assert designed_values(file)
    assert file.warnings == [
        "lag is 0.1 in components.controller.start and 0.0884 in design: it runs with the first and is designed with"
        " the second"
    ]


@pytest.mark.parametrize(
    ("given", "told"),
    [("mass: 3", "mass is 3"), ("friction: 5", "friction is 5"), ("friction: 5 N.s/m", "friction is 5"),
     ("mass: 0.705", ""), ("fix_latency: 0.1", ""), ('lag: "100 ms"', "lag is 0.1")],
)  # fmt: skip
@pytest.mark.parametrize("options", [("model: base",), ("R: [2, 2]",)])
def test_every_number_of_the_design_model_that_the_component_takes_differently_is_a_warning(
    folder: Path, options: tuple[str, ...], given: str, told: str
) -> None:
    path = scenario(folder, "", *options)
    path.write_text(path.read_text(encoding="utf-8").replace("tilt_max: 12 deg", given), encoding="utf-8")
    file = ScenarioFile(path)
    designed_values(file)
    said = [w for w in file.warnings if "designed with the second" in w]
    assert [w.split(" in ")[0] for w in said] == [told] * bool(told)


@pytest.mark.parametrize(
    ("pole", "why"), [("0", "is not stable"), ("1.0e-4", "is not stable"), ("-0.0005", "too slow")]
)
def test_a_stable_pole_that_is_refused_is_not_called_unstable(folder: Path, pole: str, why: str) -> None:
    (fault,) = faults_of(scenario(folder, POLES, f"poles: [-2, -4, -11, {pole}, -5]")).faults
    assert why in fault.message
    assert ("not stable" in fault.message) == (float(pole) >= 0.0)
    path = scenario(folder, POLES, "poles: [-2, -4, -11, -0.001, -5]")  # the cure that is told
    assert designed_values(ScenarioFile(path))


def test_a_bound_of_a_number_without_unit_is_told_without_one(folder: Path) -> None:
    path = scenario(folder, PREDICTIVE, "Q: [1, 0.5, 0.1, 0.01, 0]")
    path.write_text(path.read_text(encoding="utf-8").replace("tilt_max: 12 deg", "iterations_max: 0"), encoding="utf-8")
    (fault,) = faults_of(path).faults
    assert fault.message == "controller.iterations_max is 0; it lies in [1, 100000]"
