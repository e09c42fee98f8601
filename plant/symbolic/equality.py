"""Equality of symbols is decided where it is written, not where the numbers are known: while tracing it is an error."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

OURS = Path(__file__).resolve().parent
CURE = "of numbers `==` and `!=` are decided before they are known; compare with <, <=, > or >= in m.where"


class Decided(TypeError):
    """A model asks whether a symbol equals a number."""


@contextmanager
def undecided() -> Iterator[None]:
    """While it lasts, `==` and `!=` of a symbolic expression in a model's lines raise Decided.

    Sympy itself compares expressions all the time, and so does what traces: the file that the comparison stands in
    tells them apart.
    """
    import sympy

    library = (str(Path(sympy.__file__).parent), *map(str, (OURS, OURS.parent / "namespaces.py")))

    def guarded(plain: Callable[[Any, Any], Any], sign: str) -> Callable[[Any, Any], Any]:
        def compare(a: Any, b: Any) -> Any:
            if isinstance(a, sympy.Expr) and isinstance(b, (int, float, sympy.Expr)):
                file = sys._getframe(1).f_code.co_filename
                if not file.startswith(library) and not file.startswith("<") and a.free_symbols:
                    raise Decided(f"{_named(a)} {sign} {_named(b)}: {CURE}")
            return plain(a, b)

        return compare

    signs = {"__eq__": "==", "__ne__": "!="}
    kinds = [k for k in sympy.Symbol.__mro__[:-1] if "__eq__" in vars(k) or "__ne__" in vars(k)]
    kept = [(k, name, vars(k)[name]) for k in kinds for name in signs if name in vars(k)]
    try:
        for kind, name, plain in kept:
            setattr(kind, name, guarded(plain, signs[name]))
        yield
    finally:
        for kind, name, plain in kept:
            setattr(kind, name, plain)


def _named(e: Any) -> str:
    """An expression as its model names it."""
    return str(e).replace("state:", "").replace("input:", "")
