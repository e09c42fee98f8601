"""docs/seed.md: every row names what shows it, and short rows are shown here."""

from __future__ import annotations

import importlib
import math
import re
from pathlib import Path

import control
import numpy as np
import pytest
from scipy.optimize import brentq

from controller.design_model import design_model
from controller.gains import Settings
from cosim.linearization.structure import controllability
from cosim.linearization.workflow import linearize
from plant.bench import Bench
from plant.hovercraft import Hovercraft
from plant.namespaces import SCALAR
from plant.powertrain import ground_effect, lag, thrust_out_of_ground

PAGE = Path(__file__).resolve().parent.parent / "docs" / "seed.md"
STATUSES = {"reproduced", "corrected", "not software"}


def rows() -> list[list[str]]:
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    cells = [[c.strip() for c in line.strip("|").split(" | ")] for line in lines if line.startswith("| ")]
    return [c for c in cells if len(c) >= 5 and c[1] in STATUSES]


def test_every_row_names_a_test_that_is_there() -> None:
    assert len(rows()) > 30
    for row in rows():
        if row[1] == "not software":
            continue
        named = re.findall(r"`(test_\w+)::(test_\w+)`", row[2])
        assert named or "make seed" in row[2], row
        for module, test in named:
            assert hasattr(importlib.import_module(f"tests.{module}"), test), f"{module}::{test}"


def test_the_pole_of_eq_4_30_is_far_below_the_modes_of_the_bench() -> None:
    (pole,) = control.tf([1.0], [0.0884, 1.0]).poles()  # 4.29
    assert -pole.real == pytest.approx(11.31, abs=5e-3)
    assert -pole.real / (2 * math.pi) == pytest.approx(1.800, abs=5e-4)  # [Hz]
    assert 30.52 > 10 * 1.800  # the lowest mode of Table 3.3


def test_a_first_order_lag_has_done_63_percent_after_its_time() -> None:
    time = np.linspace(0.0, 0.5, 6)
    answer = 1.0 - np.exp(-time / 0.0884)  # 4.14
    np.testing.assert_allclose(lag(1.0, answer, 0.0884), np.exp(-time / 0.0884) / 0.0884)  # 4.9, 4.13
    rise = 0.0884 * (math.log(0.9 / 0.1))
    assert rise / 2.2 == pytest.approx(0.0884, rel=2e-3)  # §4.3.4


def test_a_hover_is_stable_in_height() -> None:
    """§4.2: thrust falls with the height, so weight and thrust meet where a rise is followed by a fall."""
    craft = Hovercraft()

    def lift(z: float) -> float:
        out = thrust_out_of_ground(SCALAR, craft.duty_nominal, craft.thrust_offset, craft.thrust_slope, 9.81)
        return out * ground_effect(SCALAR, z, craft.propeller_radius, craft.ground_effect_exponent)

    height = brentq(lambda z: lift(z) - 2.4973, 0.064, 1.0)  # T_N, eq 5.36
    assert height == pytest.approx(0.095, abs=1e-5)
    assert lift(height + 1e-3) < lift(height) < lift(height - 1e-3)


def test_thrust_is_out_of_ground_effect_above_three_radii() -> None:
    assert ground_effect(SCALAR, 3.0 * 0.127, 0.127, 2.0) < 1.01  # 4.4, 4.11 with the minus sign
    assert ground_effect(SCALAR, 0.095, 0.127, 1.902) == pytest.approx(1.142024, abs=1e-6)  # 4.28


def test_inertias_from_parts() -> None:
    arm = 2 * 0.145 * 0.17145**2  # 5.2
    assert 1.2 * arm == pytest.approx(0.01023, abs=5e-6)  # 5.3
    assert 1.1 * arm == pytest.approx(0.009377, abs=5e-6)  # 5.4
    assert Hovercraft().izz == 0.01023
    assert Hovercraft().ixx == 0.009377


def test_the_equations_of_5_14_are_the_one_body_with_what_is_ours_switched_off() -> None:
    """Eqs 5.5-5.14, written down from the page; 5.14 has φ for sin φ, the body sin φ as in 5.6."""
    m, L, Izz, Ixx = 0.705, 0.17145, 0.01023, 0.009377
    gain = ground_effect(SCALAR, 0.095, 0.127, 1.902)
    craft = Hovercraft(friction=0.0, table_roll_stiffness=0.0, table_roll_damping=0.0, roll_ground_effect=False)
    phi, (TR, TL), (aR, aL) = 0.03, (2.1, 2.3), (0.15, -0.08)
    at = {"vx": 0.4, "vy": -0.1, "psi_dot": 0.3, "phi_dot": 0.2, "phi": phi}
    state = craft.start({**at, "thrust_right": TR, "thrust_left": TL, "tilt_right": aR, "tilt_left": aL})
    rates = craft.equations(SCALAR).derivative(0.0, state, (6.4, 6.4, aR, aL))
    found = dict(zip((q.name for q in craft.states), rates, strict=True))
    FRx, FLx = gain * TR * math.sin(aR), gain * TL * math.sin(aL)  # 5.12
    FRz, FLz = gain * TR * math.cos(aR), gain * TL * math.cos(aL)
    expected = {
        "x": 0.4, "vx": (FRx + FLx) / m, "y": -0.1, "vy": -(FRz + FLz) / m * math.sin(phi),
        "psi": 0.3, "psi_dot": L / Izz * (FRx - FLx), "phi": 0.2, "phi_dot": L / Ixx * (FRz - FLz),
    }  # fmt: skip
    assert {n: found[n] for n in expected} == pytest.approx(expected, rel=1e-12)


def test_the_controllability_matrix_of_eq_5_36() -> None:
    """5.35 prints AⁿB as the last block; 5.36 ends with A⁴B, ten columns of five states."""
    A, B = design_model(Settings())
    found = controllability(A, B)
    assert found.shape == (5, 10)
    printed = [
        (0, 0, 0, 41.85, 40.07), (0, 0, 0, -41.85, 40.07), (0, 40.07, 41.85, 0, -453.3), (0, 40.07, -41.85, 0, -453.3),
        *[(40.07, -467.5, 0, 0, 5128)] * 2, *[(-467.5, 5294, 0, 0, -58009)] * 2, *[(5294, -59886, 0, 0, 656210)] * 2,
    ]  # fmt: skip
    # each block of the print is the one before, rounded to four digits, times A
    assert np.abs(found.T - printed).max(axis=1) == pytest.approx(0.0, abs=40.0)
    np.testing.assert_allclose(found.T, printed, rtol=2e-4)
    assert np.linalg.matrix_rank(found) == 5
    assert np.linalg.cond(found) == pytest.approx(224_256, abs=0.5)  # printed 22425


def test_the_assumptions_of_eqs_5_20_to_5_32_make_the_design_model_of_the_body() -> None:
    """φ = 0, constant duty, small tilts, lag on what drives the thrust: six states, of which 5.29 has five."""
    names = ("x", "vx", "psi", "psi_dot", "tilt_right", "tilt_left")
    found = linearize("base", states=names, inputs=["tilt_right", "tilt_left"], outputs=["psi", "psi_dot", "ax"]).first
    A, B = design_model(Settings())
    turn, push = B[3, 0], B[4, 0] * 0.0884  # 5.34
    expected = np.zeros((6, 6))
    expected[0, 1] = expected[2, 3] = 1.0
    expected[1, 1] = A[1, 1]  # 5.32
    expected[1, 4:], expected[3, 4:] = (push, push), (turn, -turn)  # 5.25, 5.26 with 5.24
    expected[4, 4] = expected[5, 5] = A[4, 4]  # 5.27; on the yaw axis too, which 5.29 leaves out
    # δ_N has six digits: T_N is 4e-6 N low
    np.testing.assert_allclose(found.A, expected, rtol=3e-6, atol=1e-12)


def test_the_numbers_of_eq_4_33_are_the_defaults_of_the_bench() -> None:
    b = Bench()
    assert (b.thrust_offset, b.thrust_slope, b.ground_effect_exponent, b.lag, b.assembly_arm) == (
        -2076.0, 359.9, 1.902, 0.0884, -1.170e-4,
    )  # fmt: skip


def test_the_older_quadratic_of_app_d_3_1_agrees_with_the_line_within_its_range() -> None:
    duty = np.linspace(6.0, 7.0, 11)
    quadratic, line = -3102 + 652.5 * duty - 21.67 * duty**2, -2076 + 359.9 * duty
    assert np.abs(quadratic - line).max() < 60.0  # [gf]; an older bench


def test_the_curves_of_the_cells_pass_near_the_points_of_app_c() -> None:
    b, points = Bench(), {
        "x": ([0, 25, 40, 50, 75, 105, 135], [2.43, 2.28, 2.23, 2.15, 2.01, 1.85, 1.685], 9.81e-3, 0.025),
        "z": ([0, 85, 140, 200, 225, 270, 285], [3.3, 2.58, 2.01, 1.13, 0.66, 0.38, 0.0], 9.81e-3, 0.2),
        "m": ([-0.0282, -0.0113, 0, 0.0113, 0.0282], [3.093, 2.287, 1.71, 1.217, 0.71], 1.0, 0.01),
    }  # fmt: skip
    for cell, (loads, volts, unit, off) in points.items():
        curve = [getattr(b, f"{cell}_{p}") for p in ("zero", "slope", "square", "cube")]
        read = np.polynomial.polynomial.polyval(unit * np.array(loads), curve)
        assert np.abs(read - volts).max() < off, cell


def test_the_horizontal_projection_of_app_g_is_unusable() -> None:
    """G.3, G.4: H in degrees is 0.006 at 10°, where the sine is 0.17."""
    coefficients = (6.251e-5, 6.843e-5, -9.170e-8, -2.199e-10, 7.100e-13, -5.138e-16)
    projected = sum(c * 10.0 ** (2 * k) for k, c in enumerate(coefficients))
    assert projected == pytest.approx(0.006, abs=5e-4)
    assert math.sin(math.radians(10.0)) > 25 * projected
