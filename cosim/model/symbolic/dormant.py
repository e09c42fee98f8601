"""Detection of costly functions whose values do not matter while terms are dormant.

A term is dormant at its neutral values. A function that is then multiplied by 0 can be replaced by 0 without a change
of any bit of the results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Line = tuple[Any, Any]  # symbol of a common subexpression, None for a result; expression
Term = Mapping[Any, float]  # parameter symbols of a term → neutral values

COSTLY = ("sin", "cos", "tan", "exp", "log", "sinh", "cosh", "tanh", "asin", "acos", "atan", "atan2")

CHEAP = (-2, -1, 2, 0.5, -0.5)  # exponents that compilers turn into products, quotients and roots


def find_skippable(lines: Sequence[Line], terms: Sequence[Term]) -> dict[Any, Term]:
    """Return costly function → parameters of the terms that need it, with neutral values."""
    return _Lines(lines, terms).find_skippable() if terms else {}


class _Lines:
    def __init__(self, lines: Sequence[Line], terms: Sequence[Term]) -> None:
        import sympy

        self.lines, self.terms = lines, [{p: sympy.sympify(v) for p, v in term.items()} for term in terms]
        self.users: dict[Any, list[Line]] = {}
        for line in lines:
            for symbol in line[1].free_symbols:
                self.users.setdefault(symbol, []).append(line)
        self.constants: dict[frozenset[int], dict[Any, Any]] = {}  # by dormant terms
        self.terms_by_symbol: dict[Any, set[int] | None] = {}

    def find_skippable(self) -> dict[Any, Term]:
        import sympy

        functions: dict[Any, set[int] | None] = {}
        for symbol, e in self.lines:
            for f in e.atoms(sympy.Function, sympy.Pow):
                # functions and powers much slower than a branch
                costly = type(f).__name__ in COSTLY or getattr(f, "is_costly", False)
                if not costly and not (f.is_Pow and f.exp not in CHEAP):
                    continue
                place = sympy.Dummy(real=True)
                needed = (
                    self._terms_of(symbol) if e == f else self._terms_through((symbol, e.xreplace({f: place})), place)
                )
                before = functions.get(f, set())
                functions[f] = None if needed is None or before is None else before | needed
        return {
            f: {p: float(value) for k in sorted(needed) for p, value in self.terms[k].items()}
            for f, needed in functions.items()
            if needed
        }

    def _terms_of(self, symbol: Any) -> set[int] | None:
        """Return the terms that need a subexpression; None if always needed."""
        if symbol is None:
            return None
        if symbol not in self.terms_by_symbol:
            parts = [self._terms_through(line, symbol) for line in self.users.get(symbol, ())]
            self.terms_by_symbol[symbol] = None if None in parts else {k for part in parts if part for k in part}
        return self.terms_by_symbol[symbol]

    def _terms_through(self, line: Line, symbol: Any) -> set[int] | None:
        """Return the terms that need a symbol."""
        import sympy

        target, e = line
        if not isinstance(e, sympy.Expr) or not e.is_polynomial(symbol):  # the effect of 0 on the line is unclear
            return None
        every = frozenset(range(len(self.terms)))
        if not self._vanishes(symbol, e, every):
            return self._terms_of(target)
        for k in every:
            if self._vanishes(symbol, e, frozenset((k,))):
                return {k}
        for k in every:
            fewer = every - {k}
            every = fewer if self._vanishes(symbol, e, fewer) else every
        return set(every)

    def _vanishes(self, symbol: Any, e: Any, dormant: frozenset[int]) -> bool:
        """Return True if an expression no longer contains a symbol while some terms are dormant."""
        if dormant not in self.constants:
            constants = {p: value for k in dormant for p, value in self.terms[k].items()}
            for name, line in self.lines:
                if name is not None and (value := line.xreplace(constants)).is_Number:
                    constants[name] = value
            self.constants[dormant] = constants
        return symbol not in e.xreplace(self.constants[dormant]).free_symbols
