"""Independent equations of the four own plants of the field half, from forces, powers and balances of volume."""

# ruff: noqa: RUF012 - what a rig declares are attributes of its class
import math
from functools import partial
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
    hidden_in,
    kept_level,
    pulses,
    rounded,
    sensor,
)


class DriveTrain(Rig):
    """Drive train driven by a torque; outputs angle and speed of the motor and angle of the load."""

    name, model = "drive_train", "DriveTrain"
    states = {"motor_angle": 1.0, "motor_speed": 10.0, "load_angle": 1.0, "load_speed": 10.0}
    inputs = {"torque": 0.0}
    outputs = {"motor_angle": 1e-2, "motor_speed": 0.5, "load_angle": 1e-2}
    sheet = {
        "motor_inertia": (0.004, 0.05), "load_inertia": (0.012, 0.2), "stiffness": (25.0, 0.1),
        "motor_damping": (0.015, 0.3), "load_damping": (0.025, 0.3),
    }  # fmt: skip
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
        "tacho_scale": sensor("motor_speed", "scale", 0.01, 5e-4, 0.25),
        "tacho_bias": sensor("motor_speed", "bias", 0.03, 1e-3, 2.0),
        "load_latency": sensor("load_angle", "late", 0.01, 7.5e-3, 0.02),
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
    manoeuvres, rest_rows = ((-2.0, 2.0, (0.05, 1.5)),), 20  # [N m]
    pushes, correlation_time = (4.0, 4.0), 0.2
    step, rows, horizon, preroll = 0.005, 3000, 0.5, 0.1

    def bind(self, f: Any, p: Flat) -> tuple[Rate, Look]:
        """Return the equations, with torque u on the motor, belt torque s from motor to load, and pushes on both."""
        hidden, stiffness, get = hidden_in(p), p["stiffness"], p.get
        uneven, offset = get("torque_asymmetry.ratio", 0.0), get("torque_offset.value", 0.0)

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            angle, speed, load_angle, w = x
            torque = (u[0] + uneven * f.absolute(u[0]) + offset) * (
                1.0 + hidden("amplifier_hunting", lambda depth, frequency: depth * f.sin(2.0 * math.pi * frequency * t))
            )
            turn = 4.0 * angle
            torque = torque + hidden("cogging", lambda sine, cosine: sine * f.sin(turn) + cosine * f.cos(turn))
            twist = angle - load_angle
            belt = stiffness * twist + p["belt_damping"] * (speed - w)
            belt = belt + hidden("cubic_belt", lambda stiffness: stiffness * twist**3)
            belt = belt - hidden("belt_play", lambda width: stiffness * width * f.tanh(twist / (width + 1e-3)))
            dry = hidden("load_coulomb", lambda level: level)
            dry = dry + hidden("load_stribeck", lambda breakaway, speed: breakaway * f.exp(-((w / speed) ** 2)))
            dry = dry + hidden("dragging_brake", pulses(f, t))
            brakes = p["load_damping"] * w + dry * f.tanh(w / 0.3)
            brakes = brakes + hidden("fan_drag", lambda coefficient: coefficient * w * f.absolute(w))
            brakes = brakes + hidden("load_imbalance", lambda moment: moment * f.sin(load_angle))
            brakes = brakes + hidden("tight_spot", lambda coefficient: coefficient * w * (1.0 + f.cos(load_angle)))
            motor = torque + push[0] - p["motor_damping"] * speed - belt
            return [speed, motor / p["motor_inertia"], w, (belt + push[1] - brakes) / p["load_inertia"]]

        def look(t: float, x: Any, push: Any) -> list[Any]:
            return [x[0], x[1], x[2] + hidden("eccentric_encoder", lambda amplitude: amplitude * f.sin(x[2]))]

        return rate, look

    def begin(self, rng: Random) -> Array:
        """Return a start state at rest at 0, or turning."""
        speed = float(rng.choice([0.0, 1.0]) * rng.uniform(-15.0, 15.0))
        return np.array([0.0, speed, 0.0, speed])


class Tanks(Rig):
    """Tanks with two pump voltages; outputs two levels and a flow."""

    name, model = "tanks", "Tanks"
    states = {"level_left": 0.1, "level_right": 0.1}
    inputs = {"pump_left": 5.0, "pump_right": 5.0}
    outputs = {"level_left": 2e-3, "level_right": 2e-3, "outflow": 1e-6}
    sheet = {
        "area_left": (0.02, 0.03), "area_right": (0.02, 0.03), "pipe": (1.2e-4, 0.3), "outlet": (1.2e-4, 0.2),
        "gain_left": (6e-6, 0.1), "gain_right": (6e-6, 0.1),
    }  # fmt: skip
    entries = {
        "pump_dead_band": Entry("width", 0.1, 5e-3, 1.5),
        "pump_lag": Entry("time", 2.0, 0.6, 30.0),
        "pump_curve": Entry("curvature", 0.05, 2e-3, 0.3, signed=True),
        "head_loss": Entry("slope", 0.1, 5e-3, 1.0),
        "outlet_exponent": Entry("excess", 0.05, 2e-3, 0.35, signed=True),
        "left_leak": Entry("coefficient", 3e-6, 1e-7, 5e-5),
        "constant_draw": Entry("flow", 1e-6, 5e-8, 2e-5, signed=True),
        "overflow": Entry("coefficient", 5e-4, 1e-5, 1e-2),
        "cross_flow": Entry("coefficient", 1e-5, 5e-7, 3e-4),
        "left_gauge_bias": sensor("level_left", "bias", 3e-3, 1e-4, 0.06),
        "meter_scale": sensor("outflow", "scale", 0.01, 5e-4, 0.2),
        "meter_bias": sensor("outflow", "bias", 1e-6, 3e-8, 2e-5),
        "left_gauge_latency": sensor("level_left", "late", 2.5, 1.5, 4.0),
    }
    outside = {
        "backflow": Entry("coefficient", 1e-5, 3e-7, 1e-4),
        "tapping_consumer": Entry("flow", 3e-6, 1e-7, 3e-5, shape={"period": (250.0, 400.0), "length": (60.0, 120.0)}),
        "tiring_pump": Entry("share", 0.05, 5e-3, 0.8, shape={"time": (300.0, 900.0)}),
        "sloshing_gauge": Entry("amplitude", 1e-3, 1e-4, 0.03, shape={"period": (9.0, 15.0)}),
        "conical_tank": Entry("slope", 0.2, 5e-3, 1.5),
    }
    families = (
        frozenset({"left_leak", "overflow"}),
        frozenset({"pump_dead_band", "pump_curve"}),
        frozenset({"outlet_exponent", "constant_draw", "head_loss"}),
    )
    own_states = {"pump_lag": {"pump_lag.left": 5.0, "pump_lag.right": 5.0}}
    manoeuvres, rest_rows = ((0.0, 10.0, (8.0, 150.0)),) * 2, 5  # [V]
    pushes, correlation_time = (6e-5, 6e-5), 30.0
    rest, moves = (0.3, 0.25), (0.08, 0.08)
    step, rows, horizon, preroll = 1.0, 1800, 40.0, 30.0
    substeps = 2

    def bind(self, f: Any, p: Flat) -> tuple[Rate, Look]:
        """Return the equations: flows from the pumps, through the pipe and out of both tanks."""
        hidden, get = hidden_in(p), p.get
        head, seep, draw = (get(n, 0.0) for n in ("head_loss.slope", "cross_flow.coefficient", "constant_draw.flow"))
        band, lag, curve = get("pump_dead_band.width"), get("pump_lag.time"), get("pump_curve.curvature", 0.0)
        cone, excess = get("conical_tank.slope", 0.0), get("outlet_exponent.excess")

        def spilt(left: Any, coefficient: Any) -> Any:
            above = f.maximum(left - 0.42, 0.0)
            return coefficient * above * f.sqrt(above + 1e-9)

        def drained(left: Any, coefficient: Any) -> Any:
            return coefficient * f.sqrt(f.maximum(left, 1e-3))

        def out(level: Any) -> Any:
            wet = f.maximum(level, 1e-3)
            flow = p["outlet"] * f.sqrt(wet)
            return flow if excess is None else flow * (wet / 0.25) ** excess

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            left, right = x[0], x[1]
            volts, slopes = u if band is None else [f.maximum(v - band, 0.0) for v in u], []
            if lag is not None:
                both = list(zip(volts, x[2:], strict=True))
                slopes = [(v - own) / f.maximum(lag, 0.5) for v, own in both]
                volts = [f.where(lag > 0.0, own, v) for v, own in both]
            from_left, from_right = (
                p[gain] * v * (1.0 + curve * (v / 5.0 - 1.0)) * (1.0 - head * level)
                for gain, v, level in zip(("gain_left", "gain_right"), volts, x[:2], strict=True)
            )
            fall = left - right
            across = p["pipe"] * fall * (fall * fall + 1e-4) ** -0.25 + seep * fall
            surface = p["area_left"] * (1.0 + cone * (left - 0.3))
            drawn = out(right) + draw + hidden("tapping_consumer", pulses(f, t))
            lost = hidden("left_leak", partial(drained, left)) + hidden("overflow", partial(spilt, left))
            lost = lost + hidden("backflow", lambda coefficient: drained(left, f.where(u[0] < 0.5, coefficient, 0.0)))
            tired = hidden("tiring_pump", lambda share, time: share * (1.0 - f.exp(-t / time)))
            return [
                (from_left + push[0] - across - lost) / surface,
                (from_right * (1.0 - tired) + push[1] + across - drawn) / p["area_right"],
                *slopes,
            ]

        def look(t: float, x: Any, push: Any) -> list[Any]:
            slosh = hidden("sloshing_gauge", lambda amplitude, period: amplitude * f.sin(2.0 * math.pi * t / period))
            return [x[0], x[1] + slosh, out(x[1])]

        return rate, look

    def drive(self, rng: Random) -> Array:
        """Return voltages of both pumps, corrected to keep nominal tanks half full."""
        pumps = kept_level(self.exact_drive(rng), np.array(self.rest), 0.45, 120.0, self.step)
        pumps[: self.rest_rows] = 5.0
        return rounded(pumps)


class Cart(Rig):
    """Cart driven by a force; outputs position, angle of the bob and angular rate."""

    name, model = "cart", "Cart"
    states = {"position": 1.0, "velocity": 1.0, "angle": 0.3, "rate": 1.0}
    inputs = {"force": 0.0}
    outputs = {"position": 2e-3, "angle": 5e-3, "rate": 0.05}
    sheet = {
        "cart_mass": (1.0, 0.05), "bob_mass": (0.3, 0.1), "length": (0.5, 0.02), "cart_friction": (2.0, 0.3),
        "pivot_friction": (0.008, 0.3),
    }  # fmt: skip
    constants = {"gravity": 9.81}
    entries = {
        "force_dead_band": Entry("width", 0.1, 0.01, 1.0),
        "force_asymmetry": Entry("ratio", 0.02, 1e-3, 0.3, signed=True),
        "motor_lag": Entry("time", 0.01, 5e-3, 0.3),
        "cart_coulomb": Entry("level", 0.1, 0.01, 1.0),
        "cart_drag": Entry("coefficient", 0.1, 0.01, 3.0),
        "cable_spring": Entry("stiffness", 0.05, 5e-3, 3.0),
        "belt_ripple": Entry("sine cosine", 0.1, 0.01, 1.0),
        "pivot_coulomb": Entry("level", 2e-3, 1e-4, 0.04),
        "bob_drag": Entry("coefficient", 1e-3, 1e-4, 0.03),
        "track_tilt": Entry("angle", 3e-3, 2e-4, 0.06, signed=True),
        "position_scale": sensor("position", "scale", 0.01, 1e-3, 0.2),
        "gyro_bias": sensor("rate", "bias", 3e-3, 2e-4, 0.2),
        "camera_latency": sensor("position", "late", 0.05, 0.03, 0.08),
    }
    outside = {
        "rubbing_side": Entry("coefficient", 0.2, 0.01, 2.0),
        "draught": Entry("force", 0.05, 3e-3, 0.6, shape={"period": (7.0, 11.0), "length": (2.0, 4.0)}),
        "magnet": Entry("moment", 0.02, 1e-3, 0.3, shape={"width": (0.05, 0.1)}),
        "tight_zone": Entry("coefficient", 0.5, 0.02, 8.0, shape={"place": (-0.2, 0.2), "width": (0.1, 0.2)}),
        "wavy_potentiometer": Entry("amplitude", 3e-3, 3e-4, 0.06, shape={"waves": (15.0, 25.0)}),
    }
    families = (
        frozenset({"cart_coulomb", "cart_drag", "force_dead_band"}),
        frozenset({"pivot_coulomb", "bob_drag"}),
        frozenset({"motor_lag", "camera_latency"}),
    )
    own_states = {"motor_lag": {"motor_lag.force": 0.0}}
    manoeuvres, rest_rows = ((-4.0, 4.0, (0.1, 2.5)),), 15  # [N]
    pushes, correlation_time = (8.0, 2.0), 1.0
    moves = (0.5, 0.4, 0.15, 0.5)
    step, rows, horizon, preroll = 0.02, 2000, 2.0, 0.2
    substeps = 4

    def bind(self, f: Any, p: Flat) -> tuple[Rate, Look]:
        """Return the equations; pushes are a force on the cart and a horizontal force on the bob."""
        cart, bob, length, g = p["cart_mass"], p["bob_mass"], p["length"], p["gravity"]
        hidden, tilt = hidden_in(p), p.get("track_tilt.angle", 0.0)
        tilt_sin, tilt_cos = f.sin(tilt), f.cos(tilt)
        band, uneven = p.get("force_dead_band.width"), p.get("force_asymmetry.ratio", 0.0)
        lag = p.get("motor_lag.time")

        def bell(away: Any, width: Any) -> Any:
            return f.exp(-((away / width) ** 2))

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            q, v, phi, w = x[:4]
            sin, cos = f.sin(phi), f.cos(phi)
            force = u[0] if band is None else u[0] - band * f.tanh(u[0] / (band + 0.02))
            force = force + uneven * f.absolute(force)
            slopes = [] if lag is None else [(force - x[4]) / f.maximum(lag, 0.005)]
            pull = force if lag is None else f.where(lag > 0.0, x[4], force)
            blown = hidden("draught", pulses(f, t))
            along = pull + push[0] + push[1] - p["cart_friction"] * v + blown
            about = length * cos * push[1] - p["pivot_friction"] * w + length * cos * blown
            along = along - hidden("cart_coulomb", lambda level: level * f.tanh(v / 0.02))
            along = along - hidden("cart_drag", lambda coefficient: coefficient * v * f.absolute(v))
            along = along - hidden("rubbing_side", lambda coefficient: coefficient * f.minimum(v, 0.0))
            along = along - hidden(
                "tight_zone", lambda coefficient, place, width: coefficient * v * bell(q - place, width)
            )
            along = along - hidden("cable_spring", lambda stiffness: stiffness * q)
            wave = 20.0 * math.pi * q
            along = along + hidden("belt_ripple", lambda sine, cosine: sine * f.sin(wave) + cosine * f.cos(wave))
            about = about - hidden("pivot_coulomb", lambda level: level * f.tanh(w / 0.1))
            about = about - hidden("bob_drag", lambda coefficient: coefficient * w * f.absolute(w))
            about = about - hidden("magnet", lambda moment, width: moment * phi / width * bell(phi, width))
            along = along - (cart + bob) * g * tilt_sin
            about = about - bob * g * length * (sin * tilt_cos + cos * tilt_sin)
            # [m11 m12; m12 m22]·(v̇, ẇ) = (along + centrifugal, about)
            along = along + bob * length * w * w * sin
            m11, m12, m22 = cart + bob, bob * length * cos, bob * length * length
            determinant = m11 * m22 - m12 * m12
            return [v, (along * m22 - about * m12) / determinant, w, (about * m11 - along * m12) / determinant, *slopes]

        def look(t: float, x: Any, push: Any) -> list[Any]:
            wave = hidden("wavy_potentiometer", lambda amplitude, waves: amplitude * f.sin(waves * x[2]))
            return [x[0], x[2] + wave, x[3]]

        return rate, look

    def drive(self, rng: Random) -> Array:
        """Return forces, with feedback of a nominal cart to the rail's centre."""
        force = self.exact_drive(rng)[:, 0]
        x = v = 0.0
        for k in range(self.rest_rows, self.rows):
            force[k] = min(max(0.8 * force[k] - 1.5 * x, -4.0), 4.0)
            x, v = x + self.step * v, v + self.step * (force[k] - 2.0 * v) / 1.3
        return rounded(force[:, None])


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
        "body_mass": (300.0, 0.05), "wheel_mass": (40.0, 0.1), "spring": (18000.0, 0.05), "damping": (1200.0, 0.3),
        "tyre": (180000.0, 0.15), "table_lag": (0.02, 0.2),
    }  # fmt: skip
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
        "travel_scale": sensor("travel", "scale", 0.01, 1e-3, 0.2),
        "accelerometer_bias": sensor("body_acceleration", "bias", 0.01, 1e-3, 0.5),
        "laser_latency": sensor("body_height", "late", 0.01, 7.5e-3, 0.02),
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
    manoeuvres, rest_rows = ((-0.03, 0.03, (0.06, 1.5)),), 20  # [m]
    pushes, correlation_time = (1080.0, 10800.0), 0.3
    moves = (0.01, 0.1, 0.01, 0.1, 0.0)
    step, rows, horizon, preroll = 0.005, 3000, 1.0, 0.1
    substeps = 2

    def bind(self, f: Any, p: Flat) -> tuple[Rate, Look]:
        """Return the equations; pushes are upward forces on body and wheel."""
        hidden, stiff, get = hidden_in(p), p["spring"], p.get
        gain, load, rubber = (get(n, 0.0) for n in ("road_gain.gain", "preload.force", "tyre_damping.coefficient"))
        mount, slew, mass = get("damper_mount.time"), get("table_slew.speed"), get("passenger.mass")

        def carried(x: Any, mass: Any, frequency: Any) -> Any:
            stiffness, damping = mass * (2.0 * math.pi * frequency) ** 2, 0.4 * mass * 2.0 * math.pi * frequency
            return stiffness * (x[-2] - x[0]) + damping * (x[-1] - x[1])

        def forces(t: float, x: Any) -> tuple[Any, Any, Any]:
            """Return the forces of the suspension, of the damper before its mount, and of the passenger."""
            z, v = x[2] - x[0], x[3] - x[1]
            groove = hidden("bypass_grooves", lambda depth, width: depth * f.exp(-((z / width) ** 2)))
            fade = hidden("fading_damper", lambda share, time: share * (1.0 - f.exp(-t / time)))
            damper = p["damping"] * v * (1.0 - groove) * (1.0 - fade)
            damper = damper - hidden("damper_asymmetry", lambda coefficient: coefficient * f.absolute(v))
            damper = damper + hidden("damper_coulomb", lambda level: level * f.tanh(v / 0.02))
            damper = damper + hidden("damper_progression", lambda coefficient: coefficient * v * f.absolute(v))
            spring = stiff * z + hidden("cubic_spring", lambda stiffness: stiffness * z**3)
            spring = spring + hidden("bump_stop", lambda stiffness: stiffness * f.maximum(z - 0.025, 0.0) ** 2)
            spring = spring - hidden("spring_play", lambda width: stiff * width * f.tanh(z / (width + 1e-5)))
            passed = damper if mount is None else f.where(mount > 0.0, x[5], damper)
            return spring + passed, damper, hidden("passenger", partial(carried, x))

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            hunt = hidden(
                "hunting_table", lambda amplitude, frequency: amplitude * f.sin(2.0 * math.pi * frequency * t)
            )
            table = (u[0] * (1.0 + gain) + hunt - x[4]) / p["table_lag"]
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
