"""Terms as C code, for the filter over an FMU's binary and for the wrapper of a refined FMU."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from cosim.model.namespaces import SymbolNamespace
from cosim.model.quantities import Parameter
from cosim.model.symbolic.functions import Body
from cosim.model.symbolic.languages import C
from cosim.model.symbolic.symbols import number_guard
from cosim.terms.fmu_model import FmuModel
from cosim.terms.language import Direction, Force

Hook = Literal["shape_all", "port_inputs", "added_rates", "readings"]
HOOKS: tuple[Hook, ...] = ("shape_all", "port_inputs", "added_rates", "readings")


@dataclass(frozen=True)
class TermCode:
    """Terms as C functions, with the names of their variables.

    The parameters of the functions are those of `parameters` in order, then the length of the substep [s]. The
    functions, all `static void`, may use `<math.h>`:

        shape_all(double t, const double *u, const double *m, const double *p, double *out)
        port_inputs(double t, const double *x, const double *u, const double *p, double *out)
        added_rates(double t, const double *x, const double *u, const double *p, double *out)
        readings(double t, const double *y, const double *p, double *out)

    `shape_all` returns the shaped inputs and the memory after the substep. Near 0 as length of the substep, the shaped
    inputs are those at the instant t. `port_inputs` adds forces to the shaped inputs. `added_rates` returns additions
    to the derivatives, `readings` the outputs as delivered. Dormant terms change nothing.

    Attributes:
        source: C text of the functions in `hooks`. Absent functions change nothing.
        parameters: Parameters of all terms; their names are names of variables, e.g. `coulomb_at_v.level`.
        inputs: Continuous real inputs, u.
        states: Variables passed as x: in model exchange all continuous states in FMI order, in co-simulation any real
            variables that can be read between steps.
        outputs: Real outputs, y.
        memory: Number of values in the memory m, zero at the start.
        delay: Name of a parameter [s] by which all inputs are delayed before they are shaped.
        directions: Directions of forces; `library_direction(k, i, t, x, u, p)` in `added_rates` is the rate of state i
            per force along the k-th, from a second instance of the original.
    """

    source: str
    parameters: tuple[Parameter, ...]
    inputs: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    memory: int = 0
    hooks: tuple[Hook, ...] = HOOKS
    delay: str = ""
    directions: tuple[Direction, ...] = ()


def term_code(model: FmuModel, names: Collection[str], states: Sequence[str]) -> TermCode:
    """Return the C code of the selected terms for the variables of the FMU.

    The FMU's own parameters have the values of the model.

    Args:
        names: Terms of the catalogue.
        states: The FMU's variables in place of the model's states.
    """
    import sympy

    body = Body.of(model, effects=names)
    own = {n: symbol for n, symbol in body.parameters.items() if n.partition(".")[0] in names}
    s, functions = body.symbols, _functions(body)
    remembered, step = body.shaping.remembered, sympy.Symbol("h")  # the last parameter is the length of the substep
    groups = {"x": s.state, "u": s.command, "m": remembered, "p": (*own.values(), step)}
    places = {symbol: f"{array}[{k}]" for array, group in groups.items() for k, symbol in enumerate(group)}
    places[s.time] = "t"
    base = {symbol: n for n, symbol in body.parameters.items() if n not in own}

    def with_values(e: Any) -> Any:
        return e.xreplace({n: sympy.Float(getattr(model, base[n])) for n in e.free_symbols & base.keys()})

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
        memory=len(remembered),
        hooks=tuple(functions),
        delay=next((f"{e.name}.{e.delay}" for e in body.symbols.model.awake if e.delay), ""),
        directions=model.directions if turned else (),
    )


def _functions(body: Body) -> dict[Hook, tuple[str, list[Any], Any]]:
    """Return name → (arguments, results, stages) of each function that changes a value."""
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
