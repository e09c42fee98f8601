"""The body as symbols, printed as functions of arrays: the one generator of code.

Whoever needs the equations in another language (the filter of a refinement, an FMU without Python, a sweep) takes the
`Body`, adds expressions of its own, and has it print what it needs, in C or in Python.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from cosim.model.model import Effect, Model, overrides
from cosim.model.namespaces import SymbolNamespace
from cosim.model.quantities import parameters_of
from cosim.model.symbolic.languages import Language
from cosim.model.symbolic.symbols import SymbolicModel, symbolic
from cosim.model.symbolic.tracing_guard import guarded


@dataclass(frozen=True)
class Shaping:
    """What the effects on a command make of it, stage by stage, a delay left out.

    stages:     symbol → expression, an effect each: it sees plain symbols, not the branches of those before it, for
                sympy takes seconds over branches in branches
    results:    the command that acts, then the memory after it
    remembered: symbols of the memory before it
    """

    stages: tuple[dict[Any, Any], ...]
    results: tuple[Any, ...]
    remembered: tuple[Any, ...]


@dataclass(frozen=True)
class Body:
    """The equations of a model as expressions: every effect of the catalogue awake, some, or none.

    derivative: state → expression of its derivative
    outputs:    output → expression
    parameters: name → symbol, in the order in which printed code takes them
    """

    symbols: SymbolicModel
    derivative: dict[str, Any]
    outputs: dict[str, Any]
    parameters: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls, model: Model, *, effects: bool | Collection[str] = True, flags: Mapping[str, bool] | None = None
    ) -> Body:
        """The body of a model, its Booleans as they are or as `flags` says. Raises guard.OfNumbersOnly."""
        import sympy

        s = symbolic(model, flags, effects)
        with guarded(smooth=True):
            derivative, output = s.model.acting(SymbolNamespace())
            rates, values = derivative(s.time, s.state, s.command), output(s.time, s.state, s.command)
        of_states = {q.name: sympy.sympify(e) for q, e in zip(s.model.states, rates, strict=True)}
        of_outputs = {q.name: sympy.sympify(e) for q, e in zip(s.model.outputs, values, strict=True)}
        return cls(s, of_states, of_outputs, dict(s.parameters))

    def parameter(self, name: str) -> Any:
        """The symbol of a parameter more, that no model has."""
        import sympy

        symbol = self.parameters[name] = sympy.Symbol(name, real=True)
        return symbol

    @property
    def delay(self) -> int:
        """Place of the parameter by which the command is late; -1 where the model has none."""
        name = next((f"{e.name}.{e.delay}" for e in self.symbols.model.awake if e.delay), None)
        return list(self.parameters).index(name) if name else -1

    @cached_property
    def shaping(self) -> Shaping:
        """What acts of a command. A delay's memory is a history: who has the whole log looks the command up there."""
        import sympy

        command: tuple[Any, ...] = self.symbols.command
        stages: list[dict[Any, Any]] = []
        before: list[Any] = []
        after: list[Any] = []
        for effect in overrides(self.symbols.model.awake, "shape", Effect):
            if effect.delay:
                continue
            own = tuple(sympy.Symbol(f"memory:{len(before) + k}", real=True) for k in range(len(effect.memory)))
            with guarded(smooth=True):
                shaped, memory = effect.shape(SymbolNamespace(), self.symbols.time, sympy.Symbol("h"), command, own)
            results = [sympy.sympify(e) for e in (*shaped, *memory)]
            names = [sympy.Symbol(f"s{len(stages)}_{k}", real=True) for k in range(len(results))]
            stages.append(dict(zip(names, results, strict=True)))
            command, after, before = tuple(names[: len(shaped)]), after + names[len(shaped) :], [*before, *own]
        return Shaping(tuple(stages), (*command, *after), tuple(before))

    def function(
        self, language: Language, name: str, expressions: Sequence[Any], before: Sequence[dict[Any, Any]] = ()
    ) -> str:
        """`name(t, x, u, p, out)`, printed: expressions of time, state, command, parameters and what comes `before`."""
        return language.function(name, "t x u p", expressions, self._places, before, self.terms)

    @property
    def terms(self) -> list[dict[Any, float]]:
        """Of each effect, the parameters that make it dormant, and at which values."""
        every = (
            {self.parameters[f"{e.name}.{p.name}"]: p.neutral for p in parameters_of(e) if p.neutral is not None}
            for e in self.symbols.model.effects
        )
        return [term for term in every if term]

    def shaping_function(self, language: Language, name: str) -> str:
        """`name(u, memory, p, out)`, printed: the command that acts, then the memory after it."""
        memory = {symbol: f"memory[{k}]" for k, symbol in enumerate(self.shaping.remembered)}
        return language.function(
            name, "u memory p", self.shaping.results, {**self._places, **memory}, self.shaping.stages
        )

    @property
    def _places(self) -> dict[Any, str]:
        """Where each symbol stands in the arguments."""
        groups = {"x": self.symbols.state, "u": self.symbols.command, "p": tuple(self.parameters.values())}
        places = {symbol: f"{array}[{k}]" for array, group in groups.items() for k, symbol in enumerate(group)}
        return {self.symbols.time: "t", **places}
