"""Independent equations of the cart: a linear system in both accelerations, solved by Cramer's rule."""

# ruff: noqa: RUF012 - what a rig declares are ClassVars of its base
from __future__ import annotations

import math
from typing import Any

import numpy as np

from tests.blind.field_rig import Entry, Flat, Look, Rate, Rig, Sensor, manoeuvre, rounded


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
        "force_dead_band": Entry(("width",), 0.1, (0.01, 1.0)),
        "force_asymmetry": Entry(("ratio",), 0.02, (1e-3, 0.3), signed=True),
        "motor_lag": Entry(("time",), 0.01, (5e-3, 0.3)),
        "cart_coulomb": Entry(("level",), 0.1, (0.01, 1.0)),
        "cart_drag": Entry(("coefficient",), 0.1, (0.01, 3.0)),
        "cable_spring": Entry(("stiffness",), 0.05, (5e-3, 3.0)),
        "belt_ripple": Entry(("sine", "cosine"), 0.1, (0.01, 1.0)),
        "pivot_coulomb": Entry(("level",), 2e-3, (1e-4, 0.04)),
        "bob_drag": Entry(("coefficient",), 1e-3, (1e-4, 0.03)),
        "track_tilt": Entry(("angle",), 3e-3, (2e-4, 0.06), signed=True),
        "position_scale": Entry(("value",), 0.01, (1e-3, 0.2), signed=True, neutral=1.0),
        "gyro_bias": Entry(("value",), 3e-3, (2e-4, 0.2), signed=True),
        "camera_latency": Entry(("value",), 0.05, (0.03, 0.08), fixed=True),
    }
    sensors = {
        "position_scale": Sensor("position", "scale"),
        "gyro_bias": Sensor("rate", "bias"),
        "camera_latency": Sensor("position", "late"),
    }
    outside = {
        "rubbing_side": Entry(("coefficient",), 0.2, (0.01, 2.0)),
        "draught": Entry(("force",), 0.05, (3e-3, 0.6), shape={"period": (7.0, 11.0), "length": (2.0, 4.0)}),
        "magnet": Entry(("moment",), 0.02, (1e-3, 0.3), shape={"width": (0.05, 0.1)}),
        "tight_zone": Entry(("coefficient",), 0.5, (0.02, 8.0), shape={"place": (-0.2, 0.2), "width": (0.1, 0.2)}),
        "wavy_potentiometer": Entry(("amplitude",), 3e-3, (3e-4, 0.06), shape={"waves": (15.0, 25.0)}),
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
        get = p.get
        cart, bob, length, g = p["cart_mass"], p["bob_mass"], p["length"], p["gravity"]
        b, c = p["cart_friction"], p["pivot_friction"]
        band, uneven, time = get("force_dead_band.width"), get("force_asymmetry.ratio"), get("motor_lag.time")
        dry, drag, cable = get("cart_coulomb.level"), get("cart_drag.coefficient"), get("cable_spring.stiffness")
        sine, cosine = get("belt_ripple.sine"), get("belt_ripple.cosine")
        dry_pivot, stir, tilt = get("pivot_coulomb.level"), get("bob_drag.coefficient"), get("track_tilt.angle")
        rub, magnet, magnet_width = get("rubbing_side.coefficient"), get("magnet.moment"), get("magnet.width")
        wind, period, blow = (get(f"draught.{n}") for n in ("force", "period", "length"))
        zone, place, width = (get(f"tight_zone.{n}") for n in ("coefficient", "place", "width"))
        wavy, waves = get("wavy_potentiometer.amplitude"), get("wavy_potentiometer.waves")

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            place_now, v, phi, w = x[0], x[1], x[2], x[3]
            force, slopes = u[0], []
            if band is not None:
                force = force - band * f.tanh(force / (band + 0.02))
            if uneven is not None:
                force = force + uneven * f.absolute(force)
            if time is not None:
                slopes = [(force - x[4]) / f.maximum(time, 0.005)]
                force = f.where(time > 0.0, x[4], force)
            along = force + push[0] + push[1] - b * v
            about = length * f.cos(phi) * push[1] - c * w
            if wind is not None:
                blown = f.where(t % period < blow, wind, 0.0)
                along, about = along + blown, about + length * f.cos(phi) * blown
            if dry is not None:
                along = along - dry * f.tanh(v / 0.02)
            if drag is not None:
                along = along - drag * v * f.absolute(v)
            if rub is not None:
                along = along - rub * f.minimum(v, 0.0)
            if zone is not None:
                along = along - zone * v * f.exp(-(((place_now - place) / width) ** 2))
            if cable is not None:
                along = along - cable * place_now
            if sine is not None:
                phase = 20.0 * math.pi * place_now
                along = along + sine * f.sin(phase) + cosine * f.cos(phase)
            if dry_pivot is not None:
                about = about - dry_pivot * f.tanh(w / 0.1)
            if stir is not None:
                about = about - stir * w * f.absolute(w)
            if magnet is not None:
                about = about - magnet * phi / magnet_width * f.exp(-((phi / magnet_width) ** 2))
            sin, cos = f.sin(phi), f.cos(phi)
            if tilt is None:
                about = about - bob * g * length * sin
            else:
                along = along - (cart + bob) * g * f.sin(tilt)
                about = about - bob * g * length * (sin * f.cos(tilt) + cos * f.sin(tilt))
            # [m11 m12; m12 m22]·(v̇, ẇ) = (along + centrifugal, about)
            along = along + bob * length * w * w * sin
            m11, m12, m22 = cart + bob, bob * length * cos, bob * length * length
            determinant = m11 * m22 - m12 * m12
            return [v, (along * m22 - about * m12) / determinant, w, (about * m11 - along * m12) / determinant, *slopes]

        def look(t: float, x: Any, push: Any) -> list[Any]:
            angle = x[2] if wavy is None else x[2] + wavy * f.sin(waves * x[2])
            return [x[0], angle, x[3]]

        return rate, look

    def drive(self, rng: np.random.Generator) -> np.ndarray:
        """Return forces up to ±4 N, held from 0.1 s to 2.5 s, plus feedback of a nominal cart to the rail's centre."""
        force = manoeuvre(rng, self.rows, self.step, (-4.0, 4.0), (0.1, 2.5))
        force[:15] = 0.0
        x = v = 0.0
        for k in range(15, self.rows):
            force[k] = min(max(0.8 * force[k] - 1.5 * x, -4.0), 4.0)
            x, v = x + self.step * v, v + self.step * (force[k] - 2.0 * v) / 1.3
        return rounded(force[:, None])

    def begin(self, rng: np.random.Generator) -> np.ndarray:
        """Return a start state at rest at 0, or moving."""
        return rng.choice([0.0, 1.0]) * rng.uniform(-1.0, 1.0, 4) * [0.5, 0.4, 0.15, 0.5]
