"""Least squares with a prior: what the rows determine, and what they leave open."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.core.linear_algebra import least_squares, likely_least_squares


def test_what_the_rows_determine_is_as_without_a_prior() -> None:
    rng = np.random.default_rng(1)
    matrix, true = rng.standard_normal((200, 4)), rng.standard_normal((4, 2))
    sides = matrix @ true + 1e-3 * rng.standard_normal((200, 2))
    assert likely_least_squares(matrix, sides) == pytest.approx(least_squares(matrix, sides), abs=1e-5)


def test_what_the_rows_hardly_determine_stays_small() -> None:
    """The last column is 1e-4 of the noise; plain least squares gives it a coefficient of thousands."""
    rng = np.random.default_rng(2)
    matrix = rng.standard_normal((200, 4)) * [1.0, 1.0, 1.0, 1e-6]
    sides = matrix @ np.array([[1.0], [-2.0], [0.5], [1.0]]) + 1e-2 * rng.standard_normal((200, 1))
    plain, likely = (solve(matrix, sides)[3, 0] for solve in (least_squares, likely_least_squares))
    assert abs(plain) > 100.0
    assert abs(likely) < 1.0


def test_nothing_is_estimated_from_what_is_not_finite_or_zero() -> None:
    matrix = np.ones((5, 2))
    assert (likely_least_squares(matrix * np.nan, np.ones((5, 1))) == 0.0).all()
    assert (likely_least_squares(0.0 * matrix, np.ones((5, 1))) == 0.0).all()
    assert (likely_least_squares(matrix, np.zeros((5, 3))) == 0.0).all()
