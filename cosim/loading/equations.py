"""Trial of a user's equations: on floats, as in the FMU, and on symbols."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from cosim.base.errors import Fault
from cosim.loading.source import ModelText
from cosim.model.integrate import Stepper
from cosim.model.model import Effect, Equations, Model, overrides
from cosim.model.namespaces import SCALAR, Namespace, SymbolNamespace
from cosim.model.quantities import parameters_of
from cosim.model.sensors import LeverArm, SensorError
from cosim.model.symbolic.symbols import symbolic
from cosim.storage.yaml_file import did_you_mean


def equation_faults(kind: type[Model], source: ModelText) -> list[Fault]:
    """Return the faults of `equations` and start values, evaluated on floats and on symbols.

    No effect is active on floats, all effects are active on symbols.
    """
    model = _try(source, "cannot be made", kind)
    if isinstance(model, Fault):
        return [model]
    faults = _start_faults(model, source)
    if not faults:
        arguments = 0.0, model.start(), model.start_command()
        faults = _body_faults(model, source, SCALAR, arguments, _number_objection)
    return [*faults, *_symbol_faults(model, source)]


def effect_faults(kind: type[Model], source: ModelText) -> list[Fault]:
    """Return the faults of effects and sensor errors.

    A substep is computed with each effect alone, and commands are shaped as symbols.
    """
    model = kind()
    faults = [fault for owner in kind.catalogue for fault in _step_faults(model, owner, source)]
    return [*faults, *_shaping_faults(model, source), *_sensor_faults(model, source)]


def _try(source: ModelText, doing: str, call: Callable[..., Any], *arguments: Any) -> Any:
    """Return a call's result, or its exception as fault."""
    try:
        return call(*arguments)
    except Exception as error:  # A user's file may raise any error.
        return source.convert_error(error, doing)


def _start_faults(model: Model, source: ModelText) -> list[Fault]:
    """Return faults of unknown start values."""
    faults = []
    for hook, quantities in (("start_state", model.base_states), ("start_input", model.inputs)):
        values = _try(source, f"`{hook}` raises", getattr(model, hook))
        names = [q.name for q in quantities]
        if isinstance(values, Fault):
            faults.append(values)
        elif not isinstance(values, dict):
            reason = f"`{hook}` gives {values!r}; return a dictionary of values by name"
            faults.append(source.fault(type(model), hook, reason))
        else:
            for name in values.keys() - set(names):
                reason = f'`{hook}` gives a value for "{name}"{did_you_mean(str(name), names)}'
                faults.append(source.fault(type(model), hook, f"{reason} (allowed: {', '.join(names)})"))
    return faults


def _symbol_faults(model: Model, source: ModelText) -> list[Fault]:
    """Return faults of the equations on symbols with all effects active, for both values of Boolean parameters."""
    import sympy

    flags = any(isinstance(p.default, bool) for p in model.parameters)
    faults: list[Fault] = []
    for flag in (True, False) if flags else (None,):
        s = _try(source, "cannot be made of symbols", symbolic, model, flag)
        if isinstance(s, Fault):
            return [s]
        m, arguments = SymbolNamespace(), (s.time, s.state, s.command)
        start = _try(source, "`start_state` raises", s.model.start_state, m)
        faults += [start] if isinstance(start, Fault) else []
        if body := _body_faults(s.model, source, m, arguments, _symbol_objection):
            faults += body
        elif not s.model.base_states and any(
            s.time in sympy.sympify(value).free_symbols for value in s.model.equations(m).output(*arguments)
        ):
            table = f"{type(model).__name__} has no states, so each row of its tables is independent of the others"
            faults.append(source.fault(type(model), "equations", f"{table}; let no output depend on time"))
    return faults


Objection = Callable[[Any], str]  # why a value is unsuitable, "" if it is suitable


def _body_faults(
    model: Model, source: ModelText, m: Namespace, arguments: tuple[Any, ...], objection: Objection
) -> list[Fault]:
    """Return faults of derivative and output: exceptions, number and values."""
    body = _try(source, "`equations` raises", model.equations, m)
    if isinstance(body, Fault):
        return [body]
    if not isinstance(body, Equations):
        reason = f"`equations` gives {type(body).__name__}; return Equations(derivative, output)"
        return [source.fault(type(model), "equations", reason)]
    faults: list[Fault] = []
    for function, quantities in (("derivative", model.states), ("output", model.outputs)):
        values = _try(source, f"`{function}` raises", getattr(body, function), *arguments)
        names = [q.name for q in quantities]
        if isinstance(values, Fault):
            faults.append(values)
            continue
        if not isinstance(values, (tuple, list)):
            kind = type(values).__name__
            texts = [f"`{function}` gives one {kind}; return a tuple of {len(names)}: {', '.join(names)}"]
        elif len(values) != len(names):
            texts = [f"`{function}` gives {len(values)} values; return {len(names)}: {', '.join(names)}"]
        else:
            pairs = zip(names, map(objection, values), strict=True)
            texts = [f"`{function}` gives {text} for {name}" for name, text in pairs if text]
        faults += [source.fault(type(model), "equations", text) for text in texts]
    return faults


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


def _step_faults(model: Model, owner: type[Effect], source: ModelText) -> list[Fault]:
    """Return the fault of a substep with one effect at typical size."""
    typical = {
        p.name: min(max(p.neutral + p.typical, p.bounds[0]), p.bounds[1])
        for p in parameters_of(owner)
        if p.neutral is not None and p.typical is not None
    }
    if not typical:
        return []

    def step() -> None:
        stepper = Stepper(model.with_effect(replace(owner(), **typical)))
        stepper.step(stepper.start(), model.start_command(), model.substep)

    fault = _try(source, f"a step with {owner.name} raises", step)
    return [fault] if isinstance(fault, Fault) else []


def _shaping_faults(model: Model, source: ModelText) -> list[Fault]:
    """Return faults of command shaping on symbols; delays need no check, since the log supplies delayed commands."""
    import sympy

    s = symbolic(model)
    faults = []
    for effect in overrides(s.model.awake, "shape", Effect):
        if effect.delay:
            continue
        memory = tuple(sympy.Symbol(f"memory:{q.name}", real=True) for q in effect.memory)
        h = sympy.Symbol("h", positive=True)
        doing = f"`shape` of {effect.name} raises"
        result = _try(source, doing, effect.shape, SymbolNamespace(), s.time, h, s.command, memory)
        counts = (len(s.command), len(memory))
        if isinstance(result, Fault):
            faults.append(result)
        elif (
            not isinstance(result, tuple)
            or not all(isinstance(part, (tuple, list)) for part in result)
            or tuple(map(len, result)) != counts
        ):
            message = f"`shape` of {effect.name} returns two tuples: {counts[0]} commands and {counts[1]} of memory"
            faults.append(source.fault(type(effect), "shape", message))
    return faults


def _sensor_faults(model: Model, source: ModelText) -> list[Fault]:
    """Return faults of symbolic readings of sensor errors."""
    import sympy

    value, t = (sympy.Symbol(name, real=True) for name in ("value", "time"))
    outputs = {q.name: sympy.Symbol(f"output:{q.name}", real=True) for q in model.outputs}
    faults = []
    for kind in model.sensors:
        hook = next((h for h in ("readings", "read") if getattr(kind, h) is not getattr(SensorError, h)), "measure")
        hook = "carried" if issubclass(kind, LeverArm) and kind.readings is LeverArm.readings else hook
        doing = f"`{hook}` of {kind.name} raises"
        readings = _try(source, doing, kind(value=value).readings, SymbolNamespace(), t, outputs)
        if isinstance(readings, Fault):
            faults.append(readings)
        elif list(readings) != list(kind.affected()):
            names = ", ".join(map(str, readings)) or "nothing"
            message = f"`{hook}` of {kind.name} reads {names}; it is of {', '.join(kind.affected())}"
            faults.append(source.fault(kind, hook, message))
        elif text := next(filter(None, map(_symbol_objection, readings.values())), ""):
            message = f"`{hook}` of {kind.name} gives {text} for a reading; return a number"
            faults.append(source.fault(kind, hook, message))
    return faults
