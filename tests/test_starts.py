"""Where a replay starts: parabolas through what was measured, against polynomials and bodies whose state is known."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.arrays import Array
from cosim.logs.log import Log
from cosim.residuals.drive import as_columns
from cosim.residuals.windows import (
    StartParameter,
    first_start,
    noise_levels,
    window_start,
)


def log_of(time: Array, step: float = 0.02, **outputs: Array) -> Log:
    units = dict.fromkeys(outputs, "rad")
    return Log(Path("a.csv"), time, {}, outputs, units, step, {}, {})


def seconds(duration: float, step: float = 0.02) -> Array:
    return step * np.arange(round(duration / step) + 1)


def parameter(name: str = "y_start", gain: float = 1.0, low: float = -math.inf, high: float = math.inf) -> Any:
    return StartParameter(name, gain, low, high, (0.1, 0.2))


# -- the parabola -----------------------------------------------------------------------------------

VALUE, SLOPE = 0.3, -0.7


# -- a body whose state is known --------------------------------------------------------------------

PLACES = ("x", "vx")


class Body:
    """A drive of a body that keeps its velocity, whatever the log says: what the model lacks is an acceleration."""

    outputs, frame, given = PLACES, None, dict[str, float]()

    def __init__(self, log: Log) -> None:
        self.log, self.runs = log, 0

    def run(self, first: int, last: int, start: Mapping[str, float]) -> Array:
        self.runs += 1
        t = self.log.time[first : last + 1] - self.log.time[first]
        speed = np.full(t.size, start.get("vx_start", 0.0))
        return np.column_stack([start.get("x_start", 0.0) + speed * t, speed])


BODY = {name: parameter(f"{name}_start") for name in PLACES}


def measured(acceleration: float, noise: float = 1e-4, **only: bool) -> Log:
    time, rng = seconds(6.0), np.random.default_rng(4)
    x = VALUE + SLOPE * time + 0.5 * acceleration * time**2 + noise * rng.standard_normal(time.size)
    v = SLOPE + acceleration * time + 10 * noise * rng.standard_normal(time.size)
    return log_of(time, **{n: y for n, y in (("x", x), ("vx", v)) if only.get(n, True)})


@pytest.mark.parametrize("only", [{}, {"vx": False}])
@pytest.mark.parametrize("acceleration", [0.0, 0.4])
def test_the_first_start_is_that_of_the_body_also_where_its_speed_is_not_measured(
    acceleration: float, only: dict[str, bool]
) -> None:
    log = measured(acceleration, **only)
    drive: Any = Body(log)
    start = first_start(drive, BODY)
    # 50 rows of 0.1 mm: of a parabola's end 3·σ/√50, of its slope 19·σ/(1 s·√50)
    assert start["x_start"] == pytest.approx(VALUE, abs=4 * 3e-4 / math.sqrt(50))
    assert start["vx_start"] == pytest.approx(SLOPE, abs=4 * 19e-4 / math.sqrt(50))


@pytest.mark.parametrize("acceleration", [0.0, 0.4])
def test_a_window_starts_at_the_end_of_a_parabola_through_the_half_second_before(acceleration: float) -> None:
    log = measured(acceleration)
    drive: Any = Body(log)
    k, since = 200, 150
    carrier = as_columns(
        np.vstack([np.full((since, 2), np.nan), drive.run(since, k, {"x_start": 1.0, "vx_start": 0.0})]), PLACES
    )
    start = window_start(drive, BODY, noise_levels(log), carrier, since, k)
    t = log.time[k]
    assert start["x_start"] == pytest.approx(VALUE + SLOPE * t + 0.5 * acceleration * t**2, abs=4e-4)
    assert start["vx_start"] == pytest.approx(SLOPE + acceleration * t, abs=5e-3)
