"""Symbolic evaluation of the equations effect by effect, with a block for each effect that can be skipped.

A model calls its effects through hooks with names of its own. Each call of an overridden hook is recorded as a block:
its values with the active effect, and the values of the same code at the neutral values. One set of expressions then
serves every combination of effects, and a dormant effect costs one jump.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from cosim.model.delay import Delay
from cosim.model.model import Effect, Model, overrides
from cosim.model.namespaces import SymbolNamespace
from cosim.model.quantities import parameters_of
from cosim.model.symbolic.symbols import SymbolicModel, symbolic
from cosim.model.symbolic.tracing_guard import number_guard

INTEGRATOR_HOOKS = ("shape", "remember")  # hooks called by the integrator instead of the equations


class Untraceable(ValueError):
    """A model without a symbolic form: an effect undefined at its neutral value, or a delay with its own rule.

    Attributes:
        owner, hook: Class and hook of the effect at fault, if any.
        cure: Advice for the user.
    """

    def __init__(self, text: str, owner: type | None = None, hook: str = "", cure: str = "") -> None:
        super().__init__(text)
        self.owner, self.hook, self.cure = owner, hook, cure


@dataclass(frozen=True)
class Block:
    """Symbols computed together.

    Attributes:
        values: Symbol → expression.
        effect: Catalogue index of the required effect, None for unconditional blocks.
        dormant: Symbol → expression while the effect is dormant.
    """

    values: dict[Any, Any]
    effect: int | None = None
    dormant: dict[Any, Any] = field(default_factory=dict)
    title: str = ""


@dataclass
class Trace:
    """A model as blocks, and expressions of their symbols.

    Attributes:
        derivative, outputs: Expression of each state's derivative and of each output.
        shaped, remembered: Acting commands, and the memory after a substep from the symbols in `memory`; delays are
            excluded, since a history is no expression.
        started: Memory at the start time from the start values in `memory`.
    """

    s: SymbolicModel
    blocks: list[Block] = field(default_factory=list)
    shaping: list[Block] = field(default_factory=list)  # blocks of the command
    derivative: list[Any] = field(default_factory=list)
    outputs: list[Any] = field(default_factory=list)
    shaped: list[Any] = field(default_factory=list)
    remembered: list[Any] = field(default_factory=list)
    started: list[Any] = field(default_factory=list)
    memory: list[Any] = field(default_factory=list)
    step: Any = None  # symbol of the substep's length

    _symbols: dict[Any, Any] = field(default_factory=dict)
    _calls: dict[Any, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, model: Model, flags: Mapping[str, bool] | None = None) -> Trace:
        """Return the symbolic trace of a model with all effects of its catalogue; `flags` sets the switches.

        Raises:
            Untraceable: An effect has no symbolic form.
            OfNumbersOnly: The equations use an operation that symbols lack.
        """
        import sympy

        trace = cls.__new__(cls)
        catalogue = tuple(trace._watch(kind, k) for k, kind in enumerate(model.catalogue))
        kind = type(
            type(model).__name__, (type(model),), {"catalogue": catalogue, "__module__": type(model).__module__}
        )
        values = {p.name: getattr(model, p.name) for p in model.parameters}
        trace.__init__(symbolic(kind(**values), flags))  # type: ignore[misc]  # the effects know the trace before
        s, m = trace.s, SymbolNamespace()
        with number_guard():
            derivative, output = s.model.acting(m)
            rates = derivative(s.time, s.state, s.command)
            trace.derivative = [sympy.sympify(e) for e in rates]
            trace._stop_dormant_states()
            trace.outputs = [sympy.sympify(e) for e in output(s.time, s.state, s.command)]
            trace._shape(m)
        return trace

    @property
    def effects(self) -> tuple[Any, ...]:
        """Return the active effects of the catalogue in order."""
        effects: tuple[Any, ...] = self.s.model.effects
        return effects

    def name(self, expression: Any) -> Any:
        """Return a symbol, the same for equal expressions."""
        import sympy

        if expression.is_Atom:
            return expression
        if expression not in self._symbols:
            self._symbols[expression] = sympy.Symbol(f"a{len(self._symbols)}", real=True)
            self.blocks.append(Block({self._symbols[expression]: expression}))
        return self._symbols[expression]

    def _stop_dormant_states(self) -> None:
        """Stop the states of dormant effects."""
        import sympy

        place = len(self.s.model.base_states)
        for k, effect in enumerate(self.effects):
            for q in effect.states:
                symbol = sympy.Symbol(f"rate_{k}_{place}", real=True)
                title = f"{effect.name}.{q.name}"
                awake = self.name(self.derivative[place])
                self.blocks.append(Block({symbol: awake}, k, {symbol: sympy.Integer(0)}, title))
                self.derivative[place] = symbol
                place += 1

    def _shape(self, m: SymbolNamespace) -> None:
        """Trace the shaping of the command, effect by effect, with plain symbols."""
        import sympy

        self.step = sympy.Symbol("h", real=True)
        command: tuple[Any, ...] = self.s.command
        shaping = overrides(self.effects, "shape", Effect)
        _check_delays(self.effects, shaping)
        for k, effect in enumerate(self.effects):
            if effect.delay or effect not in shaping:
                continue
            own = tuple(sympy.Symbol(f"memory:{len(self.memory) + j}", real=True) for j in range(len(effect.memory)))
            shaped, after = effect.shape(m, self.s.time, self.step, command, own)
            block, results = Block({}, k, {}, f"{effect.name}.shape"), []
            for j, (e, before) in enumerate(zip((*shaped, *after), (*command, *own), strict=True)):
                if (awake := sympy.sympify(e)) == before:
                    results.append(before)
                    continue
                results.append(symbol := sympy.Symbol(f"s{k}_{j}", real=True))
                block.values[symbol], block.dormant[symbol] = awake, before
            self.shaping.append(block)
            command = tuple(results[: len(command)])
            self.memory += own
            started = [sympy.sympify(e) for e in effect.remember(self.s.time, own)]
            if len(started) != len(own):
                text = f"{effect.name} declares {len(own)} remembered values; remember gives {len(started)}"
                raise Untraceable(text, type(effect), "remember", "let it give one for each")
            self.started += started
            self.remembered += results[len(command) :]
        self.shaped = list(command)

    def _watch(self, kind: type[Any], place: int) -> type[Any]:
        """Return the effect's class with recording hooks."""

        def hook(name: str, lines: Callable[..., Any]) -> Callable[..., Any]:
            return lambda effect, *arguments, **keywords: self._call(lines, effect, name, place, arguments, keywords)

        hooks = {name: hook(name, getattr(kind, name)) for name in _overridden(kind)}
        return type(kind.__name__, (kind,), {**hooks, "__module__": kind.__module__})

    def _call(
        self, lines: Callable[..., Any], effect: Any, name: str, place: int, arguments: Any, keywords: Any
    ) -> Any:
        import sympy

        arguments = _map(arguments, lambda e: self.name(sympy.sympify(e)))
        key = (place, name, _key((arguments, keywords)))
        if key in self._calls:
            return self._calls[key]
        result = lines(effect, *arguments, **keywords)
        values = {getattr(effect, p.name): p.neutral for p in parameters_of(effect) if p.neutral is not None}
        neutral = {s: sympy.Integer(int(v)) if v == int(v) else sympy.Float(v) for s, v in values.items()}
        passed = {e for e in _numbers(arguments) if getattr(e, "is_Symbol", False)}
        block = Block({}, place, {}, f"{effect.name}.{name}")

        def leaf(value: Any) -> Any:
            awake = sympy.sympify(value)
            asleep = awake.xreplace(neutral)
            if asleep.has(sympy.nan, sympy.zoo, sympy.oo):
                at = ", ".join(f"{p.name} is {p.neutral:g}" for p in parameters_of(effect) if p.neutral is not None)
                text = f"{effect.name} has no value where {at}: {name} gives {asleep}"
                cure = "let m.where choose another value there"
                raise Untraceable(text, type(effect), name, cure)
            if asleep == awake and (awake in passed or awake.is_Number):
                return awake
            symbol = sympy.Symbol(f"b{len(self._calls)}_{len(block.values)}", real=True)
            block.values[symbol], block.dormant[symbol] = awake, asleep
            return symbol

        self._calls[key] = _map(result, leaf)
        if block.values:
            self.blocks.append(block)
        return self._calls[key]


def _check_delays(effects: Sequence[Any], shaping: Sequence[Any]) -> None:
    """Check that at most one effect delays the command, comes first, and acts like `Delay`.

    Raises:
        Untraceable: A delay differs.
    """
    if any(e.delay for e in shaping[1:]):
        raise Untraceable("a delay comes first in the catalogue, and there is one at most")
    for late in (e for e in effects if e.delay):
        for hook in INTEGRATOR_HOOKS:
            if getattr(type(late), hook) is not getattr(Delay, hook):
                text = f"{late.name} is late by a {hook} of its own; C knows the delay of `Delay` alone"
                raise Untraceable(text, type(late), hook, "take that as it is, or build it without --native")


def _overridden(kind: type[Any]) -> Iterator[str]:
    """Yield the hooks that the class overrides and a base effect class defines."""
    names = {n for c in kind.__mro__ for n, v in vars(c).items() if callable(v) and not n.startswith("_")}
    for name in sorted(names - set(INTEGRATOR_HOOKS)):
        defined = [c for c in kind.__mro__ if name in vars(c) and issubclass(c, Effect)]
        if len(defined) > 1:
            yield name


def _numbers(value: Any) -> Iterator[Any]:
    """Yield numbers and expressions at any depth."""
    if isinstance(value, Mapping):
        value = tuple(value.values())
    if isinstance(value, (tuple, list)):
        for part in value:
            yield from _numbers(part)
    elif _is_number(value):
        yield value


def _key(value: Any) -> Any:
    """Return a hashable key of call arguments."""
    if isinstance(value, Mapping):
        return ("mapping", *((key, _key(part)) for key, part in value.items()))
    if isinstance(value, (tuple, list)):
        return (type(value), *(_key(part) for part in value))
    if _is_number(value):
        return str(value)
    try:
        hash(value)
    except TypeError:
        return repr(value)
    return (type(value), value)


def _is_number(value: Any) -> bool:
    import sympy

    return isinstance(value, (int, float, sympy.Expr)) and not isinstance(value, bool)


def _map(value: Any, change: Callable[[Any], Any]) -> Any:
    """Return the same structure with every number changed."""
    if isinstance(value, Mapping):
        return {key: _map(part, change) for key, part in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(_map(part, change) for part in value))
    if isinstance(value, (tuple, list)):
        return tuple(_map(part, change) for part in value)
    return change(value) if _is_number(value) else value


def switches(model: Model) -> tuple[str, ...]:
    """Return the Boolean parameters by FMI name."""
    return tuple(name for name, p in model.declared.items() if isinstance(p.default, bool))
