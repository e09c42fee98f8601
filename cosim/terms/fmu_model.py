"""An FMU for model exchange as a model. Its library supplies derivatives and outputs; terms are added as equations.

The equations exist for symbols only. Each derivative and output of the library is a function of the states on which it
depends, printed in C as a call; `cosim/estimation/kernel/library.c` evaluates the library.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, make_dataclass
from functools import cache
from typing import Any, ClassVar, NamedTuple

from cosim.core.arrays import Flags
from cosim.model.model import Effect, Equations, Model, Number, Values, overrides
from cosim.model.namespaces import Namespace, SymbolNamespace
from cosim.model.quantities import Parameter, Quantity
from cosim.terms.language import Direction, Force, RateTerm


class Dependencies(NamedTuple):
    """Dependencies of derivatives and outputs, shape (derivatives + outputs, states) and (…, inputs)."""

    states: Flags
    inputs: Flags


class FmuModel(Model):
    """Base class of models whose equations are in an FMU; `fmu_model` makes a subclass.

    Attributes:
        dependencies: States and inputs on which each derivative and output depends.
        rates: Position → velocity that equals its derivative, by index.
        variables: Name in the model → name of the FMU's variable.
        shown: Output → state that equals it, by index.
        stepped: True for an FMU for co-simulation; its outputs replace states.
        starts: Start values of the states.
    """

    dependencies: ClassVar[Dependencies]
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
        if not isinstance(m, SymbolNamespace):
            raise TypeError("the equations are in a library and need symbols")

        def value(row: int, state: Values, command: Values) -> Number:
            return library_value(row)(*self._arguments(m, row, state, command))

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
        """Return the inputs of the library: the commands after all input terms, plus forces added at input ports."""
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
        """Return the additions of terms to the derivatives of the library."""
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
        """Return the directions of the forces in the catalogue, in order."""
        every = (kind.place.direction for kind in self.catalogue if issubclass(kind, Force))
        return tuple(sorted({d for d in every if d is not None}, key=lambda d: d.number))

    def _arguments(self, m: Namespace, row: int, state: Values, command: Values) -> list[Number]:
        """Return the symbols on which a derivative or output depends, including forces at ports."""
        import sympy

        of_states, of_inputs = self.dependencies
        inputs = self.library_inputs(m, state, command)
        places = {k for k, depends in enumerate(of_states[row]) if depends}
        acting = [sympy.sympify(u) for u, depends in zip(inputs, of_inputs[row], strict=True) if depends]
        # keyed by name: sympy may return an earlier expression with other symbol objects
        through = {str(symbol) for u in acting for symbol in u.free_symbols}
        places |= {k for k, x in enumerate(state[: len(self.base_states)]) if str(x) in through}
        commands = [u for u in command if str(u) in through]
        return [*(state[k] for k in sorted(places)), *commands]


@cache
def library_value(row: int) -> Any:
    """Return the symbolic function of a derivative or output, numbered as in the library."""
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
    """Return the symbolic function for the rate of a state per force along a direction.

    Its derivatives are neglected: in a Jacobian they are products of the added force and the curvature of the
    inertias.
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
    """Return the model of an FMU with its own parameter values.

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
