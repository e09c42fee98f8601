"""Structure of an FMU as measured on its binary: dependencies, pairs, ports, time constants and acting parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from cosim.core.arrays import Flags, NamedValues
from cosim.fmi.description import Way
from cosim.model.quantities import Quantity
from cosim.terms.language import RatioFactor

START_STEP = 1e-2  # displacement of a start value, or of an input, as a share of its size, range or nominal value


@dataclass(frozen=True)
class Port:
    """An input that changes the rate of a velocity, and not the rate of its position, or of a storage.

    Attributes:
        gain: ∂v'/∂u, the median over the points.
        is_alone: True if the input changes no rate but this one.
    """

    input: str
    gain: float
    is_alone: bool


@dataclass(frozen=True)
class Pair:
    """A position and its velocity: q' = gain·v.

    In co-simulation both are outputs.

    Attributes:
        ports: Inputs that act on the velocity as forces do.
    """

    position: str
    velocity: str
    gain: float
    ports: tuple[Port, ...]


@dataclass(frozen=True)
class Connection:
    """A spring or damper between two pairs: q1'' = −k·(q1 − i·q2) − d·(v1 − i·v2) + …, q2'' = −r·q1'' + ….

    Attributes:
        first, second: Both pairs.
        gear: Position i of the first per position of the second at rest; 1 unless the connection alone holds both.
        ratio: Acceleration r of the second per opposite acceleration of the first.
        stiffness, damping: k and d, each the median over the points.
        deflection, speed: Standard deviation of q1 − i·q2 and v1 − i·v2 along the logs.
        factors: Factors of r, one for each parameter of an inertia.
    """

    first: Pair
    second: Pair
    gear: float
    ratio: float
    stiffness: float
    damping: float
    deflection: float
    speed: float
    factors: tuple[RatioFactor, ...] = ()


@dataclass(frozen=True)
class Damping:
    """A settable parameter b that brakes a velocity v: f(x; b + δ) − f(x; b) = −δ·v·d(x).

    d(x), the rates per force along v, tells how every force there acts; its unit is that of b times that of v.

    Attributes:
        parameter: Name of b.
        gain: Median of d in the rate of v.
        rates: States with rates that change.
        is_constant: True if only the rate of v changes, with the same d at all points.
        port: Input that acts in the direction of d, so that forces come in through it; "" without one.
        change, speed: Usual values of δ and v.
        in_step: True if a second instance can be kept in step with the first: no events, and both in one process.
    """

    pair: Pair
    parameter: str
    gain: float
    rates: tuple[str, ...]
    is_constant: bool
    port: str
    change: float
    speed: float
    in_step: bool


@dataclass(frozen=True)
class EventCount:
    """Events of an FMU along a log; an input that changes counts as none.

    Attributes:
        state, time, step: Events at zero crossings, at announced times, and requested after a solver step.
    """

    log: str
    state: int = 0
    time: int = 0
    step: int = 0

    @property
    def total(self) -> int:
        """Return the number of events."""
        return self.state + self.time + self.step


@dataclass(frozen=True)
class ProbedParameter:
    """A real parameter that may be set before initialization.

    Attributes:
        acts: True if another value changes a rate or an output.
        starts: True if another value changes a state after initialization.
        tried: Value that was tried last.
        failure: Failure of the FMU with a value near its own, a crash for example; "" without any.
    """

    quantity: Quantity
    acts: bool
    starts: bool
    tried: float
    failure: str = ""

    @property
    def name(self) -> str:
        """Return the name of the parameter."""
        return self.quantity.name


@dataclass(frozen=True)
class StartValue:
    """A start value of an FMU for co-simulation, for an unknown start state.

    Attributes:
        size: Change that moves some output by its spread.
        shown: Number of the output that shows it after initialization; −1 without one.
        gain: Change of that output relative to that of the start value.
    """

    quantity: Quantity
    size: float
    shown: int = -1
    gain: float = 0.0

    @property
    def name(self) -> str:
        """Return the name of the variable."""
        return self.quantity.name


@dataclass(frozen=True, eq=False)
class Structure:
    """Structure of an FMU along logs.

    Names are of the FMU, in its order; arrays have an entry for each element.

    Attributes:
        way: Probed interface.
        states: Continuous states; empty for co-simulation.
        depends: Whether a rate or output (row) changes with a state or input (column). In co-simulation an output
            depends on an input that changes it at any later time.
        pairs: Positions with their velocities.
        storages: States in no pair with a rate that an input or another state changes; in co-simulation, outputs in
            no pair that have an input of their own, which acts through one integrator.
        feeds: In co-simulation, storage → this input.
        shown: State → output that equals it.
        largest_rate: Largest |eigenvalue| over the points [1/s]; 0 for co-simulation.
        scales: Standard deviation along the logs by name; the rate of x is `der(x)`.
        step: Shortest usual step of the logs [s].
        events: Events along each log, in model exchange.
        connections: In model exchange, springs and dampers between pairs.
        dampings: In model exchange, the parameter that brakes each pair without an input of its own.
        starts: In co-simulation, start values of states that change an output.
        stops: Reason for each simulation that ended early.
    """

    fmu: Path
    way: Way
    states: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...]
    depends: Flags
    pairs: tuple[Pair, ...]
    storages: tuple[str, ...]
    scales: NamedValues
    step: float
    shown: Mapping[str, str] = field(default_factory=dict)
    largest_rate: float = 0.0
    events: tuple[EventCount, ...] = ()
    parameters: tuple[ProbedParameter, ...] = ()
    connections: tuple[Connection, ...] = ()
    dampings: tuple[Damping, ...] = ()
    feeds: Mapping[str, Port] = field(default_factory=dict)
    starts: tuple[StartValue, ...] = ()
    stops: tuple[str, ...] = ()

    @property
    def acting(self) -> tuple[ProbedParameter, ...]:
        """Return parameters that change a rate or output."""
        return tuple(p for p in self.parameters if p.acts)

    @property
    def directions(self) -> tuple[Damping, ...]:
        """Return the dampings that alone tell how forces act: these change other rates, or not always the same."""
        return tuple(d for d in self.dampings if not (d.is_constant or d.port))

    def shown_as(self, state: str) -> str:
        """Return the output that equals a state, else the state itself."""
        return self.shown.get(state, state)
