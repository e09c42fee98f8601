"""The loop closed as plain functions: Fig 6.2, the roll it does not show, and gains judged on the craft that flies."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from controller.loop import IntegralFeedback, StateFeedback
from controller.settings import ESTIMATORS, INTEGRAL_SETTINGS, FullSettings, Settings
from controller.synthesis import POLES, Q_INTEGRAL, LoopMode, flown_modes, lqr_gain, placed_gain, worst_modes
from plant.hovercraft import Hovercraft
from tests.controllers import OFF, STEP, Flight, fly

FREE = {"tilt_max": math.pi / 2}  # never reached


def flown(values: Mapping[str, Any], until: float, start: Mapping[str, float], **more: Any) -> Flight:
    """A flight with other settings, with integrals where their gains are given."""
    kind, law = (INTEGRAL_SETTINGS, IntegralFeedback) if "k_1_6" in values else (Settings(), StateFeedback)
    return fly((replace(kind, **values), law), duration=until, start=start, **more)


# Fig 6.2: x = 1 m, ψ = 1 rad → 0 with K on the true state.


@pytest.mark.parametrize(
    ("limit", "settled_x", "settled_psi", "tilt"), [(FREE, 2.98, 1.38, 53.3), ({}, 3.22, 1.86, 12.0)]
)
def test_figure_6_2(limit: Mapping[str, float], settled_x: float, settled_psi: float, tilt: float) -> None:
    flight = flown(limit, 10.0, OFF, truth=True)
    # on a grid of 0.02 s these are exact sample counts
    assert (flight.settled("x", 0.02), flight.settled("psi", 0.02)) == pytest.approx((settled_x, settled_psi), abs=1e-9)
    assert np.degrees(flight.tilts.max()) == pytest.approx(tilt, abs=0.05)  # half a unit of the last digit


def test_roll_that_figure_6_2_does_not_show() -> None:
    alone = Hovercraft(table_roll_stiffness=0.0, table_roll_damping=0.0)
    for craft, phi, digits in (
        (replace(alone, roll_ground_effect=False), 7.5, 0.05),  # eq 5.14: it tumbles, which the five states do not show
        (alone, 0.124, 5e-4),  # each propeller's own ground effect holds it, undamped
        (Hovercraft(), 0.007, 5e-4),  # and the air cushion of §4.2 makes it a detail
    ):
        flight = flown(FREE, 10.02, OFF, truth=True, craft=craft)  # the last row is that of 10 s
        assert np.abs(flight.y["phi"]).max() == pytest.approx(phi, abs=digits)  # half a unit of the last digit
        if phi == 7.5:
            assert np.abs(flight.y["y"]).max() == pytest.approx(35.0, abs=0.5)  # as printed
        # the 5-state figures are the same whatever roll does, to a tenth of a second or two
        assert flight.settled("x", 0.02) == pytest.approx(2.98, abs=0.03)
        assert flight.settled("psi", 0.02) == pytest.approx(1.38, abs=0.15)


# The poles of the sampled loop, the lag on both axes, the filter; held against flights.


def slowest(K: Any, *, axis: str, estimator: str = "appendix_f") -> LoopMode:
    p = FullSettings(estimator=estimator)
    return next(mode for mode in flown_modes(p, K) if mode.axis == axis and mode.pole.imag >= 0)


def flown_poles(K: Any, start: Mapping[str, float], until: float, **settings: Any) -> list[complex]:
    """Poles [rad/s] of a pair, out of the last half second of a flight: αₖ₊₂ = a·αₖ₊₁ + b·αₖ of a tilt."""
    gains = {f"k_{i + 1}_{j + 1}": k for (i, j), k in np.ndenumerate(K)}
    tilt = flown(gains | settings, until, start).command[-25:, 2]
    a, b = np.linalg.lstsq(np.column_stack([tilt[1:-1], tilt[:-2]]), tilt[2:], rcond=None)[0]
    return [cmath.log(z) / STEP for z in np.roots([1, -a, -b])]


@pytest.mark.parametrize("estimator", ESTIMATORS)
# the second is stable on eqs 5.33/5.34, not where the turn lags
@pytest.mark.parametrize("turn", [(-10.0, -12.0), (-15.0, -16.0)])
def test_the_turn_swings_in_a_flight_as_its_pole_says(turn: tuple[float, ...], estimator: str) -> None:
    K = placed_gain(Settings(), (*POLES[:3], *turn))
    expected = slowest(K, axis="turning", estimator=estimator).pole
    found = flown_poles(K, {"psi": 1e-4}, 4.0, estimator=estimator)
    # 1e-3: the filter's gain is steady after a second, the equations are nonlinear by 1e-8 of it
    assert min(abs(s - expected) for s in found) < 1e-3 * abs(expected)


def test_the_forward_axis_grows_in_a_flight_as_its_pole_says_and_integrals_count() -> None:
    K = placed_gain(Settings(), (-20.0, -21.0, -22.0, -4.0, -5.0))
    expected = slowest(K, axis="forward").pole
    assert expected.imag == pytest.approx(math.pi / STEP)  # from sample to sample
    found = flown_poles(K, {"x": 1e-21}, 0.6)
    assert min(abs(s.real - expected.real) for s in found) < 1e-3 * expected.real
    K = lqr_gain(Settings(), (10.0, 0.5, 10.0, 0.01, 0.0), Q_integral=(1.0, 400.0))
    expected = slowest(K, axis="turning").pole
    assert expected.real > 0
    assert slowest(K[:, :5], axis="turning").pole.real < expected.real - 0.1  # without its integrals
    found = flown_poles(K, {"psi": 1e-5}, 3.0)
    assert min(abs(s - expected) for s in found) < 1e-3 * abs(expected)


def test_all_designs_of_the_thesis_and_ours_are_damped_with_every_estimator() -> None:
    for estimator in ESTIMATORS:
        p = FullSettings(estimator=estimator)
        integral = lqr_gain(p, Q_integral=Q_INTEGRAL)
        every = [mode for K in (lqr_gain(p), placed_gain(p), integral) for mode in flown_modes(p, K)]
        assert worst_modes(every) == []
        assert min(mode.damping for mode in every) > 0.29
