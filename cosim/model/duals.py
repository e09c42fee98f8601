"""Dual numbers for forward-mode differentiation of the equations without symbols.

A dual number is a value with its derivatives by all states. At a branch, the derivatives of the chosen side apply.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

from cosim.model.namespaces import Namespace

Slope = Callable[[float, float, float], float]  # (operand, operand, value) → partial derivative


class Dual:
    """A value and its derivative by each state."""

    __slots__ = ("slopes", "value")

    def __init__(self, value: float, slopes: Sequence[float]) -> None:
        self.value, self.slopes = value, slopes

    def __neg__(self) -> Dual:
        return Dual(-self.value, [-a for a in self.slopes])

    def __abs__(self) -> Dual:
        return -self if self.value < 0.0 else self

    def __pos__(self) -> Dual:
        return self

    __eq__, __lt__, __le__, __gt__, __ge__ = (  # comparisons use the values only
        lambda self, other, compare=compare: bool(compare(self.value, _value(other)))
        for compare in (operator.eq, operator.lt, operator.le, operator.gt, operator.ge)
    )
    __hash__ = None  # type: ignore[assignment]  # a number that is compared by value, and changes none


def _value(number: Any) -> Any:
    return number.value if isinstance(number, Dual) else number


def _lift(value: Callable[..., float], first: Slope, second: Slope | None = None) -> Callable[..., Any]:
    """Return a function of dual numbers, from a function of one or two floats and its partial derivatives."""

    def lifted(a: Any, b: Any = 0.0) -> Any:
        v, w = _value(a), _value(b)
        y = value(v) if second is None else value(v, w)
        parts = []
        if isinstance(a, Dual) and any(a.slopes):
            slope = first(v, w, y)
            parts.append([slope * s for s in a.slopes])
        if second is not None and isinstance(b, Dual) and any(b.slopes):
            slope = second(v, w, y)
            parts.append([slope * s for s in b.slopes])
        if len(parts) == 2:
            return Dual(y, list(map(operator.add, *parts)))
        return Dual(y, parts[0]) if parts else y

    return lifted


for _name, _function, _first, _second in (
    ("add", operator.add, lambda v, w, y: 1.0, lambda v, w, y: 1.0),
    ("sub", operator.sub, lambda v, w, y: 1.0, lambda v, w, y: -1.0),
    ("mul", operator.mul, lambda v, w, y: w, lambda v, w, y: v),
    ("truediv", operator.truediv, lambda v, w, y: 1.0 / w, lambda v, w, y: -v / (w * w)),
    ("pow", operator.pow, lambda v, w, y: w * v ** (w - 1.0) if w else 0.0, lambda v, w, y: y * math.log(v)),
):
    _lifted = _lift(_function, _first, _second)
    setattr(Dual, f"__{_name}__", _lifted)
    setattr(Dual, f"__r{_name}__", lambda self, other, lifted=_lifted: lifted(other, self))


class DualNamespace(Namespace):
    """Functions of the equations on dual numbers."""

    sin = staticmethod(_lift(math.sin, lambda v, _, y: math.cos(v)))
    cos = staticmethod(_lift(math.cos, lambda v, _, y: -math.sin(v)))
    tanh = staticmethod(_lift(math.tanh, lambda v, _, y: 1.0 - y * y))
    exp = staticmethod(_lift(math.exp, lambda v, _, y: y))
    sqrt = staticmethod(_lift(math.sqrt, lambda v, _, y: 0.5 / y if y else 0.0))  # slope 0 at 0

    @staticmethod
    def rint(x: Any) -> Any:
        """Round a value and keep its derivative."""
        return x + (Namespace.rint(_value(x)) - _value(x))


def jacobian(
    derivative: Callable[..., Sequence[Any]], t: float, state: Sequence[float], command: Sequence[float]
) -> list[list[float]]:
    """Return the rows of the Jacobian ∂f/∂x; `derivative` must accept dual numbers."""
    n = len(state)
    units = [[float(i == j) for j in range(n)] for i in range(n)]
    rates = derivative(t, tuple(map(Dual, state, units)), command)
    return [list(r.slopes) if isinstance(r, Dual) else [0.0] * n for r in rates]
