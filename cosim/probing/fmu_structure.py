"""Structure of an FMU, found by simulation: dependencies, pairs, ports, time constants, effective parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from cosim.core.arrays import Flags, NamedValues
from cosim.fmi.description import Way
from cosim.model.quantities import Quantity
from cosim.terms.language import RatioFactor

START_STEP = 1e-2  # displacement of a start value or an input, as a share of its size, range or nominal value


@dataclass(frozen=True)
class Port:
    """An input that acts directly on the derivative of a velocity (but not of its position), or of a storage state.

    Attributes:
        gain: ∂v'/∂u, the median over the points.
        is_alone: True if the input changes only this derivative.
    """

    input: str
    gain: float
    is_alone: bool


@dataclass(frozen=True)
class Pair:
    """A position and its velocity: q' = gain·v.

    In co-simulation both are outputs.

    Attributes:
        ports: Inputs that act on the velocity like forces.
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
        gear: Ratio i of the positions at rest, first to second; 1 unless this connection is the only force on both at
            rest.
        ratio: Acceleration r of the second pair divided by the opposite acceleration of the first.
        stiffness, damping: k and d, medians over the points.
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
    """A settable parameter b that damps a velocity v: f(x; b + δ) − f(x; b) = −δ·v·d(x).

    The vector d(x) contains the change of all derivatives per unit of force along v, so it shows how any force along v
    acts. The unit of force is the unit of b times the unit of v.

    Attributes:
        parameter: Name of b.
        gain: Median of the component of d for v.
        rates: States whose derivatives change.
        is_constant: True if only the derivative of v changes, with the same d at all points.
        port: Input that acts in the direction of d, so that forces can be added to it; "" if there is none.
        change, speed: Typical values of δ and v.
        in_step: True if a second instance can be synchronized with the first: no events, and both in one process.
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
    """Number of events of an FMU along a log, without changes of inputs.

    Attributes:
        state, time, step: Numbers of state events, time events and step events.
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
    """A real parameter that can be set before initialization.

    Attributes:
        acts: True if another value changes a derivative or an output.
        starts: True if another value changes a state after initialization.
        tried: Value that was tried last.
        failure: Failure of the FMU, e.g. a crash, with a value near the default; "" without failure.
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
    """A start value of an FMU for co-simulation, used to set an unknown initial state.

    Attributes:
        size: Change of the start value that changes an output by its standard deviation.
        shown: Index of the output that equals the start value after initialization; −1 if there is none.
        gain: Change of this output divided by the change of the start value.
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
    """Structure of an FMU, found by simulation along logs.

    All names are FMU variables, in the order of the FMU; arrays have an entry for each element.

    Attributes:
        way: Probed interface.
        states: Continuous states; empty for co-simulation.
        depends: True if a derivative or output (row) changes with a state or input (column). In co-simulation an output
            depends on an input that changes it at any later time.
        pairs: Positions with their velocities.
        storages: States outside pairs whose derivative depends on an input or another state; in co-simulation, outputs
            outside pairs that integrate an input which changes no other output.
        feeds: In co-simulation, storage → input that it integrates.
        shown: State → output that equals it.
        largest_rate: Largest |eigenvalue| over the points [1/s]; 0 for co-simulation.
        scales: Standard deviation along the logs by name; the derivative of x is `der(x)`.
        step: Shortest typical step of the logs [s].
        events: Events along each log, in model exchange.
        connections: In model exchange, springs and dampers between pairs.
        dampings: In model exchange, the parameter that damps each pair without an input of its own.
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
        """Return the parameters that change a derivative or an output."""
        return tuple(p for p in self.parameters if p.acts)

    @property
    def directions(self) -> tuple[Damping, ...]:
        """Return the dampings that are needed to add forces, because d(x) varies or has several components."""
        return tuple(d for d in self.dampings if not (d.is_constant or d.port))

    def shown_as(self, state: str) -> str:
        """Return the output that equals a state; if there is none, the state itself."""
        return self.shown.get(state, state)
