"""Function namespaces of the equations, for floats, arrays and symbols."""

from __future__ import annotations

import math
from typing import Any, Protocol


class Namespace(Protocol):
    """Functions available to equations; numbers are floats, arrays of one shape, or symbols."""

    def sin(self, x: Any) -> Any: ...
    def cos(self, x: Any) -> Any: ...
    def tanh(self, x: Any) -> Any: ...
    def exp(self, x: Any) -> Any: ...
    def sqrt(self, x: Any) -> Any: ...
    def maximum(self, a: Any, b: Any) -> Any: ...
    def minimum(self, a: Any, b: Any) -> Any: ...
    def clip(self, x: Any, low: Any, high: Any) -> Any: ...
    def rint(self, x: Any) -> Any: ...
    def where(self, condition: Any, then: Any, otherwise: Any) -> Any: ...


class ScalarNamespace:
    """Python floats with `math`, as used by the FMU."""

    sin = staticmethod(math.sin)
    cos = staticmethod(math.cos)
    tanh = staticmethod(math.tanh)
    exp = staticmethod(math.exp)
    sqrt = staticmethod(math.sqrt)
    maximum = staticmethod(max)
    minimum = staticmethod(min)

    @staticmethod
    def clip(x: Any, low: Any, high: Any) -> Any:
        return min(max(x, low), high)

    @staticmethod
    def rint(x: Any) -> Any:
        return float(round(x))

    @staticmethod
    def where(condition: Any, then: Any, otherwise: Any) -> Any:
        return then if condition else otherwise


SCALAR: Namespace = ScalarNamespace()


def arrays() -> Namespace:
    """Return the namespace of NumPy arrays, for many runs at once."""
    import numpy

    return numpy


class SymbolNamespace:
    """SymPy expressions, for Jacobians, generated code and dependencies."""

    def __init__(self) -> None:
        import sympy

        from cosim.model.symbolic.printed import Clip, Rint

        self.clip, self.rint = Clip, Rint  # a branch within a condition would take sympy minutes
        self.sin, self.cos, self.tanh = sympy.sin, sympy.cos, sympy.tanh
        self.exp, self.sqrt = sympy.exp, sympy.sqrt
        self._piecewise = sympy.Piecewise

    def where(self, condition: Any, then: Any, otherwise: Any) -> Any:
        if condition in (True, False):
            return then if condition else otherwise
        # Unevaluated, because simplification of nested branches takes seconds without effect.
        return self._piecewise((then, condition), (otherwise, True), evaluate=False)

    # Branches instead of sympy's Max and Min, whose derivatives are Heaviside functions.
    def maximum(self, a: Any, b: Any) -> Any:
        return self.where(a >= b, a, b)

    def minimum(self, a: Any, b: Any) -> Any:
        return self.where(a <= b, a, b)
