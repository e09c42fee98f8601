"""Time in which unmeasured states forget a wrong start of the filter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cosim.core.arrays import Array
from cosim.core.linear_algebra import eigenvalues
from cosim.model.model import Model
from cosim.model.namespaces import SCALAR

NEGLIGIBLE_SHARE = 1e-4  # of a wrong start
MIN_DECAY_RATE = 1e-9  # [1/s]


def settling(model: Model, names: Sequence[str]) -> float:
    """Return the settling time [s] of the states `names`, driven by commands alone.

    The time is ln(1/NEGLIGIBLE_SHARE) times the slowest stable time constant of the base model at its start, else 0.
    """
    base = replace(model, effects=())
    derivative, start, command = base.acting(SCALAR).derivative, base.start(), base.start_command()
    places = [[s.name for s in base.states].index(name) for name in names]

    def rates(place: int, change: float) -> Array:
        state = tuple(x + change * (k == place) for k, x in enumerate(start))
        return np.array(derivative(0.0, state, command), dtype=np.float64)[places]

    steps = {place: 1e-6 * max(1.0, abs(start[place])) for place in places}
    columns = [(rates(place, h) - rates(place, -h)) / (2.0 * h) for place, h in steps.items()]
    poles = eigenvalues(np.column_stack(columns)).real if columns else np.zeros(0)
    decay = [-float(pole) for pole in poles if pole < -MIN_DECAY_RATE]
    return math.log(1.0 / NEGLIGIBLE_SHARE) / min(decay) if decay else 0.0
