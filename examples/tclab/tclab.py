"""The Temperature Control Lab as a model of one's own: two heaters, each with its sensor, on one small board.

The base model is the energy balance of a single heater, for each of the two: what a heater gives warms it, convection
carries it away, and a sensor in close contact shows it. All temperatures are above that of the cold board.
"""

from dataclasses import dataclass

from cosim.model import (
    Delay,
    Equations,
    LocalEffect,
    Model,
    Namespace,
    Number,
    Quantity,
    Scale,
    Values,
    parameter,
    size,
)

ROOM = 294.0  # [K] what the laws of radiation need; a degree more or less makes 1 % of it
BLACK = 5.67e-8 * 1.2e-3  # [W/K4] radiation of a black body of a heater's surface, 12 cm²
SENSOR = 3.0  # [s] time constant of the sensor by itself, in close contact
APART = "one heater at a time, long enough to settle, at several powers"
TOLD_APART_BY = {
    frozenset({"sensor_lag", "delay"}): "steps of a heater from rest, with rows as fast as the sensor gives them",
    frozenset({"heat_exchange", "shared_heat"}): APART,
    frozenset({"radiation", "natural_convection", "loss"}): APART,
}


# of a heater, with the temperatures [K] of it and of the other one, and the powers [W] of both
CATALOGUE = (
    Delay.named(
        "delay",
        memory=(
            Quantity("heater_1", "%", "level of heater 1 that acts until the delay has passed"),
            Quantity("heater_2", "%", "level of heater 2 that acts until the delay has passed"),
        ),
        longest=60.0,
        time=size("s", (0, 60), 10.0, "delay T"),
    ),
    LocalEffect.named(  # a sensor is glued beside its heater, and takes its time
        "sensor_lag",
        place="sensor",
        equation="(3 s + τ)·ċ = θ − c",
        time=size("s", (0, 120), 10.0, "further time constant τ"),
        change=lambda e, m, time: time + e.time,
    ),
    LocalEffect.named(  # the heaters warm each other, by convection and through the board
        "heat_exchange",
        place="heater",
        equation="heat k·(θ₂ − θ₁) from heater 2 to heater 1",
        conductance=size("W/K", (0, 0.1), 2e-3, "conductance k"),
        change=lambda e, m, heat, own, other, *_: heat + e.conductance * (other - own),
    ),
    LocalEffect.named(  # a part of the power of either heater is set free in the other's place: supply and traces
        "shared_heat",
        place="heater",
        equation="heat s·(P₂ − P₁) to heater 1",
        share=size("1", (0, 0.5), 0.1, "share s"),
        change=lambda e, m, heat, own, other, power, of_other: heat + e.share * (of_other - power),
    ),
    LocalEffect.named(
        "radiation",
        place="heater",
        equation="heat −ε·σ·A·((T₀ + θ)⁴ − T₀⁴), T₀ = 294 K",
        emissivity=size("1", (0, 1), 0.8, "emissivity ε"),
        change=lambda e, m, heat, own, *_: heat + e.emissivity * BLACK * (ROOM**4 - (ROOM + own) ** 4),
    ),
    LocalEffect.named(  # air that rises by itself carries more the warmer it is
        "natural_convection",
        place="heater",
        equation="heat −k·|θ|·θ",
        coefficient=size("W/K2", (0, 0.01), 3e-4, "coefficient k"),
        change=lambda e, m, heat, own, *_: heat - e.coefficient * m.where(own >= 0.0, own, -own) * own,
    ),
)
FirstSensorScale = Scale.named(
    "sensor_1_scale",
    output="temperature_1",
    value=parameter(1.0, unit="1", bounds=(0.5, 2), neutral=1.0, typical=0.1, doc="scale s"),
)


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
    catalogue, places = CATALOGUE, ("sensor", "heater")
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
        capacity, loss, at = self.capacity, self.loss, self.effects_at(m)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            first, second, shown_1, shown_2 = state
            one, two = 0.01 * self.power_1 * command[0], 0.01 * self.power_2 * command[1]
            into_first = at("heater", one - loss * first, first, second, one, two)
            into_second = at("heater", two - loss * second, second, first, two, one)
            time = at("sensor", SENSOR)
            return into_first / capacity, into_second / capacity, (first - shown_1) / time, (second - shown_2) / time

        def output(t: Number, state: Values, command: Values) -> Values:
            return (state[2], state[3])

        return Equations(derivative, output)
