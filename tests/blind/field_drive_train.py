"""Independent equations of the drive train: two inertias and a belt, from the power between them."""

# ruff: noqa: RUF012 - what a rig declares are ClassVars of its base
from __future__ import annotations

import math
from typing import Any

import numpy as np

from tests.blind.field_rig import Entry, Flat, Look, Rate, Rig, Sensor, manoeuvre, rounded


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
        "command_delay": Entry(("time",), 3e-3, (5e-4, 0.06)),
        "load_coulomb": Entry(("level",), 0.03, (1e-3, 0.4)),
        "load_stribeck": Entry(("breakaway",), 0.03, (2e-3, 0.4), shape={"speed": (3.0, 8.0)}),
        "fan_drag": Entry(("coefficient",), 1e-4, (1e-5, 3e-3)),
        "cubic_belt": Entry(("stiffness",), 500.0, (20.0, 4e4)),
        "belt_play": Entry(("width",), 3e-3, (2e-4, 0.06)),
        "cogging": Entry(("sine", "cosine"), 0.03, (2e-3, 0.4)),
        "torque_asymmetry": Entry(("ratio",), 0.03, (2e-3, 0.3), signed=True),
        "torque_offset": Entry(("value",), 0.03, (1e-3, 0.4), signed=True),
        "tacho_scale": Entry(("value",), 0.01, (5e-4, 0.25), signed=True, neutral=1.0),
        "tacho_bias": Entry(("value",), 0.03, (1e-3, 2.0), signed=True),
        "load_latency": Entry(("value",), 0.01, (7.5e-3, 0.02), fixed=True),
    }
    sensors = {
        "tacho_scale": Sensor("motor_speed", "scale"),
        "tacho_bias": Sensor("motor_speed", "bias"),
        "load_latency": Sensor("load_angle", "late"),
    }
    outside = {
        "load_imbalance": Entry(("moment",), 0.05, (2e-3, 0.5)),
        "tight_spot": Entry(("coefficient",), 0.01, (5e-4, 0.1)),
        "amplifier_hunting": Entry(("depth",), 0.05, (5e-3, 0.5), shape={"frequency": (2.5, 4.0)}),
        "eccentric_encoder": Entry(("amplitude",), 0.01, (5e-4, 0.2)),
        "dragging_brake": Entry(("level",), 0.1, (2e-3, 0.6), shape={"period": (4.0, 6.0), "length": (1.0, 2.0)}),
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
        inertia, driven, k, d = p["motor_inertia"], p["load_inertia"], p["stiffness"], p["belt_damping"]
        b_motor, b_load = p["motor_damping"], p["load_damping"]
        get = p.get
        dry_load, sticky = get("load_coulomb.level"), get("load_stribeck.breakaway")
        sticky_speed, fan, cubic = get("load_stribeck.speed"), get("fan_drag.coefficient"), get("cubic_belt.stiffness")
        play, sine, cosine = get("belt_play.width"), get("cogging.sine"), get("cogging.cosine")
        uneven, offset = get("torque_asymmetry.ratio"), get("torque_offset.value")
        weight, spot, wobble = (
            get("load_imbalance.moment"),
            get("tight_spot.coefficient"),
            get("eccentric_encoder.amplitude"),
        )
        depth, hertz = get("amplifier_hunting.depth"), get("amplifier_hunting.frequency")
        brake, period, length = (get(f"dragging_brake.{n}") for n in ("level", "period", "length"))

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            angle, speed, load_angle, load_speed = x
            torque = u[0]
            if uneven is not None:
                torque = torque + uneven * f.absolute(torque)
            if offset is not None:
                torque = torque + offset
            if depth is not None:
                torque = torque * (1.0 + depth * f.sin(2.0 * math.pi * hertz * t))
            if sine is not None:
                torque = torque + sine * f.sin(4.0 * angle) + cosine * f.cos(4.0 * angle)
            twist = angle - load_angle
            belt = k * twist + d * (speed - load_speed)
            if cubic is not None:
                belt = belt + cubic * twist**3
            if play is not None:
                belt = belt - k * play * f.tanh(twist / (play + 1e-3))
            brakes = b_load * load_speed
            dry = 0.0 if dry_load is None else dry_load
            if sticky is not None:
                dry = dry + sticky * f.exp(-((load_speed / sticky_speed) ** 2))
            if brake is not None:
                dry = dry + f.where(t % period < length, brake, 0.0)
            if dry_load is not None or sticky is not None or brake is not None:
                brakes = brakes + dry * f.tanh(load_speed / 0.3)
            if fan is not None:
                brakes = brakes + fan * load_speed * f.absolute(load_speed)
            if weight is not None:
                brakes = brakes + weight * f.sin(load_angle)
            if spot is not None:
                brakes = brakes + spot * load_speed * (1.0 + f.cos(load_angle))
            return [
                speed,
                (torque + push[0] - b_motor * speed - belt) / inertia,
                load_speed,
                (belt + push[1] - brakes) / driven,
            ]

        def look(t: float, x: Any, push: Any) -> list[Any]:
            load = x[2] if wobble is None else x[2] + wobble * f.sin(x[2])
            return [x[0], x[1], load]

        return rate, look

    def drive(self, rng: np.random.Generator) -> np.ndarray:
        """Return torques up to ±2 N m, held from 50 ms to 1.5 s; 0 in the first 0.1 s."""
        torque = manoeuvre(rng, self.rows, self.step, (-2.0, 2.0), (0.05, 1.5))
        torque[:20] = 0.0
        return rounded(torque[:, None])

    def begin(self, rng: np.random.Generator) -> np.ndarray:
        """Return a start state at rest at 0, or turning."""
        speed = float(rng.choice([0.0, 1.0]) * rng.uniform(-15.0, 15.0))
        return np.array([0.0, speed, 0.0, speed])
