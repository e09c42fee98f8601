"""Function namespaces of the equations, for floats, arrays and symbols."""

from __future__ import annotations

import math
from typing import Any


class Namespace:
    """Functions available to equations; numbers are floats, arrays of one shape, or symbols.

    This class works on Python floats, as in the FMU. Subclasses have the same names for arrays and symbols.
    """

    sin: Any = staticmethod(math.sin)
    cos: Any = staticmethod(math.cos)
    tanh: Any = staticmethod(math.tanh)
    exp: Any = staticmethod(math.exp)
    sqrt: Any = staticmethod(math.sqrt)
    maximum: Any = staticmethod(max)
    minimum: Any = staticmethod(min)

    @staticmethod
    def clip(x: Any, low: Any, high: Any) -> Any:
        return min(max(x, low), high)

    @staticmethod
    def rint(x: Any) -> Any:
        return float(round(x))

    @staticmethod
    def where(condition: Any, then: Any, otherwise: Any) -> Any:
        return then if condition else otherwise


SCALAR = Namespace()


def arrays() -> Any:
    """Return the NumPy namespace, with which the equations compute many runs at once."""
    import numpy

    return numpy


class SymbolNamespace(Namespace):
    """Namespace of SymPy expressions, for Jacobians, generated code and dependencies."""

    def __init__(self) -> None:
        import sympy

        from cosim.model.symbolic.printed import Clip, Rint

        self.clip, self.rint = Clip, Rint  # type: ignore[method-assign]  # a branch within a condition would take sympy minutes
        self.sin, self.cos, self.tanh = sympy.sin, sympy.cos, sympy.tanh
        self.exp, self.sqrt = sympy.exp, sympy.sqrt
        self._piecewise = sympy.Piecewise

    def where(self, condition: Any, then: Any, otherwise: Any) -> Any:  # type: ignore[override]
        if condition in (True, False):
            return then if condition else otherwise
        # Without evaluation, because sympy would spend seconds on simplifying nested branches in vain.
        return self._piecewise((then, condition), (otherwise, True), evaluate=False)

    # Branches replace sympy's Max and Min, whose derivatives are Heaviside functions.
    def maximum(self, a: Any, b: Any) -> Any:
        return self.where(a >= b, a, b)

    def minimum(self, a: Any, b: Any) -> Any:
        return self.where(a <= b, a, b)
