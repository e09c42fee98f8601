"""Effects that are in no catalogue: what a refiner must call unexplained, not by another's name.

Each is a function of its parameters that gives an `Outside`; `OUTSIDE` adds how its size is drawn and what it needs to
be seen. Sizes raise the 2 s replay error of the base model to at least twice its floor (`visibility.py`; tested).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from tests.blind.truth_craft import Outside, Push

Thrusts = tuple[float, float]


def _felt(psi: float, east: float, north: float) -> tuple[float, float]:
    """Body components of a vector along world X, Y."""
    return east * math.cos(psi) + north * math.sin(psi), east * math.sin(psi) - north * math.cos(psi)


def hold_band(width: float) -> Outside:
    """The servo stays where it is until the command has left it by more than `width`, then goes all the way."""

    def servo(t: float, goal: float, memory: dict[str, float]) -> float:
        if abs(goal - memory.get("held", 0.0)) > width:
            memory["held"] = goal
        return memory.get("held", 0.0)

    return Outside(servo=servo)


def quantised_tilt(step: float) -> Outside:
    """The servo knows only multiples of `step`."""
    return Outside(servo=lambda t, goal, memory: step * math.floor(goal / step + 0.5))


def servo_cogging(amplitude: float, pitch: float) -> Outside:
    """Magnets pull the servo to the nearest notch: α + A·sin(2πα/p)."""
    return Outside(servo=lambda t, goal, memory: goal + amplitude * math.sin(2.0 * math.pi * goal / pitch))


def tilt_stop(angle: float) -> Outside:
    """A mechanical stop nobody wrote down: tilt commands end at ±`angle`."""
    return Outside(servo=lambda t, goal, memory: min(max(goal, -angle), angle))


def gust(force: float, heading: float, period: float, length: float) -> Outside:
    """A draught across the table: a force along a world heading, on for `length` of every `period`."""

    def push(t: float, state: list[float], thrusts: Thrusts) -> Push:
        on = force if t % period > period - length else 0.0
        forward, starboard = _felt(state[4], on * math.cos(heading), on * math.sin(heading))
        return forward, starboard, 0.0, 0.0, 0.0, 0.0

    return Outside(force=push)


def tether(stiffness: float) -> Outside:
    """The supply cable pulls towards the world origin like a spring."""

    def push(t: float, state: list[float], thrusts: Thrusts) -> Push:
        forward, starboard = _felt(state[4], -stiffness * state[2], -stiffness * state[3])
        return forward, starboard, 0.0, 0.0, 0.0, 0.0

    return Outside(force=push)


def cable_torsion(stiffness: float) -> Outside:
    """The supply cable twists: yaw moment −k·ψ."""
    return Outside(force=lambda t, state, thrusts: (0.0, 0.0, -stiffness * state[4], 0.0, 0.0, 0.0))


def ratchet_friction(coefficient: float) -> Outside:
    """A brush that drags only when the craft backs: −k·vx for vx < 0."""
    return Outside(force=lambda t, state, thrusts: (-coefficient * min(state[5], 0.0), 0.0, 0.0, 0.0, 0.0, 0.0))


def growing_friction(coefficient: float, time: float) -> Outside:
    """Dust under the craft: viscous friction grows with time, −k·(t/θ)·(vx, vy)."""

    def push(t: float, state: list[float], thrusts: Thrusts) -> Push:
        k = coefficient * t / time
        return -k * state[5], -k * state[6], 0.0, 0.0, 0.0, 0.0

    return Outside(force=push)


def table_bumps(force: float, pitch: float) -> Outside:
    """A wavy table: m·g·slope along world X, periodic in X; gravity, so no accelerometer feels it."""

    def push(t: float, state: list[float], thrusts: Thrusts) -> Push:
        slope = force * math.sin(2.0 * math.pi * state[2] / pitch)
        return 0.0, 0.0, 0.0, 0.0, *_felt(state[4], slope, 0.0)

    return Outside(force=push)


def torque_reaction(ratio: float) -> Outside:
    """Both propellers' drag torque turns the craft: yaw moment κ·(T_R − T_L)."""
    return Outside(force=lambda t, state, thrusts: (0.0, 0.0, ratio * (thrusts[0] - thrusts[1]), 0.0, 0.0, 0.0))


def gyroscopic(momentum: float) -> Outside:
    """Rotors that turn the same way: yaw and roll rates couple, roll −H·ψ̇ and yaw +H·φ̇."""

    def push(t: float, state: list[float], thrusts: Thrusts) -> Push:
        return 0.0, 0.0, momentum * state[9], -momentum * state[7], 0.0, 0.0

    return Outside(force=push)


def thrust_ripple(depth: float, frequency: float) -> Outside:
    """A hunting speed controller: both thrusts × (1 + d·sin 2πft)."""
    return Outside(gain=lambda t: 1.0 + depth * math.sin(2.0 * math.pi * frequency * t))


def compass_deviation(amplitude: float) -> Outside:
    """Iron near the heading sensor: it reads ψ + A·sin 2ψ."""
    return Outside(compass=lambda psi: psi + amplitude * math.sin(2.0 * psi))


@dataclass(frozen=True)
class Entry:
    """How an outside effect is made, the ranges its parameters are drawn from, and what shows it."""

    make: Callable[..., Outside]
    ranges: dict[str, tuple[float, float]]
    needs_position: bool = False
    needs_duty: bool = False


_DEG = math.pi / 180.0
OUTSIDE: dict[str, Entry] = {
    "hold_band": Entry(hold_band, {"width": (1.5 * _DEG, 2.5 * _DEG)}),
    "quantised_tilt": Entry(quantised_tilt, {"step": (1.5 * _DEG, 2.5 * _DEG)}),
    "servo_cogging": Entry(servo_cogging, {"amplitude": (0.8 * _DEG, 1.2 * _DEG), "pitch": (4.0 * _DEG, 5.0 * _DEG)}),
    "tilt_stop": Entry(tilt_stop, {"angle": (4.0 * _DEG, 6.0 * _DEG)}),
    "gust": Entry(
        gust,
        {"force": (0.05, 0.09), "heading": (-math.pi, math.pi), "period": (12.0, 17.0), "length": (3.0, 6.0)},
        True,
    ),
    "tether": Entry(tether, {"stiffness": (0.1, 0.2)}, True),
    "cable_torsion": Entry(cable_torsion, {"stiffness": (0.002, 0.004)}),
    "ratchet_friction": Entry(ratchet_friction, {"coefficient": (0.25, 0.45)}, True),
    "growing_friction": Entry(growing_friction, {"coefficient": (0.3, 0.5), "time": (20.0, 30.0)}, True),
    "table_bumps": Entry(table_bumps, {"force": (0.05, 0.09), "pitch": (0.2, 0.4)}, True),
    "torque_reaction": Entry(torque_reaction, {"ratio": (0.02, 0.035)}, False, True),
    "gyroscopic": Entry(gyroscopic, {"momentum": (0.05, 0.08)}, True),
    "thrust_ripple": Entry(thrust_ripple, {"depth": (0.2, 0.35), "frequency": (2.5, 3.5)}),
    "compass_deviation": Entry(compass_deviation, {"amplitude": (0.06, 0.1)}),
}


def outside(name: str, parameters: dict[str, float]) -> Outside:
    """The effect `name` at given parameter values."""
    return OUTSIDE[name].make(**parameters)
