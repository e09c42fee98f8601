"""The hydraulic actuator of a crane arm: the position of its valve moves the arm; the oil pressure is measured.

Input and output are in the unknown units of the recording, so that both count as numbers. The speed is scaled to the
pressure: its derivative is the pressure that accelerates the arm.
"""

from dataclasses import dataclass

from cosim.model import (
    Delay,
    DryFriction,
    Equations,
    LocalEffect,
    Model,
    Namespace,
    Number,
    Offset,
    Quantity,
    Values,
    parameter,
    size,
)

CREEP = 0.05  # [s] speed below which dry friction is smoothed
LEAST_DROP = 0.01  # of the pressure drop over the valve, relative to the supply pressure
LARGE = 1e3  # beyond all signals
SEPARATION = {
    frozenset({"valve_offset", "load"}): "valve movements inside and outside its overlap, and steady motion both ways",
    frozenset({"flow_limit", "pressure_drop"}): "equal valve openings under different loads",
    frozenset({"leakage", "pressure_drop"}): "oscillations with a closed and with an open valve",
    frozenset({"valve_delay", "dead_band"}): "fast and slow valve movements through the middle",
}


def magnitude(m: Namespace, x: Number) -> Number:
    """Return |x| by a limit, as nested branches make the symbolic model slow to load."""
    return 2.0 * m.clip(x, 0.0, LARGE) - x


CATALOGUE = (
    Delay.named(  # hoses, or a late reading
        "valve_delay",
        memory=(Quantity("valve", "1", "valve position that acts until the delay has passed"),),
        time=size("s", (0, 0.5), 0.1, "delay T"),
    ),
    Offset.named("valve_offset", place="valve", value=size("1", (-0.5, 0.5), 0.05, "opening at position 0")),
    LocalEffect.named(  # the spool overlaps its ports
        "dead_band",
        place="valve",
        equation="u − clip(u, ±w) in place of u",
        width=size("1", (0, 0.5), 0.1, "overlap w on each side"),
        change=lambda e, m, u: u - m.clip(u, -e.width, e.width),
    ),
    LocalEffect.named(  # the piston has a rod on one side only, so that equal openings move it differently
        "asymmetry",
        place="valve",
        equation="u + a·|u| in place of u",
        ratio=size("1", (-0.9, 0.9), 0.2, "ratio a"),
        change=lambda e, m, u: u + e.ratio * magnitude(m, u),
    ),
    LocalEffect.named(  # the flow grows less than the opening, as the pump or the ports limit it
        "flow_limit",
        place="valve",
        equation="u/(1 + c·|u|) in place of u",
        coefficient=size("1", (0, 5), 0.3, "coefficient c"),
        change=lambda e, m, u: u / (1.0 + e.coefficient * magnitude(m, u)),
    ),
    LocalEffect.named(  # the flow goes with the root of the pressure drop; a positive opening lowers the pressure
        "pressure_drop",
        place="flow",
        equation="flow times √(1 + s·p·sign u)",
        inverse_supply=size("1", (0, 1), 0.1, "1/supply pressure s"),
        change=lambda e, m, flow, u, p: (
            flow * m.sqrt(m.clip(1.0 + e.inverse_supply * m.where(u >= 0.0, p, -p), LEAST_DROP, LARGE))
        ),
    ),
    LocalEffect.named(  # oil leaks past the piston
        "leakage",
        place="oil",
        equation="flow −l·p",
        rate=size("1/s", (0, 5), 0.2, "rate l"),
        change=lambda e, m, rise, p: rise - e.rate * p,
    ),
    DryFriction.named("dry_friction", place="arm", softness=CREEP, level=size("1", (0, 2), 0.2, "dry friction")),
    LocalEffect.named(  # turbulent flow in the lines
        "line_drag",
        place="arm",
        equation="pressure −q·|v|·v on the arm",
        coefficient=size("1/s2", (0, 3), 0.1, "coefficient q"),
        change=lambda e, m, total, v: total - e.coefficient * magnitude(m, v) * v,
    ),
    LocalEffect.named(  # the weight of the arm, or an offset of the pressure reading
        "load",
        place="arm",
        equation="pressure P on the arm",
        pressure=size("1", (-3, 3), 0.2, "pressure P"),
        change=lambda e, m, total, v: total + e.pressure,
    ),
)


@dataclass(frozen=True, kw_only=True)
class Actuator(Model):
    """Oil between a valve and the piston of an arm with viscous friction."""

    title = "Hydraulic actuator of a crane arm"
    base_states = (
        Quantity("pressure", "1", "oil pressure"),
        Quantity("speed", "s", "speed of the arm, scaled to the pressure"),
    )
    inputs = (Quantity("valve", "1", "position of the valve"),)
    outputs = base_states[:1]
    catalogue, places = CATALOGUE, ("valve", "flow", "oil", "arm")
    sensor_variance = {"pressure": 1e-4}  # noqa: RUF012 - a ClassVar of the base; 0.01
    start_variance = {"speed": 10.0}  # noqa: RUF012 - likewise; steady motion at the highest pressure has 5
    forced = ("pressure", "speed")
    calibrated = ("gain", "stiffness", "damping")
    told_apart_by = SEPARATION
    rate, substep, horizon = 0.1, 0.025, 2.5

    gain: float = parameter(
        -15.0, unit="1/s", bounds=(-100, -1), tolerance=0.5, doc="pressure rise by the flow through the valve"
    )
    stiffness: float = parameter(
        6.0, unit="1/s2", bounds=(0.5, 50), tolerance=0.5, doc="stiffness of oil and arm over its mass"
    )
    damping: float = parameter(0.6, unit="1/s", bounds=(0, 10), tolerance=0.5, doc="viscous friction over mass")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace: ṗ = g·u − k·v + leaks, v̇ = p − d·v + pressures."""
        at = self.effects_at(m)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            pressure, speed = state
            opening = at("valve", command[0])
            rise = at("flow", self.gain * opening, opening, pressure) - self.stiffness * speed
            return at("oil", rise, pressure), at("arm", pressure - self.damping * speed, speed)

        def output(t: Number, state: Values, command: Values) -> Values:
            return (state[0],)

        return Equations(derivative, output)
