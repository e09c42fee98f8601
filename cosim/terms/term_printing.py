"""Terms of an FMU as C code for the wrapper, and as a Python module for FMUs beside the original."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from cosim.model.model import Model
from cosim.model.namespaces import SymbolNamespace
from cosim.model.quantities import Parameter
from cosim.model.symbolic.functions import Body
from cosim.model.symbolic.languages import C, Language, Python
from cosim.model.symbolic.tracing_guard import number_guard
from cosim.terms.code import Hook, TermCode
from cosim.terms.fmu_model import FmuModel
from cosim.terms.language import Force

STEP = "h"  # last parameter of the functions: length of the substep


class PrintedTerms(NamedTuple):
    """Terms as functions of a language.

    Attributes:
        parameters: Declarations in the order of p.
        memory: Number of values in the memory.
        delay: Name of the parameter that delays all inputs, or "".
    """

    source: str
    parameters: tuple[Parameter, ...]
    hooks: tuple[Hook, ...]
    memory: int
    delay: str


def print_terms(model: FmuModel, names: Collection[str], language: Language) -> PrintedTerms:
    """Return some terms of the catalogue as functions; the FMU's own parameters have the values of the model."""
    import sympy

    body = Body.of(model, effects=names)
    own = {n: symbol for n, symbol in body.parameters.items() if n.partition(".")[0] in names}
    places, functions = _places(body, [*own.values()]), _functions(body)
    base = {symbol: n for n, symbol in body.parameters.items() if n not in own}

    def with_values(e: Any) -> Any:
        return e.xreplace({s: sympy.Float(getattr(model, base[s])) for s in e.free_symbols & base.keys()})

    texts = [
        language.function(name, words, [*map(with_values, e)], places, stages)
        for name, (words, e, stages) in functions.items()
    ]
    delay = next((f"{e.name}.{e.delay}" for e in body.symbols.model.awake if e.delay), "")
    parameters = tuple(replace(model.declared[n], name=n) for n in own)
    return PrintedTerms("\n".join(texts), parameters, tuple(functions), len(body.shaping.remembered), delay)


def term_code(model: FmuModel, names: Collection[str], states: Sequence[str]) -> TermCode:
    """Return the C code of some terms of the catalogue, for the variables of the FMU.

    Args:
        states: The FMU's variables in place of the model's states.
    """
    printed = print_terms(model, names, C())
    turned = any(e.name in names and issubclass(e, Force) and e.place.direction is not None for e in model.catalogue)
    return TermCode(
        printed.source,
        printed.parameters,
        tuple(model.variables[q.name] for q in model.inputs),
        tuple(states),
        memory=printed.memory,
        hooks=printed.hooks,
        delay=printed.delay,
        directions=model.directions if turned else (),
    )


def print_readings(model: Model, values: Mapping[str, float]) -> tuple[str, dict[int, int], dict[int, int]]:
    """Return sensor errors as a Python function `readings(t, y, p, out)`, with their lags and latencies.

    Args:
        values: Parameter of each sensor error, in the order of p.

    Returns:
        Text, output index → parameter index of each lag, and the same of each latency.
    """
    import sympy

    names, order = [q.name for q in model.outputs], [*values]
    symbols = {name: sympy.Symbol(f"y:{name}", real=True) for name in names}
    time, outputs, parameters = sympy.Symbol("t", real=True), dict(symbols), list[Any]()
    lags, latencies = dict[int, int](), dict[int, int]()
    for kind in model.sensors:
        if (name := f"{kind.name}.value") not in values:
            continue
        if kind.depends_on_past():
            times = latencies if kind.late else lags
            times |= {names.index(n): order.index(name) for n in kind.affected()}
            continue
        parameter = sympy.Symbol(f"p:{name}", real=True)
        parameters.append((parameter, f"p[{order.index(name)}]"))
        with number_guard(smooth=True):
            outputs |= kind(value=parameter).readings(SymbolNamespace(), time, outputs)
    places = {time: "t", **{s: f"y[{k}]" for k, s in enumerate(symbols.values())}, **dict(parameters)}
    results = [sympy.sympify(outputs[name]) for name in names]
    return Python().function("readings", "t y p", results, places), lags, latencies


def _places(body: Body, parameters: Sequence[Any]) -> dict[Any, str]:
    """Return the place of each symbol in the arguments of the functions."""
    import sympy

    s = body.symbols
    groups = {"x": s.state, "u": s.command, "m": body.shaping.remembered, "p": (*parameters, sympy.Symbol(STEP))}
    places = {symbol: f"{array}[{k}]" for array, group in groups.items() for k, symbol in enumerate(group)}
    return {s.time: "t", **places}


def _functions(body: Body) -> dict[Hook, tuple[str, list[Any], Any]]:
    """Return arguments, results and stages of each function that changes something."""
    import sympy

    s, m = body.symbols, SymbolNamespace()
    assert isinstance(s.model, FmuModel)
    with number_guard(smooth=True):
        inputs = [sympy.sympify(e) for e in s.model.library_inputs(m, s.state, s.command)]
        rates = [sympy.sympify(e) for e in s.model.added_rates(m, s.state)]
    functions: dict[Hook, tuple[str, list[Any], Any]] = {}
    if body.shaping.stages:
        functions["shape_all"] = ("t u m p", list(body.shaping.results), body.shaping.stages)
    if any(e != u for e, u in zip(inputs, s.command, strict=True)):
        functions["port_inputs"] = ("t x u p", inputs, ())
    if not all(e.is_zero for e in rates):
        functions["added_rates"] = ("t x u p", rates, ())
    return functions
