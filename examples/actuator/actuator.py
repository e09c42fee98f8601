"""The hydraulic actuator of a crane arm: the position of its valve moves the arm; the oil pressure is measured.

Input and output are in the unknown units of the recording, so that both count as numbers. The speed is scaled to the
pressure: its derivative is the pressure that accelerates the arm.
"""

from dataclasses import dataclass

from cosim.model import Delay, Effect, Equations, Model, Namespace, Number, Quantity, Values, overrides, parameter

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


class ActuatorEffect(Effect):
    """A part of the valve, the oil or the arm that the base model lacks."""

    def opening(self, m: Namespace, opening: Number) -> Number:
        """Return the opening of the valve after this effect."""
        return opening

    def flow(self, m: Namespace, opening: Number, pressure: Number) -> Number:
        """Share of the flow through the valve that remains."""
        return 1.0

    def leak(self, m: Namespace, pressure: Number) -> Number:
        """Rate of change [1/s] of the pressure."""
        return 0.0

    def acceleration(self, m: Namespace, speed: Number) -> Number:
        """Pressure on the arm."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class ValveDelay(Delay, ActuatorEffect):
    """The flow follows the valve T later: hoses, or a late reading."""

    name = "valve_delay"
    memory = (Quantity("valve", "1", "valve position that acts until the delay has passed"),)

    time: float = parameter(0.0, unit="s", bounds=(0, 0.5), neutral=0.0, typical=0.1, doc="delay T")


@dataclass(frozen=True, kw_only=True)
class ValveOffset(ActuatorEffect):
    """The valve is open at its position 0: u + o."""

    name = "valve_offset"
    equation = "u + o in place of u"

    value: float = parameter(0.0, unit="1", bounds=(-0.5, 0.5), neutral=0.0, typical=0.05, doc="offset o")

    def opening(self, m: Namespace, opening: Number) -> Number:
        """u + o."""
        return opening + self.value


@dataclass(frozen=True, kw_only=True)
class DeadBand(ActuatorEffect):
    """The spool overlaps its ports: no flow between −w and w."""

    name = "dead_band"
    equation = "u − clip(u, ±w) in place of u"

    width: float = parameter(0.0, unit="1", bounds=(0, 0.5), neutral=0.0, typical=0.1, doc="overlap w on each side")

    def opening(self, m: Namespace, opening: Number) -> Number:
        """u − clip(u, ±w)."""
        return opening - m.clip(opening, -self.width, self.width)


@dataclass(frozen=True, kw_only=True)
class Asymmetry(ActuatorEffect):
    """The piston has a rod on one side only, so that equal openings move it differently: u + a·|u|."""

    name = "asymmetry"
    equation = "u + a·|u| in place of u"

    ratio: float = parameter(0.0, unit="1", bounds=(-0.9, 0.9), neutral=0.0, typical=0.2, doc="ratio a")

    def opening(self, m: Namespace, opening: Number) -> Number:
        """u + a·|u|."""
        return opening + self.ratio * magnitude(m, opening)


@dataclass(frozen=True, kw_only=True)
class FlowLimit(ActuatorEffect):
    """The flow grows less than the opening, as the pump or the ports limit it: u/(1 + c·|u|)."""

    name = "flow_limit"
    equation = "u/(1 + c·|u|) in place of u"

    coefficient: float = parameter(0.0, unit="1", bounds=(0, 5), neutral=0.0, typical=0.3, doc="coefficient c")

    def opening(self, m: Namespace, opening: Number) -> Number:
        """u/(1 + c·|u|)."""
        return opening / (1.0 + self.coefficient * magnitude(m, opening))


@dataclass(frozen=True, kw_only=True)
class PressureDrop(ActuatorEffect):
    """The flow goes with the root of the pressure drop over the valve: √(1 + s·p·sign u), s the inverse of the supply.

    A positive opening lowers the pressure.
    """

    name = "pressure_drop"
    equation = "flow times √(1 + s·p·sign u)"

    inverse_supply: float = parameter(0.0, unit="1", bounds=(0, 1), neutral=0.0, typical=0.1, doc="1/supply pressure s")

    def flow(self, m: Namespace, opening: Number, pressure: Number) -> Number:
        """√(1 + s·p·sign u)."""
        drop = 1.0 + self.inverse_supply * m.where(opening >= 0.0, pressure, -pressure)
        return m.sqrt(m.clip(drop, LEAST_DROP, LARGE))


@dataclass(frozen=True, kw_only=True)
class Leakage(ActuatorEffect):
    """Oil leaks past the piston in proportion to the pressure: −l·p."""

    name = "leakage"
    equation = "flow −l·p"

    rate: float = parameter(0.0, unit="1/s", bounds=(0, 5), neutral=0.0, typical=0.2, doc="rate l")

    def leak(self, m: Namespace, pressure: Number) -> Number:
        """−l·p."""
        return -self.rate * pressure


@dataclass(frozen=True, kw_only=True)
class DryFriction(ActuatorEffect):
    """Dry friction of piston and joints: −F·tanh(v/0.05)."""

    name = "dry_friction"
    equation = "pressure −F·tanh(v/0.05) on the arm"

    level: float = parameter(0.0, unit="1", bounds=(0, 2), neutral=0.0, typical=0.2, doc="dry friction F")

    def acceleration(self, m: Namespace, speed: Number) -> Number:
        """−F·tanh(v/0.05)."""
        return -self.level * m.tanh(speed / CREEP)


@dataclass(frozen=True, kw_only=True)
class LineDrag(ActuatorEffect):
    """Turbulent flow in the lines resists the motion: −q·|v|·v."""

    name = "line_drag"
    equation = "pressure −q·|v|·v on the arm"

    coefficient: float = parameter(0.0, unit="1/s2", bounds=(0, 3), neutral=0.0, typical=0.1, doc="coefficient q")

    def acceleration(self, m: Namespace, speed: Number) -> Number:
        """−q·|v|·v."""
        return -self.coefficient * magnitude(m, speed) * speed


@dataclass(frozen=True, kw_only=True)
class Load(ActuatorEffect):
    """The weight of the arm or an offset of the pressure reading: a constant pressure on the arm."""

    name = "load"
    equation = "pressure P on the arm"

    pressure: float = parameter(0.0, unit="1", bounds=(-3, 3), neutral=0.0, typical=0.2, doc="pressure P")

    def acceleration(self, m: Namespace, speed: Number) -> Number:
        """P."""
        return self.pressure


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
    catalogue = (
        *(ValveDelay, ValveOffset, DeadBand, Asymmetry, FlowLimit),
        *(PressureDrop, Leakage, DryFriction, LineDrag, Load),
    )
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
        awake = self.awake
        openings, flows, leaks, accelerations = (
            overrides(awake, hook, ActuatorEffect) for hook in ("opening", "flow", "leak", "acceleration")
        )

        def derivative(t: Number, state: Values, command: Values) -> Values:
            pressure, speed = state
            opening = command[0]
            for effect in openings:
                opening = effect.opening(m, opening)
            rise = self.gain * opening
            for effect in flows:
                rise = rise * effect.flow(m, opening, pressure)
            rise = rise - self.stiffness * speed
            for effect in leaks:
                rise = rise + effect.leak(m, pressure)
            total = pressure - self.damping * speed
            for effect in accelerations:
                total = total + effect.acceleration(m, speed)
            return rise, total

        def output(t: Number, state: Values, command: Values) -> Values:
            return (state[0],)

        return Equations(derivative, output)
