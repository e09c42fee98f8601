"""Chassis of a quarter truck: a mass on the force of its suspension."""

from dataclasses import dataclass

from cosim.model import Equations, Model, Namespace, Number, Quantity, Values, parameter


@dataclass(frozen=True, kw_only=True)
class Chassis(Model):
    """m·v' = F, z' = v, about the rest position."""

    title = "Chassis of a quarter truck"
    base_states = (Quantity("velocity", "m/s", "velocity upwards", 0.0), Quantity("height", "m", "height", 0.0))
    inputs = (Quantity("force", "N", "force of the suspension, upwards", 0.0),)
    outputs = base_states
    forced = ("velocity",)
    rate, substep, horizon = 0.02, 0.0005, 1.0

    mass: float = parameter(400.0, unit="kg", bounds=(1, 1e5), doc="mass m")

    def equations(self, m: Namespace) -> Equations:
        """m·v' = F, z' = v."""

        def derivative(t: Number, state: Values, command: Values) -> Values:
            return command[0] / self.mass, state[0]

        def output(t: Number, state: Values, command: Values) -> Values:
            return state

        return Equations(derivative, output)
