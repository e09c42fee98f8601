"""Wheel of a quarter truck with tyre and suspension, on a road with a bump."""

from dataclasses import dataclass
from math import pi

from cosim.model import Equations, Model, Namespace, Number, Quantity, Values, parameter


@dataclass(frozen=True, kw_only=True)
class Wheel(Model):
    """m·v' = k_t·(r − z) − F with F = k·(z − z_c) + d·(v − v_c), about the rest position."""

    title = "Wheel of a quarter truck"
    base_states = (
        Quantity("velocity", "m/s", "velocity upwards", 0.0),
        Quantity("height", "m", "height", 0.0),
        Quantity("chassis_height", "m", "height of the chassis, from its velocity", 0.0),
    )
    inputs = (Quantity("chassis_velocity", "m/s", "velocity of the chassis, upwards", 0.0),)
    outputs = (Quantity("force", "N", "force on the chassis, upwards", 0.0), base_states[1])
    forced = ("velocity",)
    rate, substep, horizon = 0.02, 0.0005, 1.0

    mass: float = parameter(40.0, unit="kg", bounds=(1, 1e4), doc="mass m")
    tyre: float = parameter(150e3, unit="N/m", bounds=(0, 1e7), doc="stiffness k_t of the tyre")
    spring: float = parameter(15e3, unit="N/m", bounds=(0, 1e7), doc="stiffness k of the suspension")
    damper: float = parameter(1e3, unit="N.s/m", bounds=(0, 1e6), doc="damping d of the suspension")
    bump_height: float = parameter(0.1, unit="m", bounds=(-1, 1), doc="height of the bump")
    bump_start: float = parameter(1.0, unit="s", bounds=(0, 1e6), doc="time at which the bump begins")
    bump_length: float = parameter(0.1, unit="s", bounds=(0.001, 100), doc="time on the bump")

    def equations(self, m: Namespace) -> Equations:
        """Equations of the class, with the road r = H·(1 − cos(2π·s))/2 for 0 < s < 1."""

        def force(state: Values, command: Values) -> Number:
            velocity, height, chassis_height = state
            return self.spring * (height - chassis_height) + self.damper * (velocity - command[0])

        def derivative(t: Number, state: Values, command: Values) -> Values:
            velocity, height, _ = state
            share = (t - self.bump_start) / self.bump_length
            bump = 0.5 * self.bump_height * (1.0 - m.cos(2.0 * pi * share))
            road = m.where(share >= 0.0, m.where(share <= 1.0, bump, 0.0), 0.0)
            return (self.tyre * (road - height) - force(state, command)) / self.mass, velocity, command[0]

        def output(t: Number, state: Values, command: Values) -> Values:
            return force(state, command), state[1]

        return Equations(derivative, output)
