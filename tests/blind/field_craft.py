"""Craft of the field half: truth and pilot of the laboratory half, with other base parameters, pushes and row times.

For the cost, its equations are repeated on arrays, without effects that the field half does not hide.
"""

# ruff: noqa: RUF012 - what a rig declares are ClassVars of its base
from __future__ import annotations

import math
from typing import Any

import numpy as np

from tests.blind.field_rig import Course, Entry, Flat, Look, Rate, Rig, Run, Sensor
from tests.blind.truth_craft import DUTY, SHEET, STATES, Craft, Flight, Servos
from tests.blind.truth_outside import OUTSIDE, outside
from tests.blind.truth_pilot import Pilot, Style

_DEG = math.pi / 180.0
TOLERANCE = {"mass": 0.1, "izz": 0.2, "friction": 0.3, "lag": 0.15, "thrust_slope": 0.02}
BASE = {name: (SHEET[name], share) for name, share in TOLERANCE.items()}
CONSTANTS = {name: value for name, value in SHEET.items() if name not in BASE}


class CraftRig(Rig):
    """Craft driven by duties and tilts; outputs heading, yaw rate, acceleration and position."""

    name, model = "craft", "base"
    states = {
        "x_world": 1.0,
        "y_world": 1.0,
        "psi": 1.0,
        "vx": 0.4,
        "vy": 0.1,
        "psi_dot": 0.5,
        "phi": 0.02,
        "phi_dot": 0.2,
        "thrust_right": 0.5,
        "thrust_left": 0.5,
        "tilt_right": 0.1,
        "tilt_left": 0.1,
    }
    inputs = {"duty_right": DUTY, "duty_left": DUTY, "tilt_right": 0.0, "tilt_left": 0.0}
    outputs = {
        "psi": math.sqrt(2.613e-5),
        "psi_dot": math.sqrt(4.564e-4),
        "ax": math.sqrt(0.04479),
        "x_world": 1e-3,
        "y_world": 1e-3,
    }
    sheet = BASE
    constants = CONSTANTS
    entries = {
        "coulomb_friction": Entry(("force",), 0.01, (1e-3, 0.12)),
        "stribeck_friction": Entry(
            ("force",), 0.01, (1e-3, 0.06), shape={"speed": (0.1, 0.2)}, ratio={"static_force": (2.2, 3.0)}
        ),
        "quadratic_drag": Entry(("coefficient",), 0.1, (0.01, 2.0)),
        "yaw_damping": Entry(("coefficient",), 1e-3, (1e-4, 0.02)),
        "yaw_coulomb_friction": Entry(("moment",), 1e-3, (1e-4, 0.012)),
        "actuator_delay": Entry(("time",), 0.02, (2e-3, 0.15)),
        "servo_rate_limit": Entry(("rate",), 0.7, (0.4, 3.0), inverse=True),
        "servo_backlash": Entry(("width",), 0.5 * _DEG, (0.1 * _DEG, 4.0 * _DEG)),
        "servo_dead_band": Entry(("width",), 0.5 * _DEG, (0.05 * _DEG, 3.0 * _DEG)),
        "tilt_offset": Entry(("right", "left"), 0.3 * _DEG, (0.02 * _DEG, 3.0 * _DEG)),
        "thrust_asymmetry": Entry(("ratio",), 0.01, (1e-3, 0.08), signed=True),
        "battery_sag": Entry(("drop",), 0.1, (0.01, 0.5), shape={"time": (12.0, 18.0)}),
        "inflow_thrust_loss": Entry(("coefficient",), 0.1, (0.01, 0.6)),
        "com_offset": Entry(("right",), 1e-3, (1e-4, 0.015), signed=True),
        "table_tilt": Entry(("x", "y"), 0.05 * _DEG, (5e-3 * _DEG, 0.6 * _DEG)),
        "accelerometer_bias": Entry(("value",), 0.03, (2e-3, 0.5), signed=True),
        "accelerometer_scale": Entry(("value",), 0.05, (5e-3, 0.4), signed=True, neutral=1.0),
        "gyro_bias": Entry(("value",), 3e-3, (2e-4, 0.1), signed=True),
    }
    sensors = {
        "accelerometer_scale": Sensor("ax", "scale"),
        "accelerometer_bias": Sensor("ax", "bias"),
        "gyro_bias": Sensor("psi_dot", "bias"),
    }
    outside = {name: Entry(tuple(entry.ranges)[:1], 1.0, (1.0, 1.0), fixed=True) for name, entry in OUTSIDE.items()}
    families = (
        frozenset({"coulomb_friction", "stribeck_friction", "quadratic_drag"}),
        frozenset({"yaw_damping", "yaw_coulomb_friction"}),
        frozenset({"actuator_delay", "servo_rate_limit"}),
        frozenset({"servo_backlash", "servo_dead_band"}),
        frozenset({"thrust_asymmetry", "com_offset", "tilt_offset"}),
        frozenset({"battery_sag", "inflow_thrust_loss"}),
    )
    # ±12° of both tilts at the nominal thrust: a range of 2 N forward, 0.36 N m of yaw, of which a quarter is pushed
    pushes, correlation_time = (2.0, 2.0, 0.1), 1.0
    step, rows, horizon, preroll = 0.02, 2001, 2.0, 0.0
    shaping = (
        "actuator_delay.time",
        "servo_backlash.width",
        "servo_dead_band.width",
        "tilt_offset.right",
        "tilt_offset.left",
    )

    def acting(self, p: Flat, run: Run, parts: int) -> np.ndarray:
        """Return the mean command over each row after delay, play, offset and dead band of the servos."""
        effects: dict[str, dict[str, float]] = {}
        for key in self.shaping:
            name, _, parameter = key.partition(".")
            if key in p:
                effects.setdefault(name, {})[parameter] = float(p[key])
        servos = Servos(Craft(effects=effects))
        ends = np.append(run.times[1:], run.times[-1] + self.step)
        rows = []
        for begin, end, command in zip(run.times.tolist(), ends.tolist(), run.commands.tolist(), strict=True):
            pieces = servos.pieces(begin, end, tuple(command))
            rows.append([sum((b - a) * u[i] for a, b, u in pieces) / (end - begin) for i in range(4)])
        return np.repeat(np.array(rows)[:, None, :], parts, axis=1)

    def bind(self, f: Any, p: Flat) -> tuple[Rate, Look]:
        """Return the equations of the craft in body axes, eqs 5.9 to 5.14."""
        get = p.get
        mass, izz, ixx, arm, g = p["mass"], p["izz"], p["ixx"], p["arm"], p["gravity"]
        lag, c, slope, offset = p["lag"], p["friction"], p["thrust_slope"], p["thrust_offset"]
        stiffness, damping = p["table_roll_stiffness"], p["table_roll_damping"]
        dry, drag = get("coulomb_friction.force", 0.0), get("quadratic_drag.coefficient", 0.0)
        slide, stick, stick_speed = (get(f"stribeck_friction.{n}") for n in ("force", "static_force", "speed"))
        turn, dry_turn = get("yaw_damping.coefficient", 0.0), get("yaw_coulomb_friction.moment", 0.0)
        slew, uneven = get("servo_rate_limit.rate"), get("thrust_asymmetry.ratio", 0.0)
        drop, sag, inflow = get("battery_sag.drop"), get("battery_sag.time"), get("inflow_thrust_loss.coefficient", 0.0)
        com, tilt_x, tilt_y = get("com_offset.right", 0.0), get("table_tilt.x", 0.0), get("table_tilt.y", 0.0)

        def lift(height: Any) -> Any:
            shrunk = p["propeller_radius"] / 4.0 / f.maximum(height, p["propeller_radius"] / 2.0)
            return 1.0 / (1.0 - shrunk ** p["ground_effect_exponent"])

        def felt(t: Any, x: Any) -> tuple[Any, Any, Any, Any]:
            """Return the contact forces forward and to the right, and the yaw and roll moments."""
            _, _, _, vx, vy, r, phi, phi_dot, right, left, tilt_r, tilt_l = x
            rise = arm * f.sin(phi)
            both = 1.0 - inflow * vx
            if drop is not None:
                both = both * (1.0 - drop * (1.0 - f.exp(-t / sag)))
            right = right * lift(p["height"] + rise) * both * (1.0 + uneven)
            left = left * lift(p["height"] - rise) * both * (1.0 - uneven)
            ahead_r, ahead_l, up_r, up_l = (
                right * f.sin(tilt_r),
                left * f.sin(tilt_l),
                right * f.cos(tilt_r),
                left * f.cos(tilt_l),
            )
            speed = f.sqrt(vx * vx + vy * vy + 1e-12)
            rubs = dry
            if slide is not None:
                rubs = rubs + slide + (stick - slide) * f.exp(-((speed / stick_speed) ** 2))
            brake = c + drag * speed + rubs * f.tanh(speed / 0.01) / speed
            yaw = arm * (ahead_r - ahead_l) - com * (ahead_r + ahead_l) - turn * r - dry_turn * f.tanh(r / 0.02)
            roll = arm * (up_r - up_l) - com * (up_r + up_l) - stiffness * phi - damping * phi_dot
            return ahead_r + ahead_l - brake * vx, -(up_r + up_l) * f.sin(phi) - brake * vy, yaw, roll

        def rate(t: Any, x: Any, u: Any, push: Any) -> list[Any]:
            _, _, psi, vx, vy, r, _, phi_dot, right, left, tilt_r, tilt_l = x
            ahead, aside, yaw, roll = felt(t, x)
            cos, sin = f.cos(psi), f.sin(psi)
            down_x, down_y = mass * g * f.sin(tilt_x), mass * g * f.sin(tilt_y)
            turned = [(u[2] - tilt_r) / lag, (u[3] - tilt_l) / lag]
            if slew is not None:
                turned = [f.minimum(f.maximum(v, -slew), slew) for v in turned]
            static = [f.maximum(offset + slope * duty, 0.0) * g / 1000.0 for duty in (u[0], u[1])]
            return [
                vx * cos + vy * sin,
                vx * sin - vy * cos,
                r,
                (ahead + down_x * cos + down_y * sin + push[0]) / mass,
                (aside + down_x * sin - down_y * cos + push[1]) / mass,
                (yaw + push[2]) / izz,
                phi_dot,
                roll / ixx,
                (static[0] - right) / lag,
                (static[1] - left) / lag,
                *turned,
            ]

        def look(t: Any, x: Any, push: Any) -> list[Any]:
            return [x[2], x[5], (felt(t, x)[0] + push[0]) / mass, x[0], x[1]]

        return rate, look


def craft(base: dict[str, float], kind: str, truth: dict[str, dict[str, float]]) -> Craft:
    """Return the laboratory's craft with the parameters of a field study."""
    if kind == "outside" and truth:  # none yet while the recorder's stamps are drawn
        (name,) = truth
        return Craft(base=base, outside=outside(name, truth[name]))
    sensors = CraftRig.sensors
    return Craft(base=base, effects={name: values for name, values in truth.items() if name not in sensors})


def fly_craft(
    rig: CraftRig,
    made: Craft,
    truth: dict[str, dict[str, float]],
    rng: np.random.Generator,
    times: np.ndarray,
    pushes: np.ndarray,
    noise: np.ndarray,
) -> tuple[Run, Course]:
    """Simulate a log in closed loop; the pilot uses readings with sensor noise, without the recorder's faults."""
    start = _moving(rng)
    flight = Flight(made, made.rest(**start))
    pilot = Pilot(rng, Style.draw(rng, bool(rng.random() < 0.5)), times.size, start.get("psi", 0.0))
    p = rig.numbers({}, truth)
    readings, states, commands = np.empty((times.size, len(rig.outputs))), np.empty((times.size, flight.state.size)), []
    for k, t in enumerate(times.tolist()):
        flight.dynamics.disturbance = tuple(pushes[k].tolist())
        now = flight.dynamics.outputs(t, flight.state)
        if made.outside.compass:
            now["psi"] = made.outside.compass(now["psi"])
        readings[k] = [rig.sensed(p, output, now[output]) for output in rig.outputs]
        states[k] = flight.state
        seen = {o: float(f"{r + e:.6g}") for o, r, e in zip(rig.outputs, readings[k], noise[k], strict=True)}
        commands.append(pilot.command(seen))
        if k + 1 < times.size:
            _advance(flight, t, float(times[k + 1]), commands[-1])
    order = [STATES.index(name) for name in rig.states]
    return Run(times, np.array(commands), pushes, states[0][order]), Course(readings, states)


def _moving(rng: np.random.Generator) -> dict[str, float]:
    """Return the start state of a log: with probability ½ at rest at the origin, else moving."""
    if rng.random() < 0.5:
        return {}
    spread = {"x_world": 0.5, "y_world": 0.5, "psi": 1.0, "vx": 0.4, "vy": 0.1, "psi_dot": 0.5}
    return {name: float(rng.uniform(-width, width)) for name, width in spread.items()}


def _advance(flight: Flight, begin: float, end: float, command: Any) -> None:
    """Advance a flight over a row of any length."""
    for a, b, acting in flight.servos.pieces(begin, end, command):
        flight.dynamics.command = acting
        flight._solver.set_initial_value(flight.state, a)
        flight.state = flight._solver.integrate(b)
        if not flight._solver.successful():
            raise ArithmeticError(f"integration of the craft failed at {a:.3f} s")


def replay_craft(made: Craft, run: Run, course: Course, rig: CraftRig) -> np.ndarray:
    """Return outputs of replays over one horizon each, from the true state without pushes; NaN in the first 2 s."""
    horizon = round(rig.horizon / rig.step)
    readings = np.full(course.readings.shape, np.nan)
    for k in range(horizon, run.times.size - 1, horizon):
        flight = Flight(made, course.states[k].copy())
        for j in range(k):  # the servos remember: play, and what is outside
            flight.servos.pieces(run.times[j], run.times[j + 1], tuple(run.commands[j].tolist()))
        for j in range(k, min(k + horizon, run.times.size - 1)):
            _advance(flight, float(run.times[j]), float(run.times[j + 1]), tuple(run.commands[j].tolist()))
            now = flight.dynamics.outputs(float(run.times[j + 1]), flight.state)
            readings[j + 1] = [now[output] for output in rig.outputs]
    return readings
