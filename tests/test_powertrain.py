"""Power-train: thrust line, ground effect, first-order lag (thesis ch. 4)."""

from __future__ import annotations

import math

import pytest

from controller.settings import Settings
from cosim.model import SCALAR, Stepper
from plant.hovercraft import DUTY_NOMINAL, Hovercraft
from plant.powertrain import ground_effect, lag, thrust_out_of_ground
from tests.independent import flown

CRAFT = Hovercraft()
R, Z, K = CRAFT.propeller_radius, CRAFT.height, CRAFT.ground_effect_exponent
A, B, G = CRAFT.thrust_offset, CRAFT.thrust_slope, CRAFT.gravity
GAMMA = ground_effect(SCALAR, Z, R, K)
TAU = CRAFT.lag


def static(duty: float) -> float:
    return thrust_out_of_ground(SCALAR, duty, A, B, G)


def test_ground_effect_at_the_vehicle_s_height() -> None:
    assert pytest.approx(1.142024, abs=5e-7) == GAMMA  # eqs 4.23, 4.28 at z = 0.095 m; half a unit of the last digit


@pytest.mark.parametrize(
    ("gain", "printed", "digits"),
    [
        (GAMMA / CRAFT.mass, 1.61989, 5e-6),  # Γ/m, eq E.2 (1.620)
        (CRAFT.arm * GAMMA / CRAFT.izz, 19.140, 5e-4),  # L·Γ/Izz, eq E.2
        (CRAFT.arm * GAMMA / CRAFT.ixx, 20.881, 5e-4),  # L·Γ/Ixx; eq E.2 prints 20.90
    ],
)
def test_gains_from_thrust_to_motion(gain: float, printed: float, digits: float) -> None:
    assert gain == pytest.approx(printed, abs=digits)  # half a unit of the last digit


def test_ground_effect_gains_thrust_where_the_printed_plus_sign_would_lose_it() -> None:
    # eqs 4.11-4.33 print 1/(1 + (R/4z)^k); that is 0.889 and 0.889/m is not the 1.620 of eq E.2
    plus = 1.0 / (1.0 + (R / (4.0 * Z)) ** K)
    assert plus == pytest.approx(0.889, abs=5e-4)
    assert GAMMA > 1.0
    assert 1.0 / plus + 1.0 / GAMMA == pytest.approx(2.0, rel=1e-15)  # the two differ by that sign and nothing else


@pytest.mark.parametrize(
    ("reading", "radius"),
    [("§4.3's 'rotor diameter'", 0.254), ("D.3.2's 12.5 cm", 0.125)],
)
def test_only_the_radius_of_the_nomenclature_gives_the_gain_of_eq_e2(reading: str, radius: float) -> None:
    assert abs(ground_effect(SCALAR, Z, radius, K) / CRAFT.mass - 1.620) > 5e-3, reading


def test_ground_effect_fades_with_height_and_holds_below_the_lowest_height_planned() -> None:
    heights = [0.5 * R, 0.08, 0.095, 0.15, 0.3, 1.0]
    gains = [ground_effect(SCALAR, z, R, K) for z in heights]
    assert gains == sorted(gains, reverse=True)
    assert gains[-1] == pytest.approx(1.0, abs=2e-3)  # (R/4z)^k is 1.4e-3 one metre up
    # §4.4 plans no height below R/2, where the formula would run off to infinity at z = R/4
    for z in (0.3 * R, 0.25 * R, 0.0, -0.1):
        assert ground_effect(SCALAR, z, R, K) == gains[0]


def test_thrust_line_is_that_of_the_load_cell() -> None:
    # eq 4.20 in gf at both ends of the fitted range, exact arithmetic on the printed a and b
    assert static(6.0) == pytest.approx((-2076 + 359.9 * 6.0) * 9.81e-3, rel=1e-14)
    assert static(7.0) == pytest.approx(443.3 * 9.81e-3, rel=1e-14)
    assert static(5.0) == 0.0  # a propeller never pulls backwards: the line crosses zero at 5.768 %


def test_nominal_duty_and_nominal_thrust_say_the_same() -> None:
    # δ_N = (1000·T_N/(g·Γ) − a)/b = 6.387631, eqs 4.20 and 5.36; half a unit of the last digit
    assert pytest.approx(6.387631, abs=5e-7) == (1000 * 2.4973 / (G * GAMMA) - A) / B
    assert DUTY_NOMINAL == CRAFT.duty_nominal == Settings().duty_nominal == 6.38763
    # 6.38763 leaves out 1e-6 %, which is b·g·Γ/1000·1e-6 = 4e-6 N
    assert GAMMA * static(DUTY_NOMINAL) == pytest.approx(Settings().thrust_nominal, abs=6e-6)
    # of 40.07·τ·m (eq 5.36) T_N is the value that gives eq 6.5 to all digits; 40.07 has four of them
    assert Settings().thrust_nominal == pytest.approx(40.07 * TAU * CRAFT.mass, abs=0.005 * TAU * CRAFT.mass)


def test_table_carries_the_rest_of_the_weight() -> None:
    # 2·T_N = 4.99 N of m·g = 6.92 N: the craft floats on the table's air (§4.2), it does not fly
    assert 2 * Settings().thrust_nominal == pytest.approx(4.99, abs=5e-3)
    assert CRAFT.mass * G == pytest.approx(6.92, abs=5e-3)


def test_lag_is_first_order_with_its_pole_at_one_over_tau() -> None:
    assert pytest.approx(11.31, abs=5e-3) == 1.0 / TAU  # rad/s, eq 4.29; §4.4 prints rad/s as Hz
    assert 1.0 / TAU / (2 * math.pi) == pytest.approx(1.800, abs=5e-4)  # Hz
    assert lag(1.0, 0.0, TAU) == 1.0 / TAU


@pytest.mark.parametrize("signal", ["tilt_right_actual", "tilt_left_actual", "thrust_right", "thrust_left"])
def test_step_response_reaches_63_percent_after_one_time_constant(signal: str) -> None:
    step = {"tilt_right_actual": 2, "tilt_left_actual": 3, "thrust_right": 0, "thrust_left": 1}[signal]
    hover = [DUTY_NOMINAL, DUTY_NOMINAL, 0.0, 0.0]
    after = list(hover)
    after[step] += 0.1
    # a roll of its own would move the ground effect: the thesis' one height shows the lag alone
    craft = Hovercraft(roll_ground_effect=False)
    y = flown(Stepper(craft), [after] * 10, hold=TAU / 4)[signal]
    final = flown(Stepper(craft), [after] * 40, hold=TAU)[signal][-1]
    # 1 − 1/e of the step at t = τ; RK4's local error at h/τ = 1/20 is (h/τ)⁵/120 = 2.6e-9 a substep
    assert (y[4] - y[0]) / (final - y[0]) == pytest.approx(1 - math.exp(-1), abs=1e-7)


@pytest.mark.parametrize("axis", ["forward", "turning"])
def test_lag_acts_on_both_axes(axis: str) -> None:
    # eq 5.29 leaves it out of yaw; Test 4 measured it on the propeller, which serves both
    sign = 1.0 if axis == "forward" else -1.0
    craft = Hovercraft(friction=0.0)
    y = flown(Stepper(craft), [[DUTY_NOMINAL, DUTY_NOMINAL, 0.01, sign * 0.01]] * 10)
    speed = y["vx"] if axis == "forward" else y["psi_dot"]
    gain = 2 * GAMMA * static(DUTY_NOMINAL) * 0.01 * (1 / craft.mass if axis == "forward" else craft.arm / craft.izz)
    t = 0.2
    lagged = gain * (t - TAU * (1 - math.exp(-t / TAU)))
    # sin α for α costs α²/6 = 2e-5
    assert speed[-1] == pytest.approx(lagged, rel=4e-5)
