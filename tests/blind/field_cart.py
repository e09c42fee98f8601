"""Independent equations of the cart: a linear system in both accelerations, solved by Cramer's rule."""

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


class Cart(Rig):
    """Cart driven by a force; outputs position, angle of the bob and angular rate."""

    name, model = "cart", "Cart"
    states = {"position": 1.0, "velocity": 1.0, "angle": 0.3, "rate": 1.0}
    inputs = {"force": 0.0}
    outputs = {"position": 2e-3, "angle": 5e-3, "rate": 0.05}
    sheet = {
        "cart_mass": (1.0, 0.05),
        "bob_mass": (0.3, 0.1),
        "length": (0.5, 0.02),
        "cart_friction": (2.0, 0.3),
        "pivot_friction": (0.008, 0.3),
    }
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
        "position_scale": Entry("value", 0.01, 1e-3, 0.2, signed=True, neutral=1.0),
        "gyro_bias": Entry("value", 3e-3, 2e-4, 0.2, signed=True),
        "camera_latency": Entry("value", 0.05, 0.03, 0.08, fixed=True),
    }
    sensors = {
        "position_scale": Sensor("position", "scale"),
        "gyro_bias": Sensor("rate", "bias"),
        "camera_latency": Sensor("position", "late"),
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
    pushes, correlation_time = (8.0, 2.0), 1.0
    step, rows, horizon, preroll = 0.02, 2000, 2.0, 0.2
    substeps = 4

    def bind(self, f: Any, p: Flat) -> tuple[Rate, Look]:
        """Return the equations; pushes are a force on the cart and a horizontal force on the bob."""
        cart, bob, length, g = p["cart_mass"], p["bob_mass"], p["length"], p["gravity"]
        tilt = p.get("track_tilt.angle", 0.0)
        tilt_sin, tilt_cos = f.sin(tilt), f.cos(tilt)

        def bell(away: Any, width: Any) -> Any:
            return f.exp(-((away / width) ** 2))

        winds = terms_in(p, {"draught": lambda t, force, period, length: f.where(t % period < length, force, 0.0)})
        wavy = terms_in(p, {"wavy_potentiometer": lambda phi, amplitude, waves: amplitude * f.sin(waves * phi)})
        pulls = {
            "cart_coulomb": lambda q, v, level: -level * f.tanh(v / 0.02),
            "cart_drag": lambda q, v, coefficient: -coefficient * v * f.absolute(v),
            "rubbing_side": lambda q, v, coefficient: -coefficient * f.minimum(v, 0.0),
            "tight_zone": lambda q, v, coefficient, place, width: -coefficient * v * bell(q - place, width),
            "cable_spring": lambda q, v, stiffness: -stiffness * q,
        }
        turns = {
            "pivot_coulomb": lambda phi, w, level: -level * f.tanh(w / 0.1),
            "bob_drag": lambda phi, w, coefficient: -coefficient * w * f.absolute(w),
            "magnet": lambda phi, w, moment, width: -moment * phi / width * bell(phi, width),
        }
        on_cart, on_bob = terms_in(p, pulls), terms_in(p, turns)
        band, uneven = p.get("force_dead_band.width"), p.get("force_asymmetry.ratio", 0.0)
        lag, sine, cosine = (p.get(n) for n in ("motor_lag.time", "belt_ripple.sine", "belt_ripple.cosine"))

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            q, v, phi, w = x[:4]
            sin, cos = f.sin(phi), f.cos(phi)
            force = u[0] if band is None else u[0] - band * f.tanh(u[0] / (band + 0.02))
            force = force + uneven * f.absolute(force)
            slopes = [] if lag is None else [(force - x[4]) / f.maximum(lag, 0.005)]
            pull = force if lag is None else f.where(lag > 0.0, x[4], force)
            blown = winds(0.0, t)
            along = pull + push[0] + push[1] - p["cart_friction"] * v + blown
            about = length * cos * push[1] - p["pivot_friction"] * w + length * cos * blown
            along, about = on_cart(along, q, v), on_bob(about, phi, w)
            if sine is not None:
                along = along + sine * f.sin(20.0 * math.pi * q) + cosine * f.cos(20.0 * math.pi * q)
            along = along - (cart + bob) * g * tilt_sin
            about = about - bob * g * length * (sin * tilt_cos + cos * tilt_sin)
            # [m11 m12; m12 m22]·(v̇, ẇ) = (along + centrifugal, about)
            along = along + bob * length * w * w * sin
            m11, m12, m22 = cart + bob, bob * length * cos, bob * length * length
            determinant = m11 * m22 - m12 * m12
            return [v, (along * m22 - about * m12) / determinant, w, (about * m11 - along * m12) / determinant, *slopes]

        def look(t: float, x: Any, push: Any) -> list[Any]:
            return [x[0], wavy(x[2], x[2]), x[3]]

        return rate, look

    def drive(self, rng: Random) -> Array:
        """Return forces up to ±4 N, held from 0.1 s to 2.5 s, plus feedback of a nominal cart to the rail's centre."""
        force = manoeuvre(rng, self.rows, self.step, (-4.0, 4.0), (0.1, 2.5))
        force[:15] = 0.0
        x = v = 0.0
        for k in range(15, self.rows):
            force[k] = min(max(0.8 * force[k] - 1.5 * x, -4.0), 4.0)
            x, v = x + self.step * v, v + self.step * (force[k] - 2.0 * v) / 1.3
        return rounded(force[:, None])

    def begin(self, rng: Random) -> Array:
        """Return a start state at rest at 0, or moving."""
        return moving(rng, 0.5, 0.4, 0.15, 0.5)
