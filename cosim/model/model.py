"""What a model is: states, inputs, outputs, parameters, effects and one body of equations.

The integrator, the FMU, the linearisation and the fits ask a model for nothing more. An effect is a
term the base model lacks: dormant at its neutral value, in which case it is left out of the
equations altogether and costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple, Self

from cosim.model.namespaces import SCALAR, Namespace
from cosim.model.planar import PlanarFrame
from cosim.model.quantities import Parameter, Quantity, parameters_of

# A number is a float, an array or a symbol, whichever the namespace handed in works on.
Number = Any
Values = tuple[Number, ...]
AUTO, RK4, STIFF = "auto", "rk4", "stiff"
INTEGRATORS = (AUTO, RK4, STIFF)


@dataclass(frozen=True, kw_only=True)
class Parametric:
    """A frozen dataclass of parameters that refuses values out of bounds, all of them at once."""

    @property
    def prefix(self) -> str:
        """What stands before a parameter's name where there are parameters of others beside it."""
        return ""

    def __post_init__(self) -> None:
        faults = [self.prefix + fault for p in parameters_of(self) if (fault := p.fault(getattr(self, p.name)))]
        if faults:
            raise ValueError("; ".join(faults))


@dataclass(frozen=True, kw_only=True)
class Effect(Parametric):
    """A term that may carry continuous states, and memory updated once a substep.

    name:   how the catalogue and the FMU (`name.parameter`) call it
    states: continuous states the effect adds to the model's
    memory: what it remembers between substeps; each has a start value `name.memory_start`
    delay:  a parameter [s]: the whole command acts so much later. Such an effect comes before all others and remembers
            a history of commands, with one quantity in `memory` for each input; where the whole log is at hand,
            the late command is looked up there instead
    starts: parameter values from which a fit starts as well, where its likelihood has more than one hill
    at_least: parameter → another of the effect that it is never below: what makes it physical, which no fit leaves
    """

    name: ClassVar[str]
    equation: ClassVar[str]
    states: ClassVar[tuple[Quantity, ...]] = ()
    memory: ClassVar[tuple[Quantity, ...]] = ()
    delay: ClassVar[str | None] = None
    starts: ClassVar[tuple[Mapping[str, float], ...]] = ()
    at_least: ClassVar[Mapping[str, str]] = {}

    @property
    def prefix(self) -> str:
        """The effect's name and a dot."""
        return f"{self.name}."

    @property
    def dormant(self) -> bool:
        """Every parameter that has a neutral value is at it. (Arrays and symbols count as awake.)"""
        awake = (p for p in parameters_of(self) if p.neutral is not None)
        return all(isinstance(v := getattr(self, p.name), (int, float)) and v == p.neutral for p in awake)

    def remember(self, t: Number, start: Values) -> Values:
        """Memory at time `t` [s] from the start values of `memory`."""
        return start

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        """Command that acts over the substep from `t` to `t + h` [s], and the memory after it."""
        return command, memory

    def transmit(self, m: Namespace, command: Mapping[str, Number]) -> Mapping[str, Number]:
        """Commands that act, by input, of those that have arrived: in derivative and output alike, of any model."""
        return command


def overrides(effects: tuple[Any, ...], hook: str, base: type) -> tuple[Any, ...]:
    """The effects whose class gives `hook` a body of its own, in order."""
    return tuple(e for e in effects if getattr(type(e), hook) is not getattr(base, hook))


def _prefixed(kinds: tuple[type[Any], ...]) -> dict[str, Parameter]:
    return {f"{kind.name}.{p.name}": p for kind in kinds for p in parameters_of(kind)}


class Validity(NamedTuple):
    """Within what inputs of one quantity stay, and what happens to the model beyond, in words."""

    quantity: str
    inputs: tuple[str, ...]
    low: float
    high: float
    beyond: str


class Equations(NamedTuple):
    """The body, bound to a namespace and to parameter values.

    derivative: (t, state, command) → d state / d t; state and result are tuples, effect states last
    output:     (t, state, command) → outputs
    """

    derivative: Callable[[Number, Values, Values], Values]
    output: Callable[[Number, Values, Values], Values]


@dataclass(frozen=True, kw_only=True)
class Model(Parametric):
    """Base of every model: declared quantities, parameters as fields, effects that add up."""

    title: ClassVar[str]
    base_states: ClassVar[tuple[Quantity, ...]]
    inputs: ClassVar[tuple[Quantity, ...]]
    outputs: ClassVar[tuple[Quantity, ...]]
    catalogue: ClassVar[tuple[type[Effect], ...]] = ()
    # What is known of a real one, in order: errors that its sensors may have; variance of each measured output; at the
    # start of a log, variance of each state that nothing measures (without it: the range of the model's own run,
    # squared); states whose equations may lack something; parameters that every fit recalibrates; further parameters
    # that may be wrong.
    sensors: ClassVar[tuple[type[Any], ...]] = ()
    sensor_variance: ClassVar[Mapping[str, float]] = {}
    start_variance: ClassVar[Mapping[str, float]] = {}
    forced: ClassVar[tuple[str, ...]] = ()
    calibrated: ClassVar[tuple[str, ...]] = ()
    # parameter → inputs that must vary in the logs, or it is not identifiable
    suspect: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    told_apart_by: ClassVar[Mapping[frozenset[str], str]] = {}  # rivals → the experiment that separates them, in words
    drawn_against: ClassVar[
        Mapping[str, tuple[str, ...]]
    ] = {}  # effect or parameter → signals its form says to look at
    measured: ClassVar[tuple[str, ...]] = ()  # outputs that are usually logged; without, those of `sensor_variance`
    excursion: ClassVar[Mapping[str, float]] = {}  # signal → how far from its start an experiment may take it
    valid: ClassVar[tuple[Validity, ...]] = ()  # ranges that the model was made for; beyond one, it warns once
    planar: ClassVar[PlanarFrame | None] = None  # names of a motion in a plane
    substep: ClassVar[float] = 0.005  # longest integration substep [s]
    integrator: ClassVar[str] = AUTO  # of INTEGRATORS; "auto" is RK4, or the implicit method for a stiff model
    rate: ClassVar[float] = 0.02  # communication step the model is made for [s]
    horizon: ClassVar[float] = 2.0  # [s] over which replays are judged; infinite: one free run over the whole log

    effects: tuple[Any, ...] = field(default=())
    chosen_substep: float | None = field(default=None)  # [s]; replaces `substep` where the class states none
    chosen_integrator: str | None = field(default=None)  # replaces `integrator`

    def __init_subclass__(cls, **keywords: Any) -> None:
        """A model without a title goes by the name of its class."""
        super().__init_subclass__(**keywords)
        if not hasattr(cls, "title"):
            cls.title = cls.__name__

    def __post_init__(self) -> None:
        super().__post_init__()
        strangers = [type(e).__name__ for e in self.effects if type(e) not in self.catalogue]
        if strangers:
            raise ValueError(f"not in the catalogue of {type(self).__name__}: {', '.join(strangers)}")
        in_order = sorted(self.effects, key=lambda e: self.catalogue.index(type(e)))
        object.__setattr__(self, "effects", tuple(in_order))
        if self.chosen_substep is not None:
            object.__setattr__(self, "substep", self.chosen_substep)
        if self.chosen_integrator is not None:
            object.__setattr__(self, "integrator", self.chosen_integrator)

    def equations(self, m: Namespace) -> Equations:
        """Bind the one body of equations to a namespace."""
        raise NotImplementedError

    def start_state(self, m: Namespace = SCALAR) -> dict[str, Number]:
        """Start value of each base state that is not simply its quantity's."""
        return {}

    def warning(self, command: Values) -> str | None:
        """What to warn of where a command leaves the range the model was made for, by `valid`."""
        acting = {q.name: (value, q.unit) for q, value in zip(self.inputs, command, strict=True)}
        for quantity, inputs, low, high, beyond in self.valid:
            values = [acting[name] for name in inputs]
            if not all(low <= value <= high for value, _ in values):
                return f"{quantity} {', '.join(f'{value:g} {unit}' for value, unit in values)}: {beyond}"
        return None

    def start_input(self) -> dict[str, Number]:
        """Start value of each input that is not simply its quantity's."""
        return {}

    # -- the same for every model -------------------------------------------------------------

    def acting(self, m: Namespace) -> Equations:
        """The equations bound to a namespace, under the commands that the effects transmit."""
        bound = self.equations(m)
        names = [q.name for q in self.inputs]
        terms = overrides(self.awake, "transmit", Effect)
        if not terms:
            return bound

        def transmitted(command: Values) -> Values:
            through: Mapping[str, Number] = dict(zip(names, command, strict=True))
            for term in terms:
                through = term.transmit(m, through)
            return tuple(through[name] for name in names)

        return Equations(
            lambda t, state, command: bound.derivative(t, state, transmitted(command)),
            lambda t, state, command: bound.output(t, state, transmitted(command)),
        )

    @property
    def static(self) -> bool:
        """Without states: outputs follow the inputs at once, and what is measured is a table without time."""
        return not self.base_states

    @property
    def awake(self) -> tuple[Any, ...]:
        """The effects that act, in catalogue order."""
        return tuple(e for e in self.effects if not e.dormant)

    @property
    def states(self) -> tuple[Quantity, ...]:
        """Base states, then those of the effects that act, named `effect.state`."""
        return self.base_states + tuple(
            Quantity(f"{e.name}.{s.name}", s.unit, s.doc, s.start) for e in self.awake for s in e.states
        )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the base model."""
        return parameters_of(self)

    @property
    def declared(self) -> dict[str, Parameter]:
        """Every parameter that `with_values` knows: of the base model by name, of the catalogue `effect.parameter`."""
        return {p.name: p for p in self.parameters} | _prefixed(self.catalogue)

    @property
    def sensor_parameters(self) -> dict[str, Parameter]:
        """The parameters of the errors that the sensors may have, by `sensor.parameter`."""
        return _prefixed(self.sensors)

    def with_effect(self, effect: Any) -> Self:
        """Another model with the effect added, or put in place of one of the same kind."""
        others = tuple(e for e in self.effects if type(e) is not type(effect))
        return replace(self, effects=(*others, effect))

    def with_values(self, values: Mapping[str, Number]) -> Self:
        """Another model with `parameter` and `effect.parameter` values; raises KeyError on an unknown name."""
        known = {p.name for p in self.parameters}
        base = {name: v for name, v in values.items() if name in known}
        grouped: dict[str, dict[str, Number]] = {}
        for name in values.keys() - base.keys():
            effect, _, parameter_name = name.partition(".")
            grouped.setdefault(effect, {})[parameter_name] = values[name]
        model = replace(self, **base)
        kinds = {kind.name: kind for kind in self.catalogue}
        present = {e.name: e for e in self.effects}
        for name, changes in grouped.items():
            term = present.get(name) or kinds[name]()
            if unknown := changes.keys() - {p.name for p in parameters_of(term)}:
                raise KeyError(f"{name}.{sorted(unknown)[0]}")
            model = model.with_effect(replace(term, **changes))
        return model

    def with_substep(self, substep: float | None, integrator: str | None = None) -> Self:
        """Return the model with another longest substep [s] and integrator; None is that of its class."""
        return replace(self, chosen_substep=substep, chosen_integrator=integrator)

    def start(self, values: Mapping[str, Number] | None = None, m: Namespace = SCALAR) -> Values:
        """Initial state from start values by state name (`position`, `effect.state`)."""
        values = values or {}
        own = self.start_state(m)
        return tuple(values.get(s.name, own.get(s.name, s.start)) for s in self.states)

    def start_command(self) -> Values:
        """Inputs at their start values."""
        own = self.start_input()
        return tuple(own.get(q.name, q.start) for q in self.inputs)
