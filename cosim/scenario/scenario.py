"""Scenario files: what is run, how it is connected, what it must achieve."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    SerializeAsAny,
    Tag,
)

from cosim.blocks.profile import Profile
from cosim.coupling.algorithms import DEFAULT, AlgorithmKey
from cosim.isolation.limits import Limits
from cosim.storage.yaml_file import (
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

LARGEST_NUMBER = 1e308  # about what a double holds; larger integers are no numbers of FMI
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
Variable = Annotated[str, Field(pattern=r"(?s)^[A-Za-z_][A-Za-z0-9_]*\..+$")]


def _scalar(value: Any) -> Any:
    """A start value: a finite number, true or false, or text (a number with a unit, the value of a string, an item).

    Of an array a list of them.
    """
    if isinstance(value, list):
        return [_scalar(each) for each in value]
    if isinstance(value, (bool, str)) or (isinstance(value, (int, float)) and abs(value) < LARGEST_NUMBER):
        return value
    raise ValueError("a start value is a finite number, true or false, or text such as 12 deg")


def _kind_of(component: Any) -> str | None:
    """Which kind of component a mapping describes, by the key that only this kind has."""
    if isinstance(component, FmuComponent | ReferenceComponent | PlaybackComponent | FixComponent):
        return f"«{getattr(component, 'block', 'fmu')}»"
    if not isinstance(component, dict):
        return None
    block = component.get("block")
    return f"«{block}»" if block in BLOCKS else "«fmu»" if "fmu" in component else None


BLOCKS = ("reference", "playback", "fix")


class Noise(Part):
    """Gaussian noise and bias that a connection adds, in the square of the signal's unit and in its unit.

    variance: in the square of the unit of the input
    bias:     in the unit of the input
    """

    variance: NotNegativeAmount = 0.0
    bias: Amount = 0.0


class Connection(Part):
    """From one output to one input.

    from:   the output, `component.variable`
    to:     the input, `component.variable`; it has one source
    noise:  what the connection adds
    factor: in place of the conversion of their units
    offset: added after the factor, in the unit of the input
    """

    source: Variable = Field(alias="from")
    target: Variable = Field(alias="to")
    noise: Noise | None = None
    factor: Number | None = None
    offset: Amount | None = None

    @property
    def conversion(self) -> tuple[float, float] | None:
        """Factor and offset; None where the units say what becomes of a value."""
        if self.factor is None and self.offset is None:
            return None
        return 1.0 if self.factor is None else self.factor, self.offset or 0.0


class Disturbance(Part):
    """A fault on the connection to an input, from one time to another [s], in the unit of that input.

    on:   the input, `component.variable`
    from: when it begins [s]; at the start without
    to:   when it ends [s]; at the end without
    value: in the unit of the input
    probability: of each sample, 0 … 1
    delay: [s]
    kind: bias adds `value`; scale multiplies by it; stuck puts it in place; freeze holds what came last; dropout
    loses samples with `probability` and holds the last that came; spike adds `value`, once or with `probability`
    at each sample; delay passes on what came `delay` [s] before
    """

    on: Variable
    kind: Literal["bias", "scale", "stuck", "freeze", "dropout", "spike", "delay"]
    value: Amount | None = None
    probability: Annotated[float, Field(strict=True, gt=0, le=1), Share] | None = None
    delay: PositiveSeconds | None = None
    begin: Seconds | None = Field(default=None, alias="from")
    end: Seconds | None = Field(default=None, alias="to")


class Event(Part):
    """Values that parameters and inputs get at a time.

    at:  [s]; at the first communication point that is not before
    set: `component.variable` → value
    """

    at: Seconds
    set: dict[Variable, Annotated[Any, AfterValidator(_scalar)]] = Field(min_length=1)


class FmuComponent(Part):
    """An FMU and the start values it is given, a number in the variable's unit or text such as `12 deg`.

    fmu:     the file, relative to the scenario
    start:   variable → value: parameters, and inputs that nothing feeds
    process: `own` for one that shares its process with no other FMU
    interface: how it is run where it offers both
    step:      its communication step [s], a whole multiple of the scenario's
    tolerance: relative, of its solver
    logging:   its debug messages are asked for
    solver:    of model exchange
    sha256:    of the file; a manifest has it
    """

    fmu: str
    process: Literal["own"] | None = None
    start: dict[str, Annotated[Any, AfterValidator(_scalar)]] = Field(default_factory=dict)
    interface: Literal["co-simulation", "model-exchange"] | None = None
    step: PositiveSeconds | None = None
    tolerance: Positive | None = None
    logging: bool = False
    solver: Literal["cvode", "solve_ivp"] | None = None
    sha256: str | None = None


class ReferenceComponent(Part):
    """Reference signals made by steps and ramps.

    block:   reference
    signals: name → unit, start value and changes
    """

    block: Literal["reference"]
    signals: dict[str, Profile] = Field(min_length=1)


class PlaybackComponent(Part):
    """Columns of a CSV file, each value held until the next row.

    block:  playback
    file:   the CSV, relative to the scenario; its first column is time [s]
    sha256: of the file; a manifest has it
    """

    block: Literal["playback"]
    file: str
    sha256: str | None = None


class FixedSignal(Part):
    """A signal that fixes measure: it comes in as NAME, its fixes go out as `NAME_meas`.

    unit:  of the signal
    noise: of a fix
    """

    unit: str = ""
    noise: Noise | None = None


class FixComponent(Part):
    """A sensor that measures now and then and answers late, such as a camera, a beacon or a range to a wall.

    block:   fix
    rate:    fixes a second [Hz], the first at the start; each at the first communication point that is not before
    latency: [s] from what is measured to when it is known
    dropout: probability that a fix is lost, 0 … 1
    signals: name → unit and noise; all are measured at once. `NAME_meas` holds the latest fix, `fix` its number, 0
             before the first
    """

    block: Literal["fix"]
    rate: Annotated[Positive, InUnit("Hz")]
    latency: NotNegativeSeconds = 0.0
    dropout: Annotated[float, Field(strict=True, ge=0, le=1), Share] = 0.0
    signals: dict[Name, FixedSignal] = Field(min_length=1)


class Design(Part):
    """Start values of a controller designed before the run; further keys are the designer's (`cosim.base.registry`).

    `component`: the FMU that gets them
    `model`: a model file, from whose equations its numbers are taken; those given beside it win
    `nearest`: of the refine that left it, the model that came nearest
    """

    model_config = ConfigDict(extra="allow")

    component: Name = "controller"
    model: str | None = None
    nearest: bool | None = None


class Criterion(Part):
    """A figure of merit and its limit.

    of:    the signal, `component.variable`
    to:    what it is held against, a number or another signal; 0 without
    band:  of settling_time, in the unit of the signal
    after: from when on it is looked at [s] after the start
    until: up to when [s] after the start
    max:   most that it may be, in the unit of the signal; of settling_time [s]
    """

    of: Variable
    to: Number | Variable = 0.0
    band: PositiveAmount | None = None
    after: Seconds = 0.0
    until: Seconds | None = None
    max: Amount


Connections = Annotated[  # all of them commented out leave a key without a value
    list[Connection],
    BeforeValidator(lambda given: [] if given is None else given),
    Field(json_schema_extra={"type": ["array", "null"]}),
]
Criteria = dict[
    Literal["settling_time", "overshoot", "rms_error", "final_error", "peak", "effort"], Criterion | list[Criterion]
]
Component = Annotated[
    Annotated[FmuComponent, Tag("«fmu»")]
    | Annotated[ReferenceComponent, Tag("«reference»")]
    | Annotated[PlaybackComponent, Tag("«playback»")]
    | Annotated[FixComponent, Tag("«fix»")],
    Discriminator(
        _kind_of,
        custom_error_type="component",
        custom_error_message="a component has fmu: FILE, or block: reference, playback or fix",
    ),
]


class Scenario(Part):
    """One co-simulation.

    name:        shown in the report; results go to results/NAME
    description: shown in the report
    duration:    [s], a whole number of steps
    step:        communication step [s]
    start_time:  [s]
    seed:        of every random stream; the same seed gives the same bytes
    order:       components with inputs, in the order in which they step; where their FMUs do not settle it
    noise:       on or off, of all connections
    tolerance:   relative, of the solvers; each FMU's own without
    record:      patterns such as `plant.*`: locals and parameters recorded beside inputs and outputs
    design:      start values of a controller designed before the run
    components:  name → FMU, reference, recording or fixes
    connections: from outputs to inputs
    events:      values that parameters and inputs get at a time
    faults:      what disturbs a connection
    criteria:    what must hold; a missed one exits 5
    limits:      how long and how large a run may get
    """

    name: str
    description: str = ""
    duration: PositiveSeconds
    step: PositiveSeconds
    start_time: Seconds = 0.0
    seed: Annotated[int, Field(strict=True, ge=0)] = 0
    algorithm: Annotated[str, AlgorithmKey()] = DEFAULT.name  # its description is that of the algorithms
    order: list[Name] | None = None
    noise: bool = True
    tolerance: Positive | None = None
    record: list[str] = Field(default_factory=list)
    design: SerializeAsAny[Design] | None = None
    components: dict[Name, Component] = Field(min_length=1)
    connections: Connections = Field(default_factory=list)
    events: list[Event] = Field(default_factory=list)
    faults: list[Disturbance] = Field(default_factory=list)
    criteria: Criteria = Field(default_factory=dict)
    limits: Limits | None = None

    @property
    def steps(self) -> int:
        """Number of communication steps."""
        return round(min(self.duration / self.step, 1e18))  # which nobody takes; beyond a double is no number

    @property
    def goals(self) -> list[tuple[str, int | None, Criterion]]:
        """Every criterion: kind, its place in a list of several, itself."""
        flat: list[tuple[str, int | None, Criterion]] = []
        for kind, one_or_many in self.criteria.items():
            if isinstance(one_or_many, Criterion):
                flat.append((kind, None, one_or_many))
            else:
                flat += [(kind, k, criterion) for k, criterion in enumerate(one_or_many)]
        return flat


def resolved(scenario: Scenario) -> dict[str, Any]:
    """A scenario as a JSON mapping, defaults spelled out."""
    data: dict[str, Any] = json.loads(scenario.model_dump_json(by_alias=True, exclude_none=True))
    return data
