"""Localisation, §5.6 and §7.1: double integration, the Kalman filters, fixes, the extended filter."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from pathlib import Path

import control
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from numpy.typing import NDArray

import cosim
from controller.design_model import design_model, measurement_matrix
from controller.loop import Loop
from controller.observers import ExtendedFilter
from controller.settings import PLANT_STATES, ExtendedSettings, Settings
from cosim.fmi.fmu_build import build
from cosim.model import Stepper
from cosim.model.symbolic.linearize import load_names
from cosim.simulation.run_signals import Run
from fmus.recipes import extended_recipe, filter_recipe, jacobians
from plant.hovercraft import Hovercraft
from tests.conftest import ROOT

STEP, TEN_DEGREES = 0.02, math.radians(10)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, plant_fmu: Path, controller_fmu: Path) -> Path:
    """scenarios/ and build/ with the estimators beside plant and controller."""
    made = tmp_path_factory.mktemp("localisation")
    shutil.copytree(ROOT / "scenarios", made / "scenarios")
    (made / "build").mkdir()
    for fmu in (plant_fmu, controller_fmu):
        shutil.copy(fmu, made / "build" / fmu.name)
    for name, recipe in (("filter.fmu", filter_recipe()), ("ekf.fmu", extended_recipe())):
        assert validate_fmu(str(build(recipe, made / "build" / name))) == []
    return made


@pytest.fixture(scope="module")
def flown(folder: Path) -> Mapping[str, Run]:
    """Each scenario of this chapter, run once; all criteria are met."""
    names, found = ("localisation_rest", "localisation", "localisation_fixes"), {}
    for n in names:
        made = cosim.run(folder / "scenarios" / f"{n}.yaml", folder / n, report=False, in_process=True)
        assert (made.missed, [w for w in made.warnings if "not connected" in w]) == ([], [])
        found[n] = made
    return found


def off(made: Run, estimator: str, name: str = "x") -> NDArray[np.float64]:
    return np.asarray(made[f"{estimator}.{name}_hat"] - made[f"plant.{name}"])


# -- Figs 5.5-5.7 -------------------------------------------------------------------------------


@pytest.mark.thorough
def test_double_integration_drifts_away_at_rest_and_the_filter_does_not(flown: Mapping[str, Run]) -> None:
    rest = flown["localisation_rest"]
    assert np.abs(off(rest, "integration")).max() > 0.5  # [m], of a craft that never moved (Fig 5.5)
    assert np.abs(off(rest, "filter")).max() < 0.01
    # white noise integrated twice: σ = σ_a·Δt²·√(n³/3)
    n = len(rest.time) - 1
    assert rest["integration.x_sigma"][-1] == pytest.approx(math.sqrt(0.04479 * n**3 / 3) * STEP**2, rel=2e-3)
    assert abs(off(rest, "integration")[-1]) < 3 * rest["integration.x_sigma"][-1]


@pytest.mark.thorough
def test_the_filter_of_the_thesis_meets_10_percent_and_10_degrees_and_double_integration_does_not(
    flown: Mapping[str, Run],
) -> None:
    moved = flown["localisation"]  # 30 cm, Figs 5.6 and 5.7
    distance = moved["plant.x"][-1]
    assert distance == pytest.approx(0.3, abs=0.01)
    for estimator in ("appendix_f", "lagged", "extended"):
        assert abs(off(moved, estimator)[-1]) < 0.1 * distance
        assert np.abs(off(moved, estimator, "psi")).max() < TEN_DEGREES
    assert abs(off(moved, "integration")[-1]) > distance


@pytest.mark.thorough
def test_of_the_three_variants_the_one_that_observes_speed_is_the_worst_with_the_v_of_the_thesis(
    flown: Mapping[str, Run],
) -> None:
    # V says that the model of ẋ is off by 1 cm/s a sample, so `consistent` believes −(c/m)·ẋ of a noisy accelerometer
    worst = {e: abs(off(flown["localisation"], e)[-1]) for e in ("appendix_f", "lagged", "consistent")}
    assert worst["consistent"] > 10 * max(worst["appendix_f"], worst["lagged"])


@pytest.mark.thorough
def test_noise_from_20_s_at_rest_is_that_of_eqs_5_44_to_5_46(flown: Mapping[str, Run]) -> None:
    for name, printed in (("psi", 2.613e-5), ("psi_dot", 4.564e-4), ("ax", 0.04479)):
        found = np.var(flown["localisation_rest"][f"filter.{name}"], ddof=1)  # 5.44, 5.45
        assert found == pytest.approx(printed, rel=4 * math.sqrt(2 / 1000))  # four standard errors of 1001 readings


# -- §7.1: fixes --------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("estimator", "within"),
    [
        ("by_camera", 0.05),
        ("by_camera_extended", 0.05),
        ("by_beacon", 0.3),
        ("by_ultrasound", 0.05),
        ("by_infrared", 0.1),
    ],
)
def test_fixes_of_any_kind_find_a_start_that_nobody_told(
    flown: Mapping[str, Run], estimator: str, within: float
) -> None:
    found = flown["localisation_fixes"]
    settled = found.time > 15
    assert abs(off(found, estimator)[0]) == 0.5
    # about three of the standard deviations that it believes in
    assert np.abs(off(found, estimator)[settled]).max() < within
    sigma = found[f"{estimator}.x_sigma"]
    assert sigma[settled].max() == pytest.approx(sigma[(found.time > 5) & ~settled].max(), rel=0.5)  # P has settled


@pytest.mark.thorough
def test_without_fixes_the_start_is_never_found_and_p_diverges(flown: Mapping[str, Run]) -> None:
    found = flown["localisation_fixes"]
    assert (np.diff(found["without.x_sigma"]) > 0).all()
    assert np.abs(off(found, "without")[found.time > 5]).min() > 0.1
    assert np.abs(off(found, "by_camera")[found.time > 5]).max() < 0.1


def turning_path(settings: ExtendedSettings) -> tuple[dict[str, float], list[float]]:
    """Return the error of each estimated state at the end, and σ of x̂ at each sample, of a start that is 30 cm off.

    The craft turns right by 90°, then flies 1.5 m; a camera sees it in world axes.
    """
    craft, wrong = Hovercraft(), 0.3
    extended = ExtendedFilter(craft, settings, load_names(jacobians()), {})
    stepper, names = Stepper(craft), [q.name for q in craft.outputs]
    moment = stepper.start(0.0, {"x": wrong, "x_world": wrong})
    loop = Loop(Settings(), (wrong, 0.0, 0.0, 0.0, 0.0), wrong, 0.0)
    rng, sigma = np.random.default_rng(7), []
    for k in range(1, 501):
        command = (craft.duty_nominal, craft.duty_nominal, *loop.command)
        moment = stepper.step(moment, command, STEP)
        y = dict(zip(names, stepper.output(moment.t, moment.state, command), strict=True))
        imu = [y[n] for n in ("psi", "psi_dot", "ax")]
        loop.step(imu, wrong + (1.5 if k > 150 else 0.0), -0.5 * math.pi if k > 25 else 0.0)
        noise = rng.normal(0.0, np.sqrt([2.613e-5, 4.564e-4, 0.04479, 1e-4, 1e-4]))
        z = (np.array([*imu, y["x_world"], y["y_world"]]) + noise).tolist()
        extended.step(z[:3], command, float(k // 5), z[3:])
        sigma.append(extended.sigma[0])
    return dict(zip(PLANT_STATES, extended.filter.x - np.array(moment.state), strict=True)), sigma


def test_a_camera_in_world_axes_corrects_the_distance_along_a_path_that_turns() -> None:
    settings = ExtendedSettings(axes="world")
    error, sigma = turning_path(settings)
    assert math.hypot(error["x_world"], error["y_world"]) < 0.06  # three of σ = 2 cm
    assert abs(error["x"]) < 0.06  # what is found out before the turn is along the old axis, and is kept
    assert max(sigma[250:]) < 0.03


# -- eqs 5.48-5.53 ------------------------------------------------------------------------------


def test_the_observability_matrix_is_that_of_eq_5_49() -> None:
    A, _ = design_model(Settings())
    observability = control.obsv(A, measurement_matrix(Settings(), "appendix_f"))
    expected = np.zeros((15, 5))
    expected[0, 2] = expected[1, 3] = expected[3, 3] = 1.0
    expected[[2, 5, 8, 11, 14], 4] = 1.0, -11.31, 128.0, -1448.0, 16375.0
    np.testing.assert_allclose(observability, expected, rtol=5e-4)  # four digits printed
    assert np.linalg.matrix_rank(observability) == 3


def test_the_jordan_form_is_that_of_eqs_5_50_to_5_53_with_the_older_lag() -> None:
    A, _ = design_model(Settings(lag=0.12))  # τ of the print, which App G has too
    V = np.array(
        [
            [0.01504, -0.3534, 0.3384, 0, 0],
            [-0.1253, 0.1253, 0, 0, 0],
            [0, 0, 0, 1, 0],
            [0, 0, 0, 0, 1],
            [1, 0, 0, 0, 0],
        ]
    )  # 5.51
    expected = np.zeros((5, 5))
    expected[0, 0], expected[1, 1], expected[3, 4] = -8.333, -0.3546, 1.0
    np.testing.assert_allclose(np.linalg.solve(V, A @ V), expected, atol=4e-3)  # 5.50, by four digits of V
    assert np.linalg.inv(V)[0] == pytest.approx([0, 0, 0, 0, 1], abs=1e-12)  # 5.52: x̂₁ is the acceleration
    seen = measurement_matrix(Settings(), "appendix_f") @ V
    assert np.flatnonzero(seen.any(axis=0)).tolist() == [0, 3, 4]  # 5.53: x̂₂ and x̂₃ cannot be observed
