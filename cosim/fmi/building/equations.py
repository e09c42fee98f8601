"""Trial of a user's equations: on floats, as in the FMU, and on symbols."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from cosim.core.errors import Fault
from cosim.core.text import did_you_mean
from cosim.fmi.building.source import ModelText
from cosim.model.integrate import Stepper
from cosim.model.model import Effect, Equations, Model, overrides
from cosim.model.namespaces import SCALAR, Namespace, SymbolNamespace
from cosim.model.quantities import parameters_of
from cosim.model.sensors import LeverArm, SensorError
from cosim.model.symbolic.symbols import symbolic

FAILED = object()  # in place of the result of a call that raised an exception


class _Trial:
    """Calls of a user's functions, and the faults found."""

    def __init__(self, source: ModelText) -> None:
        self.source = source
        self.faults: list[Fault] = []

    def note(self, owner: type, attribute: str, message: str) -> None:
        self.faults.append(self.source.fault(owner, attribute, message))

    def attempt(self, doing: str, call: Callable[..., Any], *arguments: Any) -> Any:
        """Return a call's result, or FAILED with its exception noted as fault."""
        try:
            return call(*arguments)
        except Exception as error:  # A user's file may raise any error.
            self.faults.append(self.source.convert_error(error, doing))
            return FAILED


def equation_faults(kind: type[Model], source: ModelText) -> list[Fault]:
    """Return the faults of `equations` and start values, evaluated on floats and on symbols.

    No effect is active on floats. All effects are active on symbols, for both values of Boolean parameters.
    """
    trial = _Trial(source)
    model = trial.attempt("cannot be made", kind)
    if model is FAILED:
        return trial.faults
    for hook, quantities in (("start_state", model.base_states), ("start_input", model.inputs)):
        values = trial.attempt(f"`{hook}` raises", getattr(model, hook))
        names = [q.name for q in quantities]
        if not isinstance(values, dict) and values is not FAILED:
            trial.note(kind, hook, f"`{hook}` gives {values!r}; return a dictionary of values by name")
        for name in values.keys() - set(names) if isinstance(values, dict) else ():
            reason = f'`{hook}` gives a value for "{name}"{did_you_mean(str(name), names)}'
            trial.note(kind, hook, f"{reason} (allowed: {', '.join(names)})")
    if not trial.faults:
        arguments = 0.0, model.start(), model.start_command()
        _try_equations(trial, model, SCALAR, arguments, _number_objection)
    flags = any(isinstance(p.default, bool) for p in model.parameters)
    for flag in (True, False) if flags else (None,):
        s = trial.attempt("cannot be made of symbols", symbolic, model, flag)
        if s is FAILED:
            break
        m = SymbolNamespace()
        trial.attempt("`start_state` raises", s.model.start_state, m)
        _try_equations(trial, s.model, m, (s.time, s.state, s.command), _symbol_objection)
    return trial.faults


Objection = Callable[[Any], str]  # why a value is unsuitable, "" if it is suitable


def _try_equations(trial: _Trial, model: Model, m: Namespace, arguments: tuple[Any, ...], objection: Objection) -> None:
    """Note faults of derivative and output: exceptions, number and values."""
    body, kind = trial.attempt("`equations` raises", model.equations, m), type(model)
    if not isinstance(body, Equations):
        if body is not FAILED:
            reason = f"`equations` gives {type(body).__name__}; return Equations(derivative, output)"
            trial.note(kind, "equations", reason)
        return
    for function, quantities in (("derivative", model.states), ("output", model.outputs)):
        values = trial.attempt(f"`{function}` raises", getattr(body, function), *arguments)
        names = [q.name for q in quantities]
        texts = []
        if isinstance(values, (tuple, list)) and len(values) == len(names):
            objections = zip(names, map(objection, values), strict=True)
            texts = [f"`{function}` gives {text} for {name}" for name, text in objections if text]
        elif isinstance(values, (tuple, list)):
            texts = [f"`{function}` gives {len(values)} values; return {len(names)}: {', '.join(names)}"]
        elif values is not FAILED:
            wrong = type(values).__name__
            texts = [f"`{function}` gives one {wrong}; return a tuple of {len(names)}: {', '.join(names)}"]
        for text in texts:
            trial.note(kind, "equations", text)


def _number_objection(value: Any) -> str:
    is_number = isinstance(value, (int, float)) or hasattr(value, "__float__")
    if is_number and math.isfinite(value):
        return ""
    return f"{repr(value) if is_number else type(value).__name__}, no finite number, at the start values"


def _symbol_objection(value: Any) -> str:
    import sympy

    try:
        is_expression = isinstance(sympy.sympify(value, strict=True), sympy.Expr)
    except sympy.SympifyError:
        is_expression = False
    return "" if is_expression else f"{type(value).__name__}, no number,"


def effect_faults(kind: type[Model], source: ModelText) -> list[Fault]:
    """Return the faults of effects and sensor errors.

    A substep is computed with each effect alone at its typical size. Commands are shaped and readings taken as symbols.
    """
    import sympy

    model, trial, m = kind(), _Trial(source), SymbolNamespace()
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
        if effect.delay:  # It needs no check, since the log supplies delayed commands.
            continue
        memory = tuple(sympy.Symbol(f"memory:{q.name}", real=True) for q in effect.memory)
        shaped = trial.attempt(f"`shape` of {effect.name} raises", effect.shape, m, s.time, h, s.command, memory)
        counts = (len(s.command), len(memory))
        is_pair = isinstance(shaped, tuple) and all(isinstance(part, (tuple, list)) for part in shaped)
        if shaped is not FAILED and not (is_pair and tuple(map(len, shaped)) == counts):
            message = f"`shape` of {effect.name} returns two tuples: {counts[0]} commands and {counts[1]} of memory"
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
            trial.note(sensor, hook, f"{doing} reads {names}; it is of {', '.join(sensor.affected())}")
        elif text := next(filter(None, map(_symbol_objection, readings.values())), ""):
            trial.note(sensor, hook, f"{doing} gives {text} for a reading; return a number")
    return trial.faults
