"""Models: states, inputs, outputs, parameters, effects, and one body of equations.

The integrator, FMU, linearization and fits use only this class. An effect is a term that the base model lacks. An
effect is dormant at its neutral value: it is left out of the equations and costs no time.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, replace
from typing import Any, ClassVar, NamedTuple, Self

from cosim.model.namespaces import SCALAR, Namespace
from cosim.model.planar import PlanarFrame
from cosim.model.quantities import Parameter, Quantity, parameters_of

# A number is a float, an array or a symbol, according to the namespace.
Number = Any
Values = tuple[Number, ...]
AUTO, RK4, STIFF = "auto", "rk4", "stiff"
INTEGRATORS = (AUTO, RK4, STIFF)


@dataclass(frozen=True, kw_only=True)
class Parametric:
    """A frozen dataclass of parameters with checked bounds; a single error names all invalid values."""

    def invalid_values(self) -> list[str]:
        """Return one sentence for each invalid parameter."""
        return [fault for p in parameters_of(self) if (fault := p.fault(getattr(self, p.name)))]

    def __post_init__(self) -> None:
        if faults := self.invalid_values():
            raise ValueError("; ".join(faults))


@dataclass(frozen=True, kw_only=True)
class Effect(Parametric):
    """A term of the equations, with optional continuous states and with memory that is updated once per substep.

    Attributes:
        name: Name in the catalogue and the FMU (`name.parameter`).
        states: Additional continuous states.
        memory: Quantities stored between substeps; each has a start value `name.memory_start`.
        delay: Name of the parameter that delays all inputs [s]. Such an effect is first in the catalogue and stores a
            history of commands, with one quantity in `memory` per input. Fits read the delayed commands from the log
            instead.
        starts: Additional points from which fits start, for likelihoods with several maxima.
        at_least: Parameter → parameter of the same effect that is its lower bound in every fit.
        resolved: Parameters whose lower limit follows from the integration step; a fit may end at this limit.
    """

    name: ClassVar[str]
    equation: ClassVar[str]
    states: ClassVar[tuple[Quantity, ...]] = ()
    memory: ClassVar[tuple[Quantity, ...]] = ()
    delay: ClassVar[str | None] = None
    starts: ClassVar[tuple[Mapping[str, float], ...]] = ()
    at_least: ClassVar[Mapping[str, str]] = {}
    resolved: ClassVar[tuple[str, ...]] = ()

    def invalid_values(self) -> list[str]:
        """Return one sentence for each invalid parameter, named `effect.parameter`."""
        return [f"{self.name}.{fault}" for fault in super().invalid_values()]

    @property
    def dormant(self) -> bool:
        """Return True if all parameters with a neutral value equal it; False for arrays and symbols."""
        switches = (p for p in parameters_of(self) if p.neutral is not None)
        return all(isinstance(v := getattr(self, p.name), (int, float)) and v == p.neutral for p in switches)

    def remember(self, t: Number, start: Values) -> Values:
        """Return the discrete states of the effect at the initial time `t` [s], by default their start values.

        Args:
            start: Start values of the discrete states.
        """
        return start

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        """Return the changed command from `t` to `t + h` [s], and the new memory."""
        return command, memory

    def transmit(self, m: Namespace, command: Mapping[str, Number]) -> Mapping[str, Number]:
        """Return the commands, by input name, that act in derivative and output."""
        return command

    @classmethod
    def named(cls, name: str, **members: Any) -> type[Any]:
        """Return a subclass with a name, parameters and other members, and with the caller's line for messages."""
        caller = sys._getframe(1)
        module = caller.f_globals.get("__name__", cls.__module__)
        own = {"__doc__": cls.__doc__, "__module__": module, "line": caller.f_lineno}
        own["__annotations__"] = {n: "float" for n, v in members.items() if isinstance(v, Field)}
        made = type(name, (cls,), own | {"name": name} | members)
        return made if "__dataclass_fields__" in vars(made) else dataclass(frozen=True, kw_only=True)(made)


class LocalEffect(Effect):
    """An effect that changes one quantity of the equations, at one of the `places` that the model declares."""

    place: ClassVar[str]

    def change(self, m: Namespace, value: Number, *at: Number) -> Number:
        """Return the changed quantity; `at` are further quantities of the place, such as a velocity."""
        return value

    def follow(self, m: Namespace, values: Values, states: Values) -> tuple[Values, Values]:
        """Return the quantities that replace those of the place, and the derivatives of the effect's states."""
        raise NotImplementedError


def overrides(effects: tuple[Any, ...], hook: str, base: type) -> tuple[Any, ...]:
    """Return the effects, in order, whose class overrides the method `hook` of the class `base`."""
    return tuple(e for e in effects if getattr(type(e), hook) is not getattr(base, hook))


def _parameters_by_name(kinds: tuple[type[Any], ...]) -> dict[str, Parameter]:
    return {f"{kind.name}.{p.name}": p for kind in kinds for p in parameters_of(kind)}


class Validity(NamedTuple):
    """A range of validity for some inputs, all of one quantity, with a sentence on the consequence of leaving it."""

    quantity: str
    inputs: tuple[str, ...]
    low: float
    high: float
    beyond: str


class Equations(NamedTuple):
    """The equations of a model with its parameter values, computed by a namespace's functions.

    Attributes:
        derivative: (t, state, command) → derivative of the state by time. In these tuples, the states of effects are
            last.
        output: (t, state, command) → outputs.
    """

    derivative: Callable[[Number, Values, Values], Values]
    output: Callable[[Number, Values, Values], Values]


@dataclass(frozen=True, kw_only=True)
class Model(Parametric):
    """Base class of models. A subclass declares quantities, parameters as fields, effects and equations."""

    title: ClassVar[str]
    base_states: ClassVar[tuple[Quantity, ...]]
    inputs: ClassVar[tuple[Quantity, ...]]
    outputs: ClassVar[tuple[Quantity, ...]]
    catalogue: ClassVar[tuple[type[Effect], ...]] = ()
    places: ClassVar[tuple[str, ...]] = ()  # names of the quantities that local effects can change
    # Knowledge about a real plant, in this order: possible sensor errors; variance of each measured output; variance of
    # each unmeasured state at the start of a log (default: squared range in a simulation of the model); states whose
    # equations may be deficient; parameters adjusted in every fit; further parameters that may be wrong.
    sensors: ClassVar[tuple[type[Any], ...]] = ()
    sensor_variance: ClassVar[Mapping[str, float]] = {}
    start_variance: ClassVar[Mapping[str, float]] = {}
    forced: ClassVar[tuple[str, ...]] = ()
    calibrated: ClassVar[tuple[str, ...]] = ()
    # parameter → inputs that must vary in the logs for identifiability
    suspect: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    told_apart_by: ClassVar[Mapping[frozenset[str], str]] = {}  # hypotheses → experiment that separates them
    measured: ClassVar[tuple[str, ...]] = ()  # outputs that logs usually have; default: outputs in `sensor_variance`
    excursion: ClassVar[Mapping[str, float]] = {}  # signal → allowed deviation from its start in an experiment
    valid: ClassVar[tuple[Validity, ...]] = ()  # ranges of validity; the model warns once per range
    planar: ClassVar[PlanarFrame | None] = None  # signal names of a planar motion
    substep: ClassVar[float] = 0.005  # largest integration substep [s]
    integrator: ClassVar[str] = AUTO  # one of INTEGRATORS; "auto" is RK4, or the implicit method for a stiff model
    rate: ClassVar[float] = 0.02  # communication step [s] for which the model is designed
    horizon: ClassVar[float] = 2.0  # [s] length of the replays that measure the error; infinite: the whole log

    effects: tuple[Any, ...] = field(default=())
    chosen_substep: float | None = field(default=None)  # [s]; replaces `substep` if the class states none
    chosen_integrator: str | None = field(default=None)  # replaces `integrator`

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Set the class name as default title."""
        super().__init_subclass__(**keywords)
        if not hasattr(cls, "title"):
            cls.title = cls.__name__

    def __post_init__(self) -> None:
        super().__post_init__()
        strangers = [type(e).__name__ for e in self.effects if type(e) not in self.catalogue]
        if strangers:
            raise ValueError(f"not in the catalogue of {type(self).__name__}: {', '.join(strangers)}")
        effects = sorted(self.effects, key=lambda e: self.catalogue.index(type(e)))
        object.__setattr__(self, "effects", tuple(effects))
        for name in ("substep", "integrator"):
            if (choice := getattr(self, f"chosen_{name}")) is not None:
                object.__setattr__(self, name, choice)

    def equations(self, m: Namespace) -> Equations:
        """Return the model's equations, computed by the functions of a namespace."""
        raise NotImplementedError

    def start_state(self, m: Namespace = SCALAR) -> dict[str, Number]:
        """Return name → start value for base states whose start value differs from the declared one."""
        return {}

    def warning(self, command: Values) -> str | None:
        """Return a warning if a command is outside a declared range of validity; otherwise None."""
        commands = {q.name: (value, q.unit) for q, value in zip(self.inputs, command, strict=True)}
        for quantity, inputs, low, high, beyond in self.valid:
            values = [commands[name] for name in inputs]
            if not all(low <= value <= high for value, _ in values):
                return f"{quantity} {', '.join(f'{value:g} {unit}' for value, unit in values)}: {beyond}"
        return None

    def start_input(self) -> dict[str, Number]:
        """Return name → start value for inputs whose start value differs from the declared one."""
        return {}

    # -- common to all models ----------------------------------------------------------------

    def effects_at(self, m: Namespace) -> Callable[..., Number]:
        """Return a function of (place, value, further quantities) that applies the place's active local effects."""
        local = overrides(tuple(e for e in self.awake if isinstance(e, LocalEffect)), "change", LocalEffect)
        effects = {place: [e for e in local if e.place == place] for place in self.places}

        def changed(place: str, value: Number, *at: Number) -> Number:
            for effect in effects[place]:
                value = effect.change(m, value, *at)
            return value

        return changed

    def lag_at(self, m: Namespace, place: str, values: Values, states: Values) -> tuple[Values, Values]:
        """Return the quantities at a place after its active lag, and the derivatives of that lag's states.

        Args:
            states: States of all active effects.
        """
        begin = 0
        for effect in self.awake:
            end = begin + len(effect.states)
            if end > begin and getattr(effect, "place", None) == place:
                lagged: tuple[Values, Values] = effect.follow(m, values, states[begin:end])
                return lagged
            begin = end
        return values, ()

    def acting(self, m: Namespace) -> Equations:
        """Return the equations with all active effects."""
        derivative, output = equations = self.equations(m)
        names = [q.name for q in self.inputs]
        terms = overrides(self.awake, "transmit", Effect)
        if not terms:
            return equations

        def transmit(command: Values) -> Values:
            values: Mapping[str, Number] = dict(zip(names, command, strict=True))
            for term in terms:
                values = term.transmit(m, values)
            return tuple(values[name] for name in names)

        return Equations(
            lambda t, state, command: derivative(t, state, transmit(command)),
            lambda t, state, command: output(t, state, transmit(command)),
        )

    @property
    def awake(self) -> tuple[Any, ...]:
        """Return the active (not dormant) effects in catalogue order."""
        return tuple(e for e in self.effects if not e.dormant)

    @property
    def states(self) -> tuple[Quantity, ...]:
        """Return the states of the base model, then the states of the active effects."""
        return self.base_states + tuple(
            Quantity(f"{e.name}.{s.name}", s.unit, s.doc, s.start) for e in self.awake for s in e.states
        )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Return the parameters of the base model."""
        return parameters_of(self)

    @property
    def declared(self) -> dict[str, Parameter]:
        """Return name → parameter, for the model and its whole catalogue (`effect.parameter`)."""
        return {p.name: p for p in self.parameters} | _parameters_by_name(self.catalogue)

    @property
    def sensor_parameters(self) -> dict[str, Parameter]:
        """Return `sensor.parameter` → parameter, for all possible sensor errors."""
        return _parameters_by_name(self.sensors)

    def with_effect(self, effect: Any) -> Self:
        """Return the model with an effect added; an effect of the same name is replaced."""
        others = tuple(e for e in self.effects if type(e) is not type(effect))
        return replace(self, effects=(*others, effect))

    def with_values(self, values: Mapping[str, Number]) -> Self:
        """Return the model with other parameter values.

        Raises:
            KeyError: A name is unknown.
        """
        if unknown := values.keys() - self.declared.keys():
            raise KeyError(sorted(unknown)[0])
        model = replace(self, **{name: v for name, v in values.items() if "." not in name})
        present = {type(e): e for e in self.effects}
        for kind in self.catalogue:
            named = {p.name: f"{kind.name}.{p.name}" for p in parameters_of(kind)}
            if changes := {n: values[name] for n, name in named.items() if name in values}:
                model = model.with_effect(replace(present.get(kind) or kind(), **changes))
        return model

    def with_substep(self, substep: float | None, integrator: str | None = None) -> Self:
        """Return the model with another longest substep [s] and integrator; None selects the default."""
        return replace(self, chosen_substep=substep, chosen_integrator=integrator)

    def start(self, values: Mapping[str, Number] | None = None, m: Namespace = SCALAR) -> Values:
        """Return the initial state from start values by name (`position`, `effect.state`)."""
        values = values or {}
        own = self.start_state(m)
        return tuple(values.get(s.name, own.get(s.name, s.start)) for s in self.states)

    def start_command(self) -> Values:
        """Return the start values of the inputs, in their order."""
        own = self.start_input()
        return tuple(own.get(q.name, q.start) for q in self.inputs)
