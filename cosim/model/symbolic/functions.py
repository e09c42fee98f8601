"""A model's equations as symbolic expressions, which callers extend and print as functions of arrays.

Callers are the refinement filter, the wrapper of a refined FMU, and the controllers.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from cosim.model.model import Model
from cosim.model.namespaces import SymbolNamespace
from cosim.model.quantities import parameters_of
from cosim.model.symbolic.languages import Language
from cosim.model.symbolic.symbols import SymbolicModel, number_guard, symbolic


@dataclass(frozen=True)
class Shaping:
    """Expressions for the command after each effect that shapes it, without delays.

    Attributes:
        stages: For each effect, symbol → expression.
        results: Expressions of the resulting command, followed by the new memory.
        remembered: Symbols of the old memory.
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
        parameters: Name → symbol, in their order in the argument p of printed code.
    """

    symbols: SymbolicModel
    derivative: dict[str, Any]
    outputs: dict[str, Any]
    parameters: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, model: Model, *, effects: bool | Collection[str] = True) -> Body:
        """Return the equations of a model as expressions, with all, some or no effects of its catalogue.

        Raises:
            OfNumbersOnly: The equations use an operation that symbols do not support.
        """
        s = symbolic(model, None, effects)
        with number_guard(smooth=True):
            derivative, output = s.model.acting(SymbolNamespace())
            rates = {q.name: e for q, e in zip(s.model.states, s.evaluate(derivative), strict=True)}
            outputs = {q.name: e for q, e in zip(s.model.outputs, s.evaluate(output), strict=True)}
        return cls(s, rates, outputs, dict(s.parameters))

    def parameter(self, name: str) -> Any:
        """Add a parameter and return its symbol."""
        import sympy

        symbol = self.parameters[name] = sympy.Symbol(name, real=True)
        return symbol

    @property
    def delay(self) -> int:
        """Return the index of the delay parameter; −1 if the model has no delay."""
        name = next((f"{e.name}.{e.delay}" for e in self.symbols.model.awake if e.delay), None)
        return list(self.parameters).index(name) if name else -1

    @cached_property
    def shaping(self) -> Shaping:
        """Return the shaping of commands without delays, because callers read a delayed command from the log."""
        import sympy

        with number_guard(smooth=True):
            stages = [*self.symbols.shaping(sympy.Symbol("h"))]
        command = stages[-1].command if stages else self.symbols.command
        after, before = ([x for stage in stages for x in getattr(stage, n)] for n in ("remembered", "memory"))
        return Shaping(tuple(stage.block.values for stage in stages), (*command, *after), tuple(before))

    def function(
        self, language: Language, name: str, expressions: Sequence[Any], before: Sequence[dict[Any, Any]] = ()
    ) -> str:
        """Return the text of `name(t, x, u, p, out)`, which stores the values of the expressions in `out`.

        Args:
            before: Stages to compute first, each symbol → expression.
        """
        return language.function(name, "t x u p", expressions, self._places, before, self.terms)

    @property
    def terms(self) -> list[dict[Any, float]]:
        """Return one mapping per effect: symbols of its parameters → neutral values."""
        every = (
            {self.parameters[f"{e.name}.{p.name}"]: p.neutral for p in parameters_of(e) if p.neutral is not None}
            for e in self.symbols.model.effects
        )
        return [term for term in every if term]

    def shaping_function(self, language: Language, name: str) -> str:
        """Return the text of `name(h, u, memory, p, out)`: shaped command and new memory after a substep h."""
        return language.function(name, "h u memory p", self.shaping.results, self._places, self.shaping.stages)

    @property
    def _places(self) -> dict[Any, str]:
        parameters = {symbol: f"p[{k}]" for k, symbol in enumerate(self.parameters.values())}
        return self.symbols.places(parameters, self.shaping.remembered)
