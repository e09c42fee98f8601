"""Winding and shaft of a DC motor, with candidates that it may lack."""

from dataclasses import dataclass

from cosim.model import Effect, Equations, Model, Namespace, Number, Quantity, SensorError, Values, overrides, parameter


class MotorEffect(Effect):
    """A torque that the base model lacks."""

    def torque(self, m: Namespace, speed: Number) -> Number:
        """Return the torque [N.m]."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class DryFriction(MotorEffect):
    """Dry friction."""

    name = "dry_friction"
    equation = "torque −M·tanh(ω/2)"

    level: float = parameter(0.0, unit="N.m", bounds=(0, 1), neutral=0.0, typical=0.01, doc="dry torque M")

    def torque(self, m: Namespace, speed: Number) -> Number:
        """−M·tanh(ω/2)."""
        return -self.level * m.tanh(speed / 2.0)


@dataclass(frozen=True, kw_only=True)
class Drag(MotorEffect):
    """Quadratic drag of a fan."""

    name = "drag"
    equation = "torque −c·ω·|ω|"

    factor: float = parameter(0.0, unit="N.m.s2/rad2", bounds=(0, 1), neutral=0.0, typical=1e-6, doc="drag c")

    def torque(self, m: Namespace, speed: Number) -> Number:
        """−c·ω·√(ω² + 10⁻⁶)."""
        return -self.factor * speed * m.sqrt(speed * speed + 1e-6)


@dataclass(frozen=True, kw_only=True)
class SpeedOffset(SensorError):
    """The sensor of the speed reads ω + b."""

    name = "speed_offset"
    equation = "reading ω + b"
    output = "speed"

    value: float = parameter(0.0, unit="rad/s", bounds=(-50, 50), neutral=0.0, typical=1.0, doc="offset b")

    def measure(self, value: Number) -> Number:
        """Return ω + b."""
        return value + self.value


@dataclass(frozen=True, kw_only=True)
class Motor(Model):
    """DC motor: winding and shaft."""

    title = "DC motor"
    base_states = (Quantity("current", "A", "winding current"), Quantity("speed", "rad/s", "shaft speed"))
    inputs = (Quantity("voltage", "V", "terminal voltage"),)
    outputs = base_states
    catalogue = (DryFriction, Drag)
    sensors = (SpeedOffset,)
    sensor_variance = {"current": 1e-4, "speed": 1e-2}  # noqa: RUF012
    forced = ("current", "speed")
    calibrated = ("resistance", "inertia")

    resistance: float = parameter(1.2, unit="ohm", bounds=(0.1, 10), doc="winding resistance")
    inductance: float = parameter(2.04e-3, unit="H", bounds=(1e-5, 1), doc="winding inductance")
    constant: float = parameter(0.05, unit="V.s/rad", bounds=(1e-3, 1), doc="torque constant")
    inertia: float = parameter(2e-4, unit="kg.m2", bounds=(1e-6, 1), doc="moment of inertia")
    damping: float = parameter(1e-4, unit="N.m.s/rad", bounds=(0, 1), doc="viscous friction")

    def equations(self, m: Namespace) -> Equations:
        """L·di/dt = u − R·i − k·ω, J·dω/dt = k·i − d·ω + torques of the effects."""
        terms = overrides(self.awake, "torque", MotorEffect)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            current, speed = state
            total = self.constant * current - self.damping * speed
            for term in terms:
                total = total + term.torque(m, speed)
            across = command[0] - self.resistance * current - self.constant * speed
            return across / self.inductance, total / self.inertia

        def output(t: Number, state: Values, command: Values) -> Values:
            return state

        return Equations(derivative, output)
