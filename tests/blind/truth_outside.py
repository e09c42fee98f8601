"""Effects outside the catalogue: a refiner must call them unexplained, not by another effect's name.

`OUTSIDE` has the ranges of their parameters. They raise the 2 s replay error of the base model on a measured channel to
3-33 times its floor. Their laws are sorted by the place where they act.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

_DEG = math.pi / 180.0

Push = tuple[float, float, float, float, float, float]  # felt forward, starboard [N], yaw, roll [N m]; unfelt f, s [N]


def _body(psi: float, east: float, north: float) -> tuple[float, float]:
    """Return the body components of a vector along world X, Y."""
    return east * math.cos(psi) + north * math.sin(psi), east * math.sin(psi) - north * math.cos(psi)


def _gust(t: float, x: list[float], _: Any, force: float, heading: float, period: float, length: float) -> Push:
    """Push along a world heading, for a length of every period."""
    on = force if t % period > period - length else 0.0
    return *_body(x[4], on * math.cos(heading), on * math.sin(heading)), 0.0, 0.0, 0.0, 0.0


def _tether(t: float, x: list[float], _: Any, stiffness: float) -> Push:
    """Pull the craft to the world origin, as the supply cable does."""
    return *_body(x[4], -stiffness * x[2], -stiffness * x[3]), 0.0, 0.0, 0.0, 0.0


def _growing(t: float, x: list[float], _: Any, coefficient: float, time: float) -> Push:
    """Brake more and more."""
    k = coefficient * t / time
    return -k * x[5], -k * x[6], 0.0, 0.0, 0.0, 0.0


def _bumps(t: float, x: list[float], _: Any, force: float, pitch: float) -> Push:
    """Push as a wavy table does, periodic in X, and not sensed by the accelerometer."""
    return 0.0, 0.0, 0.0, 0.0, *_body(x[4], force * math.sin(2.0 * math.pi * x[2] / pitch), 0.0)


def _held(goal: float, memory: dict[str, float], width: float) -> float:
    """Move only if the command differs from the position by more than a width."""
    if abs(goal - memory.get("held", 0.0)) > width:
        memory["held"] = goal
    return memory.get("held", 0.0)


Laws = dict[str, Callable[..., Any]]  # name → function of values at its place and of the parameters
FORCES: Laws = {  # (t, state, thrusts) → Push
    "gust": _gust,
    "tether": _tether,
    "cable_torsion": lambda t, x, thrusts, stiffness: (0.0, 0.0, -stiffness * x[4], 0.0, 0.0, 0.0),
    "ratchet_friction": lambda t, x, thrusts, coefficient: (-coefficient * min(x[5], 0.0), 0.0, 0.0, 0.0, 0.0, 0.0),
    "growing_friction": _growing,
    "table_bumps": _bumps,
    # the drag torque of both propellers
    "torque_reaction": lambda t, x, thrusts, ratio: (0.0, 0.0, ratio * (thrusts[0] - thrusts[1]), 0.0, 0.0, 0.0),
    # coupling of equally turning rotors: roll −H·ψ̇ and yaw +H·φ̇
    "gyroscopic": lambda t, x, thrusts, momentum: (0.0, 0.0, momentum * x[9], -momentum * x[7], 0.0, 0.0),
}
SERVOS: Laws = {  # (goal, memory of a servo) → tilt
    "hold_band": _held,
    "quantised_tilt": lambda goal, memory, step: step * math.floor(goal / step + 0.5),
    # magnetic notches
    "servo_cogging": lambda goal, memory, amplitude, pitch: goal + amplitude * math.sin(2.0 * math.pi * goal / pitch),
    "tilt_stop": lambda goal, memory, angle: min(max(goal, -angle), angle),
}
GAINS: Laws = {  # (t) → factor on both thrusts
    "thrust_ripple": lambda t, depth, frequency: 1.0 + depth * math.sin(2.0 * math.pi * frequency * t),
    "thrust_factor": lambda t, value: value,  # in no study
}
COMPASSES: Laws = {"compass_deviation": lambda psi, amplitude: psi + amplitude * math.sin(2.0 * psi)}  # (ψ) → reading

OUTSIDE: dict[str, dict[str, tuple[float, float]]] = {
    "hold_band": {"width": (1.5 * _DEG, 2.5 * _DEG)},
    "quantised_tilt": {"step": (1.5 * _DEG, 2.5 * _DEG)},
    "servo_cogging": {"amplitude": (0.8 * _DEG, 1.2 * _DEG), "pitch": (4.0 * _DEG, 5.0 * _DEG)},
    "tilt_stop": {"angle": (4.0 * _DEG, 6.0 * _DEG)},
    "gust": {"force": (0.05, 0.09), "heading": (-math.pi, math.pi), "period": (12.0, 17.0), "length": (3.0, 6.0)},
    "tether": {"stiffness": (0.1, 0.2)},
    "cable_torsion": {"stiffness": (0.002, 0.004)},
    "ratchet_friction": {"coefficient": (0.25, 0.45)},
    "growing_friction": {"coefficient": (0.3, 0.5), "time": (20.0, 30.0)},
    "table_bumps": {"force": (0.05, 0.09), "pitch": (0.2, 0.4)},
    "torque_reaction": {"ratio": (0.02, 0.035)},
    "gyroscopic": {"momentum": (0.05, 0.08)},
    "thrust_ripple": {"depth": (0.2, 0.35), "frequency": (2.5, 3.5)},
    "compass_deviation": {"amplitude": (0.06, 0.1)},
}
