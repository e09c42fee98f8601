"""Effects outside the catalogue: a refiner must call them unexplained, not by another effect's name.

Each function returns an `Outside` for its parameters; `OUTSIDE` adds ranges of the parameters and conditions of
visibility. The effects raise the 2 s replay error of the base model to at least twice its floor (`visibility.py`;
tested).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from tests.blind.truth_craft import Outside, Push

Thrusts = tuple[float, float]


def _felt(psi: float, east: float, north: float) -> tuple[float, float]:
    """Return the body components of a vector along world X, Y."""
    return east * math.cos(psi) + north * math.sin(psi), east * math.sin(psi) - north * math.cos(psi)


def hold_band(width: float) -> Outside:
    """Return a servo that moves only if its command differs from its position by more than `width`."""

    def servo(t: float, goal: float, memory: dict[str, float]) -> float:
        if abs(goal - memory.get("held", 0.0)) > width:
            memory["held"] = goal
        return memory.get("held", 0.0)

    return Outside(servo=servo)


def quantised_tilt(step: float) -> Outside:
    """Return a servo that moves in multiples of `step`."""
    return Outside(servo=lambda t, goal, memory: step * math.floor(goal / step + 0.5))


def servo_cogging(amplitude: float, pitch: float) -> Outside:
    """Return a servo with magnetic notches: α + A·sin(2πα/p)."""
    return Outside(servo=lambda t, goal, memory: goal + amplitude * math.sin(2.0 * math.pi * goal / pitch))


def tilt_stop(angle: float) -> Outside:
    """Return a mechanical stop of the tilts at ±`angle`."""
    return Outside(servo=lambda t, goal, memory: min(max(goal, -angle), angle))


def gust(force: float, heading: float, period: float, length: float) -> Outside:
    """Return periodic gusts: a force along a world heading, for `length` of every `period`."""

    def push(t: float, state: list[float], thrusts: Thrusts) -> Push:
        on = force if t % period > period - length else 0.0
        forward, starboard = _felt(state[4], on * math.cos(heading), on * math.sin(heading))
        return forward, starboard, 0.0, 0.0, 0.0, 0.0

    return Outside(force=push)


def tether(stiffness: float) -> Outside:
    """Return a spring force of the supply cable towards the world origin."""

    def push(t: float, state: list[float], thrusts: Thrusts) -> Push:
        forward, starboard = _felt(state[4], -stiffness * state[2], -stiffness * state[3])
        return forward, starboard, 0.0, 0.0, 0.0, 0.0

    return Outside(force=push)


def cable_torsion(stiffness: float) -> Outside:
    """Return a torsion of the supply cable: yaw moment −k·ψ."""
    return Outside(force=lambda t, state, thrusts: (0.0, 0.0, -stiffness * state[4], 0.0, 0.0, 0.0))


def ratchet_friction(coefficient: float) -> Outside:
    """Return friction in backward motion only: −k·vx for vx < 0."""
    return Outside(force=lambda t, state, thrusts: (-coefficient * min(state[5], 0.0), 0.0, 0.0, 0.0, 0.0, 0.0))


def growing_friction(coefficient: float, time: float) -> Outside:
    """Return viscous friction that grows with time: −k·(t/θ)·(vx, vy)."""

    def push(t: float, state: list[float], thrusts: Thrusts) -> Push:
        k = coefficient * t / time
        return -k * state[5], -k * state[6], 0.0, 0.0, 0.0, 0.0

    return Outside(force=push)


def table_bumps(force: float, pitch: float) -> Outside:
    """Return a wavy table: m·g·slope along world X, periodic in X, and not sensed by the accelerometer."""

    def push(t: float, state: list[float], thrusts: Thrusts) -> Push:
        slope = force * math.sin(2.0 * math.pi * state[2] / pitch)
        return 0.0, 0.0, 0.0, 0.0, *_felt(state[4], slope, 0.0)

    return Outside(force=push)


def torque_reaction(ratio: float) -> Outside:
    """Return the drag torque of both propellers: yaw moment κ·(T_R − T_L)."""
    return Outside(force=lambda t, state, thrusts: (0.0, 0.0, ratio * (thrusts[0] - thrusts[1]), 0.0, 0.0, 0.0))


def gyroscopic(momentum: float) -> Outside:
    """Return gyroscopic coupling of equally turning rotors: roll −H·ψ̇ and yaw +H·φ̇."""

    def push(t: float, state: list[float], thrusts: Thrusts) -> Push:
        return 0.0, 0.0, momentum * state[9], -momentum * state[7], 0.0, 0.0

    return Outside(force=push)


def thrust_ripple(depth: float, frequency: float) -> Outside:
    """Return a periodic ripple of both thrusts: factor 1 + d·sin 2πft."""
    return Outside(gain=lambda t: 1.0 + depth * math.sin(2.0 * math.pi * frequency * t))


def compass_deviation(amplitude: float) -> Outside:
    """Return a deviation of the heading sensor: reading ψ + A·sin 2ψ."""
    return Outside(compass=lambda psi: psi + amplitude * math.sin(2.0 * psi))


@dataclass(frozen=True)
class Entry:
    """Function of an outside effect, ranges of its parameters, and conditions of visibility."""

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
    """Return the effect `name` for parameter values."""
    return OUTSIDE[name].make(**parameters)
