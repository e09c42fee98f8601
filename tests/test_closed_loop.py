"""The closed loop as plain functions: Fig 6.2, the roll motion, and gains tested on the nonlinear craft."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from controller.loop import StateFeedback
from controller.settings import ESTIMATORS, GAINS, Settings
from controller.synthesis import POLES, Q_INTEGRAL, flown_modes, lqr_gain, placed_gain, worst_modes
from plant.hovercraft import Hovercraft
from tests.controllers import OFF, STEP, Flight, fly

FREE = {"tilt_max": math.pi / 2}  # never reached


def flown(values: Mapping[str, Any], until: float, start: Mapping[str, float], **more: Any) -> Flight:
    """A flight with other settings."""
    return fly((replace(Settings(), **values), StateFeedback), duration=until, start=start, **more)


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


def flown_poles(K: Any, start: Mapping[str, float], until: float, **settings: Any) -> list[complex]:
    """Poles [rad/s] of a pair, out of the last half second of a flight: αₖ₊₂ = a·αₖ₊₁ + b·αₖ of a tilt."""
    tilt = flown(dict(zip(GAINS, K.ravel(), strict=True)) | settings, until, start).command[-25:, 2]
    a, b = np.linalg.lstsq(np.column_stack([tilt[1:-1], tilt[:-2]]), tilt[2:], rcond=None)[0]
    return [cmath.log(z) / STEP for z in np.roots([1, -a, -b])]


@pytest.mark.parametrize("estimator", ESTIMATORS)
# the second is stable on eqs 5.33/5.34, not where the turn lags
@pytest.mark.parametrize("turn", [(-10.0, -12.0), (-15.0, -16.0)])
def test_the_turn_swings_in_a_flight_as_its_pole_says(turn: tuple[float, ...], estimator: str) -> None:
    K = placed_gain(Settings(), (*POLES[:3], *turn))
    modes = flown_modes(Settings(estimator=estimator), K)
    expected = next(mode.pole for mode in modes if mode.axis == "turning" and mode.pole.imag >= 0)
    found = flown_poles(K, {"psi": 1e-4}, 4.0, estimator=estimator)
    # 1e-3: the filter's gain is steady after a second, the equations are nonlinear by 1e-8 of it
    assert min(abs(s - expected) for s in found) < 1e-3 * abs(expected)


def test_all_designs_of_the_thesis_and_ours_are_damped_with_every_estimator() -> None:
    for estimator in ESTIMATORS:
        p = Settings(estimator=estimator)
        integral = lqr_gain(p, Q_integral=Q_INTEGRAL)
        every = [mode for K in (lqr_gain(p), placed_gain(p), integral) for mode in flown_modes(p, K)]
        assert worst_modes(every) == []
        assert min(mode.damping for mode in every) > 0.29
