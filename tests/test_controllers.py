"""Pole placement, integrals and prediction: what each law does, by itself, in its FMU, and designed by a scenario."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are, solve_discrete_are
from scipy.optimize import lsq_linear

from controller.design_model import PLANT_INPUTS, design_model, discretize, full_model
from controller.laws import LawInput
from controller.loop import Loop
from controller.predictive import NAMES, PREDICTED, PredictiveLaw, TimeVariantLaw
from controller.settings import (
    INTEGRAL_SETTINGS,
    PLACED_SETTINGS,
    PLANT_STATES,
    PredictiveSettings,
    Settings,
    TimeVariantSettings,
)
from controller.synthesis import (
    POLES,
    Q_INTEGRAL,
    Q_THESIS,
    R_THESIS,
    lqr_gain,
    numbers_of,
    placed_gain,
    roll_numbers_of,
)
from cosim.fmi.fmu_build import build
from cosim.model import Stepper
from cosim.model.symbolic.linearize import linearize
from cosim.simulation.workflow import run
from fmus.recipes import integral_recipe, poles_recipe, predictive_recipe, time_variant_recipe
from plant.hovercraft import Hovercraft
from tests.controllers import LAWS, WITHIN, figure_6_2, fly, manoeuvre, time_variant
from tests.hosts_fmpy import Instance

STEP = 0.02
MPC = PredictiveSettings()
LTV = TimeVariantSettings()
RECIPES = {"pole": poles_recipe, "lqi": integral_recipe, "mpc": predictive_recipe, "ltv-mpc": time_variant_recipe}


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("laws")
    return {name: build(recipe(), folder / f"controller-{name}.fmu") for name, recipe in RECIPES.items()}


@pytest.fixture
def flown(project: Path, fmus: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """The project with all controllers built, from the folder of its scenarios."""
    for path in fmus.values():
        shutil.copy(path, project / "build" / path.name)
    monkeypatch.chdir(project / "scenarios")
    return project


# -- pole placement -----------------------------------------------------------------------------


def test_the_poles_stand_where_they_are_asked_for() -> None:
    A, B = design_model(Settings())
    for poles in (POLES, (-1.5, -3 + 1j, -3 - 1j, -4 + 2j, -4 - 2j)):
        placed = np.linalg.eigvals(A - B @ placed_gain(Settings(), poles))
        # a double pole is found to the root of a rounding
        np.testing.assert_allclose(np.sort_complex(placed), np.sort_complex(np.array(poles, dtype=complex)), atol=1e-6)


def test_the_frozen_gain_is_the_placed_one() -> None:
    assert pytest.approx(placed_gain(Settings()), rel=1e-9) == np.array(PLACED_SETTINGS.gain_matrix)


@pytest.mark.parametrize(
    "poles",
    [
        (0.5, -4, -11, -4, -5),
        (-2, -4, -11, 0.0, -5),
        (-2, -4, -4, -5, -6),
        (-2, -4, -11, -5, -5),
        (-2, -4 + 1j, -11, -4 - 1j, -5),
    ],
)
def test_poles_that_cannot_be_are_refused(poles: tuple[complex, ...]) -> None:
    with pytest.raises(ValueError, match=r"rad/s|axis"):
        placed_gain(Settings(), poles)


# -- integrals ----------------------------------------------------------------------------------


def test_the_frozen_gains_with_integrals_are_the_designed_ones_and_solve_the_riccati_equation() -> None:
    K, K_i = np.hsplit(lqr_gain(Settings(), Q_integral=Q_INTEGRAL), [5])
    p = INTEGRAL_SETTINGS
    assert pytest.approx(K, rel=1e-9) == np.array(p.gain_matrix)
    assert pytest.approx(K_i, rel=1e-9) == np.array(p.integral_matrix)
    A, B = design_model(p)
    both = np.block([[A, np.zeros((5, 2))], [np.eye(5)[[0, 2]], np.zeros((2, 2))]])
    B = np.vstack([B, np.zeros((2, 2))])
    P = solve_continuous_are(both, B, np.diag([*Q_THESIS, 0.3, 0.05]), np.diag(R_THESIS))
    np.testing.assert_allclose(B.T @ P, np.hstack([K, K_i]), rtol=1e-6, atol=1e-7)  # R = I


def test_the_measured_position_has_no_steady_error_with_fixes_and_keeps_one_with_the_imu_alone() -> None:
    tilted = Hovercraft().with_values({"table_tilt.x": 0.003})
    left = {
        (name, fixes): abs(float(f.pose[-250:, 0].mean()))
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
    linear = linearize(craft)
    p = PredictiveSettings(**{**numbers_of(craft), **roll_numbers_of(craft), "duty_max": 9.0})
    A, B = full_model(p)
    assert linear.states[:14] == PLANT_STATES
    assert linear.inputs == PLANT_INPUTS
    np.testing.assert_allclose(A, linear.A[:14, :14], atol=1e-9)
    np.testing.assert_allclose(B, linear.B[:14], atol=1e-9)


def test_the_solver_finds_what_another_one_does() -> None:
    law = PredictiveLaw(MPC)
    cost, scale = law.cost, law.scale
    root = np.linalg.cholesky(cost.H).T  # ½·U'·H·U + q'·U = ½·|root·U + root⁻ᵀ·q|² + …
    for seed in range(5):
        z = np.random.default_rng(seed).normal(size=len(NAMES)) * 0.3
        target = -np.linalg.solve(root.T, cost.f @ z)
        best = lsq_linear(root, target, tuple(law.limits), tol=1e-12).x
        law.solve(cost.at(z))
        assert law.solved
        np.testing.assert_allclose(law.last, scale * best[:4], atol=1e-6)


def test_prediction_without_limits_is_a_regulator_of_the_discrete_riccati_equation() -> None:
    free = replace(MPC, prediction_step=0.1, horizon=0.1)  # one step, then the cost to go: exactly the LQR
    A, B = full_model(free)
    F, G = discretize(A[np.ix_(PREDICTED, PREDICTED)], B[PREDICTED], 0.1)
    law = PredictiveLaw(free)
    P = solve_discrete_are(F, G, law.Q, law.R)
    K = np.linalg.solve(law.R + G.T @ P @ G, G.T @ P @ F)
    z = 1e-2 * np.random.default_rng(0).normal(size=len(NAMES))
    law.solve(law.cost.at(z))
    np.testing.assert_allclose(law.last, -K @ z, atol=1e-9)


def test_commands_keep_their_limits_wherever_the_craft_is() -> None:
    rng, law, p = np.random.default_rng(6), PredictiveLaw(MPC), MPC
    for k in range(60):
        seen = LawInput(*rng.normal(size=3), x_meas=0.0, y_meas=float(rng.normal()), fix=k // 5, started=True)
        tilts = law.command(rng.normal(size=5).tolist(), seen)
        assert max(map(abs, tilts)) <= p.tilt_max
        assert p.duty_min <= min(law.duties) <= max(law.duties) <= p.duty_max


@pytest.mark.thorough
def test_how_often_the_solver_gave_up_is_a_warning_of_the_run(flown: Path) -> None:
    swap = ["components.controller.fmu=../build/controller-mpc.fmu", "criteria={}", "duration=1", "start_time=5"]
    few = [*swap, "components.controller.start.iterations_max=3"]
    outcome = run("regulate.yaml", flown / "few", few, report=False, in_process=True)
    solved = outcome.results["controller.solved"]
    (told,) = outcome.manifest["warnings"]
    assert f"{(solved == 0).sum()} of {len(solved)}" in told
    enough = run("regulate.yaml", flown / "enough", swap, report=False, in_process=True)
    assert enough.manifest["warnings"] == []


def test_the_predictive_law_holds_y_with_fixes() -> None:
    start = {"y": 0.2}
    held_back = fly("MPC", start=start, fixes=True, duration=8.0)
    assert np.abs(held_back.pose[-50:, 1]).max() < 0.01
    assert held_back.command[:, :2].min() >= 6.0
    assert held_back.command[:, :2].max() <= 7.0
    assert np.abs(fly("LQR", start=start, fixes=True, duration=8.0).pose[-50:, 1]).min() > 0.1


@pytest.mark.parametrize(
    "given",
    [{"duty_min": 6.5}, {"horizon": 0.1, "prediction_step": 0.2}, {"weight_tilt": 0.0}, {"tilt_max": 0.0}],
)
def test_a_prediction_without_solution_is_refused(given: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(given)).partition("_")[0]):
        PredictiveSettings(**given)


# -- prediction with A(t), B(t) -----------------------------------------------------------------


@pytest.fixture(scope="module")
def planned() -> TimeVariantLaw:
    """The law after some programs for the same craft at rest, of which each linearises the plan before it."""
    law, seen = time_variant(LTV), LawInput(1.5, -1.0, 0.3)
    law.estimator(LTV, [0.0] * 5, 0.0)
    for _ in range(4):
        law.command([], seen)
        law.path[1:], law.plan[1:] = law.path[:-1].copy(), law.plan[:-1].copy()  # no time passes
    law.command([], seen)
    return law


def test_a_t_and_b_t_are_those_of_the_linearised_plant_all_along_the_plan(planned: TimeVariantLaw) -> None:
    states = np.zeros((len(planned.plan), len(PLANT_STATES)))
    states[:, PREDICTED] = planned.path[:-1]
    A, B = (planned.slopes.along(of, states, planned.plan, (14, n)) for of, n in (("state", 14), ("command", 4)))
    for k in (0, 7, 30, 99):
        linear = linearize(planned.craft, states[k].tolist(), planned.plan[k].tolist())
        np.testing.assert_allclose(A[k], linear.A, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(B[k], linear.B, rtol=1e-11, atol=1e-11)
    turning = A[:, PLANT_STATES.index("psi_dot"), PLANT_STATES.index("tilt_right")]
    assert np.ptp(turning) > 0.3 * turning[0]  # the thrust of 6 to 7 % of duty: it is time-variant


def test_the_plan_is_what_the_craft_does_where_one_linearisation_misses_it(planned: TimeVariantLaw) -> None:
    """A turn of 1 rad while it moves 1.5 m: the motors share the work, and thrust times tilt is no linear thing."""
    A, B = full_model(MPC)
    F, G = discretize(A[np.ix_(PREDICTED, PREDICTED)], B[PREDICTED], MPC.prediction_step)
    stepper, linear = Stepper(Hovercraft()), [np.zeros(len(NAMES))]
    moment = stepper.start()
    flown = [np.array(moment.state)[PREDICTED]]
    for u in planned.plan:
        moment = stepper.step(moment, tuple(u.tolist()), LTV.prediction_step)
        flown.append(np.array(moment.state)[PREDICTED])
        linear.append(F @ linear[-1] + G @ (u - planned.rest))
    x, psi = NAMES.index("x"), NAMES.index("psi")
    missed = np.abs(np.array(flown) - planned.path).max(axis=0)
    once = np.abs(np.array(flown) - planned.hover - np.array(linear)).max(axis=0)
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
    for end, column, what in ((5, 2, "psi"), (10, 0, "x"), (17, 2, "psi"), (22, 0, "x"), (26, 2, "psi"), (26, 0, "x")):
        row = round(end / STEP) - 1
        assert abs(f.pose[row, column] - f.wanted[row, column]) < WITHIN[what], (end, what)


@pytest.mark.parametrize(
    ("name", "of"), [("pole", PLACED_SETTINGS), ("lqi", INTEGRAL_SETTINGS), ("mpc", MPC), ("ltv-mpc", LTV)]
)
def test_an_fmu_commands_as_its_loop_does(fmus: dict[str, Path], name: str, of: Settings) -> None:
    make = dict(zip(RECIPES, list(LAWS.values())[1:], strict=True))[name][1]
    loop, rng = Loop(of, [0.3, 0.0, -0.2, 0.0, 0.0], 0.1, 0.2, 2.0, law=make(of)), np.random.default_rng(5)
    names = ("psi", "psi_dot", "ax", "x_ref", "psi_ref", "x_meas", "y_meas", "fix")
    with Instance(fmus[name]) as controller:
        start = {"x_hat_start": 0.3, "psi_hat_start": -0.2, "x_ref": 0.1, "psi_ref": 0.2, "fix": 2.0}
        got = [list(controller.initialize(start).outputs().values())]
        want = [[*loop.law.duties, *loop.command, *loop.estimate, *loop.sigma, *loop.law.outputs()]]
        for k in range(60):
            row = (*(0.1 * rng.normal(size=5)).tolist(), 0.2, 0.1, float(2 + k // 5))
            loop.step(row[:3], *row[3:5], row[7], row[5], y_meas=row[6])
            want.append([*loop.law.duties, *loop.command, *loop.estimate, *loop.sigma, *loop.law.outputs()])
            state = controller.serialized()
            got.append(list(controller.step(STEP * k, STEP, dict(zip(names, row, strict=True))).values()))
            if k % 20 == 10:  # taken back, hot start and all, it commands the same again
                controller.restore(state)
                assert list(controller.step(STEP * k, STEP, dict(zip(names, row, strict=True))).values()) == got[-1]
    assert got == want


def test_the_fmus_are_sound(fmus: dict[str, Path]) -> None:
    from fmpy.validation import validate_fmu

    for path in fmus.values():
        assert validate_fmu(str(path)) == []


@pytest.mark.thorough
def test_one_line_swaps_the_controller(flown: Path) -> None:
    for name in RECIPES:
        swap = [f"components.controller.fmu=../build/controller-{name}.fmu", "criteria={}", "duration=4"]
        outcome = run("regulate.yaml", flown / name, swap, report=False, in_process=True)
        assert abs(outcome.results["plant.x"][-1]) < 0.15
        assert abs(outcome.results["plant.psi"][-1]) < 0.05
    again = run("regulate.yaml", flown / "again", swap, report=False, in_process=True)
    first, second = ((folder / "results.csv").read_bytes() for folder in (outcome.folder, again.folder))
    assert first == second  # the predictive one: same seed, same bytes


@pytest.mark.thorough
def test_on_a_tilted_table_integrals_hold_x_and_prediction_holds_y(flown: Path) -> None:
    integral = run("hold.yaml", flown / "lqi", in_process=True)
    assert integral.missed == []
    assert abs(integral.results["plant.y"][-1]) > 1.0
    swap = "components.controller.fmu=../build/controller-mpc.fmu"
    predictive = run("hold.yaml", flown / "mpc", [swap, "duration=20"], report=False, in_process=True)
    assert [c["of"] for c in predictive.missed] == ["plant.x"]  # off by what the tilt pushes: it has no integral
    assert abs(predictive.results["plant.y"][-1]) < 0.1


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
