"""Code from the one body of equations: derivative, its Jacobian, outputs and the shaping of commands.

The model is evaluated with symbols, every effect of the catalogue and every sensor error awake, so that one compiled
kernel serves every candidate; an effect is switched off by its neutral value.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from typing import Any

from cosim.refine.languages import Language
from plant.model import Effect, Model, overrides
from plant.namespaces import SymbolNamespace
from plant.symbols import SymbolicModel, symbolic


@dataclass(frozen=True)
class Generated:
    """Functions in C or Python and what their arguments are.

    source:     `deriv(t, x, u, p, dx)`, `jacobian(t, x, u, p, A)`, `measure(t, x, u, p, y)`,
                `measure_jacobian(t, x, u, p, C)`, `shape_all(u, memory, p, out)`
    parameters: names, in the order of `p`
    states:     names, in the order of `x`
    stochastic: indices of the states that process noise reaches and that reach a measured output; A and C are of these
    noisy:      places, within `stochastic`, of the states that process noise enters
    outputs:    names of the measured outputs, in the order of `y`
    inputs:     number of inputs
    memory:     number of remembered values
    delay:      place of the delay among the parameters, -1 where the model has none
    substep:    longest integration substep [s]
    """

    source: str
    parameters: tuple[str, ...]
    states: tuple[str, ...]
    stochastic: tuple[int, ...]
    noisy: tuple[int, ...]
    outputs: tuple[str, ...]
    inputs: int
    memory: int
    delay: int
    substep: float


def generate(model: Model, measured: Sequence[str], language: Language, unnamed: bool = False) -> Generated:
    """Functions for a model and the outputs a log holds.

    With `unnamed`, each forced state's equation gets terms of no catalogue, `unnamed.state.basis`, each a coefficient
    times a basis function of one signal: they tell that something is missing where no effect fits.
    """
    import sympy

    s = symbolic(model)
    m = SymbolNamespace()
    body = s.model.equations(m)
    names = [q.name for q in s.model.states]
    f = [sympy.sympify(e) for e in body.derivative(s.time, s.state, s.command)]
    outputs = dict(zip((q.name for q in s.model.outputs), body.output(s.time, s.state, s.command), strict=True))
    parameters = dict(s.parameters)
    noisy, uncertain, drifting = _uncertain(model, measured)
    if unnamed:
        for name, basis in bases(s, drifting).items():
            for state in noisy:
                parameters[f"unnamed.{state}.{name}"] = c = sympy.Symbol(f"unnamed.{state}.{name}", real=True)
                f[names.index(state)] += c * basis
    for kind in model.sensors:
        parameters[f"{kind.name}.value"] = symbol = sympy.Symbol(f"{kind.name}.value", real=True)
        if kind.output in outputs:
            outputs[kind.output] = kind(value=symbol).measure(outputs[kind.output])
    g = [sympy.sympify(outputs[name]) for name in measured]
    stochastic = [names.index(n) for n in uncertain]
    x = [s.state[k] for k in stochastic]
    A = [sympy.diff(f[i], xj) for i in stochastic for xj in x]
    C = [sympy.diff(e, xj) for e in g for xj in x]
    arrays = _array_names(s, parameters)
    memory, shaping = _shaping(s, arrays, language)
    text = "\n".join(
        (
            language.function("deriv", "t x u p", f, arrays),
            language.function("jacobian", "t x u p", A, arrays),
            language.function("measure", "t x u p", g, arrays),
            language.function("measure_jacobian", "t x u p", C, arrays),
            shaping,
        )
    )
    ordered = tuple(parameters)
    delay = next((f"{e.name}.{e.delay}" for e in s.model.awake if e.delay), "")
    return Generated(
        text,
        ordered,
        tuple(names),
        tuple(stochastic),
        tuple(k for k, i in enumerate(stochastic) if names[i] in noisy),
        tuple(measured),
        len(s.command),
        memory,
        ordered.index(delay) if delay in ordered else -1,
        model.substep,
    )


def bases(s: SymbolicModel, unknown: Container[str] = ()) -> dict[str, Any]:
    """Basis functions: 1, time, states, powers of velocities, their product with time, circles of angles, commands."""
    import sympy

    found: dict[str, Any] = {"1": sympy.Integer(1), "time": s.time}
    for q, x in zip(s.model.base_states, s.state, strict=False):
        if q.name in unknown:  # drifts unseen: nothing can be said to depend on it
            continue
        found[q.name] = x
        if q.unit in {"m/s", "rad/s"}:
            found[f"{q.name}·|{q.name}|"] = x * sympy.sqrt(x * x)
            found[f"{q.name}³"] = x**3
            found[f"|{q.name}|"] = sympy.sqrt(x * x)
            found[f"time·{q.name}"] = s.time * x
        if q.unit == "rad" and not any(q.name == i.name for i in s.model.inputs):
            found |= {f"sin {q.name}": sympy.sin(x), f"cos {q.name}": sympy.cos(x), f"cos 2{q.name}": sympy.cos(2 * x)}
    for q, u in zip(s.model.inputs, s.command, strict=True):
        found[f"command {q.name}"] = u
        if q.unit == "rad":
            found[f"command {q.name}·|{q.name}|"] = u * sympy.sqrt(u * u)
    return found


def _uncertain(model: Model, measured: Sequence[str]) -> tuple[list[str], list[str], set[str]]:
    """Forced states that the base model lets reach a measured output, all they reach on the way, and what only drifts.

    Of other forced states no noise can be told. What only an effect couples (thrust to inflow, say) is left out of the
    covariance, not out of the mean.
    """
    import sympy

    s = symbolic(replace(model, effects=()), effects=False)
    body = s.model.equations(SymbolNamespace())
    f = [sympy.sympify(e) for e in body.derivative(s.time, s.state, s.command)]
    outputs = dict(zip((q.name for q in s.model.outputs), body.output(s.time, s.state, s.command), strict=True))
    names = [q.name for q in s.model.states]
    forced = [names.index(n) for n in model.forced]
    reached, seen = _reached_and_seen(f, [sympy.sympify(outputs[n]) for n in measured], s.state, forced)
    both = sorted(reached & seen)
    return [names[k] for k in forced if k in both], [names[k] for k in both], {names[k] for k in reached - seen}


def _reached_and_seen(
    f: list[Any], g: list[Any], state: tuple[Any, ...], noisy: list[int]
) -> tuple[set[int], set[int]]:
    """States that a noisy state reaches, and states that reach a measured output."""
    index = {symbol: k for k, symbol in enumerate(state)}
    feeds = [{index[v] for v in e.free_symbols if v in index} for e in f]  # states in the equation of each
    reached = set(noisy)
    while grown := {i for i, parts in enumerate(feeds) if parts & reached} - reached:
        reached |= grown
    seen = {index[v] for e in g for v in e.free_symbols if v in index}
    while grown := {j for i in seen for j in feeds[i]} - seen:
        seen |= grown
    return reached, seen


def _array_names(s: SymbolicModel, parameters: dict[str, Any]) -> dict[Any, str]:
    """Where each symbol stands in the arguments."""
    named = {s.time: "t"}
    named |= {symbol: f"x[{k}]" for k, symbol in enumerate(s.state)}
    named |= {symbol: f"u[{k}]" for k, symbol in enumerate(s.command)}
    return named | {symbol: f"p[{k}]" for k, symbol in enumerate(parameters.values())}


def _shaping(s: SymbolicModel, arrays: dict[Any, str], language: Language) -> tuple[int, str]:
    """`shape(u, memory, p)`: what the effects on a command make of it, in place, the delay left out.

    Each effect sees plain symbols, not the branches of those before it: sympy takes seconds over branches in branches.
    """
    import sympy

    m = SymbolNamespace()
    command: tuple[Any, ...] = s.command
    places: dict[Any, str] = dict(arrays)
    stages: list[dict[Any, Any]] = []
    remembered: list[Any] = []
    for effect in overrides(s.model.awake, "shape", Effect):
        if effect.delay:  # its memory is a history: the kernel looks the command up in the log
            continue
        own = tuple(sympy.Symbol(f"memory:{len(remembered) + k}", real=True) for k in range(len(effect.memory)))
        places |= {symbol: f"memory[{len(remembered) + k}]" for k, symbol in enumerate(own)}
        shaped, after = effect.shape(m, s.time, sympy.Symbol("h"), command, own)
        results = [sympy.sympify(e) for e in (*shaped, *after)]
        symbols = [sympy.Symbol(f"s{len(stages)}_{k}", real=True) for k in range(len(results))]
        stages.append(dict(zip(symbols, results, strict=True)))
        command, remembered = tuple(symbols[: len(shaped)]), remembered + symbols[len(shaped) :]
    function = language.function("shape_all", "u memory p", [*command, *remembered], places, stages)
    return len(remembered), function
