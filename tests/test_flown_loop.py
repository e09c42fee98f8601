"""Gains judged on the craft that flies, its lag on both axes, the sample, the filter; held against flights."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from controller.laws import IntegralFeedback, StateFeedback
from controller.settings import ESTIMATORS, GAINS, INTEGRAL_SETTINGS, INTEGRALS, FullSettings, Settings
from controller.synthesis import POLES, Q_INTEGRAL, LoopMode, flown_modes, lqr_gain, placed_gain, worst_modes
from tests.controllers import LAWS, STEP, fly

FAST = (-2.0, -4.0, -11.0, -15.0, -16.0)  # stable on eqs 5.33/5.34, not where the turn lags


def slowest(K: Any, K_i: Any = None, *, axis: str, estimator: str = "appendix_f") -> LoopMode:
    p = FullSettings(estimator=estimator)
    return next(mode for mode in flown_modes(p, K, K_i) if mode.axis == axis and mode.pole.imag >= 0)


def flown_poles(K: Any, start: str, size: float, until: float, K_i: Any = None, **settings: Any) -> list[complex]:
    """Poles [rad/s] of a pair, out of the last half second of a flight: αₖ₊₂ = a·αₖ₊₁ + b·αₖ of a tilt."""
    kind: Any = Settings() if K_i is None else INTEGRAL_SETTINGS
    gains = dict(zip(GAINS, K.ravel(), strict=True))
    if K_i is not None:
        gains |= dict(zip(INTEGRALS, K_i.ravel(), strict=True))
    law: Any = StateFeedback if K_i is None else IntegralFeedback
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(LAWS, "mine", (replace(kind, **gains, **settings), law))
        tilt = fly("mine", duration=until, start={start: size}).command[-25:, 2]
    a, b = np.linalg.lstsq(np.column_stack([tilt[1:-1], tilt[:-2]]), tilt[2:], rcond=None)[0]
    return [cmath.log(z) / STEP for z in np.roots([1, -a, -b])]


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("turn", [(-10.0, -12.0), FAST[3:]])
def test_the_turn_swings_in_a_flight_as_its_pole_says(turn: tuple[float, ...], estimator: str) -> None:
    K = placed_gain(Settings(), (*POLES[:3], *turn))
    expected = slowest(K, axis="turning", estimator=estimator).pole
    found = flown_poles(K, "psi", 1e-4, 4.0, estimator=estimator)
    # 1e-3: the filter's gain is steady after a second, the equations are nonlinear by 1e-8 of it
    assert min(abs(s - expected) for s in found) < 1e-3 * abs(expected)


def test_the_forward_axis_grows_in_a_flight_as_its_pole_says_and_integrals_count() -> None:
    K = placed_gain(Settings(), (-20.0, -21.0, -22.0, -4.0, -5.0))
    expected = slowest(K, axis="forward").pole
    assert expected.imag == pytest.approx(math.pi / STEP)  # from sample to sample
    found = flown_poles(K, "x", 1e-21, 0.6)
    assert min(abs(s.real - expected.real) for s in found) < 1e-3 * expected.real
    K, K_i = np.hsplit(lqr_gain(Settings(), (10.0, 0.5, 10.0, 0.01, 0.0), Q_integral=(1.0, 400.0)), [5])
    expected = slowest(K, K_i, axis="turning").pole
    assert expected.real > 0
    assert slowest(K, axis="turning").pole.real < expected.real - 0.1  # without its integrals
    found = flown_poles(K, "psi", 1e-5, 3.0, K_i)
    assert min(abs(s - expected) for s in found) < 1e-3 * abs(expected)


def test_all_designs_of_the_thesis_and_ours_are_damped_with_every_estimator() -> None:
    for estimator in ESTIMATORS:
        p = FullSettings(estimator=estimator)
        every = [
            *flown_modes(p, lqr_gain(p)),
            *flown_modes(p, placed_gain(p)),
            *flown_modes(p, *np.hsplit(lqr_gain(p, Q_integral=Q_INTEGRAL), [5])),
        ]
        assert worst_modes(every) == []
        assert min(mode.damping for mode in every) > 0.29
