"""Independent equations of the quarter car: forces on body and wheel, and the lag of the table."""

# ruff: noqa: RUF012 - what a rig declares are attributes of its class
from __future__ import annotations

import math
from typing import Any

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
    moving,
    rounded,
    terms_in,
)


class QuarterCar(Rig):
    """Quarter car on a table of commanded height; outputs suspension travel, acceleration and height of the body."""

    name, model = "quarter_car", "QuarterCar"
    states = {
        "body_height": 0.02,
        "body_speed": 0.2,
        "wheel_height": 0.02,
        "wheel_speed": 0.5,
        "table_height": 0.02,
    }
    inputs = {"road": 0.0}
    outputs = {"travel": 1e-3, "body_acceleration": 0.2, "body_height": 2e-3}
    sheet = {
        "body_mass": (300.0, 0.05),
        "wheel_mass": (40.0, 0.1),
        "spring": (18000.0, 0.05),
        "damping": (1200.0, 0.3),
        "tyre": (180000.0, 0.15),
        "table_lag": (0.02, 0.2),
    }
    entries = {
        "command_delay": Entry("time", 2e-3, 3e-4, 0.05),
        "road_gain": Entry("gain", 0.01, 1e-3, 0.2, signed=True),
        "damper_asymmetry": Entry("coefficient", 30.0, 3.0, 500.0, signed=True),
        "damper_coulomb": Entry("level", 8.0, 0.5, 120.0),
        "damper_progression": Entry("coefficient", 60.0, 5.0, 1500.0),
        "damper_mount": Entry("time", 5e-3, 3e-3, 0.06),
        "cubic_spring": Entry("stiffness", 4e5, 3e4, 2e7),
        "bump_stop": Entry("stiffness", 2e5, 1e4, 1e7),
        "tyre_damping": Entry("coefficient", 40.0, 3.0, 300.0),
        "preload": Entry("force", 5.0, 0.5, 200.0, signed=True),
        "travel_scale": Entry("value", 0.01, 1e-3, 0.2, signed=True, neutral=1.0),
        "accelerometer_bias": Entry("value", 0.01, 1e-3, 0.5, signed=True),
        "laser_latency": Entry("value", 0.01, 7.5e-3, 0.02, fixed=True),
    }
    sensors = {
        "travel_scale": Sensor("travel", "scale"),
        "accelerometer_bias": Sensor("body_acceleration", "bias"),
        "laser_latency": Sensor("body_height", "late"),
    }
    outside = {
        "bypass_grooves": Entry("depth", 0.1, 5e-3, 0.9, shape={"width": (4e-3, 8e-3)}),
        "fading_damper": Entry("share", 0.1, 5e-3, 0.9, shape={"time": (3.0, 6.0)}),
        "table_slew": Entry("speed", 0.7, 0.3, 20.0, inverse=True),
        "passenger": Entry("mass", 10.0, 0.3, 100.0, shape={"frequency": (3.0, 4.5)}),
        "spring_play": Entry("width", 1e-3, 5e-5, 0.012),
        "hunting_table": Entry("amplitude", 3e-4, 3e-5, 0.01, shape={"frequency": (4.0, 7.0)}),
    }
    families = (
        frozenset({"damper_coulomb", "damper_progression"}),
        frozenset({"cubic_spring", "bump_stop"}),
        frozenset({"command_delay", "laser_latency"}),
    )
    own_states = {
        "damper_mount": {"damper_mount.force": 0.0},
        "passenger": {"passenger.height": 0.0, "passenger.speed": 0.0},
    }
    pushes, correlation_time = (1080.0, 10800.0), 0.3
    step, rows, horizon, preroll = 0.005, 3000, 1.0, 0.1
    substeps = 2

    def bind(self, f: Any, p: Flat) -> tuple[Rate, Look]:
        """Return the equations; pushes are upward forces on body and wheel."""
        stiff, get = p["spring"], p.get
        gain, load, rubber = (get(n, 0.0) for n in ("road_gain.gain", "preload.force", "tyre_damping.coefficient"))
        mount, slew, mass = get("damper_mount.time"), get("table_slew.speed"), get("passenger.mass")
        softens = {"bypass_grooves": lambda z, depth, width: depth * f.exp(-((z / width) ** 2))}
        fades = {"fading_damper": lambda t, share, time: share * (1.0 - f.exp(-t / time))}
        brakes = {
            "damper_asymmetry": lambda v, coefficient: -coefficient * f.absolute(v),
            "damper_coulomb": lambda v, level: level * f.tanh(v / 0.02),
            "damper_progression": lambda v, coefficient: coefficient * v * f.absolute(v),
        }
        bends = {
            "cubic_spring": lambda z, stiffness: stiffness * z**3,
            "bump_stop": lambda z, stiffness: stiffness * f.maximum(z - 0.025, 0.0) ** 2,
            "spring_play": lambda z, width: -stiff * width * f.tanh(z / (width + 1e-5)),
        }
        hunts = {"hunting_table": lambda t, amplitude, frequency: amplitude * f.sin(2.0 * math.pi * frequency * t)}

        def carried(x: Any, mass: Any, frequency: Any) -> Any:
            stiffness, damping = mass * (2.0 * math.pi * frequency) ** 2, 0.4 * mass * 2.0 * math.pi * frequency
            return stiffness * (x[-2] - x[0]) + damping * (x[-1] - x[1])

        groove, fade, more_damper, more_spring, hunt, passenger = (
            terms_in(p, terms) for terms in (softens, fades, brakes, bends, hunts, {"passenger": carried})
        )

        def forces(t: float, x: Any) -> tuple[Any, Any, Any]:
            """Return the forces of the suspension, of the damper before its mount, and of the passenger."""
            z, v = x[2] - x[0], x[3] - x[1]
            damper = p["damping"] * v * (1.0 - groove(0.0, z)) * (1.0 - fade(0.0, t))
            damper = more_damper(damper, v)
            passed = damper if mount is None else f.where(mount > 0.0, x[5], damper)
            return more_spring(stiff * z, z) + passed, damper, passenger(0.0, x)

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            table = (hunt(u[0] * (1.0 + gain), t) - x[4]) / p["table_lag"]
            table = table if slew is None else f.minimum(f.maximum(table, -slew), slew)
            suspension, damper, rider = forces(t, x)
            tyre = p["tyre"] * (x[4] - x[2]) + rubber * (table - x[3])
            slopes = [] if mount is None else [(damper - x[5]) / f.maximum(mount, 0.0025)]
            slopes += [] if mass is None else [x[-1], -rider / f.maximum(mass, 1e-9)]
            lift = (suspension + (load + rider) + push[0]) / p["body_mass"]
            return [x[1], lift, x[3], (tyre - suspension + push[1]) / p["wheel_mass"], table, *slopes]

        def look(t: float, x: Any, push: Any) -> list[Any]:
            suspension, _, rider = forces(t, x)
            return [x[2] - x[0], (suspension + (load + rider) + push[0]) / p["body_mass"], x[0]]

        return rate, look

    def drive(self, rng: Random) -> Array:
        """Return heights up to ±30 mm, held from 60 ms to 1.5 s; 0 in the first 0.1 s."""
        road = manoeuvre(rng, self.rows, self.step, (-0.03, 0.03), (0.06, 1.5))
        road[:20] = 0.0
        return rounded(road[:, None])

    def begin(self, rng: Random) -> Array:
        """Return a start state at rest, or bouncing."""
        return moving(rng, 0.01, 0.1, 0.01, 0.1, 0.0)
