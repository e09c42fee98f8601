"""Control laws: their behaviour as functions and in their FMUs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fmpy.validation import validate_fmu
from scipy.optimize import lsq_linear

from controller.closed_loop import manoeuvre
from controller.design_model import design_model, discretize
from controller.designer import PREDICTIVE, DesignFile, controller_starts
from controller.loop import LawInput, Loop
from controller.predictive import PREDICTED, PREDICTED_STATES, PredictiveLaw
from controller.settings import (
    GAINS,
    INTEGRAL_SETTINGS,
    PLACED_SETTINGS,
    PLANT_STATES,
    PredictiveSettings,
    Settings,
    TimeVariantSettings,
    craft_of,
)
from controller.synthesis import (
    POLES,
    Q_INTEGRAL,
    lqr_gain,
    placed_gain,
)
from cosim.fmi.fmu_build import build
from cosim.model import Stepper
from cosim.model.symbolic.linearize import linearize
from cosim.simulation.workflow import run
from fmus.recipes import integral_recipe, poles_recipe, predictive_recipe, time_variant_recipe
from plant.hovercraft import Hovercraft
from tests.controllers import LAWS, LEGS, WITHIN, figure_6_2, fly, predictive
from tests.hosts_fmpy import Instance, refused

STEP = 0.02
MPC = PredictiveSettings()
LTV = TimeVariantSettings()
RECIPES = {"poles": poles_recipe, "LQI": integral_recipe, "MPC": predictive_recipe, "LTV": time_variant_recipe}


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory, controller_fmu: Path) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("laws")
    return {"LQR": controller_fmu} | {name: build(recipe(), folder / f"{name}.fmu") for name, recipe in RECIPES.items()}


# -- pole placement and integrals ---------------------------------------------------------------


def test_the_poles_stand_where_they_are_asked_for() -> None:
    A, B = design_model(Settings())
    for poles in (POLES, (-1.5, -3 + 1j, -3 - 1j, -4 + 2j, -4 - 2j)):
        placed = np.linalg.eigvals(A - B @ placed_gain(Settings(), poles))
        # a double pole is found to the root of a rounding
        np.testing.assert_allclose(np.sort_complex(placed), np.sort_complex(np.array(poles, dtype=complex)), atol=1e-6)
    assert pytest.approx(placed_gain(Settings()), rel=1e-9) == np.array(PLACED_SETTINGS.gain_matrix)


def test_the_frozen_gains_with_integrals_are_the_designed_ones() -> None:
    p = INTEGRAL_SETTINGS
    assert pytest.approx(lqr_gain(Settings(), Q_integral=Q_INTEGRAL), rel=1e-9) == np.array(p.gain_matrix)


def test_the_measured_position_has_no_steady_error_with_fixes_and_keeps_one_with_the_imu_alone() -> None:
    tilted = Hovercraft().with_values({"table_tilt.x": 0.003})
    left = {
        (name, fixes): abs(float(f.y["x"][-250:].mean()))
        for name in ("LQR", "LQI")
        for fixes in (False, True)
        for f in [fly(name, duration=30.0, craft=tilted, fixes=fixes)]
    }
    assert left["LQI", True] < 1e-3 < 0.03 < left["LQR", True]  # no noise here
    assert left["LQI", False] > 1.0  # 0.003·g is felt by nobody: dead reckoning is off by metres


# -- prediction ---------------------------------------------------------------------------------


def test_the_predicted_model_is_the_linearised_plant_entry_by_entry() -> None:
    craft = Hovercraft().with_values(
        {"mass": 0.8, "lag": 0.1, "table_roll_stiffness": 3.0, "yaw_damping.coefficient": 0.004}
    )
    starts, *_ = controller_starts(PREDICTIVE, DesignFile(), craft)
    linear, predicted = linearize(craft), linearize(craft_of(PredictiveSettings(**starts)))
    assert linear.states[:14] == PLANT_STATES
    np.testing.assert_allclose(predicted.A, linear.A, atol=1e-9)
    np.testing.assert_allclose(predicted.B, linear.B, atol=1e-9)
    law = predictive(PredictiveSettings(**starts))
    _, A, B = law.hover
    np.testing.assert_allclose(A, linear.A[np.ix_(PREDICTED, PREDICTED)], atol=1e-9)
    np.testing.assert_allclose(B, linear.B[PREDICTED], atol=1e-9)


def test_the_solver_finds_what_another_one_does() -> None:
    law = predictive(MPC)
    cost, scale = law.cost, law.scale
    root = np.linalg.cholesky(cost.H).T  # ½·U'·H·U + q'·U = ½·|root·U + root⁻ᵀ·q|² + …
    for seed in range(5):
        z = np.random.default_rng(seed).normal(size=len(PREDICTED_STATES)) * 0.3
        target = -np.linalg.solve(root.T, cost.f @ z)
        best = lsq_linear(root, target, tuple(law.limits), tol=1e-12).x
        law.solve(cost.at(z))
        assert law.solved
        np.testing.assert_allclose(law.last, scale * best[:4], atol=1e-6)


def test_the_predictive_law_holds_y_with_fixes() -> None:
    start = {"y": 0.2}
    held_back = fly("MPC", start=start, fixes=True, duration=8.0)
    assert np.abs(held_back.y["y"][-50:]).max() < 0.01
    assert held_back.command[:, :2].min() >= 6.0
    assert held_back.command[:, :2].max() <= 7.0
    assert np.abs(fly("LQR", start=start, fixes=True, duration=8.0).y["y"][-50:]).min() > 0.1


# -- prediction with A(t), B(t) -----------------------------------------------------------------


@pytest.fixture(scope="module")
def planned() -> PredictiveLaw:
    """The law after some programs for the same craft at rest, of which each linearises the plan before it."""
    law, seen = predictive(LTV), LawInput(1.5, -1.0, y_ref=0.3)
    law.estimator(LTV, [0.0] * 5, 0.0)
    for _ in range(4):
        law.command([], seen)
        law.path[1:], law.plan[1:] = law.path[:-1].copy(), law.plan[:-1].copy()  # no time passes
    law.command([], seen)
    return law


def test_a_t_and_b_t_are_those_of_the_linearised_plant_all_along_the_plan(planned: PredictiveLaw) -> None:
    states = np.zeros((len(planned.plan), len(PLANT_STATES)))
    states[:, PREDICTED] = planned.path[:-1]
    A, B = (planned.slopes.along(of, states, planned.plan) for of in ("state", "command"))
    for k in (0, 7, 30, 99):
        linear = linearize(planned.craft, states[k].tolist(), planned.plan[k].tolist())
        np.testing.assert_allclose(A[k], linear.A, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(B[k], linear.B, rtol=1e-11, atol=1e-11)
    turning = A[:, PLANT_STATES.index("psi_dot"), PLANT_STATES.index("tilt_right")]
    assert np.ptp(turning) > 0.3 * turning[0]  # the thrust of 6 to 7 % of duty: it is time-variant


def test_the_plan_is_what_the_craft_does_where_one_linearisation_misses_it(planned: PredictiveLaw) -> None:
    """A turn of 1 rad while it moves 1.5 m: the motors share the work, and thrust times tilt is no linear thing."""
    hover, A, B = planned.hover
    F, G = discretize(A, B, MPC.prediction_step)
    stepper, linear = Stepper(Hovercraft()), [np.zeros(len(PREDICTED_STATES))]
    moment = stepper.start()
    flown = [np.array(moment.state)[PREDICTED]]
    for u in planned.plan:
        moment = stepper.step(moment, tuple(u.tolist()), LTV.prediction_step)
        flown.append(np.array(moment.state)[PREDICTED])
        linear.append(F @ linear[-1] + G @ (u - planned.rest))
    x, psi = PREDICTED_STATES.index("x"), PREDICTED_STATES.index("psi")
    missed = np.abs(np.array(flown) - planned.path).max(axis=0)
    once = np.abs(np.array(flown) - hover - np.array(linear)).max(axis=0)
    assert missed[psi] < 0.03 < 2.0 < once[psi]
    assert missed[x] < 0.005 < 0.3 < once[x]


# -- all of them --------------------------------------------------------------------------------


def test_figure_6_2_of_each_law() -> None:
    found = figure_6_2()
    assert found["LQR"][:2] == pytest.approx((3.22, 1.86))  # as printed for the 12° saturation
    assert found["poles"][0] < found["LQR"][0]
    assert all(tilt == pytest.approx(12.0, abs=1e-9) for _, _, tilt in found.values())
    assert all(x < 7.0 and psi < 5.0 for x, psi, _ in found.values())


@pytest.mark.thorough
@pytest.mark.parametrize("name", LAWS)
def test_the_manoeuvre_of_app_g_is_within_10_percent_and_15_degrees(name: str) -> None:
    f = fly(name, manoeuvre, 26.0, seed=1)
    for end, what in (*LEGS, (26, "x")):
        row = round(end / STEP) - 1
        assert abs(f.y[what][row] - f.wanted[what][row]) < WITHIN[what], (end, what)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("LQR", dict(zip(GAINS, (0.01 * np.arange(1, 11)).tolist(), strict=True)) | {"tilt_max": 0.1}),
        ("LQR", {"estimator": "lagged"}),
        ("LQR", {"estimator": "consistent", "mass": 0.9, "fix_latency": 0.06}),
        *((name, {}) for name in RECIPES),
    ],
)
def test_an_fmu_commands_as_its_loop_does(fmus: dict[str, Path], name: str, values: dict[str, float | str]) -> None:
    settings, make = LAWS[name]
    settings = replace(settings, **values)
    loop = Loop(settings, [0.3, 0.0, -0.2, 0.0, 0.0], 0.1, 0.2, 0.0, 0.0, 2.0, law=make(settings))
    rng = np.random.default_rng(5)
    if "k_1_1" in values:
        assert np.ravel(settings.gain_matrix).tolist() == [values[gain] for gain in GAINS]

    assert validate_fmu(str(fmus[name])) == []
    with Instance(fmus[name]) as controller:
        # the first command comes before any update: measurements far off would show
        start = {"x_hat_start": 0.3, "psi_hat_start": -0.2, "x_ref": 0.1, "psi_ref": 0.2, "fix": 2.0, "psi": 3.0}
        assert list(controller.initialize(values | start).outputs().values()) == loop.outputs()
        for k in range(60):
            row = (*(0.1 * rng.normal(size=5)).tolist(), 0.2, 0.1, float(2 + k // 5))
            loop.step(row[:3], *row[3:])
            inputs = dict(
                zip(("psi", "psi_dot", "ax", "x_ref", "psi_ref", "x_meas", "y_meas", "fix"), row, strict=True)
            )
            state = controller.serialized()
            assert list(controller.step(STEP * k, STEP, inputs).values()) == loop.outputs()
            if k % 20 == 10:  # taken back, hot start and all, it commands the same again
                controller.restore(state)
                assert list(controller.step(STEP * k, STEP, inputs).values()) == loop.outputs()


@pytest.mark.parametrize(
    ("values", "length", "said"), [({}, 0.0199, "sample_time"), ({"estimator": "unscented"}, STEP, "consistent")]
)
def test_another_step_or_estimator_is_refused(
    controller_fmu: Path, values: dict[str, str], length: float, said: str
) -> None:
    def call(controller: Instance) -> None:
        controller.call("exitInitializationMode")
        controller.step(0.0, length)

    assert said in refused(controller_fmu, values, call)


@pytest.mark.thorough
def test_one_line_swaps_the_controller_and_a_solver_that_gives_up_is_a_warning(
    project: Path, fmus: dict[str, Path]
) -> None:
    swap = [f"components.controller.fmu={fmus['MPC']}", "criteria={}", "duration=4"]
    for more in ([], ["components.controller.start.iterations_max=3"]):
        outcome = run(project / "scenarios" / "regulate.yaml", project / f"{more}", [*swap, *more], in_process=True)
        assert abs(outcome.results["plant.x"][-1]) < 0.15
        failed = outcome.results["controller.solved"] == 0
        told = [f"{failed.sum()} of {len(failed)}" in warning for warning in outcome.manifest["warnings"]]
        assert told == [True] * bool(more)


def test_a_scheduler_cuts_the_inputs_off(project: Path) -> None:
    """App. G: after a stated time every input of the craft is disconnected, whatever the controller commands."""
    inputs = ("duty_right", "duty_left", "tilt_right", "tilt_left")
    cut = ", ".join(f"{{on: plant.{name}, kind: stuck, value: 0, from: 0.5}}" for name in inputs)
    settings = ["duration=2", "criteria={}", f"faults=[{cut}]"]
    scenario = project / "scenarios" / "regulate.yaml"
    results = run(scenario, project / "cut", settings, report=False, in_process=True).results
    assert results["plant.thrust_right"][25] > 2.0  # [N], t = 0.5 s
    assert results["plant.thrust_right"][-1] < 1e-6  # 17 lags later
    assert np.abs(results["controller.tilt_right"][-50:]).max() > 0.01  # it still commands
