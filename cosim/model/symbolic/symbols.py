"""Models with symbols instead of numbers, for Jacobians and generated code; dependencies of outputs on inputs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from cosim.model.model import Effect, Model, Values, overrides
from cosim.model.namespaces import SymbolNamespace
from cosim.model.quantities import parameters_of

SYMBOLIC = Path(__file__).parent  # not resolved: code objects carry the path as it was imported
EQUALITY = "cannot be evaluated on symbols; compare with <, <=, > or >= in m.where"
REMAINDER = (
    "has jumps that a solver cannot detect; use m.where, for example m.where(angle > limit, angle - 2 * limit, angle)"
)
EQUALITIES = {"__eq__": "==", "__ne__": "!="}
OPERATOR_SIGNS = {**EQUALITIES, "__mod__": "%", "__rmod__": "%", "__floordiv__": "//", "__rfloordiv__": "//"}
VARYING = ("state:", "input:")  # prefixes of symbol names


class OfNumbersOnly(TypeError):
    """An operation in a model that works on numbers but not on symbols."""


@dataclass(frozen=True)
class Block:
    """Symbols that are computed together.

    Attributes:
        values: Symbol → expression.
        effect: Catalogue index of the effect that must be active; None for a block that is always computed.
        dormant: Symbol → expression while the effect is dormant.
    """

    values: dict[Any, Any]
    effect: int | None = None
    dormant: dict[Any, Any] = field(default_factory=dict)
    title: str = ""


class Shaped(NamedTuple):
    """Shaping of the command by one effect.

    Attributes:
        memory: Symbols of the old memory.
        block: Block of the changed values; if the effect is dormant, the values are unchanged.
        command, remembered: Symbols of the new command and the new memory.
    """

    effect: Any
    memory: Values
    block: Block
    command: Values
    remembered: Values


@dataclass(frozen=True)
class SymbolicModel:
    """A model whose parameters, states and inputs are symbols, with all effects active.

    Attributes:
        model: Model with symbols as parameters; Booleans are fixed by `flags`.
        parameters: FMI name, such as `mass` or `coulomb_friction.force` → symbol.
    """

    model: Model
    time: Any
    parameters: dict[str, Any]
    state: Values
    command: Values

    def evaluate(self, function: Callable[..., Values]) -> list[Any]:
        """Return the expressions of a derivative or an output function."""
        return sympified(function(self.time, self.state, self.command))

    def shaping(self, step: Any) -> Iterator[Shaped]:
        """Yield the shaping of the command by each effect.

        Each effect gets the results of earlier effects as plain symbols, because sympy is slow with nested expressions.
        Delays are left out, since a history is not an expression.

        Args:
            step: Symbol of the substep's length.
        """
        import sympy

        command, remembered = self.command, 0
        for k, effect in enumerate(self.model.effects):
            if effect.delay or not overrides((effect,), "shape", Effect):
                continue
            own = tuple(sympy.Symbol(f"memory:{remembered + j}", real=True) for j in range(len(effect.memory)))
            remembered += len(own)
            shaped, memory = effect.shape(SymbolNamespace(), self.time, step, command, own)
            block, results = Block({}, k, {}, f"{effect.name}.shape"), []
            for j, (old, e) in enumerate(zip((*command, *own), sympified((*shaped, *memory)), strict=True)):
                results.append(old)
                if e != old:
                    results[-1] = symbol = sympy.Symbol(f"s{k}_{j}", real=True)
                    block.values[symbol], block.dormant[symbol] = e, old
            command, after = tuple(results[: len(command)]), tuple(results[len(command) :])
            yield Shaped(effect, own, block, command, after)

    def places(self, parameters: Mapping[Any, str], memory: Iterable[Any] = ()) -> dict[Any, str]:
        """Return the place of each symbol in the arguments of printed functions, such as `x[0]` or `u[1]`.

        Args:
            parameters: Name of each parameter's symbol → place.
        """
        groups = {"x": self.state, "u": self.command, "memory": memory}
        places = {symbol: f"{array}[{k}]" for array, group in groups.items() for k, symbol in enumerate(group)}
        return {self.time: "t", **places, **parameters}


def sympified(values: Iterable[Any]) -> list[Any]:
    """Convert numbers and expressions to sympy expressions."""
    import sympy

    return [sympy.sympify(e) for e in values]


def symbolic(
    model: Model, flags: bool | Mapping[str, bool] | None = None, effects: bool | Collection[str] = True
) -> SymbolicModel:
    """Return a model with symbols instead of numbers, and with all, some or no effects.

    Args:
        flags: Value of all Booleans, or values by FMI name; default: those of the model.
    """
    import sympy

    symbols: dict[str, Any] = {}

    def as_symbols(owner: Any, prefix: str) -> Any:
        values: dict[str, Any] = {}
        for p in parameters_of(owner):
            if isinstance(p.default, bool):
                flag = flags.get(prefix + p.name) if isinstance(flags, Mapping) else flags
                values[p.name] = getattr(owner, p.name) if flag is None else flag
            else:
                values[p.name] = symbols[prefix + p.name] = sympy.Symbol(prefix + p.name, real=True)
        return replace(owner, **values)

    names = [kind.name for kind in model.catalogue] if effects is True else effects or ()
    terms = tuple(as_symbols(kind(), f"{kind.name}.") for kind in model.catalogue if kind.name in names)
    awake = replace(as_symbols(model, ""), effects=terms)
    # with a prefix, since an input and a state may have the same name
    state = tuple(sympy.Symbol(f"state:{q.name}", real=True) for q in awake.states)
    command = tuple(sympy.Symbol(f"input:{q.name}", real=True) for q in awake.inputs)
    return SymbolicModel(awake, sympy.Symbol("time", real=True), symbols, state, command)


def output_dependencies(model: Model) -> tuple[dict[str, tuple[str, ...]], dict[str, tuple[str, ...]]]:
    """Return the dependencies of each output, for any active effects and any values of Boolean parameters.

    Returns:
        Two mappings by output: inputs with direct feedthrough, in their order; parameters, start values and inputs that
        affect its initial value.
    """
    flags, m = [p.name for p in model.parameters if isinstance(p.default, bool)], SymbolNamespace()
    variants = [symbolic(model, flag) for flag in (True, False)]
    outputs = [s.evaluate(s.model.acting(m).output) for s in variants]
    initial = [set(flags) if a != b else set[str]() for a, b in zip(*outputs, strict=True)]
    direct = [set[str]() for _ in initial]
    for s, expressions in zip(variants, outputs, strict=True):
        inputs = dict(zip(s.command, (q.name for q in model.inputs), strict=True))
        names = {symbol: {name} for name, symbol in s.parameters.items()} | {u: {name} for u, name in inputs.items()}
        starts = s.model.start_state(m)  # by default, start values may depend on parameters
        for q, symbol in zip(s.model.states, s.state, strict=True):
            (start,) = sympified([starts.get(q.name, q.start)])
            names[symbol] = {f"{q.name}_start"}.union(*(names[other] for other in start.free_symbols))
        for of_start, at_once, expression in zip(initial, direct, expressions, strict=True):
            of_start.update(*(names[symbol] for symbol in expression.free_symbols - {s.time}))
            at_once.update(inputs[u] for u in expression.free_symbols & inputs.keys())
    ordered = (tuple(q.name for q in model.inputs if q.name in at_once) for at_once in direct)
    return (
        dict(zip((q.name for q in model.outputs), ordered, strict=True)),
        {q.name: tuple(sorted(of_start)) for q, of_start in zip(model.outputs, initial, strict=True)},
    )


@contextmanager
def number_guard(*, smooth: bool = False) -> Iterator[None]:
    """Within the `with` block, raise OfNumbersOnly for `==`, `!=`, `%` and `//` of symbols in a model's code.

    Without this check, a comparison of symbols would give a wrong value. Comparisons by sympy and the tracer are
    allowed; the file that contains the operator decides.

    Args:
        smooth: Refuse `%` and `//` only for states and inputs, by which the equations are differentiated.
    """
    import sympy

    library = (str(Path(sympy.__file__).parent), *map(str, (SYMBOLIC, SYMBOLIC.parent / "namespaces.py")), "<")

    def guard(plain: Callable[[Any, Any], Any], name: str) -> Callable[[Any, Any], Any]:
        def operator(a: Any, b: Any) -> Any:
            if isinstance(a, sympy.Expr) and isinstance(b, (int, float, sympy.Expr)):
                if sys._getframe(1).f_code.co_filename.startswith(library):
                    return plain(a, b)
                symbols, is_equality = a.free_symbols, name in EQUALITIES
                if smooth and not is_equality:
                    symbols = {s for s in symbols | sympy.sympify(b).free_symbols if s.name.startswith(VARYING)}
                if symbols:
                    first, second = (b, a) if name.startswith("__r") else (a, b)
                    text = f"{first} {OPERATOR_SIGNS[name]} {second}".replace("state:", "").replace("input:", "")
                    raise OfNumbersOnly(f"{text} {EQUALITY if is_equality else REMAINDER}")
            return plain(a, b)

        return operator

    operators = [
        (k, name, vars(k)[name]) for k in sympy.Symbol.__mro__[:-1] for name in OPERATOR_SIGNS if name in vars(k)
    ]
    try:
        for kind, name, plain in operators:
            setattr(kind, name, guard(plain, name))
        yield
    finally:
        for kind, name, plain in operators:
            setattr(kind, name, plain)
