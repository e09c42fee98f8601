"""Figures of merit and faults of connections are those of their definitions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from cosim.blocks.faults import fault_function
from cosim.simulation import criteria

T = np.array([2.0, 2.5, 3.0, 4.0, 4.5])


@pytest.mark.parametrize(
    ("signal", "time"),
    [
        ([1, 1, 1, 1, 1], 0.0),
        ([3, 1.2, 1, 1, 1], 0.5),
        ([3, 1, 0.7, 1, 1], 1.0),
        ([0, 0, 0, 0, 1], 2.0),
        ([1, 1, 1, 1, 1.11], math.inf),
        ([1.1, 0.9, 1.1, 0.9, 1.1], 0.0),  # on the edge of the band is within it
    ],
)
def test_settling_time_is_that_of_the_last_sample_outside_the_band(signal: list[float], time: float) -> None:
    assert criteria.settling_time(T, np.array(signal), 1.0, 0.1 + 1e-12) == time


@pytest.mark.parametrize(
    ("signal", "target", "overshoot"),
    [
        ([0, 0.5, 1.25, 0.9, 1.0], 1.0, 0.25),
        ([0, -0.5, 0.5, 0.9, 1.0], 1.0, 0.0),
        ([2, 0.75, 1.5, 1.0, 1.0], 1.0, 0.25),
        ([1, 1.5, 0.25, 1.0, 1.0], 1.0, 0.75),  # from the target every excursion counts
        ([0.0, 2.5, 2.0], [0.0, 1.0, 2.0], 0.5),
    ],
)
def test_overshoot_is_measured_in_the_direction_of_travel(signal: list[float], target: Any, overshoot: float) -> None:
    assert criteria.overshoot(np.array(signal), np.array(target)) == overshoot


@pytest.mark.parametrize("kind", ["dropout", "spike"])
def test_what_is_lost_or_hit_by_chance_is_as_often_as_its_probability_says(kind: str) -> None:
    count, share = 20_000, 0.25
    fault = fault_function(kind, (0, count), count, np.random.default_rng(3), value=0.5, probability=share)
    changed = np.mean([fault(k, float(k)) != k for k in range(count)])
    assert changed == pytest.approx(share, abs=4 * math.sqrt(share * (1 - share) / count))
