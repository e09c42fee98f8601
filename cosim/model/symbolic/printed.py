"""Sympy functions that are printed as given texts; sympy neither differentiates nor expands them."""

from __future__ import annotations

from typing import Any

import sympy


class Printed(sympy.Function):  # type: ignore[misc]  # sympy is untyped
    """A function of numbers with given texts in C and Python."""

    is_real = True
    c = python = ""

    def _ccode(self, printer: Any, **_: Any) -> str:
        return self.c.format(*map(printer.doprint, self.args))

    def _pythoncode(self, printer: Any, **_: Any) -> str:
        return self.python.format(*map(printer.doprint, self.args))


class Rint(Printed):
    """Nearest integer, halves to even. Its derivative counts as 1 instead of 0."""

    c, python = "rint({})", "float(round({}))"

    def fdiff(self, argindex: int = 1) -> Any:
        """Return the derivative 1."""
        return sympy.Integer(1)


class LocalShape(Printed):
    """A local shape of unmodelled dynamics: a C function of a signal and of the shape's first coefficient in `p`."""

    c = "local_shape({}, &{})"


class LocalSlope(Printed):
    """Derivative of a local shape by its signal."""

    c = "local_slope({}, &{})"


class Below(Printed):
    """Indicator of a < b: 1 or 0."""

    c, python = "(({}) < ({}) ? 1.0 : 0.0)", "(1.0 if ({}) < ({}) else 0.0)"

    def fdiff(self, argindex: int = 1) -> Any:
        """Return the derivative 0."""
        return sympy.Integer(0)


class Clip(Printed):
    """Symbolic function: the argument x limited to the range from `low` to `high`."""

    c, python = "fmin(fmax({}, {}), {})", "min(max({}, {}), {})"

    def fdiff(self, argindex: int = 1) -> Any:
        """Return the derivative: 1 for the active argument, else 0."""
        x, low, high = self.args
        under, over = Below(x, low), Below(high, x)
        return (1 - under - over, under, over)[argindex - 1]
