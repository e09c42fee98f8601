"""Checks of a user's model class: declarations, names, bounds and units, then a trial of its equations and effects.

All faults are reported at once with line and remedy, before any log is read.
"""

from __future__ import annotations

import ast
import dataclasses
import math
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, get_args, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from cosim.core.errors import Fault, refuse
from cosim.core.text import did_you_mean
from cosim.core.units import parse
from cosim.fmi.ports import model_ports
from cosim.model.effects import Delay, Gain
from cosim.model.integrate import Stepper
from cosim.model.model import INTEGRATORS, Effect, Equations, LocalEffect, Model, overrides
from cosim.model.namespaces import SCALAR, Namespace, SymbolNamespace
from cosim.model.planar import PlanarFrame
from cosim.model.quantities import Quantity, parameters_of
from cosim.model.sensors import LeverArm, SensorError
from cosim.model.symbolic.symbols import symbolic

FUNCTIONS = ", ".join(f"m.{name}" for name in vars(Namespace) if not name.startswith("_"))
TRUTH_TEST = "truth value of"  # sympy's words for the truth test of a symbol
FOREIGN = ("Cannot convert expression to float", "must be real number", "ufunc", "Namespace' object has no attribute")


class ModelText:
    """The text of a model file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.classes: list[str] = []
        self._places: dict[tuple[str, str], tuple[int, int]] = {}
        try:
            tree = ast.parse(path.read_bytes())
        except (OSError, SyntaxError, ValueError):  # Loading the file reports this error.
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
        """Return a fault at the line of a class attribute, otherwise at the class."""
        keys = [(c.__name__, attribute) for c in owner.__mro__ if c.__module__ == owner.__module__]
        place = next((key for key in keys if key in self._places), (owner.__name__, ""))
        line, column = self._places.get(place, (int(getattr(owner, "line", 0)), 0))
        return Fault(self.path, line, column, message)

    def convert_error(self, error: BaseException, doing: str) -> Fault:
        """Return an exception as a fault, with its line and the cure, if known."""
        text = " ".join((error.msg if isinstance(error, SyntaxError) else str(error)).split())
        cure = ""
        if isinstance(error, TypeError) and TRUTH_TEST in text:
            where = "m.where(condition, then, otherwise) works on symbols too"
            cure = f"; do not use `if`, `max`, `min` or `and` on a number: {where}"
        elif isinstance(error, (TypeError, AttributeError)) and any(words in text for words in FOREIGN):
            cure = f"; use functions of m: {FUNCTIONS}"
        name = f"{doing}: {type(error).__name__}: {text}".removesuffix(": ")
        return Fault(self.path, *self._raised_at(error), f"{name}{cure}")

    def _raised_at(self, error: BaseException) -> tuple[int, int]:
        if isinstance(error, SyntaxError) and error.filename == str(self.path):
            return error.lineno or 0, max(1, error.offset or 1)
        for frame in reversed(traceback.extract_tb(error.__traceback__)):
            if frame.filename == str(self.path):
                return frame.lineno or 0, (frame.colno or 0) + 1
        return 0, 0


Faults = Iterator[tuple[type, str, str]]  # class, declaration, message
COMMA = "with a comma even after a single element"
MAX_NUMBER = sys.float_info.max
MAX_TOLERANCE = 2.0  # share of a value; larger tolerances are meaningless
DICTIONARY = "is a dictionary"
FORMS = {  # declaration → its form; its type is the annotation of `Model`
    **dict.fromkeys(("base_states", "inputs", "outputs"), f"is a tuple of quantities, {COMMA}"),
    "catalogue": f"is a tuple of subclasses of Effect, {COMMA}",
    "sensors": f"is a tuple of subclasses of SensorError, {COMMA}",
    **dict.fromkeys(("forced", "calibrated", "measured", "places"), f'is a tuple of names, {COMMA}: ("name",)'),
    "valid": 'is a tuple: (Validity("quantity", ("input",), low, high, "what happens beyond"),)',
    "suspect": f'{DICTIONARY}: {{"parameter": ("input",)}}',
    "drawn_against": f'{DICTIONARY}: {{"effect": ("signal",)}}',
    "sensor_variance": f'{DICTIONARY}: {{"output": variance}}',
    "start_variance": f'{DICTIONARY}: {{"state": variance}}',
    "excursion": f'{DICTIONARY}: {{"input or output": allowed deviation from its start}}',
    "told_apart_by": f'{DICTIONARY}: {{frozenset({{"name", "name"}}): "what an experiment needs"}}',
}


def make_model(kind: type[Model], source: ModelText) -> Model:
    """Return a model with default parameters; raise InputError with all faults of its class."""
    refuse(source.fault(*fault) for fault in _form_faults(kind))
    declared = [*_effect_faults(kind)]
    values = [*_parameter_faults(kind)]
    trial = _Trial(source)
    trial.faults += [source.fault(*f) for f in (*declared, *_name_faults(kind), *_number_faults(kind), *values)]
    if not values:
        _try_model(trial, kind)
    if not trial.faults:
        _try_effects(trial, kind)
    refuse(trial.faults)
    model = kind()
    variables = "inputs, outputs, parameters and start values"
    refuse(
        source.fault(
            kind, "", f'{count} of its {variables} ("state_start") are called "{name}"; give each its own name'
        )
        for name, count in Counter(port.name for port in model_ports(model)).items()
        if count > 1
    )
    return model


def _form_faults(kind: type[Model]) -> Faults:
    """Yield faults of missing or mistyped declarations, and of classes that are not dataclasses."""
    if kind.equations is Model.equations:
        yield kind, "", f"{kind.__name__} has no equations; give it `def equations(self, m)` that returns Equations"
    annotations = get_type_hints(Model) | {"sensors": ClassVar[tuple[type[SensorError], ...]]}
    for name, form in FORMS.items():
        if not hasattr(kind, name):
            yield kind, "", f'{kind.__name__} has no {name}; add {name} = (Quantity("name", "unit", "meaning"),)'
        elif not _is_of(getattr(kind, name), *get_args(annotations[name])):
            yield kind, name, f"{name} {form}"
    groups = (value for value in (kind.catalogue, kind.sensors) if isinstance(value, (tuple, list)))
    owners = [one for value in groups for one in value if isinstance(one, type)]
    for owner in (one for one in owners if issubclass(one, Effect)):  # an effect or sensor error
        for label in ("name", "equation"):
            if not isinstance(getattr(owner, label, None), str):
                yield owner, label, f'{owner.__name__} has no {label}; add {label} = "…"'
        if "." in (label := str(getattr(owner, "name", ""))):
            yield owner, "name", f'the name "{label}" has a dot, the separator of effect and parameter; remove it'
        for group in ("states", "memory"):
            if not _is_of(getattr(owner, group), tuple[Quantity, ...]):
                yield owner, group, f"{group} {FORMS['inputs']}"
    for cls in (kind, *owners):
        if name := next((n for n, v in vars(cls).items() if isinstance(v, dataclasses.Field)), ""):
            reason = "is not a field: put @dataclass(frozen=True, kw_only=True) above the class"
            yield cls, name, f"{cls.__name__}.{name} {reason}"


def _is_of(value: Any, annotation: Any) -> bool:
    """Return True if a value has an annotated type without conversion."""
    try:
        TypeAdapter(annotation, config=ConfigDict(strict=True, arbitrary_types_allowed=True)).validate_python(value)
    except ValidationError:
        return False
    return True


def _parameter_faults(kind: type[Model]) -> Faults:
    """Yield faults of defaults, neutral and typical values of the model, its effects and sensor errors."""
    owners: Iterable[Any] = (kind, *kind.catalogue, *kind.sensors)
    for owner, p in ((each, p) for each in owners for p in parameters_of(each)):
        prefix = f"{owner.name}." if issubclass(owner, Effect) else ""
        name = f"{prefix}{p.name}"
        if not isinstance(p.default, bool) and not p.bounds[0] < p.bounds[1]:
            yield owner, p.name, f"{name} has bounds {p.bounds}; write the lower one first"
            continue
        values = {"default": p.default, "neutral": p.neutral}
        # A fit starts at the typical size, so the size must be inside the bounds; elsewhere it is only a step size.
        if p.neutral == p.bounds[0]:
            values["typical"] = p.typical
        for word, value in values.items():
            if (word == "default" or value is not None) and (fault := p.fault(value)):
                yield owner, p.name, f"the {word} of {prefix}{fault}; change the value or the bounds"
        if p.tolerance is not None and not _is_size(p.tolerance, MAX_TOLERANCE):
            reason = "use a share of the value, such as 0.1 for 10 %"
            yield owner, p.name, f"the tolerance of {name} is {p.tolerance!r}; {reason}"
        if p.typical is not None and not 0.0 < p.typical < math.inf:
            yield owner, p.name, f"the typical size of {name} is {p.typical!r}; use a number above 0"


def _is_size(value: Any, limit: float = MAX_NUMBER) -> bool:
    """Return whether a value is a positive number up to a limit."""
    return isinstance(value, (int, float)) and 0.0 < value <= limit


def _number_faults(kind: type[Model]) -> Faults:
    """Yield faults of numbers and units: times or variances that are not positive, start values out of bounds."""
    for name, limit in (("rate", MAX_NUMBER), ("substep", MAX_NUMBER), ("horizon", math.inf)):
        if not _is_size(value := getattr(kind, name), limit):
            yield kind, name, f"{name} is {value!r}; use a time above 0 s"
    if kind.integrator not in INTEGRATORS:
        yield kind, "integrator", f"integrator is {kind.integrator!r}; allowed: {', '.join(INTEGRATORS)}"
    for attribute in ("sensor_variance", "start_variance", "excursion"):
        for name, value in getattr(kind, attribute).items():
            if not _is_size(value):
                yield kind, attribute, f"the {attribute} of {name} is {value!r}; use a number above 0"
    for attribute in ("base_states", "inputs", "outputs"):
        for q in getattr(kind, attribute):
            low, high = q.bounds
            if not low < high:
                yield kind, attribute, f"{q.name} has bounds {q.bounds}; write the lower one first"
            elif not low <= q.start <= high:
                yield kind, attribute, f"the start value {q.start:g} of {q.name} is outside its bounds {q.bounds}"
    owners: Iterable[Any] = (kind, *kind.catalogue, *kind.sensors)
    for owner in owners:
        groups = ("states", "memory") if issubclass(owner, Effect) else ("base_states", "inputs", "outputs")
        quantities = [(group, q) for group in groups for q in getattr(owner, group)]
        for attribute, declared in (*quantities, *((p.name, p) for p in parameters_of(owner))):
            if declared.unit and parse(declared.unit) is None:
                form = "write it with SI symbols, as in N.m.s/rad or m/s2, and a pure number as 1"
                yield owner, attribute, f'unknown unit "{declared.unit}" of {declared.name}; {form}'


def _name_faults(kind: type[Model]) -> Faults:
    """Yield faults of names used twice, and of references to undefined names."""
    quantities = {name: [q.name for q in getattr(kind, name)] for name in ("base_states", "inputs", "outputs")}
    named = {name: list(getattr(kind, name)) for name in ("forced", "calibrated", "measured")}
    for attribute, names in (quantities | named).items():
        for name, count in Counter(names).items():
            if count > 1:
                yield kind, attribute, f'{attribute} has {count} called "{name}"; give each its own name'
    states, inputs, outputs = quantities.values()
    if "time" in (*inputs, *outputs):
        yield kind, "", 'an input or output is called "time", the name of the time column of logs; give it another name'
    parameters = {p.name: not isinstance(p.default, bool) for p in parameters_of(kind)}
    every = (*kind.catalogue, *kind.sensors)
    for name, count in Counter(owner.name for owner in every).items():
        last = [owner for owner in every if owner.name == name][-1]
        if count > 1:
            yield last, "name", f'{count} effects or sensor errors are called "{name}"; give each its own name'
        if name in parameters:
            yield last, "name", f'"{name}" is a parameter of the model too; give the effect another name'
    for owner in kind.catalogue:
        if issubclass(owner, LocalEffect) and getattr(owner, "place", None) not in kind.places:
            places = ", ".join(kind.places) or "none yet"
            yield owner, "place", f"the place of {owner.name} is not in `places` of the model ({places}); add it there"
    if kind.planar is not None and not isinstance(kind.planar, PlanarFrame):
        fields = ", ".join(f'{field.name}="…"' for field in dataclasses.fields(PlanarFrame))
        yield kind, "planar", f"planar is a PlanarFrame({fields}) of outputs, or None"
    if states and not kind.forced:
        reason = "list the states whose equations may be incomplete, usually the accelerations"
        yield kind, "forced", f"forced names no state; {reason} (states: {', '.join(states)})"
    numbers = [name for name, is_number in parameters.items() if is_number]
    candidates = [*(owner.name for owner in every), *numbers]
    references: list[tuple[str, str, Iterable[str], list[str]]] = [
        ("forced", "state", kind.forced, states),
        ("calibrated", "parameter", kind.calibrated, numbers),
        ("suspect", "parameter", kind.suspect, numbers),
        ("suspect", "input", chain.from_iterable(kind.suspect.values()), inputs),
        ("sensor_variance", "output", kind.sensor_variance, outputs),
        ("start_variance", "state", kind.start_variance, states),
        ("measured", "output", kind.measured, outputs),
        ("excursion", "input or output", kind.excursion, [*inputs, *outputs]),
        ("valid", "input", chain.from_iterable(v.inputs for v in kind.valid), inputs),
        ("planar", "output", kind.planar.names if isinstance(kind.planar, PlanarFrame) else (), outputs),
        ("told_apart_by", "candidate", sorted(chain.from_iterable(kind.told_apart_by)), candidates),
        ("drawn_against", "candidate", kind.drawn_against, candidates),
    ]
    for attribute, sort, used, names in references:
        for name in dict.fromkeys(used):
            if name not in names:
                yield kind, attribute, f"{attribute}: {_unknown(sort, name, names)}"
    for name in kind.suspect:
        if name in kind.calibrated:
            yield kind, "suspect", f'"{name}" is also in calibrated; remove it from suspect'


def _unknown(sort: str, name: str, names: Iterable[str]) -> str:
    """Return a message about an unknown or missing name."""
    every = f"({sort.replace(' or', 's or')}s: {', '.join(names) or 'none'})"
    return f'no {sort} "{name}"{did_you_mean(str(name), names)} {every}' if name else f"a name is missing {every}"


def _effect_faults(kind: type[Model]) -> Faults:
    """Yield faults of effects, sensor errors and delays. An effect must be dormant at its default values."""
    for owner in (*kind.catalogue, *kind.sensors):
        switches = [p for p in parameters_of(owner) if p.neutral is not None]
        if not switches:
            reason = "has no parameter with a neutral value, so it is never active; add one"
            yield owner, "", f"{owner.name} {reason}"
        for p in switches:
            if p.default != p.neutral:
                values = f"{p.default!r}, its neutral value {p.neutral!r}"
                yield owner, p.name, f"the default of {owner.name}.{p.name} is {values}; they must be equal"
        names = [p.name for p in parameters_of(owner)]
        for attribute, groups in (("starts", owner.starts), ("at_least", owner.at_least.items())):
            for name in dict.fromkeys(chain.from_iterable(groups)):
                if name not in names:
                    yield owner, attribute, f'{owner.name} has no parameter "{name}"{did_you_mean(name, names)}'
    inputs = [q.name for q in kind.inputs]
    for effect in kind.catalogue:
        if issubclass(effect, Gain) and (name := getattr(effect, "input", "")) not in inputs:
            yield effect, "input", f"{effect.name}: {_unknown('input', name, inputs)}"
    outputs = [q.name for q in kind.outputs]
    for owner in kind.sensors:
        names = [p.name for p in parameters_of(owner)]
        if names != ["value"]:  # `value` is the only parameter
            cure = "move the others to another class" if "value" in names else "rename it"
            given = f"{owner.name} has {' and '.join(names) or 'none'}"
            yield owner, (names or [""])[0], f'a sensor error has one parameter, called "value"; {given}; {cure}'
        if owner.outputs and owner.read is not SensorError.read and owner.readings is SensorError.readings:
            reason = "`read` returns one output, but the class declares several `outputs`"
            yield owner, "outputs", f"{owner.name}: {reason}; declare one `output` instead, or define `readings`"
        for attribute in ("outputs" if owner.outputs else "output", *(("others",) * issubclass(owner, LeverArm))):
            value = getattr(owner, attribute, ())
            if attribute != "output" and isinstance(value, str):
                yield owner, attribute, f'{owner.name}: {attribute} is a tuple of names, {COMMA}: ("{value}",)'
                continue
            for name in (value,) if isinstance(value, str) else value or ("",):
                if name not in outputs:
                    yield owner, attribute, f"{owner.name}: {_unknown('output', name, outputs)}"
    # At most one effect delays the command. It comes before all shaping effects and stores every input.
    shaping = overrides(tuple(object.__new__(k) for k in kind.catalogue), "shape", Effect)  # uninitialized instances
    order = [type(e) for e in shaping]
    delays: list[Any] = [k for k in kind.catalogue if k.delay is not None]
    for owner in delays:
        bounds = {p.name: p.bounds for p in parameters_of(owner)}
        if owner.delay not in bounds:
            unknown = f'has no parameter "{owner.delay}"{did_you_mean(str(owner.delay), bounds)}'
            yield owner, "delay", f"{owner.name} {unknown}; `delay` names the parameter that delays the command"
        elif issubclass(owner, Delay) and (longest := bounds[owner.delay][1]) > owner.longest:
            late = f"allows a delay up to {longest:g} s but stores {owner.longest:g} s of history"
            yield owner, owner.delay, f"{owner.name} {late}; set longest = {longest:g}"
        if owner not in order:
            yield owner, "delay", f"{owner.name} delays the command but has no method `shape`; add it"
        elif owner is not order[0] and owner is delays[0]:
            yield kind, "catalogue", f"{owner.name} delays the command: put it before {order[0].name} in the catalogue"
        if len(owner.memory) != len(kind.inputs):
            counts = f"{len(kind.inputs)} inputs and has {len(owner.memory)} quantities of memory"
            yield owner, "memory", f"{owner.name} delays {counts}; declare one quantity per input, in their order"
        if owner is not delays[0]:
            yield owner, "delay", f"{owner.name} and {delays[0].name} both delay the command; only one effect may"


# -- trial of equations, on floats as in the FMU and on symbols ------------------------------------------

FAILED = object()  # in place of the result of a call that raised an exception


class _Trial:
    """Trial calls of a user's functions, and the faults they raise."""

    def __init__(self, source: ModelText) -> None:
        self.source = source
        self.faults: list[Fault] = []

    def note(self, owner: type, attribute: str, message: str) -> None:
        self.faults.append(self.source.fault(owner, attribute, message))

    def attempt(self, doing: str, call: Callable[..., Any], *arguments: Any) -> Any:
        """Return the result of a call; after an exception, record a fault and return FAILED."""
        try:
            return call(*arguments)
        except Exception as error:  # A user's file may raise any error.
            self.faults.append(self.source.convert_error(error, doing))
            return FAILED


def _try_model(trial: _Trial, kind: type[Model]) -> None:
    """Record the faults of `equations` and of start values, evaluated on floats and on symbols.

    On floats all effects are dormant. On symbols all are active, for both values of Boolean parameters.
    """
    before = len(trial.faults)
    model = trial.attempt("cannot be created with its defaults", kind)
    if model is FAILED:
        return
    for hook, quantities in (("start_state", model.base_states), ("start_input", model.inputs)):
        values = trial.attempt(f"`{hook}` raises", getattr(model, hook))
        names = [q.name for q in quantities]
        if not isinstance(values, dict) and values is not FAILED:
            trial.note(kind, hook, f"`{hook}` returns {values!r}; return a dictionary of values by name")
        for name in values.keys() - set(names) if isinstance(values, dict) else ():
            reason = f'`{hook}` returns a value for the unknown name "{name}"{did_you_mean(str(name), names)}'
            trial.note(kind, hook, f"{reason} (allowed: {', '.join(names)})")
    if len(trial.faults) == before:
        arguments = 0.0, model.start(), model.start_command()
        _try_equations(trial, model, SCALAR, arguments, _number_objection)
    flags = any(isinstance(p.default, bool) for p in model.parameters)
    for flag in (True, False) if flags else (None,):
        s = trial.attempt("cannot be evaluated with symbols as parameters", symbolic, model, flag)
        if s is FAILED:
            break
        m = SymbolNamespace()
        trial.attempt("`start_state` raises", s.model.start_state, m)
        _try_equations(trial, s.model, m, (s.time, s.state, s.command), _symbol_objection)


Objection = Callable[[Any], str]  # a function from a value to the reason why it is unsuitable, "" if it is suitable


def _try_equations(trial: _Trial, model: Model, m: Namespace, arguments: tuple[Any, ...], objection: Objection) -> None:
    """Record faults of derivative and output: exceptions, and a wrong number or type of values."""
    body, kind = trial.attempt("`equations` raises", model.equations, m), type(model)
    if not isinstance(body, Equations):
        if body is not FAILED:
            reason = f"`equations` returns {type(body).__name__}; return Equations(derivative, output)"
            trial.note(kind, "equations", reason)
        return
    for function, quantities in (("derivative", model.states), ("output", model.outputs)):
        values = trial.attempt(f"`{function}` raises", getattr(body, function), *arguments)
        names = [q.name for q in quantities]
        texts = []
        if isinstance(values, (tuple, list)) and len(values) == len(names):
            objections = zip(names, map(objection, values), strict=True)
            texts = [f"`{function}` returns {text} for {name}" for name, text in objections if text]
        elif isinstance(values, (tuple, list)):
            texts = [f"`{function}` returns {len(values)} values; return {len(names)}: {', '.join(names)}"]
        elif values is not FAILED:
            wrong = type(values).__name__
            texts = [f"`{function}` returns one {wrong}; return a tuple of {len(names)}: {', '.join(names)}"]
        for text in texts:
            trial.note(kind, "equations", text)


def _number_objection(value: Any) -> str:
    is_number = isinstance(value, (int, float)) or hasattr(value, "__float__")
    if is_number and math.isfinite(value):
        return ""
    return f"{repr(value) if is_number else type(value).__name__}, not a finite number, at the start values"


def _symbol_objection(value: Any) -> str:
    import sympy

    try:
        is_expression = isinstance(sympy.sympify(value, strict=True), sympy.Expr)
    except sympy.SympifyError:
        is_expression = False
    return "" if is_expression else f"{type(value).__name__}, not a number,"


def _try_effects(trial: _Trial, kind: type[Model]) -> None:
    """Record the faults of effects and sensor errors.

    Each effect alone is integrated over a substep at its typical size. Shaped commands and readings are tried on
    symbols.
    """
    import sympy

    model, m = kind(), SymbolNamespace()
    for owner in kind.catalogue:
        typical = {
            p.name: min(max(p.neutral + p.typical, p.bounds[0]), p.bounds[1])
            for p in parameters_of(owner)
            if p.neutral is not None and p.typical is not None
        }

        def step(owner: type[Effect] = owner, typical: dict[str, float] = typical) -> None:
            stepper = Stepper(model.with_effect(replace(owner(), **typical)))
            stepper.step(stepper.start(), model.start_command(), model.substep)

        if typical:
            trial.attempt(f"a step with {owner.name} raises", step)
    s, h = symbolic(model), sympy.Symbol("h", positive=True)
    for effect in overrides(s.model.awake, "shape", Effect):
        if effect.delay:  # The delay needs no trial on symbols, since the log supplies delayed commands.
            continue
        memory = tuple(sympy.Symbol(f"memory:{q.name}", real=True) for q in effect.memory)
        shaped = trial.attempt(f"`shape` of {effect.name} raises", effect.shape, m, s.time, h, s.command, memory)
        counts = (len(s.command), len(memory))
        is_pair = isinstance(shaped, tuple) and all(isinstance(part, (tuple, list)) for part in shaped)
        if shaped is not FAILED and not (is_pair and tuple(map(len, shaped)) == counts):
            message = f"`shape` of {effect.name} must return two tuples: {counts[0]} commands, {counts[1]} of memory"
            trial.note(type(effect), "shape", message)
    value, t = (sympy.Symbol(name, real=True) for name in ("value", "time"))
    outputs = {q.name: sympy.Symbol(f"output:{q.name}", real=True) for q in model.outputs}
    for sensor in model.sensors:
        hook = next((h for h in ("readings", "read") if getattr(sensor, h) is not getattr(SensorError, h)), "measure")
        hook = "carried" if issubclass(sensor, LeverArm) and sensor.readings is LeverArm.readings else hook
        doing = f"`{hook}` of {sensor.name}"
        readings = trial.attempt(f"{doing} raises", sensor(value=value).readings, m, t, outputs)
        if readings is FAILED:
            continue
        if list(readings) != list(sensor.affected()):
            names = ", ".join(map(str, readings)) or "nothing"
            trial.note(sensor, hook, f"{doing} returns {names}; it must return {', '.join(sensor.affected())}")
        elif text := next(filter(None, map(_symbol_objection, readings.values())), ""):
            trial.note(sensor, hook, f"{doing} returns {text} as a reading; return a number")
