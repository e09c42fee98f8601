"""Guard against operations on numbers that symbols lack: an error at the model's line instead of a wrong value."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

SYMBOLIC = Path(__file__).resolve().parent
EQUALITY = "is decided before the numbers are known; compare with <, <=, > or >= in m.where"
REMAINDER = "jumps where no solver sees it; let m.where choose: m.where(angle > limit, angle - 2 * limit, angle)"
EQUALITIES = {"__eq__": "==", "__ne__": "!="}
SIGNS = {**EQUALITIES, "__mod__": "%", "__rmod__": "%", "__floordiv__": "//", "__rfloordiv__": "//"}
VARYING = ("state:", "input:")  # prefixes of symbol names


class OfNumbersOnly(TypeError):
    """An operation in a model that needs a number instead of a symbol."""


@contextmanager
def number_guard(*, smooth: bool = False) -> Iterator[None]:
    """Raise OfNumbersOnly for `==`, `!=`, `%` and `//` of symbols in a model's lines.

    Sympy and the tracer compare expressions too; the file of the operator distinguishes the cases.

    Args:
        smooth: Refuse `%` and `//` only for states and inputs, whose derivatives are taken.
    """
    import sympy

    library = (str(Path(sympy.__file__).parent), *map(str, (SYMBOLIC, SYMBOLIC.parent / "namespaces.py")))

    def is_refused(name: str, a: Any, b: Any) -> bool:
        if name in EQUALITIES or not smooth:
            return bool(a.free_symbols)
        return any(s.name.startswith(VARYING) for e in (a, b) for s in getattr(e, "free_symbols", ()))

    def guard(plain: Callable[[Any, Any], Any], name: str) -> Callable[[Any, Any], Any]:
        def operator(a: Any, b: Any) -> Any:
            if isinstance(a, sympy.Expr) and isinstance(b, (int, float, sympy.Expr)):
                file = sys._getframe(1).f_code.co_filename
                if not file.startswith(library) and not file.startswith("<") and is_refused(name, a, b):
                    first, second = (b, a) if name.startswith("__r") else (a, b)
                    text = f"{first} {SIGNS[name]} {second}".replace("state:", "").replace("input:", "")
                    raise OfNumbersOnly(f"{text} {EQUALITY if name in EQUALITIES else REMAINDER}")
            return plain(a, b)

        return operator

    operators = [(k, name, vars(k)[name]) for k in sympy.Symbol.__mro__[:-1] for name in SIGNS if name in vars(k)]
    try:
        for kind, name, plain in operators:
            setattr(kind, name, guard(plain, name))
        yield
    finally:
        for kind, name, plain in operators:
            setattr(kind, name, plain)
