"""Localisation, §5.6 and §7.1: double integration, the Kalman filters, fixes, the extended filter."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from numpy.typing import NDArray

import cosim
from controller.design_model import design_model, measurement_matrix
from controller.observers import ExtendedFilter
from controller.settings import ExtendedSettings, Settings
from cosim.fmi.fmu_build import build
from cosim.model.symbolic.linearize import load_names
from cosim.simulation.run_signals import Run
from fmus.recipes import extended_recipe, filter_recipe, jacobians
from plant.hovercraft import Hovercraft
from tests.conftest import ROOT
from tests.hosts_fmpy import Instance

STEP, TEN_DEGREES = 0.02, math.radians(10)
BOTH = pytest.mark.parametrize("name", ["filter.fmu", "ekf.fmu"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, plant_fmu: Path, controller_fmu: Path) -> Path:
    """scenarios/ and build/ with the estimators beside plant and controller."""
    made = tmp_path_factory.mktemp("localisation")
    shutil.copytree(ROOT / "scenarios", made / "scenarios")
    (made / "build").mkdir()
    for fmu in (plant_fmu, controller_fmu):
        shutil.copy(fmu, made / "build" / fmu.name)
    build(filter_recipe(), made / "build" / "filter.fmu")
    build(extended_recipe(), made / "build" / "ekf.fmu")
    return made


@pytest.fixture(scope="module")
def flown(folder: Path) -> Mapping[str, Run]:
    """Each scenario of this chapter, run once."""
    names = ("localisation_rest", "localisation", "localisation_fixes")
    return {n: cosim.run(folder / "scenarios" / f"{n}.yaml", folder / n, report=False, in_process=True) for n in names}


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
    assert not moved.missed
    distance = moved["plant.x"][-1]
    assert distance == pytest.approx(0.3, abs=0.01)
    for estimator in ("appendix_f", "lagged", "extended"):
        assert abs(off(moved, estimator)[-1]) < 0.1 * distance
        assert np.abs(off(moved, estimator, "psi")).max() < TEN_DEGREES
    assert abs(off(moved, "integration")[-1]) > distance


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
def test_scenarios_of_this_chapter_meet_their_criteria(flown: Mapping[str, Run]) -> None:
    assert {n: made.missed for n, made in flown.items()} == {n: [] for n in flown}
    assert [w for made in flown.values() for w in made.warnings if "not connected" in w] == []


# -- eqs 5.48-5.53 ------------------------------------------------------------------------------


def test_the_observability_matrix_is_that_of_eq_5_49() -> None:
    A, _ = design_model(Settings())
    observability = control.obsv(A, measurement_matrix(Settings(), "appendix_f"))
    expected = np.zeros((15, 5))
    expected[0, 2] = expected[1, 3] = expected[3, 3] = 1.0
    expected[[2, 5, 8, 11, 14], 4] = 1.0, -11.31, 128.0, -1448.0, 16375.0
    np.testing.assert_allclose(observability, expected, rtol=5e-4)  # four digits printed
    assert np.linalg.matrix_rank(observability) == 3


# -- the FMUs -----------------------------------------------------------------------------------


def row(k: int) -> dict[str, float]:
    t = STEP * k
    moved = {"psi": 0.1 * math.sin(t), "psi_dot": 0.1 * math.cos(t), "ax": 0.3, "tilt_right": 0.05, "tilt_left": 0.04}
    return {**moved, "x_meas": 0.15 * t * t, "y_meas": 0.01, "fix": float(k // 5)}


@BOTH
def test_estimators_have_no_fault(folder: Path, name: str) -> None:
    assert validate_fmu(str(folder / "build" / name)) == []


@BOTH
@pytest.mark.parametrize("estimator", ["consistent", "double_integration"])
def test_a_restored_estimator_goes_on_bit_for_bit(folder: Path, name: str, estimator: str) -> None:
    chosen: dict[str, Any] = {"estimator": estimator} if name == "filter.fmu" else {"axes": "world"}
    with Instance(folder / "build" / name) as fmu:
        first = fmu.initialize({**chosen, "x_hat_start": 0.2, "a_hat_start": 0.3}).outputs()
        assert (first["x_hat"], first["x_sigma"]) == (0.2, 0.0)
        assert first["a_hat"] == pytest.approx(0.3, rel=1e-12)  # a tilt, and back
        for k in range(1, 12):
            fmu.step(STEP * (k - 1), STEP, row(k))
        state = fmu.serialized()
        went = [fmu.step(STEP * (k - 1), STEP, row(k)) for k in range(12, 30)]
        fmu.restore(state)
        assert [fmu.step(STEP * (k - 1), STEP, row(k)) for k in range(12, 30)] == went
    assert abs(went[-1]["x_hat"] - 0.2) > 1e-3


def test_the_extended_fmu_is_the_plain_filter(folder: Path) -> None:
    model, settings = Hovercraft(mass=0.8), ExtendedSettings(fix_latency=0.06, process_variance_vx=1e-6)
    plain = ExtendedFilter(model, settings, load_names(jacobians()), {"x": 0.2})
    given = {"mass": 0.8, "fix_latency": 0.06, "process_variance_vx": 1e-6, "x_hat_start": 0.2}
    with Instance(folder / "build" / "ekf.fmu") as fmu:
        fmu.initialize(given)
        for k in range(1, 30):
            at = row(k)
            told = fmu.step(STEP * (k - 1), STEP, at)
            duty = (model.duty_nominal, model.duty_nominal)
            sensors = (at["psi"], at["psi_dot"], at["ax"])
            plain.step(sensors, (*duty, at["tilt_right"], at["tilt_left"]), at["fix"], (at["x_meas"], at["y_meas"]))
            assert list(told.values()) == pytest.approx(
                [*plain.estimate, *plain.sigma, plain.nis], rel=1e-12, abs=1e-15
            )
