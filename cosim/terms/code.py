"""An FMU as a model. Its equations are in a library; terms are added as equations and printed as C code.

The equations exist for symbols only. Each derivative and output of the library is a function of the states on which it
depends, printed in C as a call; `cosim/estimation/kernel/library.c` evaluates the library.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass, replace
from functools import cache
from typing import Any, ClassVar, Literal

from cosim.core.arrays import Flags
from cosim.model.model import Effect, Equations, Model, Number, Values, overrides
from cosim.model.namespaces import Namespace, SymbolNamespace
from cosim.model.quantities import Parameter, Quantity
from cosim.model.symbolic.functions import Body
from cosim.model.symbolic.languages import C
from cosim.model.symbolic.symbols import number_guard
from cosim.terms.language import Direction, Force, RateTerm


class FmuModel(Model):
    """Base class of models whose equations are in an FMU; `fmu_model` makes a subclass.

    Attributes:
        dependencies: True if a derivative or output (row) depends on a state or input (column).
        rates: Index of a position → index of the velocity, its derivative.
        variables: Name in the model → name of the FMU variable.
        shown: Index of an output → index of the state that equals it.
        stepped: True for an FMU for co-simulation; its outputs replace states.
        starts: Start values of the states.
    """

    dependencies: ClassVar[Flags]
    rates: ClassVar[Mapping[int, int]]
    variables: ClassVar[Mapping[str, str]]
    shown: ClassVar[Mapping[int, int]] = {}
    stepped: ClassVar[bool] = False
    starts: ClassVar[tuple[str, ...]] = ()

    def equations(self, m: Namespace) -> Equations:
        """Return the equations with symbols.

        Raises:
            TypeError: The namespace works on numbers.
        """
        import sympy

        if not isinstance(m, SymbolNamespace):
            raise TypeError("the equations are in a library and need symbols")

        def value(row: int, state: Values, command: Values) -> Number:
            """Return a derivative or output as a function of the symbols on which it depends, with forces at ports."""
            order, inputs = len(self.base_states), self.library_inputs(m, state, command)
            of_states, of_inputs = self.dependencies[row, :order], self.dependencies[row, order:]
            places = {k for k, depends in enumerate(of_states) if depends}
            acting = [sympy.sympify(u) for u, depends in zip(inputs, of_inputs, strict=True) if depends]
            # keyed by name, since sympy may return an equal earlier expression that contains other symbol objects
            through = {str(symbol) for u in acting for symbol in u.free_symbols}
            places |= {k for k, x in enumerate(state[:order]) if str(x) in through}
            return library_value(row)(*(state[k] for k in sorted(places)), *(u for u in command if str(u) in through))

        def derivative(t: Number, state: Values, command: Values) -> Values:
            if self.stepped:
                return tuple(0.0 for _ in state)
            order = len(self.base_states)
            rates = [state[self.rates[k]] if k in self.rates else value(k, state, command) for k in range(order)]
            additions = self.added_rates(m, state)
            return (*(a + b for a, b in zip(rates, additions, strict=True)), *(0.0 for _ in state[order:]))

        def output(t: Number, state: Values, command: Values) -> Values:
            if self.stepped:
                return tuple(state[: len(self.outputs)])
            first = len(self.base_states)
            shown = self.shown
            return tuple(
                state[shown[k]] if k in shown else value(first + k, state, command) for k in range(len(self.outputs))
            )

        return Equations(derivative, output)

    def library_inputs(self, m: Namespace, state: Values, command: Values) -> Values:
        """Return the inputs of the library: the commands after all input terms, plus forces that terms add at ports."""
        names = [q.name for q in self.inputs]
        values: Mapping[str, Number] = dict(zip(names, command, strict=True))
        for term in overrides(self.awake, "transmit", Effect):
            values = term.transmit(m, values)
        inputs = [values[name] for name in names]
        for term in self.awake:
            if isinstance(term, Force) and term.place.input >= 0:
                place = term.place
                inputs[place.input] += place.sign * term.force(m, *place.motion(state))
            elif isinstance(term, RateTerm) and term.place.input >= 0:
                place = term.place
                inputs[place.input] += term.rate(m, state[place.state]) / place.gain
        return tuple(inputs)

    def added_rates(self, m: Namespace, state: Values) -> Values:
        """Return what the terms add to the derivatives of the library."""
        additions: list[Number] = [0.0 for _ in self.base_states]
        for term in self.awake:
            if isinstance(term, Force) and term.place.input < 0:
                force = term.force(m, *term.place.motion(state))
                if (direction := term.place.direction) is not None:
                    for row in direction.rates:
                        additions[row] += force * library_direction(direction.number, row)(state[term.place.position])
                    continue
                additions[term.place.state] += force
                if (other := term.place.opposite) is not None:
                    ratio: Number = other.ratio
                    for factor in other.factors:
                        ratio = ratio * factor.at(getattr(self, factor.parameter))
                    additions[other.state] -= ratio * force
            elif isinstance(term, RateTerm) and term.place.input < 0:
                additions[term.place.state] += term.rate(m, state[term.place.state])
        return tuple(additions)

    @property
    def directions(self) -> tuple[Direction, ...]:
        """Return the distinct directions of all forces in the catalogue, in order."""
        every = (kind.place.direction for kind in self.catalogue if issubclass(kind, Force))
        return tuple(sorted({d for d in every if d is not None}, key=lambda d: d.number))


@cache
def library_value(row: int) -> Any:
    """Return the symbolic function for a derivative or output, with the row number that it has in the library."""
    return _library_function(
        f"library_value_{row}",
        lambda printer: f"library_value({row}, t, x, u, p)",
        lambda e, place: library_slope(row, e.args[place])(*e.args),
    )


@cache
def library_slope(row: int, by: Any) -> Any:
    """Return the symbolic derivative of a library function by a state, printed with the index of that state."""
    return _library_function(  # a state is printed as `x[3]`
        f"library_slope_{row}_{by}", lambda printer: f"library_slope({row}, {printer._print(by)[2:-1]}, t, x, u, p)"
    )


@cache
def library_direction(number: int, row: int) -> Any:
    """Return the symbolic function for the change of a state's derivative per unit of force along a direction.

    Its derivatives are neglected: they would multiply the added force by the slight variation of the inertias.
    """
    code = f"library_direction({number}, {row}, t, x, u, p)"
    return _library_function(f"library_direction_{number}_{row}", lambda printer: code, is_costly=True)


def _library_function(
    name: str, code: Callable[[Any], str], slope: Callable[[Any, int], Any] | None = None, **attributes: Any
) -> Any:
    """Return a symbolic function that is printed as a call of the library; its derivatives are `slope`, or 0."""
    import sympy

    def fdiff(e: Any, argindex: int = 1) -> Any:
        return sympy.Integer(0) if slope is None else slope(e, argindex - 1)

    names = {"is_real": True, "fdiff": fdiff, "_ccode": lambda e, printer: code(printer), "__module__": __name__}
    return type(name, (sympy.Function,), names | attributes)


def fmu_model(
    title: str,
    signals: tuple[Sequence[Quantity], Sequence[Quantity], Sequence[Quantity]],
    parameters: Sequence[Parameter],
    terms: Sequence[type[Any]],
    **attributes: Any,
) -> FmuModel:
    """Return the model of an FMU, with the parameter values of the FMU.

    Args:
        signals: States, inputs and outputs, in the order of the FMU.
        parameters: Settable parameters; the default is the FMU's value.
        terms: Catalogue in the order in which the terms act.
        attributes: Further class attributes: `dependencies`, `rates`, `variables`, `sensors`, `forced`, …
    """
    fields = [(p.name, "float", field(default=p.default, metadata={"parameter": p})) for p in parameters]
    states, inputs, outputs = map(tuple, signals)
    namespace = {
        "title": title,
        "base_states": states,
        "inputs": inputs,
        "outputs": outputs,
        "catalogue": tuple(terms),
        "__module__": __name__,
        **attributes,
    }
    made: type[Any] = make_dataclass("OfFmu", fields, bases=(FmuModel,), namespace=namespace, frozen=True, kw_only=True)
    model: FmuModel = made()
    return model


# Terms as C code, for the filter over an FMU's binary and for the wrapper of a refined FMU.


Hook = Literal["shape_all", "port_inputs", "added_rates", "readings"]
HOOKS: tuple[Hook, ...] = ("shape_all", "port_inputs", "added_rates", "readings")


@dataclass(frozen=True)
class TermCode:
    """Terms as C functions, with the names of their variables.

    The array p contains the values of `parameters` in order, then the length of the substep [s]. The functions, all
    `static void`, may use `<math.h>`:

        shape_all(double t, const double *u, const double *m, const double *p, double *out)
        port_inputs(double t, const double *x, const double *u, const double *p, double *out)
        added_rates(double t, const double *x, const double *u, const double *p, double *out)
        readings(double t, const double *y, const double *p, double *out)

    `shape_all` returns the shaped inputs and the memory after the substep. For a substep of almost 0 s, these are the
    shaped inputs at the instant t. `port_inputs` adds forces to the shaped inputs. `added_rates` returns what is added
    to the derivatives, `readings` the outputs with sensor errors. Dormant terms change nothing.

    Attributes:
        source: C text of the functions in `hooks`. A function that is absent would change nothing.
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
        states: FMU variables that represent the states of the model.
    """
    import sympy

    body = Body.of(model, effects=names)
    own = {n: symbol for n, symbol in body.parameters.items() if n.partition(".")[0] in names}
    s, shaping, m = body.symbols, body.shaping, SymbolNamespace()
    acting = s.model
    assert isinstance(acting, FmuModel)
    with number_guard(smooth=True):
        inputs = [sympy.sympify(e) for e in acting.library_inputs(m, s.state, s.command)]
        rates = [sympy.sympify(e) for e in acting.added_rates(m, s.state)]
    step = sympy.Symbol("h")  # the last parameter is the length of the substep
    groups = {"x": s.state, "u": s.command, "m": shaping.remembered, "p": (*own.values(), step)}
    places = {symbol: f"{array}[{k}]" for array, group in groups.items() for k, symbol in enumerate(group)}
    places[s.time] = "t"
    base = {symbol: n for n, symbol in body.parameters.items() if n not in own}

    def with_values(e: Any) -> Any:
        return e.xreplace({n: sympy.Float(getattr(model, base[n])) for n in e.free_symbols & base.keys()})

    every: tuple[tuple[Hook, bool, str, Any, Any], ...] = (
        ("shape_all", bool(shaping.stages), "t u m p", shaping.results, shaping.stages),
        ("port_inputs", any(e != u for e, u in zip(inputs, s.command, strict=True)), "t x u p", inputs, ()),
        ("added_rates", not all(e.is_zero for e in rates), "t x u p", rates, ()),
    )
    functions = {
        name: C().function(name, words, [*map(with_values, results)], places, stages)
        for name, changes, words, results, stages in every
        if changes
    }
    turned = any(e.name in names and issubclass(e, Force) and e.place.direction is not None for e in model.catalogue)
    return TermCode(
        "\n".join(functions.values()),
        tuple(replace(model.declared[n], name=n) for n in own),
        tuple(model.variables[q.name] for q in model.inputs),
        tuple(states),
        memory=len(shaping.remembered),
        hooks=tuple(functions),
        delay=next((f"{e.name}.{e.delay}" for e in acting.awake if e.delay), ""),
        directions=model.directions if turned else (),
    )
