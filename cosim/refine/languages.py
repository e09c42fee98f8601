"""Printing expressions as functions: in C for a compiler, in Python for numba."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


class Language:
    """A function that writes its expressions to `out`, common subexpressions computed once.

    local, store: how a common subexpression and a result are written
    """

    local: str
    store: str

    def function(self, name: str, arguments: str, expressions: Sequence[Any], places: Mapping[Any, str]) -> str:
        """Print one function; `places` says where a symbol stands in the arguments (`x[3]`)."""
        import sympy

        printer = self.printer(places)
        replaced, reduced = sympy.cse(expressions, symbols=sympy.numbered_symbols("c"), optimizations=[])
        lines = [self.local.format(symbol, printer.doprint(e)) for symbol, e in replaced]
        lines += [self.store.format(k, printer.doprint(e)) for k, e in enumerate(reduced)]
        return self.frame(name, [*arguments.split(), "out"], "\n    ".join(lines))

    def printer(self, places: Mapping[Any, str]) -> Any:
        """Sympy's printer, with symbols in their places."""
        raise NotImplementedError

    def frame(self, name: str, arguments: Sequence[str], body: str) -> str:
        """A function of the time and of arrays around its lines."""
        raise NotImplementedError


class C(Language):
    """C99."""

    local, store = "const double {} = {};", "out[{}] = {};"

    def printer(self, places: Mapping[Any, str]) -> Any:  # noqa: D102 - told once, above
        from sympy.printing.c import C99CodePrinter

        class Printer(C99CodePrinter):  # type: ignore[misc]  # sympy is untyped
            def _print_Symbol(self, symbol: Any) -> str:
                return places.get(symbol) or str(super()._print_Symbol(symbol))

        return Printer()

    def frame(self, name: str, arguments: Sequence[str], body: str) -> str:  # noqa: D102
        kinds = {"t": "double t", "out": "double *out"}
        declared = ", ".join(kinds.get(a, f"const double *{a}") for a in arguments)
        return f"static void {name}({declared})\n{{\n    {body}\n}}\n"


class Python(Language):
    """Python with the functions of `math`."""

    local, store = "{} = {}", "out[{}] = {}"

    def printer(self, places: Mapping[Any, str]) -> Any:  # noqa: D102 - told once, above
        from sympy.printing.pycode import PythonCodePrinter

        class Printer(PythonCodePrinter):  # type: ignore[misc]  # sympy is untyped
            def _print_Symbol(self, symbol: Any) -> str:
                return places.get(symbol) or str(super()._print_Symbol(symbol))

            def _print_sign(self, e: Any) -> str:  # sympy's own is ±1 at 0
                x = self._print(e.args[0])
                return f"(1.0 if {x} > 0.0 else -1.0 if {x} < 0.0 else 0.0)"

        return Printer()

    def frame(self, name: str, arguments: Sequence[str], body: str) -> str:  # noqa: D102
        return f"def {name}({', '.join(arguments)}):\n    {body or 'pass'}\n"
