"""Battery: a voltage that falls with the charge taken out, behind an inner resistance."""

from dataclasses import dataclass

from cosim.model import Equations, Model, Namespace, Number, Quantity, Values, parameter


@dataclass(frozen=True, kw_only=True)
class Battery(Model):
    """q' = -i, u = U0·(0.8 + 0.2·q/Q) - R·i."""

    title = "Battery"
    base_states = (Quantity("charge", "C", "charge q", 36e3),)
    inputs = (Quantity("current", "A", "current i taken out", 0.0),)
    outputs = (Quantity("voltage", "V", "voltage u at the terminals", 48.0), base_states[0])
    forced = ("charge",)
    rate, substep, horizon = 0.1, 0.1, 10.0

    full: float = parameter(36e3, unit="C", bounds=(1, 1e9), doc="charge Q of the full battery")
    open_voltage: float = parameter(48.0, unit="V", bounds=(0.1, 1e4), doc="voltage U0 of the full battery at rest")
    resistance: float = parameter(0.1, unit="V/A", bounds=(0, 100), doc="inner resistance R")

    def equations(self, m: Namespace) -> Equations:
        """q' = -i, u = U0·(0.8 + 0.2·q/Q) - R·i."""

        def derivative(t: Number, state: Values, command: Values) -> Values:
            return (-command[0],)

        def output(t: Number, state: Values, command: Values) -> Values:
            (charge,) = state
            rest = self.open_voltage * (0.8 + 0.2 * charge / self.full)
            return rest - self.resistance * command[0], charge

        return Equations(derivative, output)
