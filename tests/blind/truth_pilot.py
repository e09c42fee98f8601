"""Pilot of the simulated flights: references, a small observer, feedback and dither, independent of the project.

The pilot assumes the base model and uses the measurements of the log, with sensor errors and noise.
"""

from __future__ import annotations

import math

import numpy as np

from tests.blind.field_rig import Array, Random
from tests.blind.truth_craft import DUTY, SHEET, STEP, TILT_MAX, Command

THRUST = 2.4973  # nominal thrust of a propeller in ground effect, eq 5.36 [N]


Range = tuple[float, float]


def reference(rng: Random, count: int, size: Range, rate: Range, pause: Range) -> Array:
    """Return steps and ramps: changes of ±`size`, half of them with a random `rate`, each followed by a `pause`."""
    values = np.zeros(count)
    target = 0.0
    k = int(rng.uniform(0.2, 1.5) / STEP)
    while k < count:
        change = rng.uniform(*size) * rng.choice([-1.0, 1.0])
        if abs(target + change) > 1.5 * size[1]:
            change = -change
        limit = math.inf if rng.random() < 0.5 else rng.uniform(*rate)
        ramp = np.minimum(np.arange(1, count - k + 1) * STEP * limit if limit < math.inf else abs(change), abs(change))
        values[k:] = target + math.copysign(1.0, change) * ramp
        target += change
        ahead = abs(change) / limit + rng.uniform(*pause)
        k += int(ahead / STEP)
    return values


def telegraph(rng: Random, count: int, amplitude: float, hold: Range) -> Array:
    """Return random levels within ±`amplitude`, each held for a time within `hold` [s]: broadband, down to DC."""
    values = np.zeros(count)
    k = 0
    while k < count:
        length = max(1, int(rng.uniform(*hold) / STEP))
        values[k : k + length] = amplitude * rng.uniform(-1.0, 1.0)
        k += length
    return values


class Pilot:
    """Observer and feedback, with distance and speed from the accelerometer and, if measured, the position."""

    def __init__(self, rng: Random, duty_varied: bool, count: int, heading: float) -> None:
        self.forward_gain, self.yaw_gain = rng.uniform(0.7, 1.1), rng.uniform(0.6, 0.9)
        common, turning = rng.uniform(0.03, 0.045), rng.uniform(0.03, 0.05)  # amplitudes of the dither [rad], [%]
        power = rng.uniform(0.08, 0.11) if duty_varied else 0.0
        self.distance_ref = reference(rng, count, (0.2, 1.4), (0.1, 0.6), (1.0, 4.0))
        self.heading_ref = heading + reference(rng, count, (0.3, 2.0), (0.25, 1.2), (0.5, 2.5))
        self.common = telegraph(rng, count, common, (0.04, 0.5))
        self.turning = telegraph(rng, count, turning, (0.04, 0.4))
        self.power = telegraph(rng, count, power, (0.3, 2.0))
        self.balance = telegraph(rng, count, 0.3 * power, (0.2, 1.0))
        self.k = 0
        self.distance = self.speed = self.pull = 0.0  # along the craft's axis [m, m/s, m/s²]
        self.heading, self.rate = heading, 0.0
        self.travelled = 0.0
        self.place: tuple[float, float] | None = None

    def _observe(self, seen: dict[str, float]) -> None:
        c_m = SHEET["friction"] / SHEET["mass"]
        # heading: gyro integrated, drawn to the compass; rate: gyro smoothed
        self.rate += 0.6 * (seen["psi_dot"] - self.rate)
        self.heading += STEP * self.rate
        self.heading += 0.3 * (seen["psi"] - self.heading)
        # speed: thrust acceleration less friction, drawn to the accelerometer
        expected = self.pull - c_m * self.speed
        self.speed += STEP * (expected + 0.3 * (seen["ax"] - expected))
        self.distance += STEP * self.speed
        if "x_world" not in seen:
            return
        here = seen["x_world"], seen["y_world"]
        if self.place:
            step = here[0] - self.place[0], here[1] - self.place[1]
            self.travelled += step[0] * math.cos(self.heading) + step[1] * math.sin(self.heading)
        self.place = here
        error = self.travelled - self.distance
        self.distance += 0.1 * error
        self.speed += 0.2 * error

    def command(self, seen: dict[str, float]) -> Command:
        """Return the command for a measurement of the same instant."""
        self._observe(seen)
        k = self.k
        self.k += 1
        ahead = 0.70 * (self.distance_ref[k] - self.distance) - 0.65 * self.speed
        turn = 0.22 * (self.heading_ref[k] - self.heading) - 0.11 * self.rate
        common = self.forward_gain * ahead + self.common[k]
        turning = self.yaw_gain * turn + self.turning[k]
        right = min(max(common + turning, -TILT_MAX), TILT_MAX)
        left = min(max(common - turning, -TILT_MAX), TILT_MAX)
        goal = 2.0 * THRUST / SHEET["mass"] * math.sin(0.5 * (right + left))
        self.pull += STEP / SHEET["lag"] * (goal - self.pull)
        duty = DUTY + self.power[k], DUTY + self.power[k]
        duty = duty[0] + self.balance[k], duty[1] - self.balance[k]
        # what is logged is what is sent, to the last digit
        return tuple(float(f"{u:.6g}") for u in (*duty, right, left))  # type: ignore[return-value]
