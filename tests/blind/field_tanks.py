"""Independent equations of the tanks: balance of volumes."""

# ruff: noqa: RUF012 - what a rig declares are ClassVars of its base
from __future__ import annotations

import math
from typing import Any

import numpy as np

from tests.blind.field_rig import Entry, Flat, Look, Rate, Rig, Sensor, manoeuvre, rounded


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
        "pump_dead_band": Entry(("width",), 0.1, (5e-3, 1.5)),
        "pump_lag": Entry(("time",), 2.0, (0.6, 30.0)),
        "pump_curve": Entry(("curvature",), 0.05, (2e-3, 0.3), signed=True),
        "head_loss": Entry(("slope",), 0.1, (5e-3, 1.0)),
        "outlet_exponent": Entry(("excess",), 0.05, (2e-3, 0.35), signed=True),
        "left_leak": Entry(("coefficient",), 3e-6, (1e-7, 5e-5)),
        "constant_draw": Entry(("flow",), 1e-6, (5e-8, 2e-5), signed=True),
        "overflow": Entry(("coefficient",), 5e-4, (1e-5, 1e-2)),
        "cross_flow": Entry(("coefficient",), 1e-5, (5e-7, 3e-4)),
        "left_gauge_bias": Entry(("value",), 3e-3, (1e-4, 0.06), signed=True),
        "meter_scale": Entry(("value",), 0.01, (5e-4, 0.2), signed=True, neutral=1.0),
        "meter_bias": Entry(("value",), 1e-6, (3e-8, 2e-5), signed=True),
        "left_gauge_latency": Entry(("value",), 2.5, (1.5, 4.0), fixed=True),
    }
    sensors = {
        "left_gauge_bias": Sensor("level_left", "bias"),
        "meter_scale": Sensor("outflow", "scale"),
        "meter_bias": Sensor("outflow", "bias"),
        "left_gauge_latency": Sensor("level_left", "late"),
    }
    outside = {
        "backflow": Entry(("coefficient",), 1e-5, (3e-7, 1e-4)),
        "tapping_consumer": Entry(
            ("flow",), 3e-6, (1e-7, 3e-5), shape={"period": (250.0, 400.0), "length": (60.0, 120.0)}
        ),
        "tiring_pump": Entry(("share",), 0.05, (5e-3, 0.8), shape={"time": (300.0, 900.0)}),
        "sloshing_gauge": Entry(("amplitude",), 1e-3, (1e-4, 0.03), shape={"period": (9.0, 15.0)}),
        "conical_tank": Entry(("slope",), 0.2, (5e-3, 1.5)),
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
        area_left, area_right, pipe, outlet = p["area_left"], p["area_right"], p["pipe"], p["outlet"]
        gains = p["gain_left"], p["gain_right"]
        band, time, curve, head = (
            get("pump_dead_band.width"),
            get("pump_lag.time"),
            get("pump_curve.curvature"),
            get("head_loss.slope"),
        )
        excess, leak, draw = get("outlet_exponent.excess"), get("left_leak.coefficient"), get("constant_draw.flow")
        spill, seep, back = get("overflow.coefficient"), get("cross_flow.coefficient"), get("backflow.coefficient")
        tap, tap_period, tap_length = (get(f"tapping_consumer.{n}") for n in ("flow", "period", "length"))
        tired, tire_time = get("tiring_pump.share"), get("tiring_pump.time")
        slosh, slosh_period = get("sloshing_gauge.amplitude"), get("sloshing_gauge.period")
        cone = get("conical_tank.slope")

        def out(level: Any) -> Any:
            wet = f.maximum(level, 1e-3)
            flow = outlet * f.sqrt(wet)
            return flow if excess is None else flow * (wet / 0.25) ** excess

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            left, right = x[0], x[1]
            volts, slopes = [u[0], u[1]], []
            if band is not None:
                volts = [f.maximum(v - band, 0.0) for v in volts]
            if time is not None:
                slopes = [(v - own) / f.maximum(time, 0.5) for v, own in zip(volts, x[2:], strict=True)]
                volts = [f.where(time > 0.0, own, v) for v, own in zip(volts, x[2:], strict=True)]
            flows = [g * v for g, v in zip(gains, volts, strict=True)]
            if curve is not None:
                flows = [q * (1.0 + curve * (v / 5.0 - 1.0)) for q, v in zip(flows, volts, strict=True)]
            if head is not None:
                flows = [flows[0] * (1.0 - head * left), flows[1] * (1.0 - head * right)]
            if tired is not None:
                flows = [flows[0], flows[1] * (1.0 - tired * (1.0 - f.exp(-t / tire_time)))]
            fall = left - right
            across = pipe * fall * (fall * fall + 1e-4) ** -0.25
            if seep is not None:
                across = across + seep * fall
            lost_left, lost_right = 0.0, out(right)
            if leak is not None:
                lost_left = lost_left + leak * f.sqrt(f.maximum(left, 1e-3))
            if spill is not None:
                above = f.maximum(left - 0.42, 0.0)
                lost_left = lost_left + spill * above * f.sqrt(above + 1e-9)
            if back is not None:
                lost_left = lost_left + f.where(u[0] < 0.5, back, 0.0) * f.sqrt(f.maximum(left, 1e-3))
            if draw is not None:
                lost_right = lost_right + draw
            if tap is not None:
                lost_right = lost_right + f.where(t % tap_period < tap_length, tap, 0.0)
            surface = area_left if cone is None else area_left * (1.0 + cone * (left - 0.3))
            return [
                (flows[0] + push[0] - across - lost_left) / surface,
                (flows[1] + push[1] + across - lost_right) / area_right,
                *slopes,
            ]

        def look(t: float, x: Any, push: Any) -> list[Any]:
            right = x[1] if slosh is None else x[1] + slosh * f.sin(2.0 * math.pi * t / slosh_period)
            return [x[0], right, out(x[1])]

        return rate, look

    def drive(self, rng: np.random.Generator) -> np.ndarray:
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

    def begin(self, rng: np.random.Generator) -> np.ndarray:
        """Return start levels, half full or near."""
        return np.array([0.3, 0.25]) + rng.choice([0.0, 1.0]) * rng.uniform(-0.08, 0.08, 2)
