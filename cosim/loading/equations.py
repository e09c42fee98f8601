"""Trial of a user's equations: on floats, as in the FMU, and on symbols."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from cosim.base.errors import Fault
from cosim.loading.source import Source
from cosim.model.integrate import Stepper
from cosim.model.model import Effect, Equations, Model, overrides
from cosim.model.namespaces import SCALAR, Namespace, SymbolNamespace
from cosim.model.quantities import parameters_of
from cosim.model.sensors import LeverArm, SensorError
from cosim.model.symbolic.symbols import SymbolicModel, symbolic
from cosim.storage.yaml_file import did_you_mean


def equation_faults(kind: type[Model], source: Source) -> list[Fault]:
    """Return the faults of `equations` and start values. No effect is active on floats, all are on symbols."""
    made = _tried(source, "cannot be made", kind)
    if isinstance(made, Fault):
        return [made]
    starts = _start_faults(made, source)
    return [*starts, *([] if starts else _float_faults(made, source)), *_symbol_faults(made, source)]


def effect_faults(kind: type[Model], source: Source) -> list[Fault]:
    """Return the faults of effects and sensor errors.

    Each effect takes a substep alone, and commands are shaped as symbols.
    """
    model = kind()
    faults = [fault for owner in kind.catalogue for fault in _alone(model, owner, source)]
    return [*faults, *_shaping_faults(model, source), *_sensor_faults(model, source)]


def _tried(source: Source, doing: str, call: Callable[..., Any], *arguments: Any) -> Any:
    """Return a call's result, or the fault of its exception."""
    try:
        return call(*arguments)
    except Exception as error:  # A user's file may raise any error.
        return source.raised(error, doing)


def _start_faults(model: Model, source: Source) -> list[Fault]:
    """Return faults of unknown start values."""
    faults = []
    for hook, names in (("start_state", model.base_states), ("start_input", model.inputs)):
        given = _tried(source, f"`{hook}` raises", getattr(model, hook))
        known = [q.name for q in names]
        if isinstance(given, Fault):
            faults.append(given)
        elif not isinstance(given, dict):
            faults.append(
                source.fault(type(model), hook, f"`{hook}` gives {given!r}; return a dictionary of values by name")
            )
        else:
            strangers = [n for n in given if n not in known]
            text = f"`{hook}` gives a value for"
            faults += [
                source.fault(
                    type(model), hook, f'{text} "{n}"{did_you_mean(str(n), known)} (known: {", ".join(known)})'
                )
                for n in strangers
            ]
    return faults


def _float_faults(model: Model, source: Source) -> list[Fault]:
    """Return faults at the start values, without effects."""
    state, command = model.start(), model.start_command()
    return _body_faults(model, source, SCALAR, (0.0, state, command), _finite)


def _symbol_faults(model: Model, source: Source) -> list[Fault]:
    """Return faults with all effects active, for both switch positions."""
    flags = any(isinstance(p.default, bool) for p in model.parameters)
    faults: list[Fault] = []
    for flag in (True, False) if flags else (None,):
        s = _tried(source, "cannot be made of symbols", symbolic, model, flag)
        if isinstance(s, Fault):
            return [s]
        m = SymbolNamespace()
        start = _tried(source, "`start_state` raises", s.model.start_state, m)
        faults += [start] if isinstance(start, Fault) else []
        wrong = _body_faults(s.model, source, m, (s.time, s.state, s.command), _expressions)
        faults += wrong or _timed_faults(s, source)
    return faults


def _timed_faults(s: SymbolicModel, source: Source) -> list[Fault]:
    """Return faults of time-dependent outputs without states."""
    import sympy

    if not s.model.static:
        return []
    values = s.model.equations(SymbolNamespace()).output(s.time, s.state, s.command)
    text = "no states, so each row of its tables stands for itself; let no output depend on time"
    timed = any(s.time in sympy.sympify(value).free_symbols for value in values)
    return [source.fault(type(s.model), "equations", f"{type(s.model).__name__} has {text}")] if timed else []


Judge = Callable[[Sequence[Any]], list[str]]


def _body_faults(model: Model, source: Source, m: Namespace, arguments: tuple[Any, ...], judge: Judge) -> list[Fault]:
    """Return faults of derivative and output: exceptions, number and values."""
    body = _tried(source, "`equations` raises", model.equations, m)
    if isinstance(body, Fault):
        return [body]
    if not isinstance(body, Equations):
        text = f"`equations` gives {type(body).__name__}; return Equations(derivative, output)"
        return [source.fault(type(model), "equations", text)]
    faults: list[Fault] = []
    for function, call, quantities in (
        ("derivative", body.derivative, model.states),
        ("output", body.output, model.outputs),
    ):
        names = [q.name for q in quantities]
        values = _tried(source, f"`{function}` raises", call, *arguments)
        if isinstance(values, Fault):
            faults.append(values)
            continue
        faults += [
            source.fault(type(model), "equations", f"`{function}` gives {text}")
            for text in _misshapen(values, names, judge)
        ]
    return faults


def _misshapen(values: Any, names: list[str], judge: Judge) -> Iterator[str]:
    if not isinstance(values, (tuple, list)):
        yield f"one {type(values).__name__}; return a tuple of {len(names)}: {', '.join(names)}"
    elif len(values) != len(names):
        yield f"{len(values)} values; return {len(names)}: {', '.join(names)}"
    else:
        for k, text in enumerate(judge(values)):
            if text:
                yield f"{text} for {names[k]}"


def _finite(values: Sequence[Any]) -> list[str]:
    """Return an objection per number, "" if finite."""
    found = []
    for value in values:
        number = isinstance(value, (int, float)) or hasattr(value, "__float__")
        shown = repr(value) if number else type(value).__name__
        found.append("" if number and math.isfinite(value) else f"{shown}, no finite number, at the start values")
    return found


def _expressions(values: Sequence[Any]) -> list[str]:
    """Return an objection per expression, "" if valid."""
    import sympy

    def one(value: Any) -> str:
        try:
            usable = isinstance(sympy.sympify(value, strict=True), sympy.Expr)
        except sympy.SympifyError:
            usable = False
        return "" if usable else f"{type(value).__name__}, no number,"

    return [one(value) for value in values]


def _alone(model: Model, owner: type[Effect], source: Source) -> list[Fault]:
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

    fault = _tried(source, f"a step with {owner.name} raises", step)
    return [fault] if isinstance(fault, Fault) else []


def _shaping_faults(model: Model, source: Source) -> list[Fault]:
    """Return faults of command shaping on symbols. A delay is taken from the log and needs no check."""
    import sympy

    s = symbolic(model)
    faults = []
    for effect in overrides(s.model.awake, "shape", Effect):
        if effect.delay:
            continue
        own = tuple(sympy.Symbol(f"memory:{q.name}", real=True) for q in effect.memory)
        h = sympy.Symbol("h", positive=True)
        doing = f"`shape` of {effect.name} raises"
        result = _tried(source, doing, effect.shape, SymbolNamespace(), s.time, h, s.command, own)
        wanted = (len(s.command), len(own))
        if isinstance(result, Fault):
            faults.append(result)
        elif not isinstance(result, tuple) or tuple(map(_length, result)) != wanted:
            text = f"`shape` of {effect.name} returns two tuples: {wanted[0]} commands and {wanted[1]} of memory"
            faults.append(source.fault(type(effect), "shape", text))
    return faults


def _length(values: Any) -> int:
    """Return the number of values, -1 for other types."""
    return len(values) if isinstance(values, (tuple, list)) else -1


def _sensor_faults(model: Model, source: Source) -> list[Fault]:
    """Return faults of symbolic readings of sensor errors."""
    import sympy

    value, t = (sympy.Symbol(name, real=True) for name in ("value", "time"))
    outputs = {q.name: sympy.Symbol(f"output:{q.name}", real=True) for q in model.outputs}
    faults = []
    for kind in model.sensors:
        hook = next((h for h in ("readings", "read") if getattr(kind, h) is not getattr(SensorError, h)), "measure")
        hook = "carried" if issubclass(kind, LeverArm) and kind.readings is LeverArm.readings else hook
        read = _tried(
            source, f"`{hook}` of {kind.name} raises", kind(value=value).readings, SymbolNamespace(), t, outputs
        )
        if isinstance(read, Fault):
            faults.append(read)
        elif list(read) != list(kind.affected()):
            text = f"reads {', '.join(map(str, read)) or 'nothing'}; it is of {', '.join(kind.affected())}"
            faults.append(source.fault(kind, hook, f"`{hook}` of {kind.name} {text}"))
        else:
            wrong = next((text for text in _expressions([*read.values()]) if text), "")
            if wrong:
                faults.append(source.fault(kind, hook, f"`{hook}` of {kind.name} gives {wrong} for a reading"))
    return faults
