"""Terms of an FMU as C code for the wrapper."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

from cosim.model.namespaces import SymbolNamespace
from cosim.model.symbolic.functions import Body
from cosim.model.symbolic.languages import C
from cosim.model.symbolic.tracing_guard import number_guard
from cosim.terms.code import Hook, TermCode
from cosim.terms.fmu_model import FmuModel
from cosim.terms.language import Force

STEP = "h"  # last parameter of the functions: length of the substep


def term_code(model: FmuModel, names: Collection[str], states: Sequence[str]) -> TermCode:
    """Return the C code of some terms of the catalogue, for the variables of the FMU.

    The FMU's own parameters have the values of the model.

    Args:
        states: The FMU's variables in place of the model's states.
    """
    import sympy

    body = Body.of(model, effects=names)
    own = {n: symbol for n, symbol in body.parameters.items() if n.partition(".")[0] in names}
    places, functions = _places(body, [*own.values()]), _functions(body)
    base = {symbol: n for n, symbol in body.parameters.items() if n not in own}

    def with_values(e: Any) -> Any:
        return e.xreplace({s: sympy.Float(getattr(model, base[s])) for s in e.free_symbols & base.keys()})

    texts = [
        C().function(name, words, [*map(with_values, e)], places, stages)
        for name, (words, e, stages) in functions.items()
    ]
    turned = any(e.name in names and issubclass(e, Force) and e.place.direction is not None for e in model.catalogue)
    return TermCode(
        "\n".join(texts),
        tuple(replace(model.declared[n], name=n) for n in own),
        tuple(model.variables[q.name] for q in model.inputs),
        tuple(states),
        memory=len(body.shaping.remembered),
        hooks=tuple(functions),
        delay=next((f"{e.name}.{e.delay}" for e in body.symbols.model.awake if e.delay), ""),
        directions=model.directions if turned else (),
    )


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
