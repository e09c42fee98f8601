"""The controller FMU is the plain control loop, sampled, and refuses any other step."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.loop import Loop
from controller.settings import Settings
from tests.hosts_fmpy import Instance, refused

STEP = 0.02  # [s], Fig 4.8
ESTIMATORS = ("appendix_f", "lagged", "consistent")
ESTIMATE = ("x_hat", "vx_hat", "psi_hat", "psi_dot_hat", "a_hat")
INPUTS = ("psi", "psi_dot", "ax", "x_ref", "psi_ref")
K = np.array(  # eq 6.5; the second row has the sign of ψ and ψ̇ flipped
    [[0.70711, 0.65934, 0.22361, 0.10170, 0.04958], [0.70711, 0.65934, -0.22361, -0.10170, 0.04958]]
)
K_PRINTED = 5e-6 * 5  # half of the last digit of each entry, for five states no greater than 1
TILT_MAX = math.radians(12)  # App G


def estimate(x_hat: list[float]) -> dict[str, float]:
    return {f"{n}_start": v for n, v in zip(ESTIMATE, x_hat, strict=True)}


def tilts(outputs: dict[str, float]) -> list[float]:
    return [outputs["tilt_right"], outputs["tilt_left"]]


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_the_first_command_feeds_back_what_the_filter_is_told(controller_fmu: Path, estimator: str) -> None:
    x_hat, x_ref, psi_ref = [0.1, -0.05, 0.2, 0.3, -0.4], 0.2, 0.25
    # measurements far from x̂₀: an update would show
    measured = {"psi": 3.0, "psi_dot": -2.0, "ax": 5.0, "x_ref": x_ref, "psi_ref": psi_ref}
    with Instance(controller_fmu) as controller:
        outputs = controller.begin({**estimate(x_hat), **measured, "estimator": estimator}).outputs()
        controller.call("exitInitializationMode")
        assert controller.outputs() == outputs
    expected = -K @ (np.array(x_hat) - [x_ref, 0, psi_ref, 0, 0])  # eq 6.1
    assert tilts(outputs) == pytest.approx(expected.tolist(), abs=K_PRINTED)
    assert [outputs[n] for n in ESTIMATE] == x_hat
    assert (outputs["x_sigma"], outputs["psi_sigma"]) == (0.0, 0.0)  # P = 0


@pytest.mark.parametrize(("x_ref", "sign"), [(2.0, 1), (-2.0, -1)])
def test_the_first_command_saturates_at_twelve_degrees(controller_fmu: Path, x_ref: float, sign: int) -> None:
    with Instance(controller_fmu) as controller:
        outputs = controller.initialize({"x_ref": x_ref}).outputs()
        assert tilts(outputs) == [sign * TILT_MAX] * 2
    with Instance(controller_fmu) as controller:
        outputs = controller.initialize({"x_ref": x_ref, "tilt_max": 0.1}).outputs()
        assert tilts(outputs) == [sign * 0.1] * 2


def noisy_data(count: int) -> list[tuple[float, ...]]:
    """Measurements (ψ, ψ̇, a_x) with the noise of eq 5.46 on slow motion, and references in steps."""
    rng = np.random.default_rng(546)
    t = STEP * np.arange(1, count + 1)
    psi, ax = 0.3 * np.sin(0.8 * t), 0.2 * np.cos(0.5 * t)
    clean = np.stack([psi, np.gradient(psi, STEP), ax], axis=1)
    noise = rng.normal(size=clean.shape) * np.sqrt([2.613e-5, 4.564e-4, 0.04479])
    references = np.stack([0.3 * (t > 3), -0.4 * (t > 6)], axis=1)
    return [tuple(row) for row in np.hstack([clean + noise, references]).tolist()]


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_the_fmu_commands_as_the_loop_does(controller_fmu: Path, estimator: str) -> None:
    x_hat, data = [0.3, 0.1, -0.2, 0.05, 0.1], noisy_data(500)
    loop = Loop(Settings(estimator=estimator), x_hat, 0.0, 0.0)
    duty = loop.settings.duty_nominal
    want, got = [], []
    with Instance(controller_fmu) as controller:
        controller.initialize({**estimate(x_hat), "estimator": estimator})
        for k, row in enumerate(data):
            loop.step(row[:3], *row[3:])
            want.append([duty, duty, *loop.command, *loop.estimate, *loop.sigma])
            got.append(list(controller.step(STEP * k, STEP, dict(zip(INPUTS, row, strict=True))).values()))
    # the FMU makes the same operations on the same floats: 1e-12 allows for nothing but another libm
    np.testing.assert_allclose(got, want, rtol=1e-12, atol=0)
    assert np.ptp(np.array(got)[:, 2:9], axis=0).min() > 1e-2  # commands and estimate have moved


@pytest.mark.parametrize(("updates", "sigma"), [(50, 0.0791), (500, 0.5348)])
def test_the_filter_of_appendix_f_loses_x_as_the_thesis_has_it(
    controller_fmu: Path, updates: int, sigma: float
) -> None:
    with Instance(controller_fmu) as controller:
        controller.initialize()
        for k in range(updates):
            outputs = controller.step(STEP * k, STEP)
    assert outputs["x_sigma"] == pytest.approx(sigma, abs=5e-5)  # four digits, App F with eqs 5.46 and 5.47


# -- parameters ---------------------------------------------------------------------------------


@pytest.mark.parametrize("state", range(5))
@pytest.mark.parametrize(("row", "side"), [(1, "tilt_right"), (2, "tilt_left")])
def test_each_gain_acts_from_its_state_on_its_propeller(controller_fmu: Path, row: int, side: str, state: int) -> None:
    gains = {f"k_{i}_{j}": 0.0 for i in (1, 2) for j in range(1, 6)} | {f"k_{row}_{state + 1}": 0.5}
    with Instance(controller_fmu) as controller:
        outputs = controller.initialize({**gains, f"{ESTIMATE[state]}_start": 0.1}).outputs()
    other = ({"tilt_right", "tilt_left"} - {side}).pop()
    assert (outputs[side], outputs[other]) == (-0.05, 0.0)


# -- guards -------------------------------------------------------------------------------------


def step(h: float, inputs: dict[str, float] | None = None) -> Any:
    def call(controller: Instance) -> None:
        controller.call("exitInitializationMode")
        controller.step(0.0, h, inputs)

    return call


@pytest.mark.parametrize("h", [0.01, 0.04, 0.0201, 0.0199])
def test_another_step_than_the_sample_time_is_refused(controller_fmu: Path, h: float) -> None:
    said = refused(controller_fmu, {}, step(h))
    assert f"step of {h} s; the controller is sampled at 0.02 s (parameter sample_time)" in said


def test_an_unknown_estimator_is_refused_with_those_there_are(controller_fmu: Path) -> None:
    said = refused(controller_fmu, {"estimator": "unscented"}, lambda c: c.call("exitInitializationMode"))
    assert "estimator is 'unscented'; it is one of appendix_f, lagged, consistent" in said
