"""Independent equations of the craft: vectors in world axes, integrated by scipy's DOP853.

Written from the model sheet (docs: axes, equations, catalogue) without the project's own equations, to detect errors in
either. Nothing is imported from the project.

Two frames: body axes f (forward) and s (starboard, to the right); world axes X, Y with heading ψ counted to the left.
A body vector (f, s) is (f·cos ψ + s·sin ψ, f·sin ψ − s·cos ψ) in the world, and the same map leads back.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from tests.blind.field_rig import Array, Flat, Floats, Look, Random, Rate, advanced, flat, laws_in, solver

STEP = 0.02  # sample time [s]
DUTY = 6.38763  # nominal duty [%]
DEGREE = math.pi / 180.0
TILT_MAX = math.radians(12.0)

# base model, SI; `slope`, `offset` in gf/% and gf
SHEET: dict[str, float] = {
    "mass": 0.705, "izz": 0.01023, "ixx": 0.009377, "arm": 0.17145, "propeller_radius": 0.127, "height": 0.095,
    "thrust_offset": -2076.0, "thrust_slope": 359.9, "ground_effect_exponent": 1.902, "lag": 0.0884, "friction": 0.25,
    "gravity": 9.81, "table_roll_stiffness": 5.0, "table_roll_damping": 0.45,
}  # fmt: skip
BODY = ("x", "y", "x_world", "y_world", "psi", "vx", "vy", "psi_dot", "phi", "phi_dot")
POWER = ("thrust_right", "thrust_left", "tilt_right", "tilt_left", "tilt_rate_right", "tilt_rate_left")
STATES = (*BODY, *POWER)
OUTPUTS = (*BODY, "ax", "thrust_right", "thrust_left", "tilt_right_actual", "tilt_left_actual")

Command = tuple[float, float, float, float]  # duty right, left [%]; tilt right, left [rad]
Disturbance = tuple[float, float, float]  # forward, starboard [N], yaw [N m]; held over a sample

REST: Command = (DUTY, DUTY, 0.0, 0.0)
CALM: Disturbance = (0.0, 0.0, 0.0)
# eq 5.46, and a camera of 1 mm
VARIANCE = {"psi": 2.613e-5, "psi_dot": 4.564e-4, "ax": 0.04479, "x_world": 1e-6, "y_world": 1e-6}


@dataclass(frozen=True)
class Craft:
    """Base parameters different from the model sheet, and effects by name, of the catalogue or outside of it."""

    base: Mapping[str, float] = field(default_factory=dict)
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def numbers(self) -> dict[str, float]:
        """Return all parameters by full name."""
        return {**SHEET, **self.base, **flat(self.effects)}

    def rest(self, **start: float) -> Array:
        """Return the state of a hovering craft, with some states replaced by name."""
        hover = static_thrust(Floats, self.numbers(), DUTY)
        values = {"thrust_right": hover, "thrust_left": hover} | start
        return np.array([values.pop(name, 0.0) for name in STATES])


def static_thrust(f: Any, p: Flat, duty: Any) -> Any:
    """Return the thrust out of ground effect, eq 4.20 [N]."""
    return f.maximum(p["thrust_offset"] + p["thrust_slope"] * duty, 0.0) * p["gravity"] / 1000.0


def gripped(force: float, slip: float) -> float:
    """Return the dry friction per speed: force·tanh(s/0.01)/s."""
    return force * (math.tanh(slip / 0.01) / slip if slip > 1e-12 else 100.0)


def equations(
    f: Any, p: Flat, speed: Callable[..., Any] = math.hypot, grip: Callable[..., Any] = gripped
) -> tuple[Rate, Look]:
    """Return the derivatives of `STATES`, and all of `OUTPUTS` without sensor errors, in body axes, eqs 5.9 to 5.14.

    Args:
        f: math functions, `Floats` or `Arrays`.
        p: parameters; effects missing in it are absent, those outside the catalogue are for floats.
        speed: from both velocities.
        grip: (force, speed) → dry friction per speed.
    """
    arm, mass, lag, radius, get = p["arm"], p["mass"], p["lag"], p["propeller_radius"], p.get
    drop, sag_time = get("battery_sag.drop", 0.0), get("battery_sag.time", 15.0)
    inflow, uneven = get("inflow_thrust_loss.coefficient", 0.0), get("thrust_asymmetry.ratio", 0.0)
    coulomb, drag = get("coulomb_friction.force", 0.0), get("quadratic_drag.coefficient", 0.0)
    slide, stick = get("stribeck_friction.force", 0.0), get("stribeck_friction.static_force", 0.0)
    stick_speed = get("stribeck_friction.speed", 0.05)
    com, yaw_viscous = get("com_offset.right", 0.0), get("yaw_damping.coefficient", 0.0)
    yaw_dry, turning = get("yaw_coulomb_friction.moment", 0.0), get("coriolis.gain", 0.0)
    down_x, down_y = (mass * p["gravity"] * f.sin(get(f"table_tilt.{axis}", 0.0)) for axis in ("x", "y"))
    slew, omega = get("servo_rate_limit.rate", math.inf), get("actuator_second_order.natural_frequency", 0.0)
    zeta, forces, gains = get("actuator_second_order.damping_ratio", 0.7), laws_in(p, FORCES), laws_in(p, GAINS)

    def lift(height: Any) -> Any:
        """Return the ground effect, eqs 4.23 and 4.28 (with the minus sign)."""
        return 1.0 / (1.0 - (radius / 4.0 / f.maximum(height, radius / 2.0)) ** p["ground_effect_exponent"])

    def thrusts(t: Any, x: Any) -> tuple[Any, Any]:
        """Return right and left thrust in ground effect, each propeller at its own height [N]."""
        rise = arm * f.sin(x[8])
        both = (1.0 - drop * (1.0 - f.exp(-t / sag_time))) * (1.0 - inflow * x[5])
        for gain in gains:
            both = both * gain(t)
        right = x[10] * lift(p["height"] + rise) * both * (1.0 + uneven)
        return right, x[11] * lift(p["height"] - rise) * both * (1.0 - uneven)

    def push(t: Any, x: Any, disturbance: Any) -> tuple[Any, ...]:
        """Return contact forces and moments on the craft in body axes, and gravity separately for the accelerometer."""
        _, _, _, _, psi, vf, vs, r, phi, p_phi = x[:10]
        right, left = thrusts(t, x)
        right_f, right_up = right * f.sin(x[12]), right * f.cos(x[12])
        left_f, left_up = left * f.sin(x[13]), left * f.cos(x[13])
        ahead, up = right_f + left_f, right_up + left_up

        slip = speed(vf, vs)

        dry = coulomb + slide + (stick - slide) * f.exp(-((slip / stick_speed) ** 2))
        brake = p["friction"] + drag * slip + grip(dry, slip)
        forward = ahead - brake * vf + disturbance[0]
        starboard = -up * f.sin(phi) - brake * vs + disturbance[1]
        yaw = arm * (right_f - left_f) - com * ahead - yaw_viscous * r - yaw_dry * f.tanh(r / 0.02) + disturbance[2]
        roll = arm * (right_up - left_up) - com * up
        roll = roll - p["table_roll_stiffness"] * phi - p["table_roll_damping"] * p_phi
        cos, sin = f.cos(psi), f.sin(psi)
        total: tuple[Any, ...] = (
            forward, starboard, yaw, roll, down_x * cos + down_y * sin, down_x * sin - down_y * cos,
        )  # fmt: skip
        for force in forces:
            total = tuple(a + b for a, b in zip(total, force(t, x, (right, left)), strict=True))
        return total

    def rate(t: Any, x: Any, u: Any, disturbance: Any) -> list[Any]:
        _, _, _, _, psi, vf, vs, r, _, p_phi, tr, tl, *servos = x
        forward, starboard, yaw, roll, fall_f, fall_s = push(t, x, disturbance)
        speeds, accelerations = servos[2:], [0.0, 0.0]
        if omega:
            both = zip(u[2:], servos[:2], speeds, strict=True)
            accelerations = [omega * (omega * (goal - a) - 2.0 * zeta * w) for goal, a, w in both]
        else:
            speeds = [(goal - a) / lag for goal, a in zip(u[2:], servos[:2], strict=True)]
        cos, sin = f.cos(psi), f.sin(psi)
        return [
            vf,
            vs,
            vf * cos + vs * sin,
            vf * sin - vs * cos,
            r,
            (forward + fall_f) / mass - turning * r * vs,
            (starboard + fall_s) / mass + turning * r * vf,
            yaw / p["izz"],
            p_phi,
            roll / p["ixx"],
            (static_thrust(f, p, u[0]) - tr) / lag,
            (static_thrust(f, p, u[1]) - tl) / lag,
            *(f.minimum(f.maximum(v, -slew), slew) for v in speeds),
            *accelerations,
        ]

    def look(t: Any, x: Any, disturbance: Any) -> list[Any]:
        """Return the outputs; acceleration is contact force / mass."""
        return [*x[:10], push(t, x, disturbance)[0] / mass, *thrusts(t, x), *x[12:14]]

    return rate, look


class Servos:
    """Servos without their lag: delay, play, offset, dead band, in this order; then effects outside the catalogue."""

    def __init__(self, p: Flat) -> None:
        self.p, self.laws = p, laws_in(p, SERVOS)
        self.sent: list[tuple[float, Command]] = [(-math.inf, REST)]
        self.play = [0.0, 0.0]
        self.memory: tuple[dict[str, float], dict[str, float]] = ({}, {})

    def pieces(self, t: float, end: float, command: Command) -> list[tuple[float, float, Command]]:
        """Return (from, until, acting command) within the sample from `t` to `end`; `command` is sent at `t`."""
        self.sent.append((t + self.p.get("actuator_delay.time", 0.0), command))
        cuts = [t, *(s for s, _ in self.sent if t + 1e-9 < s < end - 1e-9), end]
        while len(self.sent) > 1 and self.sent[1][0] <= t + 1e-9:
            del self.sent[0]
        arrived = [(a, b, next(u for s, u in reversed(self.sent) if s <= a + 1e-9)) for a, b in pairwise(cuts)]
        return [(a, b, self._shaped(u)) for a, b, u in arrived]

    def _shaped(self, command: Command) -> Command:
        half, band = self.p.get("servo_backlash.width", 0.0) / 2.0, self.p.get("servo_dead_band.width", 0.0)
        tilts = []
        for i, side in enumerate(("right", "left")):
            goal = command[2 + i]
            self.play[i] = min(max(self.play[i], goal - half), goal + half)
            goal = self.play[i] + self.p.get(f"tilt_offset.{side}", 0.0)
            goal = math.copysign(max(abs(goal) - band, 0.0), goal)
            for law in self.laws:
                goal = law(goal, self.memory[i])
            tilts.append(goal)
        return command[0], command[1], tilts[0], tilts[1]


class Flight:
    """A moving craft, advanced by samples; the integrator restarts at each change of the acting command."""

    def __init__(self, craft: Craft, state: Array, t: float = 0.0, tolerance: float = 1e-9) -> None:
        p = craft.numbers()
        rate, self._look = equations(Floats, p)
        self.servos, self.compasses, self.state, self.t = Servos(p), laws_in(p, COMPASSES), state, t
        self._acting: list[Any] = [REST, CALM]
        self._start, self._count = t, 0
        self._solver = solver(lambda t, x: rate(t, x.tolist(), *self._acting), tolerance, STEP)

    def advance(self, command: Command, disturbance: Disturbance = CALM, end: float | None = None) -> None:
        """Advance to `end`, by default by a sample, with `command` sent at the start."""
        self._count += 1
        end = self._start + self._count * STEP if end is None else end
        for begin, until, acting in self.servos.pieces(self.t, end, command):
            self._acting[:] = acting, disturbance
            self.state = advanced(self._solver, self.state, begin, until)
        self.t = end

    def outputs(self, disturbance: Disturbance = CALM) -> dict[str, float]:
        """Return every quantity of `OUTPUTS` without sensor errors; a compass may deviate."""
        now = dict(zip(OUTPUTS, self._look(self.t, self.state.tolist(), disturbance), strict=True))
        for compass in self.compasses:
            now["psi"] = compass(now["psi"])
        return now


# -- effects outside the catalogue -----------------------------------------------------------------------

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
    "hold_band": {"width": (1.5 * DEGREE, 2.5 * DEGREE)},
    "quantised_tilt": {"step": (1.5 * DEGREE, 2.5 * DEGREE)},
    "servo_cogging": {"amplitude": (0.8 * DEGREE, 1.2 * DEGREE), "pitch": (4.0 * DEGREE, 5.0 * DEGREE)},
    "tilt_stop": {"angle": (4.0 * DEGREE, 6.0 * DEGREE)},
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


def stranger(name: str, rng: Random) -> dict[str, float]:
    """Return random parameters of an effect outside the catalogue."""
    return {parameter: float(rng.uniform(*between)) for parameter, between in OUTSIDE[name].items()}
