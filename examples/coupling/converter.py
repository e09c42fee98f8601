"""Converter: takes the same power at every voltage, and warms up by its losses."""

from dataclasses import dataclass

from cosim.model import Equations, Model, Namespace, Number, Quantity, Values, parameter


@dataclass(frozen=True, kw_only=True)
class Converter(Model):
    """i = P/(0.95·u), C·T' = 0.05·u·i - k·T with the temperature T above that of the room."""

    title = "Converter of constant power"
    base_states = (Quantity("temperature", "K", "temperature T above that of the room", 0.0),)
    inputs = (Quantity("voltage", "V", "voltage u", 48.0), Quantity("power", "W", "power P given to the load", 1000.0))
    outputs = (Quantity("current", "A", "current i", 0.0), base_states[0])
    forced = ("temperature",)
    rate, substep, horizon = 0.1, 0.1, 10.0

    capacity: float = parameter(500.0, unit="J/K", bounds=(1, 1e6), doc="heat capacity C")
    cooling: float = parameter(2.0, unit="W/K", bounds=(0, 1e3), doc="cooling k")

    def equations(self, m: Namespace) -> Equations:
        """i = P/(0.95·u), C·T' = 0.05·u·i - k·T."""

        def current(command: Values) -> Number:
            return command[1] / (0.95 * m.maximum(command[0], 1.0))

        def derivative(t: Number, state: Values, command: Values) -> Values:
            loss = 0.05 * command[0] * current(command)
            return ((loss - self.cooling * state[0]) / self.capacity,)

        def output(t: Number, state: Values, command: Values) -> Values:
            return current(command), state[0]

        return Equations(derivative, output)
