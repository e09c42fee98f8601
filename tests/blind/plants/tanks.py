"""Two tanks, each filled by a pump, joined by a pipe; the right tank empties through an outlet with a flow meter.

Levels are about 0.1 m to 0.5 m, pumps deliver up to 0.1 L/s. Time constants are minutes; a row is a second.
"""

from dataclasses import dataclass

from cosim.model import (
    Bias,
    Effect,
    Equations,
    Latency,
    Model,
    Namespace,
    Number,
    Quantity,
    Scale,
    Values,
    overrides,
    parameter,
)

SHALLOW = 1e-3  # [m] below which a tank presses nothing out
EDGE = 0.42  # [m] at which the left tank spills
USUAL = 5.0  # [V] at which the pumps were measured
DEEP = 0.25  # [m] at which the outlet was measured
SENSOR_VARIANCE = {"level_left": 4e-6, "level_right": 4e-6, "outflow": 1e-12}
START_VARIANCE = {"level_left": 0.01, "level_right": 0.01}
TOLD_APART_BY = {
    frozenset({"left_leak", "constant_draw", "cross_flow", "overflow"}): "levels from shallow to full, in both tanks",
    frozenset({"pump_dead_band", "pump_curve", "head_loss"}): "both pumps at several voltages, and off",
}


class TankEffect(Effect):
    """Flow or pump property that the base model lacks."""

    def voltage(self, m: Namespace, left: Number, right: Number) -> tuple[Number, Number]:
        """Return the effective voltages of the pumps for the commanded voltages."""
        return left, right

    def lag(
        self, m: Namespace, left: Number, right: Number, states: Values
    ) -> tuple[tuple[Number, Number], tuple[Number, Number]]:
        """Return the voltages after the lag of the pumps, and the derivatives of its two states."""
        raise NotImplementedError

    def factor(self, m: Namespace, voltage: Number, level: Number) -> Number:
        """Return a factor on the flow of a pump, from its voltage and the level of its tank."""
        return 1.0

    def outlet(self, m: Namespace, level: Number) -> Number:
        """Return a factor on the flow through the outlet, from the right level."""
        return 1.0

    def loss(self, m: Namespace, left: Number, right: Number) -> tuple[Number, Number]:
        """Return additional flows out of the left and the right tank [m3/s], from both levels."""
        return 0.0, 0.0


@dataclass(frozen=True, kw_only=True)
class PumpDeadBand(TankEffect):
    """Dead band of both pumps: max(u − w, 0)."""

    name = "pump_dead_band"
    equation = "max(u − w, 0) in place of u, both pumps"
    width: float = parameter(0.0, unit="V", bounds=(0, 3), neutral=0.0, typical=0.3, doc="dead band w")

    def voltage(self, m: Namespace, left: Number, right: Number) -> tuple[Number, Number]:
        return m.maximum(left - self.width, 0.0), m.maximum(right - self.width, 0.0)


@dataclass(frozen=True, kw_only=True)
class PumpLag(TankEffect):
    """Lag of both pumps: τ·q̇ = u − q."""

    name = "pump_lag"
    equation = "τ·q̇ = u − q, q in place of u, both pumps"
    states = (
        Quantity("left", "V", "left voltage after the lag", USUAL),
        Quantity("right", "V", "right voltage after the lag", USUAL),
    )
    time: float = parameter(0.0, unit="s", bounds=(0, 60), neutral=0.0, typical=4.0, doc="time constant τ; 0 = off")

    def lag(
        self, m: Namespace, left: Number, right: Number, states: Values
    ) -> tuple[tuple[Number, Number], tuple[Number, Number]]:
        """Return the lagged voltages and their derivatives; time constants below 0.5 s count as 0.5 s."""
        slow, tau = self.time > 0.0, m.maximum(self.time, 0.5)
        after = m.where(slow, states[0], left), m.where(slow, states[1], right)
        return after, ((left - states[0]) / tau, (right - states[1]) / tau)


@dataclass(frozen=True, kw_only=True)
class PumpCurve(TankEffect):
    """Nonlinear flow of both pumps over the voltage: factor 1 + p·(u − 5)/5."""

    name = "pump_curve"
    equation = "flow of each pump · (1 + p·(u − 5)/5)"
    curvature: float = parameter(0.0, unit="1", bounds=(-0.5, 0.5), neutral=0.0, typical=0.1, doc="curvature p")

    def factor(self, m: Namespace, voltage: Number, level: Number) -> Number:
        return 1.0 + self.curvature * (voltage - USUAL) / USUAL


@dataclass(frozen=True, kw_only=True)
class HeadLoss(TankEffect):
    """Loss of pump flow against the level of the tank: factor 1 − k·h."""

    name = "head_loss"
    equation = "flow of each pump · (1 − k·h)"
    slope: float = parameter(0.0, unit="1/m", bounds=(0, 1.5), neutral=0.0, typical=0.2, doc="loss k per level")

    def factor(self, m: Namespace, voltage: Number, level: Number) -> Number:
        return 1.0 - self.slope * level


@dataclass(frozen=True, kw_only=True)
class OutletExponent(TankEffect):
    """Deviating exponent of a rough or laminar outlet: c·√h·(h/0.25)^e."""

    name = "outlet_exponent"
    equation = "flow through the outlet · (h/0.25)^e"
    excess: float = parameter(0.0, unit="1", bounds=(-0.4, 0.6), neutral=0.0, typical=0.1, doc="e beside one half")

    def outlet(self, m: Namespace, level: Number) -> Number:
        return (m.maximum(level, SHALLOW) / DEEP) ** self.excess


@dataclass(frozen=True, kw_only=True)
class LeftLeak(TankEffect):
    """Leak of the left tank: k·√h."""

    name = "left_leak"
    equation = "flow k·√h out of the left tank"
    coefficient: float = parameter(
        0.0, unit="m3/s", bounds=(0, 1e-4), neutral=0.0, typical=5e-6, doc="flow k at a level of 1 m"
    )

    def loss(self, m: Namespace, left: Number, right: Number) -> tuple[Number, Number]:
        return self.coefficient * m.sqrt(m.maximum(left, SHALLOW)), 0.0


@dataclass(frozen=True, kw_only=True)
class ConstantDraw(TankEffect):
    """Constant flow out of the right tank, not measured by the meter."""

    name = "constant_draw"
    equation = "flow q out of the right tank"
    flow: float = parameter(0.0, unit="m3/s", bounds=(-3e-5, 3e-5), neutral=0.0, typical=2e-6, doc="flow q")

    def loss(self, m: Namespace, left: Number, right: Number) -> tuple[Number, Number]:
        return 0.0, self.flow


@dataclass(frozen=True, kw_only=True)
class Overflow(TankEffect):
    """Overflow of the left tank at a notch of 0.42 m: k·(h − 0.42)^1.5."""

    name = "overflow"
    equation = "flow k·max(h − 0.42, 0)^1.5 out of the left tank"
    coefficient: float = parameter(
        0.0, unit="m3/s", bounds=(0, 0.02), neutral=0.0, typical=3e-4, doc="flow k at 1 m above the notch"
    )

    def loss(self, m: Namespace, left: Number, right: Number) -> tuple[Number, Number]:
        above = m.maximum(left - EDGE, 0.0)
        return self.coefficient * above * m.sqrt(above + 1e-9), 0.0


@dataclass(frozen=True, kw_only=True)
class CrossFlow(TankEffect):
    """Leak between the tanks: k·(h_l − h_r) from left to right."""

    name = "cross_flow"
    equation = "flow k·(h_l − h_r) from left to right"
    coefficient: float = parameter(
        0.0, unit="m2/s", bounds=(0, 1e-3), neutral=0.0, typical=2e-5, doc="flow k per level"
    )

    def loss(self, m: Namespace, left: Number, right: Number) -> tuple[Number, Number]:
        flow = self.coefficient * (left - right)
        return flow, -flow


@dataclass(frozen=True, kw_only=True)
class LeftGaugeBias(Bias):
    """Bias of the left gauge: reading h + b."""

    name = "left_gauge_bias"
    output = "level_left"
    value: float = parameter(0.0, unit="m", bounds=(-0.1, 0.1), neutral=0.0, typical=0.01, doc="bias b")


@dataclass(frozen=True, kw_only=True)
class MeterScale(Scale):
    """Scale error of the flow meter: reading s·q."""

    name = "meter_scale"
    output = "outflow"
    value: float = parameter(1.0, unit="1", bounds=(0.5, 2), neutral=1.0, typical=0.05, doc="scale s")


@dataclass(frozen=True, kw_only=True)
class MeterBias(Bias):
    """Bias of the flow meter: reading q + b."""

    name = "meter_bias"
    output = "outflow"
    value: float = parameter(0.0, unit="m3/s", bounds=(-3e-5, 3e-5), neutral=0.0, typical=2e-6, doc="bias b")


@dataclass(frozen=True, kw_only=True)
class LeftGaugeLatency(Latency):
    """Latency of the left gauge on a slow bus: the level is T old."""

    name = "left_gauge_latency"
    output = "level_left"
    outputs = ("level_left",)
    value: float = parameter(0.0, unit="s", bounds=(0, 25), neutral=0.0, typical=3.0, doc="latency T of the readings")


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
    catalogue = (
        PumpDeadBand, PumpLag, PumpCurve, HeadLoss, OutletExponent, LeftLeak, ConstantDraw, Overflow, CrossFlow,
    )  # fmt: skip
    sensors = (MeterScale, MeterBias, LeftGaugeBias, LeftGaugeLatency)
    sensor_variance, start_variance = SENSOR_VARIANCE, START_VARIANCE
    forced = ("level_left", "level_right")
    calibrated = ("area_left", "area_right", "pipe", "outlet", "gain_left", "gain_right")
    told_apart_by = TOLD_APART_BY
    rate, substep, horizon = 1.0, 0.25, 40.0

    area_left: float = parameter(0.02, unit="m2", bounds=(1e-3, 1), tolerance=0.03, doc="surface of the left tank")
    area_right: float = parameter(0.02, unit="m2", bounds=(1e-3, 1), tolerance=0.03, doc="surface of the right tank")
    pipe: float = parameter(
        1.2e-4, unit="m3/s", bounds=(1e-6, 1e-2), tolerance=0.3, doc="flow through the pipe per √(1 m) of difference"
    )
    outlet: float = parameter(
        1.2e-4, unit="m3/s", bounds=(1e-6, 1e-2), tolerance=0.2, doc="flow through the outlet per √(1 m)"
    )
    gain_left: float = parameter(
        6e-6, unit="m3/s/V", bounds=(1e-7, 1e-3), tolerance=0.1, doc="flow of the left pump per volt"
    )
    gain_right: float = parameter(
        6e-6, unit="m3/s/V", bounds=(1e-7, 1e-3), tolerance=0.1, doc="flow of the right pump per volt"
    )

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace.

        A_l·ḣ_l = g_l·u_l − p − flows of the effects,  p = c_p·Δ/(Δ² + 10⁻⁴)^¼,  Δ = h_l − h_r
        A_r·ḣ_r = g_r·u_r + p − c_o·√h_r − flows of the effects
        """
        a_left, a_right, pipe, outlet = self.area_left, self.area_right, self.pipe, self.outlet
        gains, awake = (self.gain_left, self.gain_right), self.awake
        shaped = overrides(awake, "voltage", TankEffect)
        lagged = overrides(awake, "lag", TankEffect)
        factors = overrides(awake, "factor", TankEffect)
        outlets = overrides(awake, "outlet", TankEffect)
        losses = overrides(awake, "loss", TankEffect)

        def outflow(level: Number) -> Number:
            flow = outlet * m.sqrt(m.maximum(level, SHALLOW))
            for term in outlets:
                flow = flow * term.outlet(m, level)
            return flow

        def derivative(t: Number, state: Values, command: Values) -> Values:
            left, right, *own = state
            volts: tuple[Number, Number] = (command[0], command[1])
            slopes: Values = ()
            for term in shaped:
                volts = term.voltage(m, *volts)
            for term in lagged:
                volts, slopes = term.lag(m, *volts, tuple(own))
            inflow = [gains[0] * volts[0], gains[1] * volts[1]]
            for term in factors:
                inflow[0] = inflow[0] * term.factor(m, volts[0], left)
                inflow[1] = inflow[1] * term.factor(m, volts[1], right)
            difference = left - right
            through = pipe * difference / m.sqrt(m.sqrt(difference * difference + 1e-4))
            into_left, into_right = inflow[0] - through, inflow[1] + through - outflow(right)
            for term in losses:
                from_left, from_right = term.loss(m, left, right)
                into_left, into_right = into_left - from_left, into_right - from_right
            return into_left / a_left, into_right / a_right, *slopes

        def output(t: Number, state: Values, command: Values) -> Values:
            return state[0], state[1], outflow(state[1])

        return Equations(derivative, output)
