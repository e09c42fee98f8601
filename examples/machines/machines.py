"""Textbook models of three measured machines, as an engineer would write them first; make_logs.py builds their FMUs."""

from dataclasses import dataclass

from cosim.model import Equations, Model, Namespace, Number, Quantity, Values, parameter

WATER = 4186.0  # heat capacity [J/(kg K)]


@dataclass(frozen=True, kw_only=True)
class Lamp(Model):
    """A halogen lamp above a steel plate: τ·dT/dt = g·u − (T − T₀)."""

    title = "Lamp above a plate"
    base_states = (Quantity("temperature", "degC", "back of the plate"),)
    inputs = (Quantity("voltage", "V", "drive of the lamp"),)
    outputs = base_states
    sensor_variance = {"temperature": 0.1**2}  # noqa: RUF012 - a ClassVar of the base; resolution 0.244 K
    forced = ("temperature",)
    calibrated = ("gain", "time_constant")
    rate, substep, horizon = 2.0, 2.0, 100.0

    gain: float = parameter(18.5, unit="K/V", bounds=(1, 100), tolerance=0.3, doc="167 K at 9 V")
    time_constant: float = parameter(60.0, unit="s", bounds=(5, 500), tolerance=0.3, doc="τ")
    room: float = parameter(25.0, unit="degC", bounds=(0, 50), doc="temperature of the room T₀")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace."""

        def derivative(t: Number, state: Values, command: Values) -> Values:
            return ((self.gain * command[0] - (state[0] - self.room)) / self.time_constant,)

        return Equations(derivative, lambda t, state, command: (state[0],))


@dataclass(frozen=True, kw_only=True)
class Tanks(Model):
    """Two tanks with free outlets: dx₁/dt = k·u − a·√x₁, dx₂/dt = b·√x₁ − c·√x₂, with levels in volts of the sensor."""

    title = "Cascaded tanks"
    base_states = (Quantity("upper", "V", "level of the upper tank"), Quantity("lower", "V", "level of the lower tank"))
    inputs = (Quantity("pump", "V", "voltage of the pump"),)
    outputs = base_states[1:]
    sensor_variance = {"lower": 0.02**2}  # noqa: RUF012 - a ClassVar of the base
    start_variance = {"upper": 4.0}  # noqa: RUF012 - likewise
    forced = ("upper", "lower")
    calibrated = ("pumped", "from_upper", "to_lower", "from_lower")
    rate, substep, horizon = 4.0, 1.0, 200.0

    pumped: float = parameter(0.06, unit="1/s", bounds=(0.005, 1), tolerance=0.3, doc="k")
    from_upper: float = parameter(0.075, unit="V/s", bounds=(0.005, 1), tolerance=0.3, doc="a")
    to_lower: float = parameter(0.075, unit="V/s", bounds=(0.005, 1), tolerance=0.3, doc="b")
    from_lower: float = parameter(0.075, unit="V/s", bounds=(0.005, 1), tolerance=0.3, doc="c")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace."""

        def derivative(t: Number, state: Values, command: Values) -> Values:
            upper, lower = (m.sqrt(m.maximum(level, 1e-4)) for level in state)
            return (
                self.pumped * command[0] - self.from_upper * upper,
                self.to_lower * upper - self.from_lower * lower,
            )

        return Equations(derivative, lambda t, state, command: (state[1],))


@dataclass(frozen=True, kw_only=True)
class Exchanger(Model):
    """Water heated by condensing steam, well mixed: C·dT/dt = c·q·(T_in − T) + U·(T_steam − T)."""

    title = "Steam heat exchanger"
    base_states = (Quantity("outlet", "degC", "water that leaves"),)
    inputs = (Quantity("flow", "kg/s", "flow of water"),)
    outputs = base_states
    sensor_variance = {"outlet": 0.1**2}  # noqa: RUF012 - a ClassVar of the base
    forced = ("outlet",)
    calibrated = ("capacity", "conductance")
    rate, substep, horizon = 1.0, 1.0, 30.0

    capacity: float = parameter(2e4, unit="J/K", bounds=(1e3, 1e6), tolerance=0.3, doc="5 kg of water C")
    conductance: float = parameter(8e3, unit="W/K", bounds=(100, 1e6), tolerance=0.3, doc="U")
    inlet: float = parameter(25.0, unit="degC", bounds=(0, 90), doc="water that enters T_in")
    steam: float = parameter(110.0, unit="degC", bounds=(100, 150), doc="saturated steam T_steam")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace."""

        def derivative(t: Number, state: Values, command: Values) -> Values:
            drawn = WATER * command[0] * (self.inlet - state[0])
            return ((drawn + self.conductance * (self.steam - state[0])) / self.capacity,)

        return Equations(derivative, lambda t, state, command: (state[0],))
