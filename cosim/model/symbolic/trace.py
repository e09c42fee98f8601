"""Symbolic evaluation of the equations effect by effect; each effect becomes a block that can be skipped.

A model calls its effects through methods (hooks), whose names the model chooses. Each call of a hook that an effect
overrides is recorded as a block: its expressions with the active effect, and at the neutral values. One set of
expressions then serves every combination of effects, and a dormant effect costs one jump.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from cosim.model.effects import Delay
from cosim.model.model import Effect, Model
from cosim.model.namespaces import SymbolNamespace
from cosim.model.quantities import parameters_of
from cosim.model.symbolic.symbols import Block, number_guard, symbolic, sympified

INTEGRATOR_HOOKS = ("shape", "remember")  # hooks called by the integrator instead of the equations


class UnprintableModel(ValueError):
    """A model that has no symbolic form or C equivalent, e.g. because an effect is undefined at its neutral value.

    Attributes:
        owner, hook: Class and hook of the effect at fault, if any.
        cure: Advice for the user.
    """

    def __init__(self, text: str, owner: type | None = None, hook: str = "", cure: str = "") -> None:
        super().__init__(text)
        self.owner, self.hook, self.cure = owner, hook, cure


class Trace:
    """The expressions of a model, with each effect of its catalogue as blocks.

    Args:
        flags: Values of the Booleans.

    Attributes:
        effects: Active effects of the catalogue in order.
        shaping: Blocks of the effects that shape the command.
        derivative, outputs: Expression of each state's derivative and of each output.
        shaped, remembered: Expressions of the shaped commands, and of the memory after a substep as a function of the
            symbols in `memory`. Delays are excluded, since a history is not an expression.
        started: Expressions of the memory at the start time, as a function of its start values.
        step: Symbol of the substep's length.

    Raises:
        UnprintableModel: An effect has no symbolic form.
        OfNumbersOnly: The equations use an operation that symbols do not support.
    """

    def __init__(self, model: Model, flags: Mapping[str, bool] | None = None) -> None:
        import sympy

        self.blocks, self.shaping = list[Block](), list[Block]()
        self._symbols, self._calls = dict[Any, Any](), dict[str, Any]()
        catalogue = tuple(self._watch(kind, k) for k, kind in enumerate(model.catalogue))
        kind = type(
            type(model).__name__, (type(model),), {"catalogue": catalogue, "__module__": type(model).__module__}
        )
        self.s = s = symbolic(kind(**{p.name: getattr(model, p.name) for p in model.parameters}), flags)
        self.effects: tuple[Any, ...] = s.model.effects
        with number_guard():
            derivative, output = s.model.acting(SymbolNamespace())
            self.derivative = s.evaluate(derivative)
            place = len(s.model.base_states)
            for k, effect in enumerate(self.effects):  # the states of a dormant effect are constant
                for q in effect.states:
                    symbol = sympy.Symbol(f"rate_{k}_{place}", real=True)
                    awake = self._name(self.derivative[place])
                    self.blocks.append(Block({symbol: awake}, k, {symbol: sympy.Integer(0)}, f"{effect.name}.{q.name}"))
                    self.derivative[place] = symbol
                    place += 1
            self.outputs = s.evaluate(output)
            for late in (e for e in self.effects if e.delay):
                for hook in INTEGRATOR_HOOKS:
                    if getattr(type(late), hook) is not getattr(Delay, hook):
                        text = f"{late.name} overrides {hook}; C code supports only the delay of class `Delay`"
                        cure = "use it unchanged, or build without --native"
                        raise UnprintableModel(text, type(late), hook, cure)
            self.step, self.shaped = sympy.Symbol("h", real=True), [*s.command]
            self.memory, self.remembered, self.started = list[Any](), list[Any](), list[Any]()
            for stage in s.shaping(self.step):
                effect = stage.effect
                self.shaping.append(stage.block)
                started = sympified(effect.remember(s.time, stage.memory))
                if len(started) != len(stage.memory):
                    text = (
                        f"{effect.name} has {len(stage.memory)} quantities in memory; remember returns {len(started)}"
                    )
                    raise UnprintableModel(text, type(effect), "remember", "return one value per quantity")
                self.memory += stage.memory
                self.started += started
                self.remembered += stage.remembered
                self.shaped = list(stage.command)

    def places(self, indices: Mapping[str, int]) -> dict[Any, str]:
        """Return the place of each symbol in the arguments of printed functions, with the parameters' indices in p."""
        named = {symbol: f"p[{indices[name]}]" for name, symbol in self.s.parameters.items()}
        return {self.step: "h", **self.s.places(named, self.memory)}

    def _name(self, expression: Any) -> Any:
        """Return the symbol that stands for an expression; equal expressions share a symbol."""
        import sympy

        if expression.is_Atom:
            return expression
        if expression not in self._symbols:
            self._symbols[expression] = sympy.Symbol(f"a{len(self._symbols)}", real=True)
            self.blocks.append(Block({self._symbols[expression]: expression}))
        return self._symbols[expression]

    def _watch(self, kind: type[Any], place: int) -> type[Any]:
        """Return a subclass of the effect that records the calls of each overridden hook."""

        def recorded(name: str, lines: Callable[..., Any]) -> Callable[..., Any]:
            return lambda effect, *arguments, **keywords: self._call(lines, effect, name, place, arguments, keywords)

        names = {n for c in kind.__mro__ for n, v in vars(c).items() if callable(v) and not n.startswith("_")}
        hooks = {
            name: recorded(name, getattr(kind, name))
            for name in sorted(names - set(INTEGRATOR_HOOKS))
            if sum(name in vars(c) and issubclass(c, Effect) for c in kind.__mro__) > 1
        }
        return type(kind.__name__, (kind,), {**hooks, "__module__": kind.__module__})

    def _call(
        self, lines: Callable[..., Any], effect: Any, name: str, place: int, arguments: Any, keywords: Any
    ) -> Any:
        import sympy

        passed = set[Any]()

        def named(value: Any) -> Any:
            symbol = self._name(sympy.sympify(value))
            passed.add(symbol)
            return symbol

        arguments = _map(arguments, named)
        key = repr((place, name, arguments, keywords))
        if key in self._calls:
            return self._calls[key][-1]
        switches = {p.name: p.neutral for p in parameters_of(effect) if p.neutral is not None}
        neutral = {
            getattr(effect, n): sympy.Integer(int(v)) if v == int(v) else sympy.Float(v) for n, v in switches.items()
        }
        values, block = lines(effect, *arguments, **keywords), Block({}, place, {}, f"{effect.name}.{name}")

        def leaf(value: Any) -> Any:
            awake = sympy.sympify(value)
            asleep = awake.xreplace(neutral)
            if asleep.has(sympy.nan, sympy.zoo, sympy.oo):
                at = ", ".join(f"{n} is {v:g}" for n, v in switches.items())
                text = f"{effect.name} is not finite at {at}: {name} returns {asleep}"
                cure = "use m.where to return another value there"
                raise UnprintableModel(text, type(effect), name, cure)
            if asleep == awake and (awake in passed or awake.is_Number):
                return awake
            symbol = sympy.Symbol(f"b{len(self._calls)}_{len(block.values)}", real=True)
            block.values[symbol], block.dormant[symbol] = awake, asleep
            return symbol

        result = _map(values, leaf)
        # The list of arguments is kept, so that a text such as <object at 0x…> always means the same object.
        self._calls[key] = arguments, keywords, result
        if block.values:
            self.blocks.append(block)
        return result


def _map(value: Any, change: Callable[[Any], Any]) -> Any:
    """Return the same structure with `change` applied to every number and expression."""
    import sympy

    if isinstance(value, Mapping):
        return {key: _map(part, change) for key, part in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(_map(part, change) for part in value))
    if isinstance(value, (tuple, list)):
        return tuple(_map(part, change) for part in value)
    return change(value) if isinstance(value, (int, float, sympy.Expr)) and not isinstance(value, bool) else value
