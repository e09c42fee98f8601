"""Checks of a user's model class for a refine: names, bounds, units, sensors, delays.

All faults are reported at once with line and remedy, before any log is read.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

from cosim.base.errors import refuse
from cosim.base.units import parse
from cosim.loading.equations import effect_faults, equation_faults
from cosim.loading.names import Faults, duplicate_names, duplicate_variables, undefined_names
from cosim.loading.source import ModelText
from cosim.model.delay import Delay
from cosim.model.gain import Gain
from cosim.model.model import INTEGRATORS, Effect, Model, Validity, overrides
from cosim.model.quantities import Parameter, Quantity, parameters_of
from cosim.model.sensors import Drift, LeverArm, SensorError
from cosim.storage.yaml_file import did_you_mean

NOT_QUANTITIES = "{name} is a tuple of quantities, with a comma even after a single one"

MAX_NUMBER = sys.float_info.max
MAX_TOLERANCE = 2.0  # share of a value; larger tolerances are meaningless


def make_model(kind: type[Model], source: ModelText) -> Model:
    """Return a model with default parameters; raise InputError with all faults of its class."""
    refuse(source.fault(*fault) for fault in _shape_faults(kind))
    declared = [*_effect_faults(kind), *_sensor_faults(kind), *_delay_faults(kind), *_gain_faults(kind)]
    declared += _static_faults(kind)
    names = [*duplicate_names(kind), *undefined_names(kind), *_number_faults(kind), *_unit_faults(kind)]
    values = [fault for owner in (kind, *kind.catalogue, *kind.sensors) for fault in _parameter_faults(owner)]
    faults = [source.fault(*fault) for fault in (*declared, *names, *values)]
    if not values:
        faults += equation_faults(kind, source)
    if not declared and not values and not faults:
        faults += effect_faults(kind, source)
    refuse(faults)
    model = kind()
    refuse(source.fault(*fault) for fault in duplicate_variables(model))
    return model


def _shape_faults(kind: type[Model]) -> Faults:
    """Yield faults of missing or mistyped declarations."""
    if kind.equations is Model.equations:
        yield kind, "", f"{kind.__name__} has no equations; give it `def equations(self, m)` that returns Equations"
    for name in ("base_states", "inputs", "outputs"):
        value = getattr(kind, name, None)
        if value is None:
            yield kind, "", f'{kind.__name__} has no {name}; add {name} = (Quantity("name", "unit", "meaning"),)'
        elif not _is_tuple_of(value, Quantity):
            yield kind, name, NOT_QUANTITIES.format(name=name)
    for name, base in (("catalogue", Effect), ("sensors", SensorError)):
        yield from _class_faults(kind, name, base)
    for name in ("forced", "calibrated", "measured"):
        if not _is_tuple_of(getattr(kind, name), str):
            yield kind, name, f'{name} is a tuple of names, with a comma even after a single one: ("name",)'
    if not _is_tuple_of(kind.valid, Validity):
        yield kind, "valid", 'valid is a tuple: (Validity("quantity", ("input",), low, high, "what happens beyond"),)'
    for name, key, item, form in _MAPPINGS:
        value = getattr(kind, name)
        if not isinstance(value, Mapping) or not (
            _is_tuple_of((*value,), key) and _is_tuple_of((*value.values(),), item)
        ):
            yield kind, name, f"{name} is a dictionary: {form}"
    yield from _find_undecorated([kind])


_MAPPINGS: tuple[tuple[str, type, Any, str], ...] = (  # name, types of keys and values, written form
    ("suspect", str, tuple, '{"parameter": ("input",)}'),
    ("drawn_against", str, tuple, '{"effect": ("signal",)}'),
    ("sensor_variance", str, (int, float), '{"output": variance}'),
    ("start_variance", str, (int, float), '{"state": variance}'),
    ("excursion", str, (int, float), '{"input or output": how far from its start}'),
    ("told_apart_by", frozenset, str, '{frozenset({"name", "name"}): "what an experiment needs"}'),
)


def _is_tuple_of(value: Any, kind: Any) -> bool:
    return isinstance(value, tuple) and all(isinstance(one, kind) for one in value)


def _class_faults(kind: type[Model], name: str, base: type) -> Faults:
    """Yield faults of the classes listed in the catalogue or in the sensors of a model."""
    value = getattr(kind, name)
    if _is_tuple_of(value, type) and all(issubclass(k, base) for k in value):
        yield from _label_faults(value)
    else:
        yield kind, name, f"{name} is a tuple of subclasses of {base.__name__}, with a comma even after a single one"
    if isinstance(value, (tuple, list)):
        yield from _find_undecorated(k for k in value if isinstance(k, type))


def _label_faults(owners: Sequence[type]) -> Faults:
    """Yield faults in the names, equations, states and memory of effects and sensor errors."""
    for owner in owners:
        for name in ("name", "equation"):
            if not isinstance(getattr(owner, name, None), str):
                yield owner, name, f'{owner.__name__} has no {name}; add {name} = "…"'
        if "." in (label := str(getattr(owner, "name", ""))):
            yield owner, "name", f'the name "{label}" has a dot, which parts effect and parameter; leave it out'
        for name in ("states", "memory"):
            if not _is_tuple_of(getattr(owner, name), Quantity):
                yield owner, name, NOT_QUANTITIES.format(name=name)


def _find_undecorated(owners: Iterable[type]) -> Faults:
    """Yield faults of classes without the dataclass decorator."""
    for owner in owners:
        if name := next((n for n, v in vars(owner).items() if isinstance(v, dataclasses.Field)), ""):
            yield (
                owner,
                name,
                f"{owner.__name__}.{name} is no field: put @dataclass(frozen=True, kw_only=True) above the class",
            )


def _parameter_faults(owner: Any) -> Faults:
    """Yield faults of defaults, neutral and typical values."""
    prefix = f"{owner.name}." if issubclass(owner, Effect) else ""
    for p in parameters_of(owner):
        name = f"{prefix}{p.name}"
        if not isinstance(p.default, bool) and not p.bounds[0] < p.bounds[1]:
            yield owner, p.name, f"{name} has bounds {p.bounds}; write the lower one first"
            continue
        values = {"default": p.default, "neutral": p.neutral}
        if p.neutral == p.bounds[0]:  # Its fit starts at the typical size; elsewhere the size is only a step.
            values["typical"] = p.typical
        for word, value in values.items():
            if (word == "default" or value is not None) and (fault := p.fault(value)):
                yield owner, p.name, f"the {word} of {prefix}{fault}; change the value or the bounds"
        if p.tolerance is not None and not _is_size(p.tolerance, MAX_TOLERANCE):
            yield (
                owner,
                p.name,
                f"the tolerance of {name} is {p.tolerance!r}; it is a share of the value, as 0.1 for 10 %",
            )
        if p.typical is not None and not 0.0 < p.typical < math.inf:
            yield owner, p.name, f"the typical of {name} is {p.typical!r}; it is a size above 0"


def _is_size(value: Any, limit: float = MAX_NUMBER) -> bool:
    """Return whether a value is a positive number up to a limit."""
    return isinstance(value, (int, float)) and 0.0 < value <= limit


def _number_faults(kind: type[Model]) -> Faults:
    """Yield faults of declared numbers: times and variances not positive, start values out of bounds."""
    for name, limit in (("rate", MAX_NUMBER), ("substep", MAX_NUMBER), ("horizon", math.inf)):
        if not _is_size(value := getattr(kind, name), limit):
            yield kind, name, f"{name} is {value!r}; it is a time above 0 s"
    if kind.integrator not in INTEGRATORS:
        yield kind, "integrator", f"integrator is {kind.integrator!r}; it is one of {', '.join(INTEGRATORS)}"
    for attribute in ("sensor_variance", "start_variance", "excursion"):
        for name, value in getattr(kind, attribute).items():
            if not _is_size(value):
                yield kind, attribute, f"the {attribute} of {name} is {value!r}; it is a number above 0"
    for attribute in ("base_states", "inputs", "outputs"):
        for q in getattr(kind, attribute):
            low, high = q.bounds
            if not low < high:
                yield kind, attribute, f"{q.name} has bounds {q.bounds}; write the lower one first"
            elif not low <= q.start <= high:
                yield kind, attribute, f"{q.name} starts at {q.start:g}, beyond its bounds {q.bounds}"


def _effect_faults(kind: type[Model]) -> Faults:
    """Yield faults of neutral values, starts and names of effects. An effect must be dormant at its default values."""
    for owner in (*kind.catalogue, *kind.sensors):
        switches = [p for p in parameters_of(owner) if p.neutral is not None]
        if not switches:
            yield (
                owner,
                "",
                f"{owner.name} has no parameter with a neutral value, so that it can never be awake; add one",
            )
        for p in switches:
            if p.default != p.neutral:
                fields = {"owner": owner.name, "name": p.name, "default": p.default, "neutral": p.neutral}
                yield (
                    owner,
                    p.name,
                    (
                        "the default of {owner}.{name} is {default!r}, its neutral value {neutral!r}; let them be "
                        "the same"
                    ).format(**fields),
                )
        names = [p.name for p in parameters_of(owner)]
        for attribute, groups in (("starts", owner.starts), ("at_least", owner.at_least.items())):
            for name in dict.fromkeys(chain.from_iterable(groups)):
                if name not in names:
                    cure = did_you_mean(name, names)
                    yield owner, attribute, f'{owner.name} has no parameter "{name}"{cure}'


def _sensor_faults(kind: type[Model]) -> Faults:
    """Yield faults of sensor errors' parameters and outputs."""
    outputs = [q.name for q in kind.outputs]
    for owner in kind.sensors:
        names = [p.name for p in parameters_of(owner)]
        if names != ["value"]:  # `value` is the only parameter
            cure = "let another class hold the others" if "value" in names else "call it so"
            message = (
                f'a sensor error has one parameter, called "value"; {owner.name} has '
                f"{' and '.join(names) or 'none'}; {cure}"
            )
            yield owner, (names or [""])[0], message
        if owner.outputs and owner.read is not SensorError.read and owner.readings is SensorError.readings:
            yield (
                owner,
                "outputs",
                (
                    f"{owner.name}: `read` returns one output, but the class declares several `outputs`; declare one "
                    "`output` instead, or define `readings`"
                ),
            )
        yield from _output_faults(owner, "outputs" if owner.outputs else "output", outputs)
        if issubclass(owner, LeverArm):
            yield from _output_faults(owner, "others", outputs)


def _output_faults(owner: type[SensorError], attribute: str, outputs: Sequence[str]) -> Faults:
    """Yield faults of sensor errors on non-outputs."""
    value = getattr(owner, attribute, ())
    if attribute != "output" and isinstance(value, str):
        yield (
            owner,
            attribute,
            f'{owner.name}: {attribute} is a tuple of names, with a comma even after a single one: ("{value}",)',
        )
        return
    place = " in `others`" if attribute == "others" else ""
    for name in (value,) if isinstance(value, str) else value or ("",):
        if name not in outputs:
            yield owner, attribute, _unknown_signal(owner, "output", name, outputs, place)


def _unknown_signal(owner: Any, kind: str, name: str, names: Sequence[str], place: str = "") -> str:
    """Return a message about an unknown or missing signal."""
    fields = {"owner": owner.name, "kind": kind, "place": place, "names": ", ".join(names)}
    if not name:
        return "{owner}: no {kind} is named{place} ({kind}s: {names})".format(**fields)
    return '{owner}: no {kind} "{name}"{cure}{place} ({kind}s: {names})'.format(
        name=name, cure=did_you_mean(str(name), names), **fields
    )


def _delay_faults(kind: type[Model]) -> Faults:
    """Yield faults of delays.

    At most one effect delays the command. It comes before all shaping effects and stores every input.
    """
    shaping = overrides(tuple(object.__new__(k) for k in kind.catalogue), "shape", Effect)  # uninitialized instances
    order = [type(e) for e in shaping]
    delays: list[Any] = [k for k in kind.catalogue if k.delay is not None]
    for owner in delays:
        yield from _delay_parameter_faults(owner)
        if owner not in order:
            yield owner, "delay", f"{owner.name} delays the command but has no `shape`; give it one"
        elif owner is not order[0] and owner is delays[0]:
            yield kind, "catalogue", f"{owner.name} delays the command: put it before {order[0].name} in the catalogue"
        if len(owner.memory) != len(kind.inputs):
            counts = {"inputs": len(kind.inputs), "memory": len(owner.memory)}
            yield (
                owner,
                "memory",
                (
                    "{owner} delays {inputs} inputs and has {memory} quantities of memory; give it one for each "
                    "input, in their order"
                ).format(owner=owner.name, **counts),
            )
    for owner in delays[1:]:
        yield owner, "delay", f"{owner.name} and {delays[0].name} both delay the command; let one of them do it"


def _delay_parameter_faults(owner: Any) -> Faults:
    """Yield faults of a delay's parameter and longest memory."""
    bounds = {p.name: p.bounds for p in parameters_of(owner)}
    if owner.delay not in bounds:
        cure = did_you_mean(str(owner.delay), bounds)
        yield (
            owner,
            "delay",
            (
                f'{owner.name} has no parameter "{owner.delay}"{cure}; `delay` names the one by which the command is '
                "late"
            ),
        )
    elif issubclass(owner, Delay) and (longest := bounds[owner.delay][1]) > owner.longest:
        yield (
            owner,
            owner.delay,
            (f"{owner.name} is up to {longest:g} s late and remembers {owner.longest:g} s; set longest = {longest:g}"),
        )


def _gain_faults(kind: type[Model]) -> Faults:
    """Yield faults of gains on unknown inputs."""
    inputs = [q.name for q in kind.inputs]
    for owner in kind.catalogue:
        if issubclass(owner, Gain) and (name := getattr(owner, "input", "")) not in inputs:
            yield owner, "input", _unknown_signal(owner, "input", name, inputs)


def _static_faults(kind: type[Model]) -> Faults:
    """Yield faults of time-dependent effects without states."""
    if kind.base_states:
        return
    for owner in kind.catalogue:
        fields = {"model": kind.__name__, "owner": owner.name}
        if owner.states or owner.memory or owner.delay:
            yield (
                owner,
                "",
                (
                    "{model} has no states, so each row of its tables is independent of the others; {owner} keeps "
                    "what was before: leave it out, or give the model a state"
                ).format(**fields),
            )
        elif owner.shape is not Effect.shape:
            yield (
                owner,
                "",
                (
                    "{model} has no states, and {owner} shapes what acts on states: an output takes a command "
                    "unchanged; let it act in the output, by a hook of your own"
                ).format(**fields),
            )
    for sensor in kind.sensors:
        if sensor.depends_on_past() or issubclass(sensor, Drift):
            yield (
                sensor,
                "",
                (
                    f"{kind.__name__} has no states, so each row of its tables is independent of the others; "
                    f"{sensor.name} depends on time: leave it out, or give the model a state"
                ),
            )


def _unit_faults(kind: type[Model]) -> Faults:
    """Yield faults of unknown units."""
    for owner in (kind, *kind.catalogue, *kind.sensors):
        for attribute, declared in _declared_units(owner):
            if declared.unit and parse(declared.unit) is None:
                yield (
                    owner,
                    attribute,
                    (
                        f'unknown unit "{declared.unit}" of {declared.name}; write it with SI symbols, as in '
                        "N.m.s/rad or m/s2, and a pure number as 1"
                    ),
                )


def _declared_units(owner: Any) -> Iterator[tuple[str, Quantity | Parameter]]:
    groups = ("states", "memory") if issubclass(owner, Effect) else ("base_states", "inputs", "outputs")
    for group in groups:
        yield from ((group, q) for q in getattr(owner, group))
    yield from ((p.name, p) for p in parameters_of(owner))
