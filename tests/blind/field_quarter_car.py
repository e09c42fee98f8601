"""Independent equations of the quarter car: forces on body and wheel, and the lag of the table."""

# ruff: noqa: RUF012 - what a rig declares are ClassVars of its base
from __future__ import annotations

import math
from typing import Any

import numpy as np

from tests.blind.field_rig import Entry, Flat, Look, Rate, Rig, Sensor, manoeuvre, rounded


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
        "command_delay": Entry(("time",), 2e-3, (3e-4, 0.05)),
        "road_gain": Entry(("gain",), 0.01, (1e-3, 0.2), signed=True),
        "damper_asymmetry": Entry(("coefficient",), 30.0, (3.0, 500.0), signed=True),
        "damper_coulomb": Entry(("level",), 8.0, (0.5, 120.0)),
        "damper_progression": Entry(("coefficient",), 60.0, (5.0, 1500.0)),
        "damper_mount": Entry(("time",), 5e-3, (3e-3, 0.06)),
        "cubic_spring": Entry(("stiffness",), 4e5, (3e4, 2e7)),
        "bump_stop": Entry(("stiffness",), 2e5, (1e4, 1e7)),
        "tyre_damping": Entry(("coefficient",), 40.0, (3.0, 300.0)),
        "preload": Entry(("force",), 5.0, (0.5, 200.0), signed=True),
        "travel_scale": Entry(("value",), 0.01, (1e-3, 0.2), signed=True, neutral=1.0),
        "accelerometer_bias": Entry(("value",), 0.01, (1e-3, 0.5), signed=True),
        "laser_latency": Entry(("value",), 0.01, (7.5e-3, 0.02), fixed=True),
    }
    sensors = {
        "travel_scale": Sensor("travel", "scale"),
        "accelerometer_bias": Sensor("body_acceleration", "bias"),
        "laser_latency": Sensor("body_height", "late"),
    }
    outside = {
        "bypass_grooves": Entry(("depth",), 0.1, (5e-3, 0.9), shape={"width": (4e-3, 8e-3)}),
        "fading_damper": Entry(("share",), 0.1, (5e-3, 0.9), shape={"time": (3.0, 6.0)}),
        "table_slew": Entry(("speed",), 0.7, (0.3, 20.0), inverse=True),
        "passenger": Entry(("mass",), 10.0, (0.3, 100.0), shape={"frequency": (3.0, 4.5)}),
        "spring_play": Entry(("width",), 1e-3, (5e-5, 0.012)),
        "hunting_table": Entry(("amplitude",), 3e-4, (3e-5, 0.01), shape={"frequency": (4.0, 7.0)}),
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
        get = p.get
        body, wheel, k, c, k_tyre, lag = (
            p[n] for n in ("body_mass", "wheel_mass", "spring", "damping", "tyre", "table_lag")
        )
        gain, uneven, dry = get("road_gain.gain"), get("damper_asymmetry.coefficient"), get("damper_coulomb.level")
        harder, mount, cubic = (
            get("damper_progression.coefficient"),
            get("damper_mount.time"),
            get("cubic_spring.stiffness"),
        )
        stop, rubber, load = get("bump_stop.stiffness"), get("tyre_damping.coefficient"), get("preload.force")
        groove, groove_width = get("bypass_grooves.depth"), get("bypass_grooves.width")
        fade, fade_time, slew = get("fading_damper.share"), get("fading_damper.time"), get("table_slew.speed")
        rider, rider_hertz, play = get("passenger.mass"), get("passenger.frequency"), get("spring_play.width")
        hunt, hunt_hertz = get("hunting_table.amplitude"), get("hunting_table.frequency")

        def forces(t: float, x: Any) -> tuple[Any, Any, Any]:
            """Return the force of the suspension, the damper's force before its mount, and more forces on the body."""
            z, v = x[2] - x[0], x[3] - x[1]
            damper = c * v
            if groove is not None:
                damper = damper * (1.0 - groove * f.exp(-((z / groove_width) ** 2)))
            if fade is not None:
                damper = damper * (1.0 - fade * (1.0 - f.exp(-t / fade_time)))
            if uneven is not None:
                damper = damper - uneven * f.absolute(v)
            if dry is not None:
                damper = damper + dry * f.tanh(v / 0.02)
            if harder is not None:
                damper = damper + harder * v * f.absolute(v)
            passed = damper if mount is None else f.where(mount > 0.0, x[5], damper)
            spring = k * z
            if cubic is not None:
                spring = spring + cubic * z**3
            if stop is not None:
                spring = spring + stop * f.maximum(z - 0.025, 0.0) ** 2
            if play is not None:
                spring = spring - k * play * f.tanh(z / (play + 1e-5))
            more = 0.0 if load is None else load
            if rider is not None:
                stiff = rider * (2.0 * math.pi * rider_hertz) ** 2
                damp = 0.4 * rider * 2.0 * math.pi * rider_hertz
                more = more + stiff * (x[-2] - x[0]) + damp * (x[-1] - x[1])
            return spring + passed, damper, more

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            goal = u[0]
            if gain is not None:
                goal = goal * (1.0 + gain)
            if hunt is not None:
                goal = goal + hunt * f.sin(2.0 * math.pi * hunt_hertz * t)
            table = (goal - x[4]) / lag
            if slew is not None:
                table = f.minimum(f.maximum(table, -slew), slew)
            suspension, damper, more = forces(t, x)
            tyre = k_tyre * (x[4] - x[2])
            if rubber is not None:
                tyre = tyre + rubber * (table - x[3])
            slopes = [] if mount is None else [(damper - x[5]) / f.maximum(mount, 0.0025)]
            if rider is not None:
                slopes += [x[-1], -(more if load is None else more - load) / f.maximum(rider, 1e-9)]
            return [
                x[1],
                (suspension + more + push[0]) / body,
                x[3],
                (tyre - suspension + push[1]) / wheel,
                table,
                *slopes,
            ]

        def look(t: float, x: Any, push: Any) -> list[Any]:
            suspension, _, more = forces(t, x)
            return [x[2] - x[0], (suspension + more + push[0]) / body, x[0]]

        return rate, look

    def drive(self, rng: np.random.Generator) -> np.ndarray:
        """Return heights up to ±30 mm, held from 60 ms to 1.5 s; 0 in the first 0.1 s."""
        road = manoeuvre(rng, self.rows, self.step, (-0.03, 0.03), (0.06, 1.5))
        road[:20] = 0.0
        return rounded(road[:, None])

    def begin(self, rng: np.random.Generator) -> np.ndarray:
        """Return a start state at rest, or bouncing."""
        return rng.choice([0.0, 1.0]) * rng.uniform(-1.0, 1.0, 5) * [0.01, 0.1, 0.01, 0.1, 0.0]
