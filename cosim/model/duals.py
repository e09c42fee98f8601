"""Dual numbers, which compute the Jacobian of the equations without symbols.

A dual number is a value with its derivatives by all states. At a branch, the derivatives are those of the chosen side.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

from cosim.model.namespaces import Namespace


class Dual:
    """A value and its derivative by each state."""

    __slots__ = ("slopes", "value")

    def __init__(self, value: float, slopes: Sequence[float]) -> None:
        self.value, self.slopes = value, slopes

    def __add__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value + other.value, [a + b for a, b in zip(self.slopes, other.slopes, strict=True)])
        return Dual(self.value + other, self.slopes)

    def __mul__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            v, w = self.value, other.value
            return Dual(v * w, [a * w + v * b for a, b in zip(self.slopes, other.slopes, strict=True)])
        return _scale(self, self.value * other, other)

    def __neg__(self) -> Dual:
        return _scale(self, -self.value, -1.0)

    def __sub__(self, other: Any) -> Dual:
        return self.__add__(-other)

    def __rsub__(self, other: Any) -> Dual:
        return self.__neg__().__add__(other)

    def __truediv__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return self * _scale(other, 1.0 / other.value, -1.0 / (other.value * other.value))
        return _scale(self, self.value / other, 1.0 / other)

    def __rtruediv__(self, other: Any) -> Dual:
        return _scale(self, other / self.value, -other / (self.value * self.value))

    def __pow__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            power = self.value**other.value
            by_exponent = _scale(other, 0.0, power * math.log(self.value)) if any(other.slopes) else 0.0
            return _scale(self, power, other.value * self.value ** (other.value - 1.0)) + by_exponent
        return _scale(self, self.value**other, other * self.value ** (other - 1) if other else 0.0)

    def __rpow__(self, other: Any) -> Dual:
        power = other**self.value
        return _scale(self, power, power * math.log(other))

    def __abs__(self) -> Dual:
        return -self if self.value < 0.0 else self

    def __pos__(self) -> Dual:
        return self

    __radd__, __rmul__ = __add__, __mul__

    __eq__, __lt__, __le__, __gt__, __ge__ = (  # by value
        lambda self, other, compare=compare: bool(compare(self.value, _value(other)))
        for compare in (operator.eq, operator.lt, operator.le, operator.gt, operator.ge)
    )
    __hash__ = None  # type: ignore[assignment]  # a number that is compared by value, and changes none


def _value(number: Any) -> Any:
    return number.value if isinstance(number, Dual) else number


def _scale(x: Dual, value: float, slope: float) -> Dual:
    """Return a dual function value from value and slope."""
    return Dual(value, [slope * a for a in x.slopes])


def _lift(function: Callable[[float], float], slope: Callable[[float, float], float]) -> Callable[[Any], Any]:
    """Return a function on dual numbers; `slope` takes argument and function value."""

    def lifted(x: Any) -> Any:
        value = function(_value(x))
        return _scale(x, value, slope(x.value, value)) if isinstance(x, Dual) else value

    return lifted


class DualNamespace(Namespace):
    """Functions of the equations on dual numbers."""

    sin = staticmethod(_lift(math.sin, lambda x, _: math.cos(x)))
    cos = staticmethod(_lift(math.cos, lambda x, _: -math.sin(x)))
    tanh = staticmethod(_lift(math.tanh, lambda _, y: 1.0 - y * y))
    exp = staticmethod(_lift(math.exp, lambda _, y: y))
    sqrt = staticmethod(_lift(math.sqrt, lambda _, y: 0.5 / y if y else 0.0))  # slope at 0 is unused

    @staticmethod
    def rint(x: Any) -> Any:
        """Round a number and keep its slope."""
        return x + (Namespace.rint(_value(x)) - _value(x))


def jacobian(
    derivative: Callable[..., Sequence[Any]], t: float, state: Sequence[float], command: Sequence[float]
) -> list[list[float]]:
    """Return the rows of the Jacobian ∂f/∂x; `derivative` must accept dual numbers."""
    n = len(state)
    units = [[float(i == j) for j in range(n)] for i in range(n)]
    rates = derivative(t, tuple(map(Dual, state, units)), command)
    return [list(r.slopes) if isinstance(r, Dual) else [0.0] * n for r in rates]
