"""Functions that sympy would differentiate or unfold into something of no use: printed as they are."""

from __future__ import annotations

from typing import Any

import sympy


class _Printed(sympy.Function):  # type: ignore[misc]  # sympy is untyped
    """A function of numbers, and how C and Python write it."""

    is_real = True
    c = python = ""

    def _ccode(self, printer: Any, **_: Any) -> str:
        return self.c.format(*map(printer.doprint, self.args))

    def _pythoncode(self, printer: Any, **_: Any) -> str:
        return self.python.format(*map(printer.doprint, self.args))


class Rint(_Printed):
    """The nearest whole number, halves to even. Steps have no useful slope: that of what is rounded."""

    c, python = "rint({})", "float(round({}))"

    def fdiff(self, argindex: int = 1) -> Any:
        """1."""
        return sympy.Integer(1)


class Below(_Printed):
    """1 where a < b, else 0."""

    c, python = "(({}) < ({}) ? 1.0 : 0.0)", "(1.0 if ({}) < ({}) else 0.0)"

    def fdiff(self, argindex: int = 1) -> Any:
        """0."""
        return sympy.Integer(0)


class Clip(_Printed):
    """x, no lower than `low` and no higher than `high`."""

    c, python = "fmin(fmax({}, {}), {})", "min(max({}, {}), {})"

    def fdiff(self, argindex: int = 1) -> Any:
        """1 with respect to the one that it is, else 0."""
        x, low, high = self.args
        under, over = Below(x, low), Below(high, x)
        return (1 - under - over, under, over)[argindex - 1]
