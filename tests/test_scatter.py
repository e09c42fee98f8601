"""Gain of a part of a hypothesis against the scatter of chance, over blocks of time."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.special import stdtrit

from cosim.core.linear_algebra import square_roots
from cosim.estimation.problem import Scored
from cosim.refinement.decision.scatter import gain_per_chance
from tests.cases import some

BLOCKS, ROWS = 30, 100
BLOCK = np.repeat(np.arange(BLOCKS), ROWS)
BY_CHANCE = 0.01
LIMIT = 0.5 * stdtrit(BLOCKS - 1, 1.0 - 0.5 * BY_CHANCE / 20)  # of the best of twenty candidates
COST = 10.0


def fitted(term, y):
    """Return the scores of a constant variance without a term and with its regression."""
    size = term @ y / (term @ term)

    def score(errors):
        variances = np.full(errors.size, np.mean(errors**2))
        return Scored(errors, variances, (errors.size,), np.arange(errors.size))

    return score(y), score(y - size * term)


def acting_in(blocks, rng):
    """Return a term of unit size that acts in a few blocks and hardly elsewhere."""
    term = 0.02 * np.sin(0.21 * np.arange(BLOCKS * ROWS))
    for k in range(blocks):
        term[k * ROWS : (k + 1) * ROWS] = 0.35**k * np.sin(0.3 * np.arange(ROWS) + rng.uniform(0.0, 6.0))
    return term / np.linalg.norm(term)


def passes(term, y):
    """Return whether the gain is beyond its cost and beyond chance."""
    worse, better = fitted(term, y)
    return worse.nll - better.nll > COST and gain_per_chance(BLOCK, worse, better) > LIMIT


def test_an_effect_that_acts_in_three_blocks_is_no_chance() -> None:
    rng = np.random.default_rng(1)
    terms = [acting_in(3, rng) for _ in range(200)]
    passed = [passes(term, 9.0 * term + rng.normal(size=term.size)) for term in terms]
    assert np.mean(passed) > 0.5  # Its gain is 40.


@pytest.mark.parametrize("blocks", some([1, 2, 3, BLOCKS], every=3))
def test_coloured_noise_passes_for_no_effect(blocks: int) -> None:
    rng = np.random.default_rng(2)
    noise = [lfilter([1.0], [1.0, -0.8], rng.normal(size=BLOCKS * ROWS)) for _ in range(400)]
    assert np.mean([passes(acting_in(blocks, rng), y) for y in noise]) < BY_CHANCE


def test_a_single_event_passes_for_no_effect() -> None:
    rng = np.random.default_rng(3)
    term = acting_in(BLOCKS, rng)
    event = np.where(BLOCK == 7, 40.0 * term, 0.0)
    assert not any(passes(term, event + rng.normal(size=term.size)) for _ in range(100))


def test_square_roots_of_covariances_exist_for_singular_and_diverged_ones_too() -> None:
    singular = np.array([[4.0, 2.0], [2.0, 1.0]])
    roots = square_roots(np.stack([singular, np.full((2, 2), np.nan)]))
    np.testing.assert_allclose(roots @ roots.transpose(0, 2, 1), np.stack([singular, np.zeros((2, 2))]), atol=1e-12)
