"""Figures of merit and faults of connections are those of their definitions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from cosim.blocks.faults import fault_function, points
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


def test_errors_and_effort_are_their_formulas() -> None:
    signal, target = np.array([1.0, -3.0, 2.0, 5.0, 4.0]), np.array([0.0, 0.0, 2.0, 1.0, 1.0])
    assert criteria.rms_error(signal, target) == pytest.approx(math.sqrt((1 + 9 + 0 + 16 + 9) / 5))
    assert (criteria.final_error(signal, target), criteria.peak(-signal)) == (3.0, 5.0)
    assert criteria.effort(T, signal) == 0.5 * 1 + 0.5 * 3 + 1.0 * 2 + 0.5 * 5


@pytest.mark.parametrize("kind", ["dropout", "spike"])
def test_what_is_lost_or_hit_by_chance_is_as_often_as_its_probability_says(kind: str) -> None:
    count, share = 20_000, 0.25
    fault = fault_function(kind, (0, count), count, np.random.default_rng(3), value=0.5, probability=share)
    changed = np.mean([fault(k, float(k)) != k for k in range(count)])
    assert changed == pytest.approx(share, abs=4 * math.sqrt(share * (1 - share) / count))


@pytest.mark.parametrize(
    ("begin", "end", "found"),
    [
        (None, 5.3, (0, 3)),
        (5.2, 5.6, (2, 6)),
        (5.21, 5.59, (3, 5)),
        (5.0 + 3 * 0.1, None, (3, 10)),  # 0.1·3 is a little above 0.3
        (4.0, 9.0, (-10, 40)),
    ],
)
def test_the_window_of_a_fault_is_the_points_within_its_times(begin: Any, end: Any, found: tuple[int, int]) -> None:
    assert points(begin, end, 5.0, 0.1, 11) == found
