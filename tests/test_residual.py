"""The residual's statistics, each against its formula or against chance."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from cosim.logs.log import noise_level
from cosim.residuals.residual_statistics import fit_percent, input_correlations, pool_errors, rmse, score, whiteness

Array = NDArray[np.float64]


def coloured(rng: np.random.Generator, phi: float, count: int = 2000) -> Array:
    """First-order autoregression r(t) = φ·r(t − 1) + e(t)."""
    e, r = rng.standard_normal(count), np.zeros(count)
    for t in range(1, count):
        r[t] = phi * r[t - 1] + e[t]
    return r


def test_fit_and_rmse_are_their_formulas_and_cells_that_were_not_measured_do_not_count() -> None:
    y = np.array([1.0, 2.0, 3.0, 4.0])
    # ‖y − ŷ‖ = √(4·0.25) = 1, ‖y − mean‖ = √(2·1.5² + 2·0.5²) = √5
    assert fit_percent(y, y + 0.5) == pytest.approx(100.0 * (1.0 - 1.0 / math.sqrt(5.0)), rel=1e-15)
    errors = [np.array([3.0]), np.array([4.0, 0.0, 0.0])]
    assert rmse(*errors) == 2.5  # √((9 + 16)/4): over rows, not over logs
    assert pool_errors([{"psi": e} for e in errors]) == {"psi": 2.5}
    found = score(np.array([1.0, math.nan, 3.0, 4.0]), np.array([1.0, 100.0, 3.0, 2.0]))
    assert (found.rmse, found.rows) == (pytest.approx(2.0 / math.sqrt(3.0), rel=1e-15), 3)


def test_noise_is_told_from_a_fast_signal_and_from_outliers() -> None:
    t = np.arange(2000) * 0.02
    noise = 0.02 * np.random.default_rng(1).standard_normal(t.size)
    signal = np.sin(3.0 * t) + np.where(t > 20.0, 5.0, 0.0)  # a step is no noise
    seen = signal + noise
    seen[::100] += 3.0
    # robust estimate: standard error about 1.2/√2000·√(70/36) = 4 % with neighbours' overlap; outliers add some
    assert noise_level(seen) == pytest.approx(0.02, rel=0.15)
    assert noise_level(signal) < (3.0 * 0.02) ** 4 / 6.0  # what (ωh)⁴/6 of a unit sine leaves where it is largest


@pytest.mark.parametrize("missing", [0.0, 0.4])
def test_white_residuals_are_called_coloured_as_often_as_the_level_says(missing: float) -> None:
    rng = np.random.default_rng(4)
    p = []
    for _ in range(400):
        r = rng.standard_normal(500)
        r[rng.random(500) < missing] = np.nan
        p.append(whiteness(r, 30).p_value)
    # 5 % of 400 is 20, standard deviation 4.4; the statistic is chi-square only for many rows: five of them
    assert abs(sum(v < 0.05 for v in p) - 20) < 22
    assert 0.4 < np.median(p) < 0.65


def test_slow_residuals_are_not_white() -> None:
    assert not whiteness(coloured(np.random.default_rng(6), 0.5), 50).white


def test_the_input_a_residual_follows_stands_out_at_its_lag() -> None:
    rng = np.random.default_rng(7)
    u, v = coloured(rng, 0.5), coloured(rng, 0.5)
    r = 0.3 * np.concatenate((np.zeros(7), u[:-7])) + rng.standard_normal(u.size)
    first, second = input_correlations(r, {"v": v, "u": u, "still": np.ones(u.size)}, 50)
    assert (first.name, first.lags[first.peak], first.stands_out, first.ahead) == ("u", 7, True, True)
    assert (second.name, second.stands_out) == ("v", False)


def test_slow_signals_do_not_follow_one_another_by_chance() -> None:
    rng = np.random.default_rng(8)
    found = [input_correlations(coloured(rng, 0.9), {"u": coloured(rng, 0.9)}, 50)[0] for _ in range(200)]
    beyond = sum(abs(float(c.rho[c.lags == 1][0])) > c.band for c in found)
    assert beyond < 25  # 5 % of 200 is 10, standard deviation 3.1; with 1.96/√n as the band it is more than half
    assert sum(c.stands_out for c in found) <= 2  # four standard errors, over 50 lags that are nearly one


def test_feedback_is_not_mistaken_for_a_cause() -> None:
    rng = np.random.default_rng(9)
    noise = rng.standard_normal(2000)
    u = 0.5 * np.concatenate((np.zeros(3), noise[:-3])) + rng.standard_normal(2000)  # answers what it measured
    (found,) = input_correlations(noise, {"u": u}, 50)
    assert not found.stands_out
    assert found.rho[found.lags == -3][0] > 3 * found.band
