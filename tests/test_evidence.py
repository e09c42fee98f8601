"""Evidence for a part of a hypothesis: its gain against the scatter of chance, over blocks of time."""

import math

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.special import stdtrit

from cosim.estimation.problem import Scored
from cosim.refinement.decision.evidence import (
    BY_CHANCE,
    deviations_from,
    gain_per_chance,
    gain_per_scatter,
    refuting_deviations,
)
from tests.cases import some

BLOCKS, ROWS = 30, 100
BLOCK = np.repeat(np.arange(BLOCKS), ROWS)
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
    """Return whether the gain is beyond its cost and beyond chance, by each scatter."""
    worse, better = fitted(term, y)
    gain = worse.nll - better.nll
    ratios = gain_per_chance(BLOCK, worse, better), gain_per_scatter(BLOCK, worse, better, 0.0)
    return [gain > COST and ratio > LIMIT for ratio in ratios]


def test_an_effect_that_acts_in_three_blocks_is_no_chance() -> None:
    rng = np.random.default_rng(1)
    terms = [acting_in(3, rng) for _ in range(200)]
    shares = np.mean([passes(term, 9.0 * term + rng.normal(size=term.size)) for term in terms], axis=0)
    assert shares[0] > 0.5  # Its gain is 40.
    assert shares[1] < 0.05  # Blocks without excitation count as scatter.


@pytest.mark.parametrize("blocks", some([1, 2, 3, BLOCKS], every=3))
def test_coloured_noise_passes_for_no_effect(blocks: int) -> None:
    rng = np.random.default_rng(2)
    noise = [lfilter([1.0], [1.0, -0.8], rng.normal(size=BLOCKS * ROWS)) for _ in range(400)]
    assert np.mean([passes(acting_in(blocks, rng), y)[0] for y in noise]) < BY_CHANCE


def test_a_single_event_passes_for_no_effect() -> None:
    rng = np.random.default_rng(3)
    term = acting_in(BLOCKS, rng)
    event = np.where(BLOCK == 7, 40.0 * term, 0.0)
    assert not any(passes(term, event + rng.normal(size=term.size))[0] for _ in range(100))


def alike(rng):
    """Return two terms of unit size with a correlation of 0.7."""
    time = np.arange(BLOCKS * ROWS)
    one, other = (np.sin(frequency * time + rng.uniform(0.0, 6.0)) for frequency in (0.21, 0.33))
    one, other = one / np.linalg.norm(one), other / np.linalg.norm(other)
    return one, 0.7 * one + math.sqrt(1.0 - 0.7**2) * other


def test_a_true_rival_is_seldom_refuted() -> None:
    rng = np.random.default_rng(4)
    wrong = []
    for colour in (0.0, 0.8):
        for _ in range(150):
            true, other = alike(rng)
            noise = lfilter([1.0], [1.0, -colour], rng.normal(size=true.size))
            worse, better = (fitted(term, 2.8 / (1.0 - colour) * true + noise)[1] for term in (true, other))
            wrong.append(
                worse.nll - better.nll > 3.0 and deviations_from(BLOCK, worse, better) > refuting_deviations(1)
            )
    assert np.mean(wrong) < 0.02
