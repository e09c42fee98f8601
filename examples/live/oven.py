"""A reflow oven: heater, chamber and board, with a fan that carries heat away."""

from dataclasses import dataclass

from cosim.model import Equations, Model, Namespace, Number, Quantity, Values, parameter


@dataclass(frozen=True, kw_only=True)
class Oven(Model):
    """Three heat capacities in a row, and a fan."""

    title = "Reflow oven"
    base_states = (
        Quantity("heater", "K", "temperature of the heater", start=293.15),
        Quantity("chamber", "K", "temperature of the air", start=293.15),
        Quantity("board", "K", "temperature of the board", start=293.15),
    )
    inputs = (
        Quantity("power", "W", "electrical power of the heater", start=600.0, bounds=(0.0, 2000.0)),
        Quantity("fan", "1", "speed of the fan, as a share", bounds=(0.0, 1.0)),
        Quantity("room", "K", "temperature around the oven", start=293.15, bounds=(250.0, 320.0)),
    )
    outputs = base_states
    forced = ("heater", "chamber", "board")
    substep, rate = 0.05, 0.1

    heater_capacity: float = parameter(120.0, unit="J/K", bounds=(1, 1e4), doc="heat capacity of the heater")
    chamber_capacity: float = parameter(400.0, unit="J/K", bounds=(1, 1e4), doc="heat capacity of the air and walls")
    board_capacity: float = parameter(90.0, unit="J/K", bounds=(1, 1e4), doc="heat capacity of the board")
    heater_transfer: float = parameter(3.0, unit="W/K", bounds=(0, 100), doc="heat transfer from heater to chamber")
    board_transfer: float = parameter(1.2, unit="W/K", bounds=(0, 100), doc="heat transfer from chamber to board")
    loss: float = parameter(2.0, unit="W/K", bounds=(0, 100), doc="heat transfer from chamber to room, fan at rest")
    fan_loss: float = parameter(12.0, unit="W/K", bounds=(0, 100), doc="further heat transfer at full speed of the fan")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace.

        C_h·Ṫ_h = P − k_h·(T_h − T_c)
        C_c·Ṫ_c = k_h·(T_h − T_c) − k_b·(T_c − T_b) − (k_l + k_f·fan)·(T_c − T_r)
        C_b·Ṫ_b = k_b·(T_c − T_b)
        """

        def derivative(t: Number, state: Values, command: Values) -> Values:
            heater, chamber, board = state
            power, fan, room = command
            given = self.heater_transfer * (heater - chamber)
            taken = self.board_transfer * (chamber - board)
            lost = (self.loss + self.fan_loss * fan) * (chamber - room)
            return (
                (power - given) / self.heater_capacity,
                (given - taken - lost) / self.chamber_capacity,
                taken / self.board_capacity,
            )

        def output(t: Number, state: Values, command: Values) -> Values:
            return state

        return Equations(derivative, output)
