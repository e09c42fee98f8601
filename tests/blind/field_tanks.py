"""Independent equations of the tanks: balance of volumes."""

# ruff: noqa: RUF012 - what a rig declares are attributes of its class
from __future__ import annotations

import math
from typing import Any

import numpy as np

from tests.blind.field_rig import Array, Entry, Flat, Look, Random, Rate, Rig, Sensor, manoeuvre, rounded, terms_in


class Tanks(Rig):
    """Tanks with two pump voltages; outputs two levels and a flow."""

    name, model = "tanks", "Tanks"
    states = {"level_left": 0.1, "level_right": 0.1}
    inputs = {"pump_left": 5.0, "pump_right": 5.0}
    outputs = {"level_left": 2e-3, "level_right": 2e-3, "outflow": 1e-6}
    sheet = {
        "area_left": (0.02, 0.03),
        "area_right": (0.02, 0.03),
        "pipe": (1.2e-4, 0.3),
        "outlet": (1.2e-4, 0.2),
        "gain_left": (6e-6, 0.1),
        "gain_right": (6e-6, 0.1),
    }
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
        "left_gauge_bias": Entry("value", 3e-3, 1e-4, 0.06, signed=True),
        "meter_scale": Entry("value", 0.01, 5e-4, 0.2, signed=True, neutral=1.0),
        "meter_bias": Entry("value", 1e-6, 3e-8, 2e-5, signed=True),
        "left_gauge_latency": Entry("value", 2.5, 1.5, 4.0, fixed=True),
    }
    sensors = {
        "left_gauge_bias": Sensor("level_left", "bias"),
        "meter_scale": Sensor("outflow", "scale"),
        "meter_bias": Sensor("outflow", "bias"),
        "left_gauge_latency": Sensor("level_left", "late"),
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
    pushes, correlation_time = (6e-5, 6e-5), 30.0
    step, rows, horizon, preroll = 1.0, 1800, 40.0, 30.0
    substeps = 2

    def bind(self, f: Any, p: Flat) -> tuple[Rate, Look]:
        """Return the equations: flows from the pumps, through the pipe and out of both tanks."""
        get = p.get
        head, seep, draw = (get(n, 0.0) for n in ("head_loss.slope", "cross_flow.coefficient", "constant_draw.flow"))
        band, lag, curve = get("pump_dead_band.width"), get("pump_lag.time"), get("pump_curve.curvature", 0.0)
        cone, excess = get("conical_tank.slope", 0.0), get("outlet_exponent.excess")

        def spilt(left: Any, u: Any, coefficient: Any) -> Any:
            above = f.maximum(left - 0.42, 0.0)
            return coefficient * above * f.sqrt(above + 1e-9)

        def drained(left: Any, u: Any, coefficient: Any) -> Any:
            return coefficient * f.sqrt(f.maximum(left, 1e-3))

        def back(left: Any, u: Any, coefficient: Any) -> Any:
            return drained(left, u, f.where(u[0] < 0.5, coefficient, 0.0))

        lost = terms_in(p, {"left_leak": drained, "overflow": spilt, "backflow": back})
        tap = {"tapping_consumer": lambda t, flow, period, length: f.where(t % period < length, flow, 0.0)}
        tire = {"tiring_pump": lambda t, share, time: share * (1.0 - f.exp(-t / time))}
        waves = {"sloshing_gauge": lambda t, amplitude, period: amplitude * f.sin(2.0 * math.pi * t / period)}
        tapped, tired, slosh = terms_in(p, tap), terms_in(p, tire), terms_in(p, waves)

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
            drawn = tapped(out(right) + draw, t)
            return [
                (from_left + push[0] - across - lost(0.0, left, u)) / surface,
                (from_right * (1.0 - tired(0.0, t)) + push[1] + across - drawn) / p["area_right"],
                *slopes,
            ]

        def look(t: float, x: Any, push: Any) -> list[Any]:
            return [x[0], slosh(x[1], t), out(x[1])]

        return rate, look

    def drive(self, rng: Random) -> Array:
        """Return voltages of both pumps, 0 to 10 V, held 8 s to 150 s, corrected to keep nominal tanks half full."""
        pumps = np.column_stack([manoeuvre(rng, self.rows, self.step, (0.0, 10.0), (8.0, 150.0)) for _ in range(2)])
        pumps[:5] = 5.0
        levels, gain, area = np.array([0.3, 0.25]), 6e-6, 0.02
        for row in pumps:  # on paper: keep the nominal tanks from overflowing and from running dry
            row += 6.0 * np.minimum(0.45 - levels, 0.0) / 0.05 + 6.0 * np.maximum(0.12 - levels, 0.0) / 0.05
            np.clip(row, 0.0, 10.0, out=row)
            fall = levels[0] - levels[1]
            across = 1.2e-4 * fall * (fall * fall + 1e-4) ** -0.25
            levels = levels + self.step / area * (
                gain * row + np.array([-across, across - 1.2e-4 * math.sqrt(max(levels[1], 1e-3))])
            )
        pumps[:5] = 5.0
        return rounded(pumps)

    def begin(self, rng: Random) -> Array:
        """Return start levels, half full or near."""
        return np.array([0.3, 0.25]) + rng.choice([0.0, 1.0]) * rng.uniform(-0.08, 0.08, 2)
