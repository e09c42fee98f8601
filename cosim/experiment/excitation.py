"""Random excitation signals: multisines, chirps, steps and ramps, with rests between."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cosim.base.arrays import Array
from cosim.experiment.rigs import RigAxis

TONES = 12
MAX_PARTS = 6  # parts of a trial in which an axis moves or rests
MOVE_PROBABILITY = 0.75  # probability that an axis moves in a part
AMPLITUDE_SHARE = (0.3, 1.0)  # share of an axis' amplitude
KINDS = ("multisine", "chirp", "steps", "ramps")


def draw_signals(rng: np.random.Generator, axes: Sequence[RigAxis], time: Array) -> dict[str, Array]:
    """Return random signals of one experiment for all axes."""
    parts = int(rng.integers(1, MAX_PARTS + 1))
    part = np.minimum((time / time[-1] * parts).astype(int), parts - 1)
    signals = {}
    for axis in axes:
        kind = str(rng.choice(KINDS))
        size = axis.amplitude * rng.uniform(*AMPLITUDE_SHARE)
        moves = rng.random(parts) < MOVE_PROBABILITY
        signals[axis.name] = size * _wave(rng, kind, axis, time) * moves[part]
    return signals


def _wave(rng: np.random.Generator, kind: str, axis: RigAxis, time: Array) -> Array:
    """Return a signal within ±1: a multisine, chirp, ramps or steps."""
    if kind == "multisine":
        frequency = np.geomspace(axis.slowest, axis.fastest, TONES)
        phase = rng.uniform(0.0, 2.0 * math.pi, TONES)
        wave = np.sin(2.0 * math.pi * np.outer(time, frequency) + phase).sum(axis=1)
        return np.asarray(wave / np.abs(wave).max())
    if kind == "chirp":
        from scipy.signal import chirp

        swept = chirp(time, axis.slowest, time[-1], axis.fastest, method="logarithmic", phi=-90)
        return np.asarray(swept if rng.random() < 0.5 else swept[::-1])
    # Levels are held, or joined by lines, for between half a period of the fastest and of the slowest frequency.
    knots, ahead = [0.0], (0.5 / axis.fastest, 0.5 / axis.slowest)
    while knots[-1] < time[-1]:
        knots.append(knots[-1] + math.exp(rng.uniform(math.log(ahead[0]), math.log(ahead[1]))))
    levels = np.concatenate([[0.0], rng.uniform(-1.0, 1.0, len(knots) - 1)])
    if kind == "ramps":
        return np.asarray(np.interp(time, knots, levels))
    return np.asarray(levels[np.searchsorted(knots, time, side="right") - 1])
