"""Independent equations of the six plants whose FMUs are in `fmus/`, with their places and base parameters.

Parameters are named as in the FMU, with _ for every other character. Equations are written from energies and balances,
without the equations of the FMUs and without the project.
"""

# ruff: noqa: RUF012 - what a rig declares are attributes of its class
import math
from typing import Any

import numpy as np

from tests.blind.field_rig import Array, Entry, Flat, Random, Rate, kept_level, pulses, rounded
from tests.blind.fmu_rig import CoSimulation, FmuRig, Input, ModelExchange, Output, Pair, Storage

LAGS = "lag second_order_lag rate_limit"
STATIC = "dead_band saturation play"


class Drive(FmuRig):
    """Motor and load on an elastic shaft."""

    name = "drive"
    states = {"motor.phi": 1.0, "motor.w": 10.0, "load.phi": 1.0, "load.w": 10.0}
    plants_inputs = {"torque": Input(0.0, -2.0, 2.0, (0.05, 1.5), f"bias {STATIC} {LAGS}")}
    pairs = {
        "motor_w": Pair(2.0, 15.0, 1.0, "coulomb stribeck quadratic_drag cogging", True, "", (0.7, 2.0)),
        "load_w": Pair(2.0, 15.0, 1.0, "coulomb stribeck viscous quadratic_drag cogging", False, "load_J", (0.7, 2.0)),
    }
    plants_outputs = {
        "motor.phi": Output(0, 1e-2, 10.0, "scale lag"),
        "motor.w": Output(1, 0.3, 30.0, "bias scale lag drift"),
        "load.phi": Output(2, 1e-2, 10.0, "scale lag drift latency"),
    }
    strangers = {
        "brake": Entry("level", 0.1, 2e-3, 1.0, shape={"period": (2.5, 4.0), "length": (0.6, 1.2)}),
    }
    pushes, correlation_time = (2.0, 2.0), 0.2
    step, rows, horizon = 0.005, 2000, 0.5
    substeps = 2

    def equations(self, f: Any, p: Flat, acts: Any, hidden: Any) -> Rate:
        """Return the derivatives from the balance of momentum of both discs."""

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            a, wa, b, wb = x[:4]
            through = p["shaft_c"] * (a - b) + p["shaft_d"] * (wa - wb)
            slows = 0.03 * wb + acts("load_w", b, wb) + hidden("brake", pulses(f, t)) * f.tanh(wb / 0.3)
            from_motor = u[0] + push[0] - p["motor_b"] * wa - acts("motor_w", a, wa)
            return [wa, (from_motor - through) / p["motor_J"], wb, (through + push[1] - slows) / p["load_J"]]

        return rate

    def begin(self, rng: Random) -> Array:
        """Return a start at rest, or turning."""
        speed = float(rng.choice([0.0, 1.0]) * rng.uniform(-20.0, 20.0))
        return np.array([0.0, speed, 0.0, speed])


class DcMotor(FmuRig):
    """DC motor with a measured load torque."""

    name = "dc_motor"
    states = {"current": 1.0, "angle": 1.0, "speed": 50.0}
    plants_inputs = {
        "voltage": Input(0.0, -12.0, 12.0, (0.03, 1.0), f"bias gain {STATIC} {LAGS}"),
        "load_torque": Input(0.0, -0.04, 0.04, (0.1, 2.0), "gain dead_band lag"),
    }
    pairs = {
        "speed": Pair(0.1, 100.0, 1.0, "coulomb stribeck quadratic_drag cogging", True, "", (2 * math.pi / 7, 2.0)),
    }
    plants_outputs = {
        "current": Output(0, 0.03, 6.0, "bias scale lag drift"),
        "angle": Output(1, 0.05, 100.0, "scale lag latency"),
        "speed": Output(2, 1.0, 200.0, "bias scale lag drift"),
    }
    strangers = {"iron": Entry("share", 0.02, 1e-3, 0.6)}
    pushes, correlation_time = (12.0, 0.1), 0.2
    step, rows, horizon = 0.005, 2000, 0.5
    substeps = 2

    def equations(self, f: Any, p: Flat, acts: Any, hidden: Any) -> Rate:
        """Return the derivatives from flux linkage and momentum."""

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            i, angle, w = x[:3]
            flux = p["constant"] * (1.0 - hidden("iron", lambda share: share * (i / 5.0) ** 2))
            voltage = u[0] + push[0] - flux * w
            torque = flux * i + push[1] - u[1] - acts("speed", angle, w)
            faster = torque / p["inertia"] - p["damping"] / p["inertia"] * w
            return [voltage / p["inductance"] - p["resistance"] / p["inductance"] * i, w, faster]

        return rate

    def begin(self, rng: Random) -> Array:
        """Return a start at rest, or turning."""
        return np.array([0.0, 0.0, float(rng.choice([0.0, 1.0]) * rng.uniform(-150.0, 150.0))])


class Tanks(FmuRig):
    """Two tanks joined by a pipe."""

    name = "tanks"
    states = {"left.h": 0.1, "right.h": 0.1}
    plants_inputs = {
        name: Input(5.0, 0.0, 10.0, (8.0, 150.0), f"bias {STATIC} {LAGS}") for name in ("pump_left", "pump_right")
    }
    storages = {
        "left_h": Storage(0.3, 0.4, 3e-3, "leak overflow"),
        "right_h": Storage(0.25, 0.33, 3e-3, "leak overflow"),
    }
    plants_outputs = {
        "gauge_left": Output(0, 1e-3, 0.2, "bias scale lag drift latency"),
        "gauge_right": Output(1, 1e-3, 0.2, "bias scale lag drift"),
    }
    strangers = {
        "cone": Entry("slope", 0.2, 5e-3, 1.8),
        "tap": Entry("flow", 3e-6, 1e-7, 4e-5, shape={"period": (250.0, 400.0), "length": (60.0, 120.0)}),
    }
    moves = (0.06, 0.06)
    pushes, correlation_time = (6e-5, 6e-5), 30.0
    step, rows, horizon = 1.0, 1800, 40.0
    substeps = 1

    def equations(self, f: Any, p: Flat, acts: Any, hidden: Any) -> Rate:
        """Return the derivatives from the balance of volume."""

        def orifice(k: Any, head: Any) -> Any:
            return k * head * (1e-4 + head * head) ** -0.25

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            left, right = x[0], x[1]
            pipe = orifice(p["pipe_k"], left - right)
            out = orifice(p["outlet_k"], right) + hidden("tap", pulses(f, t))
            area = p["left_area"] * (1.0 + hidden("cone", lambda slope: slope * (left - 0.3)))
            return [
                (p["gain_left"] * u[0] + push[0] - pipe) / area - acts("left_h", left),
                (p["gain_right"] * u[1] + push[1] + pipe - out) / p["right_area"] - acts("right_h", right),
            ]

        return rate

    def drive(self, rng: Random) -> Array:
        """Return voltages that keep nominal tanks from running over and dry."""
        pumps = kept_level(super().drive(rng), np.array(self.rest), 0.42, 100.0, self.step)
        pumps[: self.rest_rows] = 5.0
        return rounded(pumps)


class HeatedBox(FmuRig):
    """Box with a heater, in a room."""

    name = "heated_box"
    states = {"T_heater": 10.0, "T_air": 10.0}
    plants_inputs = {
        "heater": Input(0.0, 0.0, 1.0, (20.0, 250.0), f"dead_band saturation play {LAGS}"),
        "T_room": Input(295.0, 292.0, 298.0, (100.0, 600.0)),
    }
    plants_outputs = {
        "T_heater": Output(0, 0.1, 40.0, "bias lag drift"),
        "T_air": Output(1, 0.05, 30.0, "bias lag drift latency"),
    }
    strangers = {
        "radiation": Entry("share", 0.02, 1e-3, 1.0),
        "door": Entry("conductance", 0.1, 5e-3, 3.0, shape={"period": (500.0, 800.0), "length": (60.0, 150.0)}),
    }
    pushes, correlation_time = (100.0, 100.0), 60.0
    step, rows, horizon = 2.0, 1500, 100.0
    substeps = 1

    def equations(self, f: Any, p: Flat, acts: Any, hidden: Any) -> Rate:
        """Return the derivatives from the balance of heat."""

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            hot, air = x[0], x[1]
            given = p["G_heater"] * (1.0 + hidden("radiation", lambda share: share * (hot - air) / 30.0)) * (hot - air)
            lost = (p["G_wall"] + hidden("door", pulses(f, t))) * (air - u[1])
            return [(p["power"] * u[0] + push[0] - given) / p["C_heater"], (given + push[1] - lost) / p["C_air"]]

        return rate

    def begin(self, rng: Random) -> Array:
        """Return a start at the temperature of the room, or warm."""
        warm = float(rng.choice([0.0, 1.0]))
        return np.array(self.rest) + warm * np.array([rng.uniform(5.0, 30.0), rng.uniform(5.0, 20.0)])


class Pendulum(FmuRig):
    """Cart on a spring with a hanging pendulum."""

    name = "pendulum"
    states = {"x": 0.3, "v": 0.5, "phi": 0.3, "w": 1.0}
    plants_inputs = {"force": Input(0.0, -4.0, 4.0, (0.2, 3.0), f"{STATIC} {LAGS}")}
    pairs = {
        "v": Pair(4.0, 1.0, 1.0, "coulomb stribeck quadratic_drag cubic_spring cogging", True, "", (0.3, 0.6)),
        "w": Pair(1.0, 2.0, 0.5, "coulomb quadratic_drag"),
    }
    plants_outputs = {
        "x": Output(0, 2e-3, 1.5, "scale lag"),
        "phi": Output(2, 3e-3, 0.8, "bias scale lag drift latency"),
    }
    strangers = {
        "magnet": Entry("force", 0.1, 2e-3, 2.0, shape={"place": (-0.5, 0.5), "width": (0.1, 0.2)}),
    }
    moves = (0.4, 0.5, 0.4, 1.5)
    pushes, correlation_time = (4.0, 1.0), 1.0
    step, rows, horizon = 0.02, 2000, 2.0
    substeps = 2

    def equations(self, f: Any, p: Flat, acts: Any, hidden: Any) -> Rate:
        """Return the derivatives by elimination of the force in the rod.

        Along the rod and across it: l·w' = −g·sin φ − v'·cos φ + hinge/(m·l), and the cart feels the rod.
        """
        mass, bob, length = p["cart"], p["bob"], p["length"]

        def attracted(force: Any, off: Any) -> Any:
            return force * off * f.exp(-off * off)

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            q, v, phi, w = x[:4]
            sin, cos = f.sin(phi), f.cos(phi)
            hinge = push[1] - p["hinge"] * w - acts("w", phi, w)
            outer = u[0] + push[0] - p["spring"] * q - p["rub"] * v - acts("v", q, v)
            outer = outer - hidden("magnet", lambda force, place, width: attracted(force, (q - place) / width))
            bent = bob * sin * (length * w * w + 9.81 * cos) - hinge * cos / length
            faster = (outer + bent) / (mass + bob * sin * sin)
            return [v, faster, w, (hinge / (bob * length) - 9.81 * sin - faster * cos) / length]

        return rate


class Cylinder(FmuRig):
    """Hydraulic cylinder with a valve, against a spring and a measured force."""

    name = "cylinder"
    states = {"piston.x": 0.02, "piston.v": 0.1, "p_a": 2e5, "p_b": 2e5}
    plants_inputs = {
        "valve": Input(0.0, -0.6, 0.6, (0.03, 0.6), f"bias {STATIC} {LAGS}"),
        "load": Input(0.0, -300.0, 300.0, (0.1, 1.5), "gain dead_band lag"),
    }
    pairs = {
        "piston_v": Pair(1500.0, 0.1, 0.05, "coulomb stribeck quadratic_drag cubic_spring", True),
    }
    storages = {"p_a": Storage(1e6, 1.5e6, 1e7, "leak"), "p_b": Storage(1e6, 1.5e6, 1e7, "leak")}
    plants_outputs = {
        "piston.x": Output(0, 2e-4, 0.1, "scale lag latency"),
        "p_a": Output(2, 5e3, 1e6, "bias scale lag drift"),
        "p_b": Output(3, 5e3, 1e6, "bias scale lag drift"),
    }
    strangers = {"foam": Entry("share", 0.05, 2e-3, 0.9)}
    moves = (0.01, 0.1, 1e5, 1e5)
    pushes, correlation_time = (1500.0,), 0.3
    step, rows, horizon = 0.005, 2000, 0.5
    substeps = 4

    def equations(self, f: Any, p: Flat, acts: Any, hidden: Any) -> Rate:
        """Return the derivatives from momentum and the balance of volume of both chambers."""

        def orifice(opening: Any, head: Any) -> Any:
            return p["valve_k"] * opening * head * (4e8 + head * head) ** -0.25

        def stiff(pressure: Any) -> Any:
            return p["bulk"] * (1.0 - hidden("foam", lambda share: share * f.exp(-pressure / 5e5)))

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            q, v, a, b = x[:4]
            out, back = f.maximum(u[0], 0.0), f.maximum(-u[0], 0.0)
            flow_a = orifice(out, p["supply"] - a) - orifice(back, a)
            flow_b = orifice(back, p["supply"] - b) - orifice(out, b)
            force = 1e-3 * (a - b) - u[1] + push[0] - p["spring"] * q - p["damping"] * v - acts("piston_v", q, v)
            return [
                v,
                force / p["mass"],
                stiff(a) * (flow_a - 1e-3 * v) / (5e-4 + 1e-3 * q) - acts("p_a", a),
                stiff(b) * (flow_b + 1e-3 * v) / (5e-4 - 1e-3 * q) - acts("p_b", b),
            ]

        return rate


CLASSES: tuple[type[FmuRig], ...] = (Drive, DcMotor, Tanks, HeatedBox, Pendulum, Cylinder)
RIGS = {(rig.name, way): rig(way) for rig in CLASSES for way in (ModelExchange, CoSimulation)}
