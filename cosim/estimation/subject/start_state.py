"""Start of a log: the subject's own start, with the first readings of measured states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.core.arrays import Array
from cosim.estimation.kernel.kernel import Data
from cosim.estimation.subject.interface import Subject
from cosim.logs.log import slowness

STARTING = 0.2  # [s] within which a measurement counts as initial


def start_state(subject: Subject, data: Data, measured: Sequence[str], states: Sequence[str]) -> Array:
    """Return the subject's start state, with initial measurements inserted."""
    start = subject.start_of_log(first_measured(subject, data, measured))
    return np.array([start.get(name, 0.0) for name in states])


def first_measured(subject: Subject, data: Data, measured: Sequence[str]) -> dict[str, float]:
    """Return state → first measurement near the start."""
    states, first = subject.measured_states, {}
    early = data.y[: round(STARTING * slowness(data.step) / data.step) + 1]
    for j, name in enumerate(measured):
        column = early[:, j][~np.isnan(early[:, j])]
        if name in states and len(column):
            first[name] = float(column[0])
    return first
