"""A tank: what flows in, less what its own weight presses out."""

from dataclasses import dataclass

from cosim.model import Effect, Equations, Model, Namespace, Number, Quantity, SensorError, Values, overrides, parameter


class TankEffect(Effect):
    """A flow out of the tank that the base model lacks."""

    def loss(self, m: Namespace, level: Number) -> Number:
        """Flow [m3/s] out of the tank."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class Leak(TankEffect):
    """A leak: k·h."""

    name = "leak"
    equation = "flow k·h out"

    rate: float = parameter(0.0, unit="m2/s", bounds=(0, 1), neutral=0.0, typical=0.005, doc="flow k per level")

    def loss(self, m: Namespace, level: Number) -> Number:
        """k·h."""
        return self.rate * level


@dataclass(frozen=True, kw_only=True)
class Draw(TankEffect):
    """A constant draw: f."""

    name = "draw"
    equation = "flow f out"

    flow: float = parameter(0.0, unit="m3/s", bounds=(-0.1, 0.1), neutral=0.0, typical=0.005, doc="flow f")

    def loss(self, m: Namespace, level: Number) -> Number:
        """Flow f."""
        return self.flow


@dataclass(frozen=True, kw_only=True)
class GaugeOffset(SensorError):
    """The gauge reads h + b."""

    name = "gauge_offset"
    equation = "reading h + b"
    output = "level"

    value: float = parameter(0.0, unit="m", bounds=(-1, 1), neutral=0.0, typical=0.02, doc="offset b")

    def measure(self, value: Number) -> Number:
        """Return the reading h + b."""
        return value + self.value


@dataclass(frozen=True, kw_only=True)
class Tank(Model):
    """A tank with an outlet."""

    title = "Tank"
    base_states = (Quantity("level", "m", "level of the water", 1.0),)
    inputs = (Quantity("inflow", "m3/s", "flow in", 0.02),)
    outputs = base_states
    catalogue = (Leak, Draw)
    sensors = (GaugeOffset,)
    sensor_variance = {"level": 1e-6}  # noqa: RUF012 - a ClassVar of the base; 1 mm
    start_variance = {"level": 0.01}  # noqa: RUF012
    forced = ("level",)
    calibrated = ("area",)
    excursion = {"inflow": 0.015}  # noqa: RUF012
    rate, substep, horizon = 0.5, 0.125, 20.0

    area: float = parameter(0.5, unit="m2", bounds=(0.01, 10), doc="area of the surface")

    def equations(self, m: Namespace) -> Equations:
        """A·dh/dt = q - c·sqrt(h) - flows of the effects."""
        terms = overrides(self.awake, "loss", TankEffect)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            (level,) = state
            flow = command[0] - 0.02 * m.sqrt(m.maximum(level, 1e-6))
            for term in terms:
                flow = flow - term.loss(m, level)
            return (flow / self.area,)

        def output(t: Number, state: Values, command: Values) -> Values:
            return state

        return Equations(derivative, output)
