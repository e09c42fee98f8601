"""docs/seed.md: every row names what shows it, and short rows are shown here."""

from __future__ import annotations

import json
import math
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from ruamel.yaml import YAML
from scipy.optimize import brentq

from controller.design_model import design_model
from controller.settings import PredictiveSettings, Settings
from cosim.linearization.workflow import linearize
from cosim.model import SCALAR
from plant.bench import Bench
from plant.hovercraft import Hovercraft
from plant.identification.protocol import read_protocol
from plant.identification.recordings import calibrate, load_runs, play, runs_of
from plant.identification.workflow import analyse
from plant.powertrain import ground_effect, lag, servo_angle, thrust_out_of_ground
from tests.conftest import ROOT
from tests.test_first_steps import told

PAGE = ROOT / "docs" / "seed.md"
BENCH = ROOT / "examples" / "bench" / "protocol.yaml"


def test_commands_that_linearise_show_the_numbers_of_their_rows(tmp_path: Path) -> None:
    def linear(row: str, matrix: str) -> tuple[dict[str, Any], Any]:
        """What the command of a row of the page's list prints, and a matrix of it."""
        (command,) = re.findall(rf"^\| {row} \|.*\| `cosim (.*)` \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
        words = [*shlex.split(command), "--json", "--no-report", "--out", tmp_path / matrix]
        found = json.loads(told(*words))
        return found, np.array(found["models"][0][matrix])

    bench, C = linear("4.1–4.8", "C")
    gain = 1.0 / (1.0 - (0.127 / (4 * 0.095)) ** 1.902)  # eq 4.28
    assert bench["outputs"] == ["force_z", "force_x", "moment", "thrust_actual"]
    assert bench["states"][:2] == ["thrust", "tilt"]
    assert C[[0, 1, 3], 0] == pytest.approx([gain * math.cos(0.1), gain * math.sin(0.1), gain], rel=1e-4)
    assert C[2, 1] != 0.0  # eq 4.10
    craft, A = linear("5.20–5.34", "A")
    assert craft["states"] == ["x", "vx", "psi", "psi_dot", "tilt_right", "tilt_left"]
    assert (A[1, 1], A[5, 5]) == (pytest.approx(-0.3546, abs=5e-5), pytest.approx(-11.31, abs=5e-3))
    assert A[3, 4] == pytest.approx(41.85, abs=5e-3)


# -- rows that are short enough to stand here -------------------------------------------------


def test_the_shipped_protocol_is_app_d_2_where_it_differs_from_chapter_4() -> None:
    content, bench = YAML(typ="safe").load(BENCH.read_text(encoding="utf-8")), Bench()
    line, ground, projection, step, sines, moment = (
        content["tests"][name] for name in ("thrust_line", "ground_effect", "projection", "step", "frequency", "moment")
    )
    # D.2.1: 6 to 7 % in 60 s, t_i = 820 rows of 0.02 s; the cell's end, 285 gf, is at 6.56 %
    assert line["phases"][2:4] == [[5, 6, 0], [65, 7, 0]]
    assert 6.0 + (line["window"][0] - 5.0) / 60.0 == pytest.approx(6.19, abs=5e-4)
    assert (285.0 - bench.thrust_offset) / bench.thrust_slope == pytest.approx(6.56, abs=5e-3)
    # D.2.2: four heights at one duty; §4.4's 119 gf for validation
    assert ground["heights"] == [0.68, 1.25, 2.0, 2.75]
    assert {duty for _, duty, _ in ground["phases"]} == {5, 6.3}
    assert bench.thrust_offset + bench.thrust_slope * ground["validation_duty"] == pytest.approx(119.0, abs=0.5)
    assert bench.propeller_radius == 0.127
    # D.2.3: 25 deg in 21 s; D.2.4: 25 deg at once
    assert projection["phases"][3:5] == [[6, 6.3, 0], [27, 6.3, 25]]
    assert (step["phases"][-1][1:], step["at"]) == ([6.4, 25], 6)
    # D.2.5 in rad/s; D.3.4 skips up to three periods, so they are recorded
    assert sines["frequencies"] == [0.1, 1, 2, 4, 6, 8, 10]
    assert sines["thesis_skip"] == [0, 0, 0, 0, 2, 2, 3]
    assert min(sines["periods"][1:]) == 4
    assert all(p - s >= 3 for p, s in zip(sines["periods"][1:], sines["thesis_skip"][1:], strict=True))
    # D.2.6: 80 deg in 45 s
    assert [tilt for *_, tilt in moment["phases"]] == [0, 0, 80, 80]
    assert bench.assembly_mass == 0.145
    assert [t["repetitions"] for t in (line, ground, projection, step, sines, moment)] == [20, 10, 15, 20, 20, 20]
    assert [t["low_pass"] for t in (line, ground, projection, step, moment)] == [0.25, 0.25, 0.1, 0, 0.5]


@pytest.mark.thorough
def test_tares_are_estimated_and_not_copied(tmp_path: Path) -> None:
    """D.3 takes 5 gf and 0.75e-4 N m off every run; a cell that is 0.1 V off all day changes nothing here."""
    content = YAML(typ="safe").load(BENCH.read_text(encoding="utf-8"))
    content["tests"] = {"step": content["tests"]["step"] | {"repetitions": 3}}
    (tmp_path / "protocol.yaml").write_text(json.dumps(content))
    protocol = read_protocol(tmp_path / "protocol.yaml")
    bench, found = protocol.bench, []
    cells = calibrate(protocol, {c: play(bench, runs) for c, runs in load_runs(protocol, 1).items()})
    runs = play(bench, runs_of(protocol, "step", 1))
    for off in (0.0, 0.1):
        moved = [replace(r, volts={c: v + off for c, v in r.volts.items()}) for r in runs]
        found.append(analyse(protocol, cells, {"step": moved})[0].estimates[0])
    assert found[1].value == pytest.approx(found[0].value, rel=1e-9)
    assert abs(found[1].thesis / found[0].thesis - 1.0) > 1e-3


def test_the_angle_of_app_d_3_3_is_another_servo_s_than_that_of_eq_3_1() -> None:
    duty, b = np.array([6.4, 7.1, 7.5, 8.2]), Bench()
    copied = 0.85 * 22.5 * (duty - 7.1)  # D.3.3, its sign aside
    own = np.degrees(servo_angle(duty, b.servo_neutral, b.servo_slope))
    assert own == pytest.approx(22.5 * (duty - 7.5), abs=2e-3)  # 3.1
    assert (copied - own)[2] == pytest.approx(7.65)
    given = b.with_values({"servo_neutral": 7.1, "servo_slope": 0.85 * b.servo_slope})
    assert np.degrees(servo_angle(duty, given.servo_neutral, given.servo_slope)) == pytest.approx(copied, abs=2e-3)


def test_within_the_limits_of_the_predictive_law_b_t_leaves_that_of_hover_by_its_duty() -> None:
    """5.19: the tilts' columns of B(t) are Γ·T·cos α; the law of §7.1 has them at hover."""

    def columns(duty: float, tilt: float) -> np.ndarray:
        at = [f"duty_right={duty!r}", f"duty_left={duty!r}", f"tilt_right={tilt!r}", f"tilt_left={tilt!r}"]
        lags = ["thrust_right", "thrust_left", "tilt_right", "tilt_left"]
        found = linearize("base", at=at, residualize=lags, inputs=["tilt_right", "tilt_left"], outputs=["psi"]).first
        return found.B[[found.states.index(n) for n in ("vx", "psi_dot")]]

    p = PredictiveSettings()
    hover = columns(Hovercraft().duty_nominal, 0.0)
    assert columns(p.duty_min, 0.0) / hover == pytest.approx(0.374, abs=1e-3)
    assert columns(p.duty_max, 0.0) / hover == pytest.approx(1.989, abs=1e-3)
    assert columns(Hovercraft().duty_nominal, p.tilt_max) / hover == pytest.approx(math.cos(math.radians(12)), abs=1e-6)


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
    moving = {"vx": 0.4, "vy": -0.1, "psi_dot": 0.3, "phi_dot": 0.2, "phi": phi}
    state = craft.start(moving | {"thrust_right": TR, "thrust_left": TL, "tilt_right": aR, "tilt_left": aL})
    rates = craft.equations(SCALAR).derivative(0.0, state, (6.4, 6.4, aR, aL))
    found = dict(zip((q.name for q in craft.states), rates, strict=True))
    FRx, FLx = gain * TR * math.sin(aR), gain * TL * math.sin(aL)  # 5.12
    FRz, FLz = gain * TR * math.cos(aR), gain * TL * math.cos(aL)
    expected = {
        "x": 0.4, "y": -0.1, "psi": 0.3, "phi": 0.2, "vx": (FRx + FLx) / m, "vy": -(FRz + FLz) / m * math.sin(phi),
        "psi_dot": L / Izz * (FRx - FLx), "phi_dot": L / Ixx * (FRz - FLz),
    }  # fmt: skip
    assert {n: found[n] for n in expected} == pytest.approx(expected, rel=1e-12)


def test_the_controllability_matrix_of_eq_5_36() -> None:
    """5.35 prints AⁿB as the last block; 5.36 ends with A⁴B, ten columns of five states."""
    A, B = design_model(Settings())
    found = control.ctrb(A, B)
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
