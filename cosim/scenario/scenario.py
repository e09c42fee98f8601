"""Scenario files: components, connections and criteria of a run."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag

from cosim.blocks.coupling import DEFAULT, AlgorithmKey
from cosim.blocks.profile import Profile
from cosim.files.yaml_file import (
    UNIT_OF_KEY,
    Amount,
    InUnit,
    NotNegativeAmount,
    NotNegativeSeconds,
    Number,
    Part,
    Positive,
    PositiveAmount,
    PositiveSeconds,
    Seconds,
    Share,
)
from cosim.isolation.limits import Limits

Course = Literal["hold", "linear", "quadratic"]
COURSES: tuple[Course, ...] = ("hold", "linear", "quadratic")  # index: polynomial degree
Place = tuple[str | int, ...]  # keys of a part of the scenario
LARGEST_NUMBER = 1e308  # approximate limit of doubles; FMI has no larger integers
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
Variable = Annotated[str, Field(pattern=r"(?s)^[A-Za-z_][A-Za-z0-9_]*\..+$")]


def scalar(value: Any) -> Any:
    """Return a value if it is valid: a finite number, true or false, or text; raise ValueError if not.

    Text is a number with a unit, a string or an enumeration item. The value of an array is a list.
    """
    if isinstance(value, list):
        return [scalar(each) for each in value]
    if isinstance(value, (bool, str)) or (isinstance(value, (int, float)) and abs(value) < LARGEST_NUMBER):
        return value
    raise ValueError("use a finite number, true or false, or text such as 12 deg")


def _kind_of(component: Any) -> str | None:
    """Return the kind of a component in guillemets, such as «fmu» or «playback»; None for an unknown kind."""
    if isinstance(component, FmuComponent | ReferenceComponent | PlaybackComponent | FixComponent):
        return f"«{getattr(component, 'block', 'fmu')}»"
    if not isinstance(component, dict):
        return None
    block = component.get("block")
    return f"«{block}»" if block in SOURCE_KEYS else "«fmu»" if "fmu" in component else None


SOURCE_KEYS = ("reference", "playback", "fix")


class Noise(Part):
    """Gaussian noise and bias added by a connection.

    variance: in the square of the unit of the input
    bias:     in the unit of the input
    """

    variance: NotNegativeAmount = 0.0
    bias: Amount = 0.0


class Connection(Part):
    """Connection of an output to an input.

    from:   the output, `component.variable`
    to:     the input, `component.variable`; an input has one source
    noise:  noise and bias added to the value
    factor: multiplies the value, instead of a unit conversion
    offset: added after the factor, in the unit of the input
    """

    source: Variable = Field(alias="from")
    target: Variable = Field(alias="to")
    noise: Noise | None = None
    factor: Number | None = None
    offset: Amount | None = None

    @property
    def ends(self) -> tuple[str, str, str, str]:
        """Return the component and the name of the output, then of the input."""
        return *self.source.split(".", 1), *self.target.split(".", 1)  # type: ignore[return-value]

    @property
    def conversion(self) -> tuple[float, float] | None:
        """Return factor and offset of the connection; None for automatic unit conversion."""
        if self.factor is None and self.offset is None:
            return None
        return 1.0 if self.factor is None else self.factor, self.offset or 0.0


class Disturbance(Part):
    """Fault on the connection to an input during an interval [s].

    on:   the input, `component.variable`
    from: start [s]; by default the start of the run
    to:   end [s]; by default the end of the run
    value: in the unit of the input
    probability: per sample, 0 … 1
    delay: [s]
    kind: bias adds `value`; scale multiplies by `value`; stuck replaces the signal by `value`; freeze keeps the last
        value; dropout loses samples with `probability` and keeps the last received one; spike adds `value`, once or
        with `probability` per sample; delay delays the signal by `delay` [s]
    """

    on: Variable
    kind: Literal["bias", "scale", "stuck", "freeze", "dropout", "spike", "delay"]
    value: Amount | None = None
    probability: Annotated[float, Field(strict=True, gt=0, le=1), Share] | None = None
    delay: PositiveSeconds | None = None
    begin: Seconds | None = Field(default=None, alias="from")
    end: Seconds | None = Field(default=None, alias="to")


class Event(Part):
    """Values set for parameters and inputs at a time.

    at:  time [s]; the values are set at the first communication point at or after this time
    set: `component.variable` → value
    """

    at: Seconds
    set: dict[Variable, Annotated[Any, AfterValidator(scalar)]] = Field(min_length=1)


class ClockTiming(Part):
    """Times of an input clock of an FMU.

    interval: time [s] between two ticks, of a triggered clock, or in place of the declared interval of a fixed or
        tunable clock
    shift:    time [s] from the start of the run to the first tick of a triggered clock
    at:       times [s] of all ticks of a triggered clock, in order
    """

    interval: PositiveSeconds | None = None
    shift: NotNegativeSeconds | None = None
    at: list[Seconds] = Field(default_factory=list)


class FmuComponent(Part):
    """FMU with start values: a number in the variable's unit, or text such as `12 deg`.

    fmu:     file, relative to the scenario
    start:   variable → value, for parameters and unconnected inputs
    parameters: parameter sets (SSV), files relative to the scenario, such as fitted.ssv; later files override
        earlier ones, and `start` overrides all
    process: `own` for a process of its own, not shared with other FMUs
    interface: FMI interface, if the FMU offers several
    event_mode: true to use event mode in FMI 3.0 co-simulation; by default true if the FMU has clocks
    clocks:    input clock → its times
    step:      communication step of this FMU [s], a whole multiple of the scenario's step
    tolerance: relative tolerance of the FMU's solver
    logging:   true for debug logging
    solver:    solver for model exchange
    solver_step: longest step of the solver [s]; by default 1/50 of the run
    max_steps: largest number of solver steps between communication points and events; by default 500 for
        CVODE, any number for solve_ivp
    feedthrough: inputs with direct feedthrough, for an FMU that declares no dependencies; [] for none. By default a
        run measures them at its start, if a loop depends on them
    sha256:    SHA-256 of the file, as written to a manifest
    """

    fmu: str
    process: Literal["own"] | None = None
    parameters: str | list[str] = Field(default_factory=list)
    start: dict[str, Annotated[Any, AfterValidator(scalar)]] = Field(default_factory=dict)
    interface: Literal["co-simulation", "model-exchange", "scheduled-execution"] | None = None
    event_mode: bool | None = None
    clocks: dict[str, ClockTiming] = Field(default_factory=dict)
    step: PositiveSeconds | None = None
    tolerance: Positive | None = None
    logging: bool = False
    solver: Literal["cvode", "solve_ivp"] | None = None
    solver_step: PositiveSeconds | None = None
    max_steps: Annotated[int, Field(strict=True, ge=1)] | None = None
    feedthrough: list[str] | None = None
    sha256: str | None = None


class ReferenceComponent(Part):
    """Reference signals made of steps and ramps.

    block:   reference
    signals: name → unit, start value and changes
    """

    block: Literal["reference"]
    signals: dict[str, Profile] = Field(min_length=1)


class PlaybackComponent(Part):
    """Columns of a CSV file.

    block:         playback
    file:          CSV file, relative to the scenario; its first column is time [s]
    interpolation: held: each value applies until the next row; linear: interpolated. Equal times mark a jump
    sha256:        SHA-256 of the file, as written to a manifest
    """

    block: Literal["playback"]
    file: str
    interpolation: Literal["held", "linear"] = "held"
    sha256: str | None = None


class FixedSignal(Part):
    """Signal of a fix sensor: input NAME, output `NAME_meas`.

    unit:  unit of the signal
    noise: noise of each fix
    """

    unit: str = ""
    noise: Noise | None = None


class FixComponent(Part):
    """Sensor with sporadic, delayed fixes, such as a camera, a beacon or a range to a wall.

    block:   fix
    rate:    fixes per second [Hz], the first one at the start of the run; each fix is taken at the first communication
        point at or after its time
    latency: delay from measurement to output [s]
    dropout: probability of losing a fix, 0 … 1
    signals: name → unit and noise; all signals are measured at the same time. Output `NAME_meas` is the latest fix,
        output `fix` its number, 0 before the first fix
    """

    block: Literal["fix"]
    rate: Annotated[Positive, InUnit("Hz")]
    latency: NotNegativeSeconds = 0.0
    dropout: Annotated[float, Field(strict=True, ge=0, le=1), Share] = 0.0
    signals: dict[Name, FixedSignal] = Field(min_length=1)


class Bond(Part):
    """Power bond of two FMUs: two outputs whose product is a power, each connected to an input of the other FMU.

    effort: a force, torque, voltage or pressure, `component.output`
    flow:   the matching velocity, speed, current or flow, `component.output`
    """

    effort: Variable
    flow: Variable


class StepControl(Part):
    """Communication steps controlled by their error.

    max:       longest step [s]
    min:       shortest step [s]
    tolerance: largest error of a step, relative to a signal's magnitude or its nominal value, whichever is larger
    per:       step; or second, if `tolerance` is an error per second of simulated time (estimator halving only)
    rows:      time between rows of the results [s]; a step never extends beyond a row; by default `max`
    estimator: halving, residual or energy; by default energy with bonds, halving if all FMUs save and restore their
        state, otherwise residual
    bonds:     power bonds of the estimator energy
    """

    max: PositiveSeconds
    min: PositiveSeconds
    tolerance: Positive = 1e-4
    per: Literal["step", "second"] = "step"
    rows: PositiveSeconds | None = None
    estimator: Literal["halving", "residual", "energy"] | None = None
    bonds: list[Bond] = Field(default_factory=list)


class Recording(Part):
    """Recorded part of a run.

    signals: patterns of the signals to record, such as `plant.*`, including locals and parameters; by default all
        inputs and outputs
    every:   time between recorded rows [s], a whole number of steps; by default the step
    """

    signals: Annotated[list[str], Field(min_length=1)] | None = None
    every: PositiveSeconds | None = None


class LoopSettings(Part):
    """Solution of algebraic loops at each communication point.

    tolerance:  largest residual, relative to a signal's magnitude or its nominal value, whichever is larger
    iterations: maximum number of iterations at a communication point
    method:     newton, or anderson for fixed-point iterations with Anderson acceleration; by default newton, and
        anderson for loops with too many signals for finite differences
    """

    tolerance: Positive = 1e-8
    iterations: Annotated[int, Field(strict=True, ge=1)] = 20
    method: Literal["newton", "anderson"] | None = None


class Criterion(Part):
    """Figure of merit with a limit.

    of:    signal, `component.variable`
    to:    target, a number or another signal; default 0
    band:  tolerance band of settling_time, in the unit of the signal
    after: start of the evaluation, in seconds after the start of the run
    until: end of the evaluation, in seconds after the start of the run
    max:   largest allowed value, in the unit of the signal; of settling_time [s]
    """

    of: Variable
    to: Annotated[Number | Variable, UNIT_OF_KEY] = 0.0
    band: PositiveAmount | None = None
    after: Seconds = 0.0
    until: Seconds | None = None
    max: Amount


class ValidCriterion(Part):
    """Required share of the time that an FMU spends in the region covered by the logs of its fit.

    of:  component whose FMU has a record of credibility
    min: required share, 0 … 1
    """

    of: Name
    min: Annotated[float, Field(strict=True, ge=0, le=1), Share]


def _goal_of(criterion: Any) -> str:
    """Return the tag of the union branch for a criterion: of a component, or of a signal."""
    keys = criterion if isinstance(criterion, dict) else vars(criterion) if isinstance(criterion, Part) else {}
    return "«component»" if "min" in keys else "«signal»"


Goal = Annotated[
    Annotated[Criterion, Tag("«signal»")] | Annotated[ValidCriterion, Tag("«component»")], Discriminator(_goal_of)
]
Connections = Annotated[  # a key with all entries commented out has no value
    list[Connection],
    BeforeValidator(lambda value: [] if value is None else value),
    Field(json_schema_extra={"type": ["array", "null"]}),
]
Criteria = dict[
    Literal["settling_time", "overshoot", "rms_error", "final_error", "peak", "effort", "valid"], Goal | list[Goal]
]
Component = Annotated[
    Annotated[FmuComponent, Tag("«fmu»")]
    | Annotated[ReferenceComponent, Tag("«reference»")]
    | Annotated[PlaybackComponent, Tag("«playback»")]
    | Annotated[FixComponent, Tag("«fix»")],
    Discriminator(
        _kind_of,
        custom_error_type="component",
        custom_error_message="a component needs fmu: FILE, or block: reference, playback or fix",
    ),
]


class Scenario(Part):
    """Co-simulation scenario.

    name:        title in the report; results go to results/NAME
    description: text in the report
    duration:    [s], a whole number of steps
    step:        communication step [s], or the control of its error
    start_time:  [s]
    seed:        seed of all random streams; the same seed gives the same bytes
    order:       stepping order of components with inputs, if declared dependencies do not determine it
    extrapolate: inputs during a step, if only past values are available; by default hold, or linear with controlled
        steps
    interpolate: inputs during a step, if the value at its end is available; by default hold, or linear with controlled
        steps
    loops:       solution of algebraic loops; inputs without declared dependencies can then be part of a loop
    noise:       on or off, for all connections
    tolerance:   relative tolerance of the solvers; by default each FMU's own
    record:      patterns, such as `plant.*`, of locals and parameters to record besides inputs and outputs; or a
        mapping that selects signals and rows
    components:  name → FMU, reference, recording or fixes
    connections: from outputs to inputs
    events:      values set for parameters and inputs at a time
    faults:      faults on connections
    criteria:    figures of merit with limits; a missed criterion leads to exit code 5
    limits:      limits on time and memory of a run
    checkpoint:  wall-clock time [s] between two checkpoints, from which `cosim run FOLDER --resume` continues
    pace:        simulated seconds per second: 1 for real time; by default as fast as possible
    display:     unit → unit in which reports, tables and charts show it; by default the display unit of the FMUs.
        Files always have the declared units
    """

    name: str
    description: str = ""
    duration: PositiveSeconds
    stepping: Annotated[
        Annotated[PositiveSeconds, Tag("«equal»")] | Annotated[StepControl, Tag("«controlled»")],
        Discriminator(lambda step: "«controlled»" if isinstance(step, dict | StepControl) else "«equal»"),
    ] = Field(alias="step")
    start_time: Seconds = 0.0
    seed: Annotated[int, Field(strict=True, ge=0)] = 0
    algorithm: Annotated[str, AlgorithmKey()] = DEFAULT.name  # its description lists the registered algorithms
    order: list[Name] | None = None
    extrapolate: Course | None = None
    interpolate: Course | None = None
    loops: LoopSettings | None = None
    noise: bool = True
    tolerance: Positive | None = None
    record: Annotated[
        Annotated[list[str], Tag("«more»")] | Annotated[Recording, Tag("«part»")],
        Discriminator(lambda record: "«part»" if isinstance(record, dict | Recording) else "«more»"),
    ] = Field(default_factory=list)
    components: dict[Name, Component] = Field(min_length=1)
    connections: Connections = Field(default_factory=list)
    events: list[Event] = Field(default_factory=list)
    faults: list[Disturbance] = Field(default_factory=list)
    criteria: Criteria = Field(default_factory=dict)
    limits: Limits | None = None
    checkpoint: PositiveSeconds | None = None
    pace: Positive | None = None
    display: dict[str, str] = Field(default_factory=dict)

    @property
    def control(self) -> StepControl | None:
        """Return the step control; None for steps of equal length."""
        return self.stepping if isinstance(self.stepping, StepControl) else None

    @property
    def step(self) -> float:
        """Return the time between rows [s]."""
        if isinstance(self.stepping, StepControl):
            return self.stepping.max if self.stepping.rows is None else self.stepping.rows
        return self.stepping

    @property
    def recorded(self) -> list[str]:
        """Return the patterns of the locals and parameters to record besides inputs and outputs."""
        return (self.record.signals or []) if isinstance(self.record, Recording) else self.record

    @property
    def targets(self) -> frozenset[str]:
        """Return the connected inputs, by name `component.variable`."""
        return frozenset(connection.target for connection in self.connections)

    @property
    def isolated(self) -> frozenset[str]:
        """Return the names of components with a process of their own."""
        every = self.components.items()
        return frozenset(name for name, c in every if isinstance(c, FmuComponent) and c.process == "own")

    @property
    def courses(self) -> tuple[int, int]:
        """Return the polynomial degrees of extrapolated and of interpolated inputs."""
        default = COURSES[0] if self.control is None else COURSES[1]
        return COURSES.index(self.extrapolate or default), COURSES.index(self.interpolate or default)

    @property
    def steps(self) -> int:
        """Return the number of steps between rows, which is the number of rows minus one."""
        return round(min(self.duration / self.step, 1e18))  # above the limit of any run; infinity has no integer

    @property
    def goals(self) -> list[tuple[str, Place, Criterion]]:
        """Return all criteria of signals as (kind, place in the scenario, criterion)."""
        return [(kind, at, c) for kind, at, c in self.every_goal if isinstance(c, Criterion)]

    @property
    def valid_goals(self) -> list[tuple[str, Place, ValidCriterion]]:
        """Return all criteria of components as (kind, place in the scenario, criterion)."""
        return [(kind, at, c) for kind, at, c in self.every_goal if isinstance(c, ValidCriterion)]

    @property
    def every_goal(self) -> list[tuple[str, Place, Criterion | ValidCriterion]]:
        """Return all criteria as (kind, place in the scenario, criterion)."""
        goals: list[tuple[str, Place, Criterion | ValidCriterion]] = []
        for kind, entry in self.criteria.items():
            if isinstance(entry, list):
                goals += [(kind, ("criteria", kind, k), criterion) for k, criterion in enumerate(entry)]
            else:
                goals.append((kind, ("criteria", kind), entry))
        return goals


def resolve_defaults(scenario: Scenario) -> dict[str, Any]:
    """Return a scenario as JSON data, including all defaults."""
    data: dict[str, Any] = json.loads(scenario.model_dump_json(by_alias=True, exclude_none=True))
    return data
