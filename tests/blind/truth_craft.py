"""Independent equations of the craft: vectors in world axes, integrated by scipy's DOP853.

Written from the model sheet (docs: axes, equations, catalogue) without the project's own equations, to detect errors in
either. Nothing is imported from the project.

Two frames: body axes f (forward) and s (starboard, to the right); world axes X, Y with heading ψ counted to the left.
A body vector (f, s) is (f·cos ψ + s·sin ψ, f·sin ψ − s·cos ψ) in the world, and the same map leads back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.integrate import ode

STEP = 0.02  # sample time [s]
DUTY = 6.38763  # nominal duty [%]
TILT_MAX = math.radians(12.0)

# base model, SI; `slope`, `offset` in gf/% and gf
SHEET: dict[str, float] = {
    "mass": 0.705,
    "izz": 0.01023,
    "ixx": 0.009377,
    "arm": 0.17145,
    "propeller_radius": 0.127,
    "height": 0.095,
    "thrust_offset": -2076.0,
    "thrust_slope": 359.9,
    "ground_effect_exponent": 1.902,
    "lag": 0.0884,
    "friction": 0.25,
    "gravity": 9.81,
    "table_roll_stiffness": 5.0,
    "table_roll_damping": 0.45,
}
BODY = ("x", "y", "x_world", "y_world", "psi", "vx", "vy", "psi_dot", "phi", "phi_dot")
POWER = ("thrust_right", "thrust_left", "tilt_right", "tilt_left", "tilt_rate_right", "tilt_rate_left")
STATES = (*BODY, *POWER)
OUTPUTS = (*BODY, "ax", "thrust_right", "thrust_left", "tilt_right_actual", "tilt_left_actual")

Command = tuple[float, float, float, float]  # duty right, left [%]; tilt right, left [rad]
Push = tuple[float, float, float, float, float, float]  # felt forward, starboard [N], yaw, roll [N m]; unfelt f, s [N]


@dataclass(frozen=True)
class Outside:
    """An effect outside the catalogue, by its place in the equations; each hook is optional.

    force(t, state, thrusts) → Push;  servo(t, tilt, memory) → tilt of one propeller, with a memory dict of its own;
    gain(t) → factor on both thrusts;  compass(ψ) → reading of the heading sensor.
    """

    force: Callable[[float, list[float], tuple[float, float]], Push] | None = None
    servo: Callable[[float, float, dict[str, float]], float] | None = None
    gain: Callable[[float], float] | None = None
    compass: Callable[[float], float] | None = None


@dataclass(frozen=True)
class Craft:
    """Base parameters different from the model sheet, effects by catalogue name, and at most one effect outside it."""

    base: Mapping[str, float] = field(default_factory=dict)
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    outside: Outside = Outside()

    def number(self, name: str) -> float:
        return self.base.get(name, SHEET[name])

    def value(self, effect: str, parameter: str, neutral: float = 0.0) -> float:
        return self.effects.get(effect, {}).get(parameter, neutral)

    def static_thrust(self, duty: float) -> float:
        """Return the thrust out of ground effect, eq 4.20 [N]."""
        grams = self.number("thrust_offset") + self.number("thrust_slope") * duty
        return max(0.0, grams) * self.number("gravity") / 1000.0

    def rest(self, **start: float) -> np.ndarray:
        """Return the state of a hovering craft, with some states replaced by name."""
        hover = self.static_thrust(DUTY)
        values = {"thrust_right": hover, "thrust_left": hover} | start
        return np.array([values.pop(name, 0.0) for name in STATES])


Disturbance = tuple[float, float, float]  # forward, starboard [N], yaw [N m]; held over a sample


class Dynamics:
    """State derivative and outputs of a craft, with constants computed once."""

    def __init__(self, craft: Craft) -> None:
        self.craft = craft
        self.command: Command = (DUTY, DUTY, 0.0, 0.0)
        self.disturbance: Disturbance = (0.0, 0.0, 0.0)
        number, value = craft.number, craft.value
        self.m, self.izz, self.ixx, self.arm = number("mass"), number("izz"), number("ixx"), number("arm")
        self.z, self.radius, self.k = number("height"), number("propeller_radius"), number("ground_effect_exponent")
        self.tau, self.c, self.g = number("lag"), number("friction"), number("gravity")
        self.kt, self.dt = number("table_roll_stiffness"), number("table_roll_damping")
        self.asymmetry = value("thrust_asymmetry", "ratio")
        self.drop, self.sag_time = value("battery_sag", "drop"), value("battery_sag", "time", 15.0)
        self.inflow = value("inflow_thrust_loss", "coefficient")
        self.coulomb, self.drag = value("coulomb_friction", "force"), value("quadratic_drag", "coefficient")
        stribeck = [value("stribeck_friction", p, d) for p, d in (("force", 0), ("static_force", 0), ("speed", 0.05))]
        self.slide, self.stick, self.stick_speed = stribeck
        self.yaw_viscous = value("yaw_damping", "coefficient")
        self.yaw_dry = value("yaw_coulomb_friction", "moment")
        self.com = value("com_offset", "right")
        tilt_x, tilt_y = value("table_tilt", "x"), value("table_tilt", "y")
        self.downhill = (self.m * self.g * math.sin(tilt_x), self.m * self.g * math.sin(tilt_y))
        self.turning = value("coriolis", "gain")
        self.omega = value("actuator_second_order", "natural_frequency")
        self.zeta = value("actuator_second_order", "damping_ratio", 0.7)
        self.slew = value("servo_rate_limit", "rate") or math.inf

    def _gamma(self, height: float) -> float:
        """Return the ground effect, eqs 4.23 and 4.28 (with the minus sign)."""
        return 1.0 / (1.0 - (self.radius / 4.0 / max(height, self.radius / 2.0)) ** self.k)

    def thrusts(self, t: float, state: list[float]) -> tuple[float, float]:
        """Return right and left thrust in ground effect, each propeller at its own height [N]."""
        rise = self.arm * math.sin(state[8])
        both = 1.0 - self.drop * (1.0 - math.exp(-t / self.sag_time)) if self.drop else 1.0
        both *= 1.0 - self.inflow * state[5]
        if self.craft.outside.gain:
            both *= self.craft.outside.gain(t)
        right = state[10] * self._gamma(self.z + rise) * both * (1.0 + self.asymmetry)
        left = state[11] * self._gamma(self.z - rise) * both * (1.0 - self.asymmetry)
        return right, left

    def push(self, t: float, state: list[float]) -> Push:
        """Return contact forces and moments on the craft in body axes, and gravity separately for the accelerometer."""
        _, _, _, _, psi, vf, vs, r, phi, p = state[:10]
        right, left = self.thrusts(t, state)
        right_f, right_up = right * math.sin(state[12]), right * math.cos(state[12])
        left_f, left_up = left * math.sin(state[13]), left * math.cos(state[13])
        ahead, up = right_f + left_f, right_up + left_up
        speed = math.hypot(vf, vs)
        brake = self.c + self.drag * speed  # force per velocity
        dry = self.coulomb
        if self.slide or self.stick:
            dry += self.slide + (self.stick - self.slide) * math.exp(-((speed / self.stick_speed) ** 2))
        if dry:
            # tanh(s/0.01)/s tends to 1/0.01 at rest
            brake += dry * (math.tanh(speed / 0.01) / speed if speed > 1e-12 else 100.0)
        forward = ahead - brake * vf + self.disturbance[0]
        starboard = -up * math.sin(phi) - brake * vs + self.disturbance[1]
        yaw = self.arm * (right_f - left_f) - self.com * ahead - self.yaw_viscous * r + self.disturbance[2]
        if self.yaw_dry:
            yaw -= self.yaw_dry * math.tanh(r / 0.02)
        roll = self.arm * (right_up - left_up) - self.com * up - self.kt * phi - self.dt * p
        cos, sin = math.cos(psi), math.sin(psi)
        fall_f = self.downhill[0] * cos + self.downhill[1] * sin
        fall_s = self.downhill[0] * sin - self.downhill[1] * cos
        if self.craft.outside.force:
            more = self.craft.outside.force(t, state, (right, left))
            forward, starboard, yaw, roll = forward + more[0], starboard + more[1], yaw + more[2], roll + more[3]
            fall_f, fall_s = fall_f + more[4], fall_s + more[5]
        return forward, starboard, yaw, roll, fall_f, fall_s

    def derivative(self, t: float, vector: np.ndarray) -> list[float]:
        state = vector.tolist()
        _, _, _, _, psi, vf, vs, r, _, p, tr, tl, ar, al, wr, wl = state
        forward, starboard, yaw, roll, fall_f, fall_s = self.push(t, state)
        duty_r, duty_l, goal_r, goal_l = self.command
        if self.omega:
            speed_r, speed_l = wr, wl
            acc_r = self.omega * (self.omega * (goal_r - ar) - 2.0 * self.zeta * wr)
            acc_l = self.omega * (self.omega * (goal_l - al) - 2.0 * self.zeta * wl)
        else:
            speed_r, speed_l, acc_r, acc_l = (goal_r - ar) / self.tau, (goal_l - al) / self.tau, 0.0, 0.0
        cos, sin = math.cos(psi), math.sin(psi)
        return [
            vf,
            vs,
            vf * cos + vs * sin,
            vf * sin - vs * cos,
            r,
            (forward + fall_f) / self.m - self.turning * r * vs,
            (starboard + fall_s) / self.m + self.turning * r * vf,
            yaw / self.izz,
            p,
            roll / self.ixx,
            (self.craft.static_thrust(duty_r) - tr) / self.tau,
            (self.craft.static_thrust(duty_l) - tl) / self.tau,
            min(max(speed_r, -self.slew), self.slew),
            min(max(speed_l, -self.slew), self.slew),
            acc_r,
            acc_l,
        ]

    def outputs(self, t: float, vector: np.ndarray) -> dict[str, float]:
        """Return every quantity of `OUTPUTS` without sensor errors; acceleration is contact force / mass."""
        state = vector.tolist()
        values = (*state[:10], self.push(t, state)[0] / self.m, *self.thrusts(t, state), *state[12:14])
        return dict(zip(OUTPUTS, values, strict=True))


class Servos:
    """Servos without their lag: delay, play, offset, dead band, in this order; then effects outside the catalogue."""

    def __init__(self, craft: Craft) -> None:
        self.craft = craft
        self.delay = craft.value("actuator_delay", "time")
        self.sent: list[tuple[float, Command]] = [(-math.inf, (DUTY, DUTY, 0.0, 0.0))]
        self.play = [0.0, 0.0]
        self.memory: tuple[dict[str, float], dict[str, float]] = ({}, {})

    def pieces(self, t: float, end: float, command: Command) -> list[tuple[float, float, Command]]:
        """Return (from, until, acting command) within the sample from `t` to `end`; `command` is sent at `t`."""
        self.sent.append((t + self.delay, command))
        cuts = [t, *(s for s, _ in self.sent if t + 1e-9 < s < end - 1e-9), end]
        while len(self.sent) > 1 and self.sent[1][0] <= t + 1e-9:
            del self.sent[0]
        arrived = [(a, b, next(u for s, u in reversed(self.sent) if s <= a + 1e-9)) for a, b in pairwise(cuts)]
        return [(a, b, self._shaped(a, u)) for a, b, u in arrived]

    def _shaped(self, t: float, command: Command) -> Command:
        value = self.craft.value
        half, band = value("servo_backlash", "width") / 2.0, value("servo_dead_band", "width")
        tilts = []
        for i, side in enumerate(("right", "left")):
            goal = command[2 + i]
            self.play[i] = min(max(self.play[i], goal - half), goal + half)
            goal = self.play[i] + value("tilt_offset", side)
            goal = math.copysign(max(abs(goal) - band, 0.0), goal)
            if self.craft.outside.servo:
                goal = self.craft.outside.servo(t, goal, self.memory[i])
            tilts.append(goal)
        return command[0], command[1], tilts[0], tilts[1]


class Flight:
    """A moving craft, advanced by samples; the integrator restarts at each change of the acting command."""

    def __init__(self, craft: Craft, state: np.ndarray, t: float = 0.0, tolerance: float = 1e-9) -> None:
        self.dynamics, self.servos = Dynamics(craft), Servos(craft)
        self.state, self.start, self.count = state, t, 0
        self._solver = ode(self.dynamics.derivative).set_integrator(
            "dop853", rtol=tolerance, atol=1e-2 * tolerance, first_step=STEP / 2, nsteps=10_000
        )

    def advance(self, command: Command, disturbance: Disturbance = (0.0, 0.0, 0.0)) -> None:
        """Advance by a sample with `command` sent at its start."""
        self.dynamics.disturbance = disturbance
        for begin, end, acting in self.servos.pieces(self.t, self.t_next, command):
            self.dynamics.command = acting
            self._solver.set_initial_value(self.state, begin)
            self.state = self._solver.integrate(end)
            if not self._solver.successful():
                raise ArithmeticError(f"integration failed at {begin:.3f} s")
        self.count += 1

    @property
    def t(self) -> float:
        return self.start + self.count * STEP

    @property
    def t_next(self) -> float:
        return self.start + (self.count + 1) * STEP

    def outputs(self) -> dict[str, float]:
        return self.dynamics.outputs(self.t, self.state)
