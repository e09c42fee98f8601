"""Checks of a user's model class for a refine: names, bounds, units, sensors, delays.

All faults are reported at once with line and remedy, before any log is read.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

from cosim.base.errors import refuse
from cosim.base.units import parse
from cosim.loading.equations import effect_faults, equation_faults
from cosim.loading.names import Found, named, unique, variables
from cosim.loading.source import Source
from cosim.model.delay import Delay
from cosim.model.gain import Gain
from cosim.model.model import INTEGRATORS, Effect, Model, Validity, overrides
from cosim.model.quantities import Parameter, Quantity, parameters_of
from cosim.model.sensors import Drift, LeverArm, SensorError
from cosim.storage.yaml_file import did_you_mean

LARGEST = sys.float_info.max
WIDEST = 2.0  # share of a value; larger tolerances say nothing
DATACLASS = "put @dataclass(frozen=True, kw_only=True) above the class"


def checked(kind: type[Model], source: Source) -> Model:
    """Return a model with default parameters; raise InputError with all faults of its class."""
    _refuse(source, _shape(kind))
    declared = [*_effects(kind), *_sensors(kind), *_delays(kind), *_gains(kind), *_timeless(kind)]
    names = [*unique(kind), *named(kind), *_numbers(kind), *_limits(kind), *_units(kind)]
    values = [fault for owner in (kind, *kind.catalogue, *kind.sensors) for fault in _values(owner)]
    faults = [source.fault(*found) for found in (*declared, *names, *values)]
    if not values:
        faults += equation_faults(kind, source)
    if not declared and not values and not faults:
        faults += effect_faults(kind, source)
    refuse(faults)
    model = kind()
    _refuse(source, variables(model))
    return model


def _refuse(source: Source, found: Found) -> None:
    refuse([source.fault(*one) for one in found])


def _shape(kind: type[Model]) -> Found:
    """Yield missing or mistyped declarations, which prevent further checks."""
    if kind.equations is Model.equations:
        yield kind, "", f"{kind.__name__} has no equations; give it `def equations(self, m)` that returns Equations"
    for name in ("base_states", "inputs", "outputs"):
        given = getattr(kind, name, None)
        if given is None:
            yield kind, "", f'{kind.__name__} has no {name}; add {name} = (Quantity("name", "unit", "meaning"),)'
        elif not _all(given, Quantity):
            yield kind, name, f"{name} is a tuple of quantities, with a comma even after a single one"
    for name, base in (("catalogue", Effect), ("sensors", SensorError)):
        given = getattr(kind, name)
        if _are_subclasses(given, base):
            yield from _labelled(given)
        else:
            text = f"{name} is a tuple of subclasses of {base.__name__}, with a comma even after a single one"
            yield kind, name, text
    for name in ("forced", "calibrated", "measured"):
        if not _all(getattr(kind, name), str):
            yield kind, name, f'{name} is a tuple of names, with a comma even after a single one: ("name",)'
    if not _all(kind.valid, Validity):
        yield kind, "valid", 'valid is a tuple: (Validity("quantity", ("input",), low, high, "what happens beyond"),)'
    for name, key, value, written in _MAPPINGS:
        given = getattr(kind, name)
        if not isinstance(given, Mapping) or not _all((*given,), key) or not _all((*given.values(),), value):
            yield kind, name, f"{name} is a dictionary: {written}"
    yield from _undecorated((kind, *_classes(kind)))


_MAPPINGS: tuple[tuple[str, type, Any, str], ...] = (  # name, types of keys and values, written form
    ("suspect", str, tuple, '{"parameter": ("input",)}'),
    ("drawn_against", str, tuple, '{"effect": ("signal",)}'),
    ("sensor_variance", str, (int, float), '{"output": variance}'),
    ("start_variance", str, (int, float), '{"state": variance}'),
    ("excursion", str, (int, float), '{"input or output": how far from its start}'),
    ("told_apart_by", frozenset, str, '{frozenset({"name", "name"}): "what an experiment needs"}'),
)


def _all(given: Any, kind: Any) -> bool:
    return isinstance(given, tuple) and all(isinstance(one, kind) for one in given)


def _are_subclasses(given: Any, base: type) -> bool:
    return isinstance(given, tuple) and all(isinstance(k, type) and issubclass(k, base) for k in given)


def _classes(kind: type[Model]) -> list[type]:
    """Return the declared effects and sensor errors that are classes."""
    given = [g for g in (kind.catalogue, kind.sensors) if isinstance(g, (tuple, list))]
    return [k for group in given for k in group if isinstance(k, type)]


def _labelled(owners: Sequence[type]) -> Found:
    """Yield faults of names, equations, states and memory of effects."""
    for owner in owners:
        for name in ("name", "equation"):
            if not isinstance(getattr(owner, name, None), str):
                yield owner, name, f'{owner.__name__} has no {name}; add {name} = "…"'
        if "." in (name := str(getattr(owner, "name", ""))):
            yield owner, "name", f'the name "{name}" has a dot, which parts effect and parameter'
        for name in ("states", "memory"):
            if not _all(getattr(owner, name), Quantity):
                yield owner, name, f"{name} is a tuple of quantities, with a comma even after a single one"


def _undecorated(owners: Sequence[type]) -> Found:
    """Yield parameters of classes without the dataclass decorator."""
    for owner in owners:
        left = [n for n, v in vars(owner).items() if isinstance(v, dataclasses.Field)]
        if left:
            yield owner, left[0], f"{owner.__name__}.{left[0]} is no field: {DATACLASS}"


def _values(owner: Any) -> Found:
    """Yield defaults, neutral values and typical sizes outside bounds."""
    prefix = f"{owner.name}." if issubclass(owner, Effect) else ""
    for p in parameters_of(owner):
        if not isinstance(p.default, bool) and not p.bounds[0] < p.bounds[1]:
            yield owner, p.name, f"{prefix}{p.name} has bounds {p.bounds}; write the lower one first"
            continue
        within = {"default": p.default, "neutral": p.neutral}
        if p.neutral == p.bounds[0]:  # Its fit starts at the typical size; elsewhere the size is only a step.
            within["typical"] = p.typical
        for word, value in within.items():
            if (word == "default" or value is not None) and (fault := p.fault(value)):
                yield owner, p.name, f"the {word} of {prefix}{fault}; change the value or the bounds"
        if p.tolerance is not None and not _is_size(p.tolerance, WIDEST):
            text = f"the tolerance of {prefix}{p.name} is {p.tolerance!r}; it is a share of the value, as 0.1 for 10 %"
            yield owner, p.name, text
        if p.typical is not None and not 0.0 < p.typical < math.inf:
            yield owner, p.name, f"the typical of {prefix}{p.name} is {p.typical!r}; it is a size above 0"


def _is_size(value: Any, most: float) -> bool:
    """Return whether a value is a positive number up to a limit."""
    return isinstance(value, (int, float)) and 0.0 < value <= most


def _numbers(kind: type[Model]) -> Found:
    """Yield times and variances that are not positive."""
    for name, most in (("rate", LARGEST), ("substep", LARGEST), ("horizon", math.inf)):
        if not _is_size(value := getattr(kind, name), most):
            yield kind, name, f"{name} is {value!r}; it is a time above 0 s"
    if kind.integrator not in INTEGRATORS:
        yield kind, "integrator", f"integrator is {kind.integrator!r}; it is one of {', '.join(INTEGRATORS)}"
    for attribute in ("sensor_variance", "start_variance", "excursion"):
        for name, value in getattr(kind, attribute).items():
            if not _is_size(value, LARGEST):
                yield kind, attribute, f"the {attribute} of {name} is {value!r}; it is a number above 0"


def _limits(kind: type[Model]) -> Found:
    """Yield signal bounds that exclude the start value."""
    for name in ("base_states", "inputs", "outputs"):
        for q in getattr(kind, name):
            low, high = q.bounds
            if not low < high:
                yield kind, name, f"{q.name} has bounds {q.bounds}; write the lower one first"
            elif not low <= q.start <= high:
                yield kind, name, f"{q.name} starts at {q.start:g}, beyond its bounds {q.bounds}"


def _effects(kind: type[Model]) -> Found:
    """Yield faults of neutral values, starts and names of effects. An effect must be dormant at its default values."""
    for owner in (*kind.catalogue, *kind.sensors):
        switches = [p for p in parameters_of(owner) if p.neutral is not None]
        if not switches:
            text = f"{owner.name} has no parameter with a neutral value, so that it can never be awake; add one"
            yield owner, "", text
        for p in switches:
            if p.default != p.neutral:
                text = f"the default of {owner.name}.{p.name} is {p.default!r}, its neutral value {p.neutral!r}"
                yield owner, p.name, f"{text}; let them be the same"
        names = [p.name for p in parameters_of(owner)]
        for attribute, groups in (("starts", owner.starts), ("at_least", owner.at_least.items())):
            for name in dict.fromkeys(chain.from_iterable(groups)):
                if name not in names:
                    yield owner, attribute, f'{owner.name} has no parameter "{name}"{did_you_mean(name, names)}'


def _sensors(kind: type[Model]) -> Found:
    """Yield faults of sensor errors' parameters and outputs."""
    outputs = [q.name for q in kind.outputs]
    for owner in kind.sensors:
        yield from _value_alone(owner)
        if owner.outputs and owner.read is not SensorError.read and owner.readings is SensorError.readings:
            text = f"{owner.name}: `read` is of one output; name it in `output`, or give `readings` a body"
            yield owner, "outputs", text
        yield from _not_outputs(owner, "outputs" if owner.outputs else "output", outputs)
        if issubclass(owner, LeverArm):
            yield from _not_outputs(owner, "others", outputs)


def _not_outputs(owner: type[SensorError], attribute: str, outputs: Sequence[str]) -> Found:
    """Yield names of a sensor error that are no outputs."""
    given = getattr(owner, attribute, ())
    if attribute != "output" and isinstance(given, str):
        text = f'{attribute} is a tuple of names, with a comma even after a single one: ("{given}",)'
        yield owner, attribute, f"{owner.name}: {text}"
        return
    place = " in `others`" if attribute == "others" else ""
    for name in (given,) if isinstance(given, str) else given or ("",):
        if name not in outputs:
            yield owner, attribute, f"{owner.name}: {_unknown('output', name, outputs, place)}"


def _value_alone(owner: type[SensorError]) -> Found:
    """Yield a fault unless `value` is the only parameter."""
    names = [p.name for p in parameters_of(owner)]
    if names != ["value"]:
        has = " and ".join(names) or "none"
        cure = "let another class hold what is more" if "value" in names else "call it so"
        text = f'a sensor error has one parameter, called "value"; {owner.name} has {has}'
        yield owner, (names or [""])[0], f"{text}; {cure}"


def _unknown(what: str, name: str, known: Sequence[str], place: str = "") -> str:
    """Return a message on an unknown or missing signal name."""
    told = f'no {what} "{name}"{did_you_mean(str(name), known)}{place}' if name else f"no {what} is named{place}"
    return f"{told} ({what}s: {', '.join(known)})"


def _delays(kind: type[Model]) -> Found:
    """Yield faults of delays.

    At most one effect delays the command. It comes before all shaping effects and stores every input.
    """
    shaping = overrides(tuple(_bare(k) for k in kind.catalogue), "shape", Effect)
    order = [type(e) for e in shaping]
    late = [k for k in kind.catalogue if k.delay is not None]
    for owner in late:
        yield from _longest_delay(owner)
        if owner not in order:
            yield owner, "delay", f"{owner.name} delays the command but has no `shape`; give it one"
        elif owner is not order[0] and owner is late[0]:
            yield kind, "catalogue", f"{owner.name} delays the command: put it before {order[0].name} in the catalogue"
        if len(owner.memory) != len(kind.inputs):
            text = f"{owner.name} delays {len(kind.inputs)} inputs and has {len(owner.memory)} quantities of memory"
            yield owner, "memory", f"{text}; give it one for each input, in their order"
    for owner in late[1:]:
        yield owner, "delay", f"{owner.name} and {late[0].name} both delay the command; let one of them do it"


def _longest_delay(owner: Any) -> Found:
    """Yield faults of a delay's parameter and longest memory."""
    bounds = {p.name: p.bounds for p in parameters_of(owner)}
    if owner.delay not in bounds:
        text = f'{owner.name} has no parameter "{owner.delay}"{did_you_mean(str(owner.delay), bounds)}'
        yield owner, "delay", f"{text}; `delay` names the one by which the command is late"
    elif issubclass(owner, Delay) and (most := bounds[owner.delay][1]) > owner.longest:
        text = f"{owner.name} is up to {most:g} s late and remembers {owner.longest:g} s"
        yield owner, str(owner.delay), f"{text}; set longest = {most:g}"


def _gains(kind: type[Model]) -> Found:
    """Yield gains on unknown inputs."""
    inputs = [q.name for q in kind.inputs]
    for owner in kind.catalogue:
        if issubclass(owner, Gain) and (name := getattr(owner, "input", "")) not in inputs:
            yield owner, "input", f"{owner.name}: {_unknown('input', name, inputs)}"


def _timeless(kind: type[Model]) -> Found:
    """Yield effects with time dependence in a model without states."""
    if kind.base_states:
        return
    why = f"{kind.__name__} has no states, so each row of its tables stands for itself"
    cure = "leave it out, or give the model a state"
    for owner in kind.catalogue:
        if owner.states or owner.memory or owner.delay:
            yield owner, "", f"{why}; {owner.name} keeps what was before: {cure}"
        elif owner.shape is not Effect.shape:
            text = "an output takes a command as it was given; let it act in the output, by a hook of your own"
            yield owner, "", f"{kind.__name__} has no states, and {owner.name} shapes what acts on states: {text}"
    for sensor in kind.sensors:
        if sensor.late or issubclass(sensor, Drift):
            yield sensor, "", f"{why}; {sensor.name} goes with time: {cure}"


def _bare(kind: type) -> Any:
    """Return an uninitialized instance, for access to its class."""
    return object.__new__(kind)


def _units(kind: type[Model]) -> Found:
    """Yield unknown units."""
    for owner in (kind, *kind.catalogue, *kind.sensors):
        for attribute, declared in _declared_units(owner):
            if declared.unit and parse(declared.unit) is None:
                cure = "write it with SI symbols, as in N.m.s/rad or m/s2, and a pure number as 1"
                yield owner, attribute, f'unknown unit "{declared.unit}" of {declared.name}; {cure}'


def _declared_units(owner: Any) -> Iterator[tuple[str, Quantity | Parameter]]:
    groups = ("states", "memory") if issubclass(owner, Effect) else ("base_states", "inputs", "outputs")
    for group in groups:
        yield from ((group, q) for q in getattr(owner, group))
    yield from ((p.name, p) for p in parameters_of(owner))
