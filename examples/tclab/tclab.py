"""The Temperature Control Lab as a model of one's own: two heaters, each with its sensor, on one small board.

The base model is the energy balance of a single heater, for each of the two: what a heater gives warms it, convection
carries it away, and a sensor in close contact shows it. All temperatures are above that of the cold board.
"""

from dataclasses import dataclass

from cosim.model import (
    Delay,
    Effect,
    Equations,
    Model,
    Namespace,
    Number,
    Quantity,
    Scale,
    Values,
    overrides,
    parameter,
)

Pair = tuple[Number, Number]
ROOM = 294.0  # [K] what the laws of radiation need; a degree more or less makes 1 % of it
BLACK = 5.67e-8 * 1.2e-3  # [W/K4] radiation of a black body of a heater's surface, 12 cm²
SENSOR = 3.0  # [s] time constant of the sensor by itself, in close contact
APART = "one heater at a time, long enough to settle, at several powers"
TOLD_APART_BY = {
    frozenset({"sensor_lag", "delay"}): "steps of a heater from rest, with rows as fast as the sensor gives them",
    frozenset({"heat_exchange", "shared_heat"}): APART,
    frozenset({"radiation", "natural_convection", "loss"}): APART,
}


class BoardEffect(Effect):
    """Heat, or a lag of the sensors, that the base model lacks."""

    def lag(self) -> Number:
        """By how much the time constant [s] of the sensors is longer."""
        return 0.0

    def heat(self, m: Namespace, board: Pair, power: Pair) -> Pair:
        """Heat [W] into either heater, from their temperatures [K] above the room and their powers [W]."""
        return 0.0, 0.0


@dataclass(frozen=True, kw_only=True)
class CommandDelay(Delay, BoardEffect):
    """Both heaters act T later."""

    name = "delay"
    memory = (
        Quantity("heater_1", "%", "level of heater 1 that acts until the delay has passed"),
        Quantity("heater_2", "%", "level of heater 2 that acts until the delay has passed"),
    )
    longest = 60.0

    time: float = parameter(0.0, unit="s", bounds=(0, 60), neutral=0.0, typical=10.0, doc="delay T")


@dataclass(frozen=True, kw_only=True)
class SensorLag(BoardEffect):
    """A sensor is glued beside its heater, and takes its time: (3 s + τ)·ċ = θ − c."""

    name = "sensor_lag"
    equation = "(3 s + τ)·ċ = θ − c"

    time: float = parameter(0.0, unit="s", bounds=(0, 120), neutral=0.0, typical=10.0, doc="further time constant τ")

    def lag(self) -> Number:
        """τ."""
        return self.time


@dataclass(frozen=True, kw_only=True)
class HeatExchange(BoardEffect):
    """The heaters warm each other, by convection and through the board: k·(θ₂ − θ₁)."""

    name = "heat_exchange"
    equation = "heat k·(θ₂ − θ₁) from heater 2 to heater 1"

    conductance: float = parameter(0.0, unit="W/K", bounds=(0, 0.1), neutral=0.0, typical=2e-3, doc="conductance k")

    def heat(self, m: Namespace, board: Pair, power: Pair) -> Pair:
        """k·(θ₂ − θ₁), and back."""
        flow = self.conductance * (board[1] - board[0])
        return flow, -flow


@dataclass(frozen=True, kw_only=True)
class SharedHeat(BoardEffect):
    """A part of the power of either heater is set free in the other's place: in the supply and the traces."""

    name = "shared_heat"
    equation = "heat s·(P₂ − P₁) to heater 1"

    share: float = parameter(0.0, unit="1", bounds=(0, 0.5), neutral=0.0, typical=0.1, doc="share s")

    def heat(self, m: Namespace, board: Pair, power: Pair) -> Pair:
        """s·(P₂ − P₁), and back."""
        flow = self.share * (power[1] - power[0])
        return flow, -flow


@dataclass(frozen=True, kw_only=True)
class Radiation(BoardEffect):
    """Heat that is radiated: −ε·σ·A·((T₀ + θ)⁴ − T₀⁴)."""

    name = "radiation"
    equation = "heat −ε·σ·A·((T₀ + θ)⁴ − T₀⁴), T₀ = 294 K"

    emissivity: float = parameter(0.0, unit="1", bounds=(0, 1), neutral=0.0, typical=0.8, doc="emissivity ε")

    def heat(self, m: Namespace, board: Pair, power: Pair) -> Pair:
        """−ε·σ·A·((T₀ + θ)⁴ − T₀⁴)."""
        first, second = (self.emissivity * BLACK * (ROOM**4 - (ROOM + x) ** 4) for x in board)
        return first, second


@dataclass(frozen=True, kw_only=True)
class NaturalConvection(BoardEffect):
    """Air that rises by itself carries more the warmer it is: −k·|θ|·θ."""

    name = "natural_convection"
    equation = "heat −k·|θ|·θ"

    coefficient: float = parameter(0.0, unit="W/K2", bounds=(0, 0.01), neutral=0.0, typical=3e-4, doc="coefficient k")

    def heat(self, m: Namespace, board: Pair, power: Pair) -> Pair:
        """−k·|θ|·θ."""
        first, second = (-self.coefficient * m.where(x >= 0.0, x, -x) * x for x in board)
        return first, second


@dataclass(frozen=True, kw_only=True)
class FirstSensorScale(Scale):
    """Sensor 1 reads s·θ."""

    name = "sensor_1_scale"
    output = "temperature_1"

    value: float = parameter(1.0, unit="1", bounds=(0.5, 2), neutral=1.0, typical=0.1, doc="scale s")


@dataclass(frozen=True, kw_only=True)
class Board(Model):
    """Two heaters, each of which knows only itself and the room."""

    title = "Temperature Control Lab"
    base_states = (
        Quantity("board_1", "K", "heater 1, above the room"),
        Quantity("board_2", "K", "heater 2, above the room"),
        Quantity("sensor_1", "K", "sensor 1, above the room"),
        Quantity("sensor_2", "K", "sensor 2, above the room"),
    )
    inputs = (
        Quantity("heater_1", "%", "level of heater 1", 0.0, (0.0, 100.0)),
        Quantity("heater_2", "%", "level of heater 2", 0.0, (0.0, 100.0)),
    )
    outputs = (
        Quantity("temperature_1", "K", "sensor 1, above its cold reading"),
        Quantity("temperature_2", "K", "sensor 2, above its cold reading"),
    )
    catalogue = (
        CommandDelay,
        SensorLag,
        HeatExchange,
        SharedHeat,
        Radiation,
        NaturalConvection,
    )
    sensors = (FirstSensorScale,)
    sensor_variance = {"temperature_1": 0.01, "temperature_2": 0.01}  # noqa: RUF012 - a ClassVar of the base; 0.1 K
    start_variance = dict.fromkeys(("board_1", "board_2", "sensor_1", "sensor_2"), 0.04)
    forced = ("board_1", "board_2")
    calibrated = ("loss", "power_1", "power_2")
    told_apart_by = TOLD_APART_BY
    excursion = {"heater_1": 100.0, "heater_2": 100.0}  # noqa: RUF012 - likewise
    rate, substep = 1.0, 0.25
    horizon = float("inf")  # judged by the free run

    capacity: float = parameter(2.0, unit="J/K", bounds=(0.5, 20), doc="heat capacity of a heater: 4 g, 500 J/kg/K")
    loss: float = parameter(
        0.012, unit="W/K", bounds=(1e-3, 0.1), tolerance=0.3, doc="loss by convection: 12 cm², 10 W/m²/K"
    )
    power_1: float = parameter(1.0, unit="W", bounds=(0.1, 5), tolerance=0.5, doc="power of heater 1 at 100 %")
    power_2: float = parameter(0.75, unit="W", bounds=(0.1, 5), tolerance=0.5, doc="power of heater 2 at 100 %")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace.

        C·θ̇ᵢ = Pᵢ·uᵢ/100 % − k·θᵢ + heat of the effects
        (3 s + lag of the effects)·ċᵢ = θᵢ − cᵢ
        """
        capacity, loss = self.capacity, self.loss
        terms = overrides(self.awake, "heat", BoardEffect)
        lags = overrides(self.awake, "lag", BoardEffect)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            first, second, shown_1, shown_2 = state
            power = 0.01 * self.power_1 * command[0], 0.01 * self.power_2 * command[1]
            total_1, total_2 = power[0] - loss * first, power[1] - loss * second
            for term in terms:
                gain_1, gain_2 = term.heat(m, (first, second), power)
                total_1, total_2 = total_1 + gain_1, total_2 + gain_2
            time = SENSOR
            for term in lags:
                time = time + term.lag()
            return total_1 / capacity, total_2 / capacity, (first - shown_1) / time, (second - shown_2) / time

        def output(t: Number, state: Values, command: Values) -> Values:
            return (state[2], state[3])

        return Equations(derivative, output)
