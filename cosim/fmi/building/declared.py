"""Checks of a user's model class: declarations, names, bounds and units, then trial calls of its equations and effects.

All faults are reported at once with line and remedy, before any log is read.
"""

from __future__ import annotations

import ast
import dataclasses
import math
import re
import sys
import traceback
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, get_args, get_origin, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from cosim.core.errors import Fault, refuse
from cosim.core.text import did_you_mean
from cosim.core.units import parse
from cosim.fmi.ports import model_ports
from cosim.model.effects import Delay, Gain
from cosim.model.integrate import Stepper
from cosim.model.model import INTEGRATORS, Effect, Equations, LocalEffect, Model, overrides
from cosim.model.namespaces import SCALAR, Namespace, SymbolNamespace
from cosim.model.quantities import Quantity, parameters_of
from cosim.model.sensors import LeverArm, SensorError
from cosim.model.symbolic.symbols import symbolic

NAMESPACE_FUNCTIONS = ", ".join(f"m.{name}" for name in vars(Namespace) if not name.startswith("_"))
OF_NUMBERS = (
    "Cannot convert expression to float",
    "must be real number",
    "ufunc",
    "Namespace' object has no attribute",
)
CURES = {  # words of an exception → cure
    "truth value of": (
        "do not use `if`, `max`, `min` or `and` on a number: m.where(condition, then, otherwise) works on symbols too"
    ),
    "maximum recursion depth": "use fewer minima and maxima within each other",  # sympy 1.14
    **dict.fromkeys(OF_NUMBERS, f"use functions of m: {NAMESPACE_FUNCTIONS}"),
}


class ModelText:
    """The text of a model file, from which faults get their lines."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.classes: list[str] = []
        self._places: dict[tuple[str, str], tuple[int, int]] = {}
        try:
            tree = ast.parse(path.read_bytes())
        except (OSError, SyntaxError, ValueError):  # These errors are reported when the file is loaded.
            return
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                self.classes.append(node.name)
                self._places[node.name, ""] = node.lineno, node.col_offset + 1
                for part in node.body:
                    names = [n.id for n in ast.walk(part) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)]
                    if isinstance(part, ast.FunctionDef):
                        names = [part.name]
                    self._places |= {(node.name, name): (part.lineno, part.col_offset + 1) for name in names}

    def fault(self, owner: type, attribute: str, message: str) -> Fault:
        """Return a fault at the line of a class attribute; if the line is unknown, at the line of the class."""
        keys = [(c.__name__, attribute) for c in owner.__mro__ if c.__module__ == owner.__module__]
        place = next((key for key in keys if key in self._places), (owner.__name__, ""))
        line, column = self._places.get(place, (int(getattr(owner, "line", 0)), 0))
        return Fault(self.path, line, column, message)

    def convert_error(self, error: BaseException, doing: str) -> Fault:
        """Return the fault for an exception that occurred while `doing`: line, message and, if known, the cure."""
        text = " ".join((error.msg if isinstance(error, SyntaxError) else str(error)).split())
        cure = next((f"; {cure}" for words, cure in CURES.items() if words in text), "")
        frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename == str(self.path)]
        place = (frames[-1].lineno or 0, (frames[-1].colno or 0) + 1) if frames else (0, 0)
        if isinstance(error, SyntaxError) and error.filename == str(self.path):
            place = error.lineno or 0, max(1, error.offset or 1)
        return Fault(self.path, *place, f"{doing}: {type(error).__name__}: {text}".removesuffix(": ") + cure)


Faults = Iterator[tuple[type, str, str]]  # class, declaration, message
MAX_TOLERANCE = 2.0  # share of a value; larger tolerances are meaningless
SIGNAL_ATTRIBUTES = ("base_states", "inputs", "outputs")


def make_model(kind: type[Model], source: ModelText) -> Model:
    """Return a model of a class with default parameters; raise InputError with all faults of the class."""
    refuse(source.fault(*fault) for fault in _form_faults(kind))
    declared = chain(_effect_faults(kind), _name_faults(kind), _value_faults(kind))
    refuse(source.fault(*fault) for fault in declared)
    refuse(_trial_faults(kind, source))
    model = kind()
    counts = Counter(port.name for port in model_ports(model))
    cure = "inputs, outputs, parameters and start values need different names; the start value of s is named s_start"
    refuse(source.fault(kind, "", f'{n} variables are called "{name}"; {cure}') for name, n in counts.items() if n > 1)
    return model


def _form_faults(kind: type[Model]) -> Faults:
    """Yield faults of missing or mistyped declarations, and of classes that are not dataclasses."""
    if kind.equations is Model.equations:
        yield kind, "", f"{kind.__name__} has no equations; give it `def equations(self, m)` that returns Equations"
    groups = (value for value in (kind.catalogue, kind.sensors) if isinstance(value, (tuple, list)))
    owners = [one for value in groups for one in value if isinstance(one, type) and issubclass(one, Effect)]
    for owner in (kind, *owners):
        base = next(c for c in owner.__mro__ if c.__module__.startswith("cosim.model."))
        hints = get_type_hints(base) | ({"sensors": ClassVar[tuple[type[SensorError], ...]]} if owner is kind else {})
        for name, hint in hints.items():
            if get_origin(hint) is not ClassVar:
                continue
            (form,) = get_args(hint)
            type_name = re.sub(r"<class '|'>|(\w+\.)+", "", str(form))  # without modules
            cure = f"of type {type_name}; a tuple of one element has a comma too"
            if hasattr(owner, name):
                value, strict = getattr(owner, name), ConfigDict(strict=True, arbitrary_types_allowed=True)
                try:
                    TypeAdapter(form, config=strict).validate_python(value)
                except ValidationError:
                    yield owner, name, f"{name} is {value!r}; give a value {cure}"
            elif owner is kind or name in ("name", "equation"):
                yield owner, "", f"{owner.__name__} has no {name}; add {name}, {cure}"
        if name := next((n for n, v in vars(owner).items() if isinstance(v, dataclasses.Field)), ""):
            reason = "is not a field: put @dataclass(frozen=True, kw_only=True) above the class"
            yield owner, name, f"{owner.__name__}.{name} {reason}"


def _value_faults(kind: type[Model]) -> Faults:
    """Yield faults of numbers and units: defaults, neutral and typical values, times, variances, start values."""
    positive: list[tuple[type, str, str, Any, float]] = [
        (kind, name, name, getattr(kind, name), math.inf if name == "horizon" else sys.float_info.max)
        for name in ("rate", "substep", "horizon")
    ]
    for attribute in ("sensor_variance", "start_variance", "excursion"):
        values = getattr(kind, attribute).items()
        positive += [(kind, attribute, f"the {attribute} of {n}", v, sys.float_info.max) for n, v in values]
    declared: list[tuple[Any, str, Any, str]] = []  # owner, attribute, quantity or parameter, and its name
    for owner in (kind, *kind.catalogue, *kind.sensors):
        groups, prefix = (SIGNAL_ATTRIBUTES, "") if owner is kind else (("states", "memory"), f"{owner.name}.")
        declared += [(owner, group, q, q.name) for group in groups for q in getattr(owner, group)]
        declared += [(owner, p.name, p, prefix + p.name) for p in parameters_of(owner)]
    for owner, attribute, d, name in declared:
        low, high = d.bounds
        is_quantity = isinstance(d, Quantity)
        if d.unit and parse(d.unit) is None:
            cure = "write it with SI symbols, as in N.m.s/rad or m/s2, and 1 if there is no unit"
            yield owner, attribute, f'unknown unit "{d.unit}" of {name}; {cure}'
        if (is_quantity or not isinstance(d.default, bool)) and not low < high:
            yield owner, attribute, f"{name} has bounds {d.bounds}; write the lower one first"
        elif is_quantity:
            if not low <= d.start <= high:
                yield owner, attribute, f"the start value {d.start:g} of {name} is outside its bounds {d.bounds}"
        else:
            # A fit starts at the typical size, so the size must be inside the bounds; in other cases the typical size
            # is only a step size.
            typical = d.typical if d.neutral == low else None
            for word, value in (("default", d.default), ("neutral", d.neutral), ("typical", typical)):
                if (word == "default" or value is not None) and (fault := d.fault(value)):
                    yield owner, attribute, f"the {word} value of {name}: {fault}; change the value or the bounds"
            for word, limit in (("tolerance", MAX_TOLERANCE), ("typical", sys.float_info.max)):
                if (value := getattr(d, word)) is not None:
                    positive.append((owner, attribute, f"the {word} size of {name}", value, limit))
    for owner, attribute, name, value, limit in positive:
        if not (isinstance(value, (int, float)) and 0.0 < value <= limit):
            most = f", at most {limit:g}" if limit == MAX_TOLERANCE else ""
            yield owner, attribute, f"{name} is {value!r}; use a number above 0{most}"
    if kind.integrator not in INTEGRATORS:
        yield kind, "integrator", f"integrator is {kind.integrator!r}; allowed: {', '.join(INTEGRATORS)}"


def _name_faults(kind: type[Model]) -> Faults:
    """Yield faults of names used twice, and of references to undefined names."""
    states, inputs, outputs = ([q.name for q in getattr(kind, name)] for name in SIGNAL_ATTRIBUTES)
    if "time" in (*inputs, *outputs):
        yield kind, "", 'an input or output is called "time", the name of the time column of logs; give it another name'
    parameters = {p.name: not isinstance(p.default, bool) for p in parameters_of(kind)}
    numbers, taken = [name for name, is_number in parameters.items() if is_number], [*parameters]
    if states and not kind.forced:
        reason = "list the states whose equations may be incomplete, usually the accelerations"
        yield kind, "forced", f"forced names no state; {reason} (states: {', '.join(states)})"
    owners = (*kind.catalogue, *kind.sensors)
    candidates = [*(owner.name for owner in owners), *numbers]
    references: list[tuple[type, str, str, Iterable[str], Iterable[str]]] = [
        (kind, "forced", "state", kind.forced, states),
        (kind, "calibrated", "parameter", kind.calibrated, numbers),
        (kind, "suspect", "parameter", kind.suspect, numbers),
        (kind, "suspect", "input", chain(*kind.suspect.values()), inputs),
        (kind, "sensor_variance", "output", kind.sensor_variance, outputs),
        (kind, "start_variance", "state", kind.start_variance, states),
        (kind, "measured", "output", kind.measured, outputs),
        (kind, "excursion", "input or output", kind.excursion, [*inputs, *outputs]),
        (kind, "valid", "input", chain(*(v.inputs for v in kind.valid)), inputs),
        (kind, "planar", "output", kind.planar.names if kind.planar else (), outputs),
        (kind, "told_apart_by", "candidate", sorted(chain(*kind.told_apart_by)), candidates),
    ]
    for owner in owners:
        own: Any = owner
        if own.name in taken:
            yield own, "name", f'"{own.name}" is the name of another effect or a parameter; give each its own name'
        if "." in own.name:
            yield own, "name", f'the name "{own.name}" has a dot, the separator of effect and parameter; remove it'
        taken.append(own.name)
        names = [p.name for p in parameters_of(own)]
        references.append((own, "starts", "parameter", chain(*own.starts), names))
        references.append((own, "at_least", "parameter", chain(*own.at_least.items()), names))
        references.append((own, "delay", "parameter", () if own.delay is None else (own.delay,), names))
        if issubclass(own, LocalEffect):
            references.append((own, "place", "place", (getattr(own, "place", ""),), kind.places))
        if issubclass(own, Gain):
            references.append((own, "input", "input", (getattr(own, "input", ""),), inputs))
        if issubclass(own, SensorError):
            attribute = "outputs" if own.outputs else "output"
            references.append((own, attribute, "output", own.outputs or (getattr(own, "output", ""),), outputs))
        if issubclass(own, LeverArm):
            references.append((own, "others", "output", getattr(own, "others", ()) or ("",), outputs))
    for where, attribute, sort, used, allowed in references:
        for name in dict.fromkeys(used):
            if name not in allowed:
                hint = f"{did_you_mean(str(name), allowed)} (allowed: {', '.join(allowed) or 'none'})"
                yield where, attribute, f'{getattr(where, "name", attribute)}: no {sort} "{name}"{hint}'


def _effect_faults(kind: type[Model]) -> Faults:
    """Yield faults of effects, sensor errors and delays. An effect must be dormant at its default values."""
    for owner in (*kind.catalogue, *kind.sensors):
        switches = [p for p in parameters_of(owner) if p.neutral is not None]
        if not switches:
            yield owner, "", f"{owner.name} has no parameter with a neutral value, so it is never active; add one"
        for p in switches:
            if p.default != p.neutral:
                values = f"{p.default!r}, its neutral value {p.neutral!r}"
                yield owner, p.name, f"the default of {owner.name}.{p.name} is {values}; they must be equal"
    for owner in kind.sensors:
        if [p.name for p in parameters_of(owner)] != ["value"]:
            yield owner, "", f'a sensor error has one parameter, called "value"; change those of {owner.name}'
        if owner.outputs and owner.read is not SensorError.read and owner.readings is SensorError.readings:
            reason = "`read` returns one output, but the class declares several `outputs`"
            yield owner, "outputs", f"{owner.name}: {reason}; declare one `output` instead, or define `readings`"
    # At most one effect delays the command. It comes before all shaping effects and stores every input.
    shaping = overrides(tuple(object.__new__(k) for k in kind.catalogue), "shape", Effect)  # uninitialized instances
    order = [type(e) for e in shaping]
    delays: list[Any] = [k for k in kind.catalogue if k.delay is not None]
    for owner in delays:
        longest = {p.name: p.bounds[1] for p in parameters_of(owner)}.get(owner.delay, 0.0)
        if issubclass(owner, Delay) and longest > owner.longest:
            late = f"allows a delay up to {longest:g} s but stores {owner.longest:g} s of history"
            yield owner, owner.delay, f"{owner.name} {late}; set longest = {longest:g}"
        if owner not in order:
            yield owner, "delay", f"{owner.name} delays the command but has no method `shape`; add it"
        elif owner is not delays[0]:
            yield owner, "delay", f"{owner.name} and {delays[0].name} both delay the command; only one effect may"
        elif owner is not order[0]:
            yield kind, "catalogue", f"{owner.name} delays the command: put it before {order[0].name} in the catalogue"
        if len(owner.memory) != len(kind.inputs):
            counts = f"{len(kind.inputs)} inputs and has {len(owner.memory)} quantities of memory"
            yield owner, "memory", f"{owner.name} delays {counts}; declare one quantity per input, in their order"


# -- trial of equations, on floats as in the FMU and on symbols ------------------------------------------


def _trial_faults(kind: type[Model], source: ModelText) -> list[Fault]:
    """Return the faults of start values, equations, effects and sensors in trial calls; an exception ends the trial.

    On floats all effects are dormant, and each is then active alone for a substep. On symbols all are active, for both
    values of Boolean parameters.
    """
    import sympy

    faults: list[Fault] = []
    m, doing = SymbolNamespace(), "cannot be created with its defaults"
    try:
        model = kind()
        for hook, quantities in (("start_state", model.base_states), ("start_input", model.inputs)):
            doing = f"`{hook}` raises"
            values, names = getattr(model, hook)(), [q.name for q in quantities]
            if not (isinstance(values, dict) and values.keys() <= set(names)):
                reason = (
                    f"`{hook}` returns {values!r}; return a dict of names and values; allowed names: {', '.join(names)}"
                )
                return [source.fault(kind, hook, reason)]
        doing = "`equations` raises"
        faults += _equation_faults(source, model, SCALAR, (0.0, model.start(), model.start_command()))
        for flag in (True, False) if any(isinstance(p.default, bool) for p in model.parameters) else (None,):
            s = symbolic(model, flag)
            s.model.start_state(m)
            faults += _equation_faults(source, s.model, m, (s.time, s.state, s.command))
        if faults:
            return faults
        for owner in model.catalogue:
            typical = {
                p.name: min(max(p.neutral + p.typical, p.bounds[0]), p.bounds[1])
                for p in parameters_of(owner)
                if p.neutral is not None and p.typical is not None
            }
            doing = f"a step with {owner.name} raises"
            stepper = Stepper(model.with_effect(replace(owner(), **typical)))
            stepper.step(stepper.start(), model.start_command(), model.substep)
        s, h = symbolic(model), sympy.Symbol("h", positive=True)
        for effect in overrides(s.model.awake, "shape", Effect):
            if effect.delay:  # The delay needs no trial on symbols, since the log supplies delayed commands.
                continue
            doing = f"`shape` of {effect.name} raises"
            memory = tuple(sympy.Symbol(f"memory:{q.name}", real=True) for q in effect.memory)
            command, after = effect.shape(m, s.time, h, s.command, memory)
            if (len(command), len(after)) != (counts := (len(s.command), len(memory))):
                reason = f"`shape` of {effect.name} must return {counts[0]} commands, {counts[1]} of memory"
                faults.append(source.fault(type(effect), "shape", reason))
        value, t = (sympy.Symbol(name, real=True) for name in ("value", "time"))
        outputs = {q.name: sympy.Symbol(f"output:{q.name}", real=True) for q in model.outputs}
        for sensor in model.sensors:
            doing = f"reading {sensor.name} raises"
            readings = sensor(value=value).readings(m, t, outputs)
            if list(readings) != list(sensor.affected()) or not all(_is_number(r, m) for r in readings.values()):
                reason = f"{sensor.name} returns {readings}; it must return numbers for {', '.join(sensor.affected())}"
                faults.append(source.fault(sensor, "", reason))
    except Exception as error:  # A user's file may raise any error.
        faults.append(source.convert_error(error, doing))
    return faults


def _equation_faults(source: ModelText, model: Model, m: Namespace, arguments: tuple[Any, ...]) -> Iterator[Fault]:
    """Yield faults of derivative and output: a wrong number of values, or values of a wrong type."""
    body = model.equations(m)
    if not isinstance(body, Equations):
        reason = f"`equations` returns {type(body).__name__}; return Equations(derivative, output)"
        yield source.fault(type(model), "equations", reason)
        return
    for function, quantities in (("derivative", model.states), ("output", model.outputs)):
        values, names = getattr(body, function)(*arguments), [q.name for q in quantities]
        is_list = isinstance(values, (tuple, list))
        if not is_list or len(values) != len(names):
            count = len(values) if is_list else f"one {type(values).__name__}"
            reason = f"`{function}` returns {count}; return a tuple of {len(names)} values: {', '.join(names)}"
            yield source.fault(type(model), "equations", reason)
            return
        for name, value in zip(names, values, strict=True):
            if not _is_number(value, m):
                reason = f"`{function}` returns {value!r}, not a finite number, for {name}"
                yield source.fault(type(model), "equations", reason)


def _is_number(value: Any, m: Namespace) -> bool:
    """Return True for a finite number; with the namespace of symbols, for an expression too."""
    import sympy

    if m is SCALAR:
        return (isinstance(value, (int, float)) or hasattr(value, "__float__")) and math.isfinite(value)
    try:
        return isinstance(sympy.sympify(value, strict=True), sympy.Expr)
    except sympy.SympifyError:
        return False
