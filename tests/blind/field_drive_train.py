"""Independent equations of the drive train: two inertias and a belt, from the power between them."""

# ruff: noqa: RUF012 - what a rig declares are attributes of its class
from __future__ import annotations

import math
from typing import Any

import numpy as np

from tests.blind.field_rig import (
    Array,
    Entry,
    Flat,
    Look,
    Random,
    Rate,
    Rig,
    Sensor,
    manoeuvre,
    rounded,
    terms_in,
)


class DriveTrain(Rig):
    """Drive train driven by a torque; outputs angle and speed of the motor and angle of the load."""

    name, model = "drive_train", "DriveTrain"
    states = {"motor_angle": 1.0, "motor_speed": 10.0, "load_angle": 1.0, "load_speed": 10.0}
    inputs = {"torque": 0.0}
    outputs = {"motor_angle": 1e-2, "motor_speed": 0.5, "load_angle": 1e-2}
    sheet = {
        "motor_inertia": (0.004, 0.05),
        "load_inertia": (0.012, 0.2),
        "stiffness": (25.0, 0.1),
        "motor_damping": (0.015, 0.3),
        "load_damping": (0.025, 0.3),
    }
    constants = {"belt_damping": 0.05}
    entries = {
        "command_delay": Entry("time", 3e-3, 5e-4, 0.06),
        "load_coulomb": Entry("level", 0.03, 1e-3, 0.4),
        "load_stribeck": Entry("breakaway", 0.03, 2e-3, 0.4, shape={"speed": (3.0, 8.0)}),
        "fan_drag": Entry("coefficient", 1e-4, 1e-5, 3e-3),
        "cubic_belt": Entry("stiffness", 500.0, 20.0, 4e4),
        "belt_play": Entry("width", 3e-3, 2e-4, 0.06),
        "cogging": Entry("sine cosine", 0.03, 2e-3, 0.4),
        "torque_asymmetry": Entry("ratio", 0.03, 2e-3, 0.3, signed=True),
        "torque_offset": Entry("value", 0.03, 1e-3, 0.4, signed=True),
        "tacho_scale": Entry("value", 0.01, 5e-4, 0.25, signed=True, neutral=1.0),
        "tacho_bias": Entry("value", 0.03, 1e-3, 2.0, signed=True),
        "load_latency": Entry("value", 0.01, 7.5e-3, 0.02, fixed=True),
    }
    sensors = {
        "tacho_scale": Sensor("motor_speed", "scale"),
        "tacho_bias": Sensor("motor_speed", "bias"),
        "load_latency": Sensor("load_angle", "late"),
    }
    outside = {
        "load_imbalance": Entry("moment", 0.05, 2e-3, 0.5),
        "tight_spot": Entry("coefficient", 0.01, 5e-4, 0.1),
        "amplifier_hunting": Entry("depth", 0.05, 5e-3, 0.5, shape={"frequency": (2.5, 4.0)}),
        "eccentric_encoder": Entry("amplitude", 0.01, 5e-4, 0.2),
        "dragging_brake": Entry("level", 0.1, 2e-3, 0.6, shape={"period": (4.0, 6.0), "length": (1.0, 2.0)}),
    }
    families = (
        frozenset({"load_coulomb", "load_stribeck"}),
        frozenset({"cubic_belt", "belt_play"}),
        frozenset({"torque_asymmetry", "torque_offset"}),
    )
    pushes, correlation_time = (4.0, 4.0), 0.2
    step, rows, horizon, preroll = 0.005, 3000, 0.5, 0.1

    def bind(self, f: Any, p: Flat) -> tuple[Rate, Look]:
        """Return the equations, with torque u on the motor, belt torque s from motor to load, and pushes on both."""
        stiffness, get = p["stiffness"], p.get
        uneven, offset = get("torque_asymmetry.ratio", 0.0), get("torque_offset.value", 0.0)
        hunting = {"amplifier_hunting": lambda t, depth, frequency: depth * f.sin(2.0 * math.pi * frequency * t)}
        sine, cosine = get("cogging.sine"), get("cogging.cosine")
        twists = {
            "cubic_belt": lambda twist, stiffness: stiffness * twist**3,
            "belt_play": lambda twist, width: -stiffness * width * f.tanh(twist / (width + 1e-3)),
        }
        rubs = {
            "load_coulomb": lambda t, w, level: level,
            "load_stribeck": lambda t, w, breakaway, speed: breakaway * f.exp(-((w / speed) ** 2)),
            "dragging_brake": lambda t, w, level, period, length: f.where(t % period < length, level, 0.0),
        }
        slows = {
            "fan_drag": lambda angle, w, coefficient: coefficient * w * f.absolute(w),
            "load_imbalance": lambda angle, w, moment: moment * f.sin(angle),
            "tight_spot": lambda angle, w, coefficient: coefficient * w * (1.0 + f.cos(angle)),
        }
        shown = {"eccentric_encoder": lambda angle, amplitude: amplitude * f.sin(angle)}
        hunts, bends, dry, drags, off = (terms_in(p, x) for x in (hunting, twists, rubs, slows, shown))

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            angle, speed, load_angle, load_speed = x
            torque = (u[0] + uneven * f.absolute(u[0]) + offset) * hunts(1.0, t)
            if sine is not None:
                torque = torque + sine * f.sin(4.0 * angle) + cosine * f.cos(4.0 * angle)
            twist = angle - load_angle
            belt = bends(stiffness * twist + p["belt_damping"] * (speed - load_speed), twist)
            brakes = p["load_damping"] * load_speed + dry(0.0, t, load_speed) * f.tanh(load_speed / 0.3)
            brakes = drags(brakes, load_angle, load_speed)
            motor = torque + push[0] - p["motor_damping"] * speed - belt
            return [speed, motor / p["motor_inertia"], load_speed, (belt + push[1] - brakes) / p["load_inertia"]]

        def look(t: float, x: Any, push: Any) -> list[Any]:
            return [x[0], x[1], off(x[2], x[2])]

        return rate, look

    def drive(self, rng: Random) -> Array:
        """Return torques up to ±2 N m, held from 50 ms to 1.5 s; 0 in the first 0.1 s."""
        torque = manoeuvre(rng, self.rows, self.step, (-2.0, 2.0), (0.05, 1.5))
        torque[:20] = 0.0
        return rounded(torque[:, None])

    def begin(self, rng: Random) -> Array:
        """Return a start state at rest at 0, or turning."""
        speed = float(rng.choice([0.0, 1.0]) * rng.uniform(-15.0, 15.0))
        return np.array([0.0, speed, 0.0, speed])
