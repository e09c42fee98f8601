"""Printers of expressions as functions in C and Python."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

Term = Mapping[Any, float]  # parameter symbols of a term → neutral values
COSTLY = ("sin", "cos", "tan", "exp", "log", "sinh", "cosh", "tanh", "asin", "acos", "atan", "atan2")
CHEAP = (-2, -1, 2, 0.5, -0.5)  # exponents that compilers turn into products, quotients and roots


class Unprintable(ValueError):
    """An expression that a language cannot express."""


class Language:
    """Formats of a programming language, to print functions that store results in `out`.

    Attributes:
        skipped, either: Formats of an expression that is 0 unless a condition, or either of two conditions, is true.
        local, store: Format of a common subexpression and of a result.
        assign: Format of an assignment to a declared symbol.
        declared: Format of a declaration of symbols without values, "" for none.
        when, otherwise: Start of the branches of an active effect (place, title) and of a dormant one.
        end: End of the branches.
        angle, power: Formats of sine and cosine, and of a power, near a known point (index, symbols, arguments).
    """

    skipped: str
    either: str
    local: str
    store: str
    assign: str
    declared: str
    when: str
    otherwise: str
    end: str
    angle: str
    power: str

    def function(
        self,
        name: str,
        arguments: str,
        expressions: Sequence[Any],
        places: Mapping[Any, str],
        before: Sequence[Mapping[Any, Any]] = (),
        terms: Sequence[Term] = (),
    ) -> str:
        """Return the text of one function.

        Args:
            places: Symbol → place in the arguments, such as `x[3]`.
            before: Stages to compute first, each symbol → expression of arguments and earlier symbols.
            terms: Terms; costly functions that only dormant terms need are skipped.
        """
        import sympy

        names = sympy.numbered_symbols("c")
        parts: list[tuple[Any, Any]] = []  # symbol or result index, and expression
        for stage in (*before, dict(enumerate(expressions))):
            common, reduced = sympy.cse(list(stage.values()), symbols=names, optimizations=[])
            parts += [*common, *zip(stage, reduced, strict=True)]
        plain = [(None if isinstance(target, int) else target, e) for target, e in parts]
        conditions = {
            f: self.either.join(f"{places[p]} != {float(v)!r}" for p, v in awake.items())
            for f, awake in _find_skippable(plain, terms).items()
        }
        printer, lines = self.printer(places, conditions), []
        for target, e in parts:
            form = self.store if isinstance(target, int) else self.local
            lines.append(form.format(target, printer.doprint(e)))
        return self.frame(name, [*arguments.split(), "out"], "\n    ".join(lines))

    def printer(self, places: Mapping[Any, str], conditions: Mapping[Any, str] | None = None) -> Any:
        """Return sympy's printer that replaces symbols by their places.

        Args:
            conditions: Function → condition under which the function is called; otherwise its value is 0.
        """
        skipped, base = self.skipped, self.base_printer()

        class Printer(base):  # type: ignore[misc, valid-type]  # sympy is untyped
            def _print(self, e: Any, **options: Any) -> str:
                text = str(super()._print(e, **options))
                return skipped.format(conditions[e], text) if conditions and e in conditions else text

            def _print_Symbol(self, symbol: Any) -> str:
                return places.get(symbol) or str(super()._print_Symbol(symbol))

        return Printer()

    def base_printer(self) -> Any:
        """Return sympy's printer class for this language."""
        raise NotImplementedError

    def frame(self, name: str, arguments: Sequence[str], body: str) -> str:
        """Return the source of a function with this body."""
        raise NotImplementedError


class C(Language):
    """C99 printer."""

    skipped, either = "(({}) ? {} : 0.0)", " || "
    local, store, assign = "const double {} = {};", "out[{}] = {};", "{} = {};"
    declared = "double {};"
    when, otherwise, end = "if (awake[{}]) {{ /* {} */", "} else {", "}"
    angle = "double {1}, {2}; near_angle(near + {0}, {3}, &{1}, &{2});"
    power = "const double {1} = near_power(near + {0}, {2}, {3});"

    def base_printer(self) -> Any:  # noqa: D102
        from sympy import Function
        from sympy.printing.c import C99CodePrinter

        class Printer(C99CodePrinter):  # type: ignore[misc]
            def doprint(self, expression: Any, assign_to: Any = None) -> str:
                try:
                    text = " ".join(super().doprint(expression, assign_to).split())
                except NotImplementedError:  # sympy before 1.13 writes a comment instead
                    text = "Not supported in C"
                if "Not supported in C" in text:
                    functions = {type(f).__name__ for f in expression.atoms(Function)}
                    unknown = sorted(functions - self.known_functions.keys() - {"Piecewise"})
                    raise Unprintable(f"C has no {', '.join(unknown) or 'such function'}")
                return text

        return Printer

    def frame(self, name: str, arguments: Sequence[str], body: str) -> str:  # noqa: D102
        kinds = {
            "t": "double t",
            "h": "double h",
            "near": "Near *near",
            "awake": "const unsigned char *awake",
            "out": "double *out",
        }
        declarations = ", ".join(kinds.get(a, f"const double *{a}") for a in arguments)
        unused = [a for a in arguments if not re.search(rf"\b{a}\b", body)]
        lines = [f"(void){a};" for a in unused] if "awake" in arguments else []
        text = "\n    ".join([*lines, body] if body else lines)
        return f"static void {name}({declarations})\n{{\n    {text}\n}}\n"


class Python(Language):
    """Python printer with the functions of `math`."""

    skipped, either = "({1} if {0} else 0.0)", " or "
    local, store, assign, declared = "{} = {}", "out[{}] = {}", "{} = {}", ""
    when, otherwise, end = "if awake[{}]:  # {}", "else:", ""

    def base_printer(self) -> Any:  # noqa: D102
        from sympy.printing.pycode import PythonCodePrinter

        class Printer(PythonCodePrinter):  # type: ignore[misc]
            def _print_sign(self, e: Any) -> str:  # sympy's printer gives ±1 at 0
                x = self._print(e.args[0])
                return f"(1.0 if {x} > 0.0 else -1.0 if {x} < 0.0 else 0.0)"

        return Printer

    def frame(self, name: str, arguments: Sequence[str], body: str) -> str:  # noqa: D102
        return f"def {name}({', '.join(arguments)}):\n    {body or 'pass'}\n"


class Arrays(Python):
    """NumPy printer: numbers are arrays, `math` is a module of array functions, and branches compute both sides."""

    def printer(self, places: Mapping[Any, str], conditions: Mapping[Any, str] | None = None) -> Any:
        """Return the Python printer. No function is skipped, since elements may differ in their active terms."""
        return super().printer(places)

    def base_printer(self) -> Any:  # noqa: D102
        class Printer(super().base_printer()):  # type: ignore[misc]
            def _print_Piecewise(self, e: Any) -> str:
                *branches, last = e.args
                if last[1] != True:  # noqa: E712 - sympy's own
                    raise Unprintable("a branch lacks a default value")
                text = str(self._print(last[0]))
                for value, condition in reversed(branches):
                    text = f"math.where({self._print(condition)}, {self._print(value)}, {text})"
                return text

            def _print_And(self, e: Any) -> str:
                return " & ".join(f"({self._print(a)})" for a in e.args)

            def _print_Or(self, e: Any) -> str:
                return " | ".join(f"({self._print(a)})" for a in e.args)

        return Printer


def _find_skippable(lines: Sequence[tuple[Any, Any]], terms: Sequence[Term]) -> dict[Any, Term]:
    """Return the costly functions that can be skipped: function → terms that need the function, with neutral values.

    A term is dormant at its neutral values. If the expression of a dormant term multiplies a function by 0, replacing
    the function by 0 leaves all results equal bit for bit.

    Args:
        lines: Pairs of a symbol (None for a result) and the expression of this subexpression or result.
    """
    import sympy

    def is_clear(e: Any, symbol: Any) -> bool:
        """Return True if 0 can replace a symbol in an expression: if it is a polynomial of the symbol."""
        return isinstance(e, sympy.Expr) and bool(e.is_polynomial(symbol))

    if not terms:
        return {}
    # symbols and functions that are always needed; per line: costly function → symbol in its place, changed expression
    always: set[Any] = {None}
    functions: list[dict[Any, tuple[Any, Any]]] = []
    for _, e in lines:
        always |= {s for s in e.free_symbols if not is_clear(e, s)}
        functions.append({})
        for f in e.atoms(sympy.Function, sympy.Pow):  # functions that cost much more than a branch
            if type(f).__name__ in COSTLY or getattr(f, "is_costly", False) or (f.is_Pow and f.exp not in CHEAP):
                place = sympy.Dummy(real=True)
                functions[-1][f] = place, e.xreplace({f: place})
                always |= {f} if not is_clear(functions[-1][f][1], place) else set()

    @cache
    def needed(dormant: frozenset[int]) -> set[Any]:
        """Return the symbols and functions on which results depend while some terms are dormant."""
        known = {p: sympy.sympify(v) for k in dormant for p, v in terms[k].items()}
        values = []
        for name, e in lines:
            values.append(e.xreplace(known))
            if name is not None and values[-1].is_Number:
                known[name] = values[-1]
        found = set(always)
        for (name, _), value, parts in reversed([*zip(lines, values, functions, strict=True)]):
            if name in found:
                found |= value.free_symbols
                found |= {f for f, (place, e) in parts.items() if place in e.xreplace(known).free_symbols}
        return found

    skippable: dict[Any, Term] = {}
    every = frozenset(range(len(terms)))
    for f in dict.fromkeys(f for parts in functions for f in parts):
        if f in needed(every):
            continue
        least = next((frozenset((k,)) for k in sorted(every) if f not in needed(frozenset((k,)))), every)
        for k in sorted(least) if len(least) > 1 else ():
            least = least - {k} if f not in needed(least - {k}) else least
        skippable[f] = {p: float(value) for k in sorted(least) for p, value in terms[k].items()}
    return skippable
