"""Effects outside the catalogue: a refiner must call them unexplained, not by another effect's name.

`OUTSIDE` has the effects for their parameters, ranges of the parameters, and what makes them visible. They raise the
2 s replay error of the base model on a measured channel to 3-33 times its floor.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tests.blind.truth_craft import Outside, Push

_DEG = math.pi / 180.0


@dataclass(frozen=True)
class Entry:
    """Function of an outside effect, ranges of its parameters, and conditions of visibility."""

    make: Callable[..., Outside]
    ranges: dict[str, tuple[float, float]]
    needs_position: bool = False
    needs_duty: bool = False


def _servo(angle: Callable[..., float]) -> Callable[..., Outside]:
    """Return the maker of a servo, from (goal, parameters) → angle."""
    return lambda **p: Outside(servo=lambda t, goal, memory: angle(goal, **p))


def _push(of: Callable[..., Push]) -> Callable[..., Outside]:
    """Return the maker of a force, from (t, state, thrusts, parameters) → push."""
    return lambda **p: Outside(force=lambda t, state, thrusts: of(t, state, thrusts, **p))


def _held(width: float) -> Outside:
    def servo(t: float, goal: float, memory: dict[str, float]) -> float:
        if abs(goal - memory.get("held", 0.0)) > width:
            memory["held"] = goal
        return memory.get("held", 0.0)

    return Outside(servo=servo)


def _felt(psi: float, east: float, north: float) -> tuple[float, float]:
    """Return the body components of a vector along world X, Y."""
    return east * math.cos(psi) + north * math.sin(psi), east * math.sin(psi) - north * math.cos(psi)


def _gust(t: float, x: list[float], _: Any, force: float, heading: float, period: float, length: float) -> Push:
    on = force if t % period > period - length else 0.0
    return *_felt(x[4], on * math.cos(heading), on * math.sin(heading)), 0.0, 0.0, 0.0, 0.0


def _tether(t: float, x: list[float], _: Any, stiffness: float) -> Push:
    return *_felt(x[4], -stiffness * x[2], -stiffness * x[3]), 0.0, 0.0, 0.0, 0.0


def _growing(t: float, x: list[float], _: Any, coefficient: float, time: float) -> Push:
    k = coefficient * t / time
    return -k * x[5], -k * x[6], 0.0, 0.0, 0.0, 0.0


def _bumps(t: float, x: list[float], _: Any, force: float, pitch: float) -> Push:
    return 0.0, 0.0, 0.0, 0.0, *_felt(x[4], force * math.sin(2.0 * math.pi * x[2] / pitch), 0.0)


OUTSIDE: dict[str, Entry] = {
    # a servo that moves only if its command differs from its position by more than a width
    "hold_band": Entry(_held, {"width": (1.5 * _DEG, 2.5 * _DEG)}),
    "quantised_tilt": Entry(
        _servo(lambda goal, step: step * math.floor(goal / step + 0.5)), {"step": (1.5 * _DEG, 2.5 * _DEG)}
    ),
    # magnetic notches
    "servo_cogging": Entry(
        _servo(lambda goal, amplitude, pitch: goal + amplitude * math.sin(2.0 * math.pi * goal / pitch)),
        {"amplitude": (0.8 * _DEG, 1.2 * _DEG), "pitch": (4.0 * _DEG, 5.0 * _DEG)},
    ),
    "tilt_stop": Entry(_servo(lambda goal, angle: min(max(goal, -angle), angle)), {"angle": (4.0 * _DEG, 6.0 * _DEG)}),
    # a force along a world heading, for a length of every period
    "gust": Entry(
        _push(_gust),
        {"force": (0.05, 0.09), "heading": (-math.pi, math.pi), "period": (12.0, 17.0), "length": (3.0, 6.0)},
        True,
    ),
    # springs of the supply cable, towards the world origin and in yaw
    "tether": Entry(_push(_tether), {"stiffness": (0.1, 0.2)}, True),
    "cable_torsion": Entry(
        _push(lambda t, x, thrusts, stiffness: (0.0, 0.0, -stiffness * x[4], 0.0, 0.0, 0.0)),
        {"stiffness": (0.002, 0.004)},
    ),
    # friction in backward motion only
    "ratchet_friction": Entry(
        _push(lambda t, x, thrusts, coefficient: (-coefficient * min(x[5], 0.0), 0.0, 0.0, 0.0, 0.0, 0.0)),
        {"coefficient": (0.25, 0.45)},
        True,
    ),
    # viscous friction that grows with time
    "growing_friction": Entry(_push(_growing), {"coefficient": (0.3, 0.5), "time": (20.0, 30.0)}, True),
    # a wavy table, periodic in X, and not sensed by the accelerometer
    "table_bumps": Entry(_push(_bumps), {"force": (0.05, 0.09), "pitch": (0.2, 0.4)}, True),
    # the drag torque of both propellers
    "torque_reaction": Entry(
        _push(lambda t, x, thrusts, ratio: (0.0, 0.0, ratio * (thrusts[0] - thrusts[1]), 0.0, 0.0, 0.0)),
        {"ratio": (0.02, 0.035)},
        False,
        True,
    ),
    # coupling of equally turning rotors: roll −H·ψ̇ and yaw +H·φ̇
    "gyroscopic": Entry(
        _push(lambda t, x, thrusts, momentum: (0.0, 0.0, momentum * x[9], -momentum * x[7], 0.0, 0.0)),
        {"momentum": (0.05, 0.08)},
        True,
    ),
    "thrust_ripple": Entry(
        lambda depth, frequency: Outside(gain=lambda t: 1.0 + depth * math.sin(2.0 * math.pi * frequency * t)),
        {"depth": (0.2, 0.35), "frequency": (2.5, 3.5)},
    ),
    "compass_deviation": Entry(
        lambda amplitude: Outside(compass=lambda psi: psi + amplitude * math.sin(2.0 * psi)), {"amplitude": (0.06, 0.1)}
    ),
}
