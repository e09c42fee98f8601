"""Detection of costly functions without effect while terms are dormant.

A term is dormant at its neutral values. A function that is then multiplied by 0 can be replaced by 0 without a change
of
any bit of the results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Line = tuple[Any, Any]  # symbol of a common subexpression, None for a result; expression
Term = Mapping[Any, float]  # parameter symbols of a term → neutral values

COSTLY = ("sin", "cos", "tan", "exp", "log", "sinh", "cosh", "tanh", "asin", "acos", "atan", "atan2")

CHEAP = (-2, -1, 2, 0.5, -0.5)  # exponents that compilers turn into products, quotients and roots


def _costly(f: Any) -> bool:
    """Return True for a function or power much slower than a branch."""
    return type(f).__name__ in COSTLY or (f.is_Pow and f.exp not in CHEAP)


def skippable(lines: Sequence[Line], terms: Sequence[Term]) -> dict[Any, Term]:
    """Return costly function → parameters of the terms that need it, with neutral values."""
    return _Lines(lines, terms).skippable() if terms else {}


class _Lines:
    def __init__(self, lines: Sequence[Line], terms: Sequence[Term]) -> None:
        import sympy

        self.lines, self.terms = lines, [{p: sympy.sympify(v) for p, v in term.items()} for term in terms]
        self.users: dict[Any, list[Line]] = {}
        for line in lines:
            for used in line[1].free_symbols:
                self.users.setdefault(used, []).append(line)
        self.known: dict[frozenset[int], dict[Any, Any]] = {}
        self.asked: dict[Any, set[int] | None] = {}

    def skippable(self) -> dict[Any, Term]:
        import sympy

        found: dict[Any, set[int] | None] = {}
        for symbol, e in self.lines:
            for f in e.atoms(sympy.Function, sympy.Pow):
                if not _costly(f):
                    continue
                place = sympy.Dummy(real=True)
                needed = self._needed_by(symbol) if e == f else self._needed((symbol, e.xreplace({f: place})), place)
                before = found.get(f, set())
                found[f] = None if needed is None or before is None else before | needed
        return {
            f: {p: float(value) for k in sorted(needed) for p, value in self.terms[k].items()}
            for f, needed in found.items()
            if needed
        }

    def _needed_by(self, symbol: Any) -> set[int] | None:
        """Return the terms that need a subexpression; None if always needed."""
        if symbol is None:
            return None
        if symbol not in self.asked:
            parts = [self._needed(line, symbol) for line in self.users.get(symbol, ())]
            self.asked[symbol] = None if None in parts else {k for part in parts if part for k in part}
        return self.asked[symbol]

    def _needed(self, line: Line, symbol: Any) -> set[int] | None:
        """Return the terms that need a symbol in a line."""
        import sympy

        target, e = line
        if not isinstance(e, sympy.Expr) or not e.is_polynomial(symbol):  # the effect of 0 on the line is unclear
            return None
        every = frozenset(range(len(self.terms)))
        if not self._vanishes(symbol, e, every):
            return self._needed_by(target)
        for k in every:
            if self._vanishes(symbol, e, frozenset((k,))):
                return {k}
        for k in every:
            fewer = every - {k}
            every = fewer if self._vanishes(symbol, e, fewer) else every
        return set(every)

    def _vanishes(self, symbol: Any, e: Any, dormant: frozenset[int]) -> bool:
        """Return True if an expression loses a symbol while some terms are dormant."""
        if dormant not in self.known:
            known = {p: value for k in dormant for p, value in self.terms[k].items()}
            for name, line in self.lines:
                if name is not None and (value := line.xreplace(known)).is_Number:
                    known[name] = value
            self.known[dormant] = known
        return symbol not in e.xreplace(self.known[dormant]).free_symbols
