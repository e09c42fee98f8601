"""Readings that a recorder made up are left out, what a system does is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cosim.arrays import Array
from cosim.logs.log import Log
from cosim.logs.spikes import find_spikes, without

ROWS, NOISE = 600, 0.01


def log_of(values: Array, step: float) -> Log:
    still = np.zeros(values.size)
    time = step * np.arange(values.size)
    return Log(Path("a.csv"), time, {"u": still}, {"y": values}, {"y": "m"}, step, {}, {})


def left_out(values: Array, step: float = 0.005) -> list[int]:
    log = log_of(values, step)
    spikes = find_spikes(log)
    gone = np.flatnonzero(np.isfinite(values) & np.isnan(without(log, spikes).outputs["y"])).tolist()
    assert {n: rows.tolist() for n, rows in spikes.items()} == ({"y": gone} if gone else {})
    return gone


@pytest.fixture
def moving() -> Array:
    """A slow swing, a tilt and noise."""
    k = np.arange(ROWS)
    swing = 0.8 * np.sin(2.0 * np.pi * k / 150.0) + 2e-3 * k
    return np.asarray(swing + NOISE * np.random.default_rng(3).standard_normal(ROWS))


@pytest.mark.parametrize("step", [0.005, 1.0, 60.0])
@pytest.mark.parametrize(
    ("wild", "missing"),
    [
        ([200], []),
        ([200], [201]),
        ([200], [198]),
        ([200], [199, 202]),
        ([200, 201], []),
        ([200, 202], []),
        ([200, 202, 203], []),
        ([200, 203], [201]),
        ([200, 400, 401], [402]),
    ],
)
def test_wild_readings_are_left_out_wherever_they_stand(
    moving: Array, wild: list[int], missing: list[int], step: float
) -> None:
    moving[wild] += 30.0 * NOISE * np.where(np.arange(len(wild)) % 3 == 1, -1.0, 1.0)
    moving[missing] = np.nan
    assert left_out(moving, step) == wild


@pytest.mark.parametrize("size", [0.5, 1.0, 5.0])
def test_a_step_a_kink_a_pulse_and_a_quick_oscillation_are_motion(moving: Array, size: float) -> None:
    k = np.arange(ROWS)
    motions = {
        "step": size * (k > 200),
        "kink": 0.1 * size * np.maximum(0, k - 200),
        "pulse of four rows": size * ((k >= 200) & (k < 204)),
        "decay": size * np.where(k >= 200, np.exp(-(k - 200) / 4.0), 0.0),
        "oscillation of eight rows": size * np.sin(2.0 * np.pi * k / 8.0) * (k >= 200),
    }
    for name, motion in motions.items():
        assert left_out(moving + motion) == [], name
        gone = moving + motion
        gone[[199, 205]] = np.nan
        assert left_out(gone) == [], f"{name} beside readings that are missing"
