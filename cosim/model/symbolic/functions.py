"""Symbolic equations printed as functions of arrays, the only code generator.

Users of the equations in another language (refinement filter, native FMU, sweep) take the `Body`, add expressions, and
print C or Python.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from cosim.model.model import Effect, Model, overrides
from cosim.model.namespaces import SymbolNamespace
from cosim.model.quantities import parameters_of
from cosim.model.symbolic.languages import Language
from cosim.model.symbolic.symbols import SymbolicModel, symbolic
from cosim.model.symbolic.tracing_guard import number_guard


@dataclass(frozen=True)
class Shaping:
    """Shaping of the command by effects, stage by stage, without delays.

    Attributes:
        stages: Symbol → expression for each effect. Later effects refer to plain symbols, because sympy is slow with
            nested branches.
        results: Resulting command, then the memory after.
        remembered: Symbols of the memory before.
    """

    stages: tuple[dict[Any, Any], ...]
    results: tuple[Any, ...]
    remembered: tuple[Any, ...]


@dataclass(frozen=True)
class Body:
    """The equations of a model as symbolic expressions, with all, some or no effects of the catalogue.

    Attributes:
        derivative: State → expression of its derivative.
        outputs: Output → expression.
        parameters: Name → symbol, in the order of printed code.
    """

    symbols: SymbolicModel
    derivative: dict[str, Any]
    outputs: dict[str, Any]
    parameters: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, model: Model, *, effects: bool | Collection[str] = True) -> Body:
        """Return the body of a model, with all, some or no effects of its catalogue.

        Raises:
            OfNumbersOnly: The equations use an operation that symbols lack.
        """
        import sympy

        s = symbolic(model, None, effects)
        with number_guard(smooth=True):
            derivative, output = s.model.acting(SymbolNamespace())
            rates, values = derivative(s.time, s.state, s.command), output(s.time, s.state, s.command)
        of_states = {q.name: sympy.sympify(e) for q, e in zip(s.model.states, rates, strict=True)}
        of_outputs = {q.name: sympy.sympify(e) for q, e in zip(s.model.outputs, values, strict=True)}
        return cls(s, of_states, of_outputs, dict(s.parameters))

    def parameter(self, name: str) -> Any:
        """Add a parameter and return its symbol."""
        import sympy

        symbol = self.parameters[name] = sympy.Symbol(name, real=True)
        return symbol

    @property
    def delay(self) -> int:
        """Return the index of the delay parameter, −1 without one."""
        name = next((f"{e.name}.{e.delay}" for e in self.symbols.model.awake if e.delay), None)
        return list(self.parameters).index(name) if name else -1

    @cached_property
    def shaping(self) -> Shaping:
        """Return the shaping of commands; a delay is excluded, since its users look up the command in the log."""
        import sympy

        command: tuple[Any, ...] = self.symbols.command
        stages: list[dict[Any, Any]] = []
        before: list[Any] = []
        after: list[Any] = []
        for effect in overrides(self.symbols.model.awake, "shape", Effect):
            if effect.delay:
                continue
            own = tuple(sympy.Symbol(f"memory:{len(before) + k}", real=True) for k in range(len(effect.memory)))
            with number_guard(smooth=True):
                shaped, memory = effect.shape(SymbolNamespace(), self.symbols.time, sympy.Symbol("h"), command, own)
            results = [sympy.sympify(e) for e in (*shaped, *memory)]
            names = [sympy.Symbol(f"s{len(stages)}_{k}", real=True) for k in range(len(results))]
            stages.append(dict(zip(names, results, strict=True)))
            command, after, before = tuple(names[: len(shaped)]), after + names[len(shaped) :], [*before, *own]
        return Shaping(tuple(stages), (*command, *after), tuple(before))

    def function(
        self, language: Language, name: str, expressions: Sequence[Any], before: Sequence[dict[Any, Any]] = ()
    ) -> str:
        """Return the text of `name(t, x, u, p, out)`, which stores the values of the expressions in `out`.

        Args:
            before: Stages computed first, symbol → expression.
        """
        return language.function(name, "t x u p", expressions, self._places, before, self.terms)

    @property
    def terms(self) -> list[dict[Any, float]]:
        """Return for each effect its parameters' symbols with the neutral values."""
        every = (
            {self.parameters[f"{e.name}.{p.name}"]: p.neutral for p in parameters_of(e) if p.neutral is not None}
            for e in self.symbols.model.effects
        )
        return [term for term in every if term]

    def shaping_function(self, language: Language, name: str) -> str:
        """Return the text of `name(h, u, memory, p, out)`: shaped command, then memory, over a substep h."""
        memory = {symbol: f"memory[{k}]" for k, symbol in enumerate(self.shaping.remembered)}
        return language.function(
            name, "h u memory p", self.shaping.results, {**self._places, **memory}, self.shaping.stages
        )

    @property
    def _places(self) -> dict[Any, str]:
        """Return the place of each symbol in the arguments."""
        groups = {"x": self.symbols.state, "u": self.symbols.command, "p": tuple(self.parameters.values())}
        places = {symbol: f"{array}[{k}]" for array, group in groups.items() for k, symbol in enumerate(group)}
        return {self.symbols.time: "t", **places}
