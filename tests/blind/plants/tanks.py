"""Two tanks, each filled by a pump, joined by a pipe; the right tank empties through an outlet with a flow meter.

Levels are about 0.1 m to 0.5 m, pumps deliver up to 0.1 L/s. Time constants are minutes; a row is a second.
"""

from dataclasses import dataclass

from cosim.model import (
    Bias,
    Equations,
    FirstOrderLag,
    Latency,
    LocalEffect,
    Model,
    Namespace,
    Number,
    Quantity,
    Scale,
    Values,
    parameter,
    size,
)

SHALLOW = 1e-3  # [m] below which a tank presses nothing out
EDGE = 0.42  # [m] at which the left tank spills
USUAL = 5.0  # [V] at which the pumps were measured
DEEP = 0.25  # [m] at which the outlet was measured
SENSOR_VARIANCE = {"level_left": 4e-6, "level_right": 4e-6, "outflow": 1e-12}
START_VARIANCE = {"level_left": 0.01, "level_right": 0.01}


def overflow(e: LocalEffect, m: Namespace, flow: Number, left: Number, right: Number) -> Number:
    """Return the flow with k·max(h − 0.42, 0)^1.5."""
    above = m.maximum(left - EDGE, 0.0)
    return flow + e.coefficient * above * m.sqrt(above + 1e-9)


CATALOGUE = (
    LocalEffect.named(
        "pump_dead_band", place="voltage", equation="max(u − w, 0) in place of u, both pumps",
        width=size("V", (0, 3), 0.3, "dead band w"), change=lambda e, m, u: m.maximum(u - e.width, 0.0),
    ),
    FirstOrderLag.named(
        "pump_lag", place="voltage", shortest=0.5, time=size("s", (0, 60), 4.0, "time constant τ; 0 = off"),
        states=(
            Quantity("left", "V", "left voltage after the lag", USUAL),
            Quantity("right", "V", "right voltage after the lag", USUAL),
        ),
    ),
    LocalEffect.named(
        "pump_curve", place="inflow", equation="flow of each pump · (1 + p·(u − 5)/5)",
        curvature=size("1", (-0.5, 0.5), 0.1, "curvature p"),
        change=lambda e, m, flow, u, level: flow * (1.0 + e.curvature * (u - USUAL) / USUAL),
    ),
    LocalEffect.named(
        "head_loss", place="inflow", equation="flow of each pump · (1 − k·h)",
        slope=size("1/m", (0, 1.5), 0.2, "loss k per level"),
        change=lambda e, m, flow, u, level: flow * (1.0 - e.slope * level),
    ),
    LocalEffect.named(
        "outlet_exponent", place="outlet", equation="flow through the outlet · (h/0.25)^e",
        excess=size("1", (-0.4, 0.6), 0.1, "e beside one half"),
        change=lambda e, m, flow, level: flow * (m.maximum(level, SHALLOW) / DEEP) ** e.excess,
    ),
    LocalEffect.named(
        "left_leak", place="left", equation="flow k·√h out of the left tank",
        coefficient=size("m3/s", (0, 1e-4), 5e-6, "flow k at a level of 1 m"),
        change=lambda e, m, flow, left, right: flow + e.coefficient * m.sqrt(m.maximum(left, SHALLOW)),
    ),
    LocalEffect.named(
        "constant_draw", place="right", equation="flow q out of the right tank, beside the meter",
        flow=size("m3/s", (-3e-5, 3e-5), 2e-6, "flow q"), change=lambda e, m, flow: flow + e.flow,
    ),
    LocalEffect.named(
        "overflow", place="left", equation="flow k·max(h − 0.42, 0)^1.5 out of the left tank",
        coefficient=size("m3/s", (0, 0.02), 3e-4, "flow k at 1 m above the notch"), change=overflow,
    ),
    LocalEffect.named(
        "cross_flow", place="pipe", equation="flow k·(h_l − h_r) from left to right",
        coefficient=size("m2/s", (0, 1e-3), 2e-5, "flow k per level"),
        change=lambda e, m, flow, fall: flow + e.coefficient * fall,
    ),
)  # fmt: skip
SENSORS = (
    Scale.named(
        "meter_scale", output="outflow",
        value=parameter(1.0, unit="1", bounds=(0.5, 2), neutral=1.0, typical=0.05, doc="scale s"),
    ),
    Bias.named("meter_bias", output="outflow", value=size("m3/s", (-3e-5, 3e-5), 2e-6, "bias b")),
    Bias.named("left_gauge_bias", output="level_left", value=size("m", (-0.1, 0.1), 0.01, "bias b")),
    Latency.named(
        "left_gauge_latency", outputs=("level_left",), value=size("s", (0, 25), 3.0, "latency T of the readings")
    ),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Tanks(Model):
    """Two tanks, two pumps, a pipe and an outlet."""

    title = "Coupled tanks"
    base_states = (
        Quantity("level_left", "m", "level of the left tank", 0.3),
        Quantity("level_right", "m", "level of the right tank", 0.25),
    )
    inputs = (
        Quantity("pump_left", "V", "voltage of the left pump", USUAL),
        Quantity("pump_right", "V", "voltage of the right pump", USUAL),
    )
    outputs = (*base_states, Quantity("outflow", "m3/s", "flow through the outlet"))
    catalogue, sensors = CATALOGUE, SENSORS
    places = ("voltage", "inflow", "outlet", "pipe", "left", "right")
    sensor_variance, start_variance = SENSOR_VARIANCE, START_VARIANCE
    forced = ("level_left", "level_right")
    calibrated = ("area_left", "area_right", "pipe", "outlet", "gain_left", "gain_right")
    rate, substep, horizon = 1.0, 0.25, 40.0

    area_left: float = parameter(0.02, unit="m2", bounds=(1e-3, 1), tolerance=0.03, doc="surface of the left tank")
    area_right: float = parameter(0.02, unit="m2", bounds=(1e-3, 1), tolerance=0.03, doc="surface of the right tank")
    pipe: float = parameter(1.2e-4, unit="m3/s", bounds=(1e-6, 1e-2), tolerance=0.3, doc="flow through it at 1 m")
    outlet: float = parameter(1.2e-4, unit="m3/s", bounds=(1e-6, 1e-2), tolerance=0.2, doc="flow through it at 1 m")
    gain_left: float = parameter(6e-6, unit="m3/s/V", bounds=(1e-7, 1e-3), tolerance=0.1, doc="flow of its pump")
    gain_right: float = parameter(6e-6, unit="m3/s/V", bounds=(1e-7, 1e-3), tolerance=0.1, doc="flow of its pump")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace.

        A_l·ḣ_l = g_l·u_l − p − flows of the effects,  p = c_p·Δ/(Δ² + 10⁻⁴)^¼,  Δ = h_l − h_r
        A_r·ḣ_r = g_r·u_r + p − c_o·√h_r − flows of the effects
        """
        at, gains = self.effects_at(m), (self.gain_left, self.gain_right)

        def outflow(level: Number) -> Number:
            return at("outlet", self.outlet * m.sqrt(m.maximum(level, SHALLOW)), level)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            left, right, *own = state
            volts, slopes = self.lag_at(m, "voltage", tuple(at("voltage", u) for u in command), tuple(own))
            from_left, from_right = (
                at("inflow", gain * u, u, level) for gain, u, level in zip(gains, volts, (left, right), strict=True)
            )
            fall = left - right
            through = at("pipe", self.pipe * fall / m.sqrt(m.sqrt(fall * fall + 1e-4)), fall)
            into_left = from_left - at("left", through, left, right)
            into_right = from_right + through - at("right", outflow(right))
            return into_left / self.area_left, into_right / self.area_right, *slopes

        def output(t: Number, state: Values, command: Values) -> Values:
            return state[0], state[1], outflow(state[1])

        return Equations(derivative, output)
