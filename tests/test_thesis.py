"""Numbers that the thesis' own scripts make, and those of docs/seed.md beside them."""

from __future__ import annotations

import pytest

from tests import thesis


def numbers(name: str) -> list[tuple[float, float]]:
    return [(row.thesis, row.ours) for row in thesis.ROWS[name]()]


def test_the_correction_of_test_5_inside_its_loop_turns_the_sign_of_the_arm() -> None:
    (_, looped), (_, once), (printed, right) = numbers("D.3.5")
    assert looped == pytest.approx(8.9e-4, abs=5e-6)
    assert once == pytest.approx(-1.885e-4, abs=1e-7)
    assert right == pytest.approx(printed, rel=1e-9)  # with the mass of eq 5.2
    # blocks are corrected 19, 19, 18, … 1 times, 10.45 times in the mean
    assert (looped - once) / (once - _uncorrected()) == pytest.approx(9.45, rel=1e-9)


def _uncorrected() -> float:
    """Arm of the same recordings without any correction, from the mean of sin α over that of its square."""
    import numpy as np

    sine = np.sin(np.radians(np.linspace(0.0, 80.0, 2251)))
    return -1.17e-4 * 0.145 / 0.09 - 0.75e-4 * sine.sum() / (sine @ sine) / (0.09 * 9.81)


def test_without_the_weights_of_eq_4_27_the_exponent_scatters_more() -> None:
    (plain, weighted), (loose, close) = numbers("D.3.2")
    assert abs(plain - weighted) > 1e-5
    assert weighted == pytest.approx(1.902, abs=3 * close)
    assert loose == pytest.approx(0.0123, abs=5e-4)
    assert close == pytest.approx(0.0087, abs=5e-4)


def test_amplitudes_less_3_gf_and_shifted_phases_bend_the_bode_diagram_of_test_4() -> None:
    (bent, straight), (shifted, phase), (late, lag) = numbers("D.3.4")
    assert straight == pytest.approx(-2.507, abs=1e-3)  # 10·log10(1 + (10·0.0884)²)
    assert bent == pytest.approx(-2.827, abs=1e-3)
    assert phase == pytest.approx(-41.48, abs=5e-3)
    assert shifted - phase == pytest.approx(0.506, abs=1e-3)  # atan(0.1·0.0884)
    assert late - lag == pytest.approx(1.50e-3, abs=1e-5)


def test_the_thrust_of_test_3_is_that_of_one_run_at_another_duty() -> None:
    (low, high), (one, mean) = numbers("D.3.3")
    assert (low, high) == pytest.approx((155.38, 191.37), abs=5e-3)  # 4.20
    assert one / mean == pytest.approx(15**0.5)


def test_4_newton_at_25_degrees_are_1_69_newton_ahead() -> None:
    ((printed, ours),) = numbers("3.3.1")
    assert (printed, ours) == (1.75, pytest.approx(1.690, abs=5e-4))


def test_two_modes_of_the_bench_are_within_the_speeds_of_the_propeller() -> None:
    assert numbers("3.3.2") == [(6500.0, pytest.approx(1831, abs=0.5)), (6500.0, pytest.approx(4720, abs=0.5))]


def test_the_least_rmse_chooses_the_highest_degree_for_a_straight_line() -> None:
    assert numbers("4.3.1") == [(3, 1)]


def test_the_initial_slope_of_three_rows_makes_the_lag_a_quarter_longer() -> None:
    ((slope, lag),) = numbers("4.3.4")
    assert lag == 0.0884
    assert slope == pytest.approx(0.1099, abs=5e-5)


def test_single_precision_moves_the_estimates_of_app_f_by_micrometres() -> None:
    (single, double), (position, _), (heading, _) = numbers("F")
    assert double == pytest.approx(1.5870, abs=5e-5)
    assert single != double
    assert single == pytest.approx(double, rel=1e-4)  # 3000 roundings of 6e-8 each
    assert 1e-7 < position < 1e-4  # [m]; the last bits differ by machine
    assert 0.0 < heading < 1e-7


def test_noise_on_the_states_moves_the_tilts_six_times_as_much_as_the_filter_does() -> None:
    (direct, filtered), _ = numbers("6.1")
    assert direct == pytest.approx(0.64, abs=0.01)  # [deg]: (K₃²·W₁ + K₄²·W₂ + K₅²·W₃)^½ and what it moves
    assert filtered == pytest.approx(0.097, abs=0.005)
