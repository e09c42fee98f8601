"""Signals derived from others by a formula such as `a - b`, `der(a)` or `lowpass(a, 0.5)`."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.base.messages import Note
from cosim.base.text import counted
from cosim.base.units import parse
from cosim.viewing import formula_units
from cosim.viewing.formula_units import Quantity
from cosim.viewing.pyramid import TIME, Recording

LONGEST, DEEPEST = 500, 40  # characters of a formula, levels of brackets
UNIFORM = 1e-6  # largest deviation of a step, relative to the steps
Rule = Callable[[Callable[..., Array], Sequence[Quantity], str], Quantity]


def derivative(time: Array, values: Array) -> Array:
    """Return the derivative by central differences; NaN at rows of one time, where the values may step."""
    if time.size < 2:
        return np.full(time.size, np.nan)
    before, after = np.maximum(np.arange(time.size) - 1, 0), np.minimum(np.arange(time.size) + 1, time.size - 1)
    steps = time[after] - time[before]
    steps[time[after] == time] = np.where(after == np.arange(time.size), steps, 0.0)[time[after] == time]
    steps[(time == time[before]) & (before != np.arange(time.size))] = 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(steps > 0.0, (values[after] - values[before]) / steps, np.nan)


def integral(time: Array, values: Array) -> Array:
    """Return the integral from the first row by trapezoids."""
    return np.concatenate(([0.0], np.cumsum(np.diff(time) * (values[1:] + values[:-1]) / 2)))[: time.size]


def lowpass(time: Array, values: Array, constant: float) -> Array:
    """Return the output of 1/(constant·s + 1), which starts at the first value.

    Each value acts until the next row, and the steps are exact for any distances of the rows.
    """
    if not time.size:
        return values
    steps = np.diff(time)
    gains = -np.expm1(-steps / constant) if constant > 0.0 else np.ones_like(steps)
    if steps.size and float(np.ptp(steps)) <= UNIFORM * float(np.mean(steps)):
        from scipy.signal import lfilter

        gain = float(np.mean(gains))
        rest, _ = lfilter([0.0, gain], [1.0, gain - 1.0], values, zi=[values[0]])
        return np.asarray(rest, dtype=np.float64)
    out = [float(values[0])]
    for value, gain in zip(values[:-1].tolist(), gains.tolist(), strict=True):
        out.append(out[-1] + gain * (value - out[-1]))
    return np.array(out)


def over_rows_with_values(function: Callable[..., Array], time: Array, values: Array, *more: float) -> Array:
    """Return a function of the rows that have a value, NaN in the other rows."""
    good, out = np.isfinite(values), np.full(time.size, np.nan)
    out[good] = function(time[good], values[good], *more)
    return out


PLAIN: dict[str, tuple[int, Callable[..., Array], Rule]] = {  # number of arguments, function, rule of units
    "abs": (1, np.abs, formula_units.same_unit),
    "sqrt": (1, np.sqrt, formula_units.root),
    "sin": (1, np.sin, formula_units.ratio),
    "cos": (1, np.cos, formula_units.ratio),
    "tan": (1, np.tan, formula_units.ratio),
    "asin": (1, np.arcsin, formula_units.angle),
    "acos": (1, np.arccos, formula_units.angle),
    "atan": (1, np.arctan, formula_units.angle),
    "atan2": (2, np.arctan2, formula_units.direction),
    "exp": (1, np.exp, formula_units.ratio),
    "log": (1, np.log, formula_units.ratio),
    "log10": (1, np.log10, formula_units.ratio),
    "hypot": (2, np.hypot, formula_units.length),
    "min": (2, np.minimum, formula_units.alike),
    "max": (2, np.maximum, formula_units.alike),
    "number": (1, np.positive, formula_units.bare),
}
OVER_TIME = {"der": 1, "integral": 1, "lowpass": 2}  # numbers of arguments
FUNCTIONS = (*OVER_TIME, *PLAIN)


class Formula:
    """A formula over signals that are called by letters; a signal of another run is interpolated linearly.

    Attributes:
        notes: Notes on the values, after their evaluation.

    Raises:
        InputError: The formula is not understood, or uses a letter without a signal.
    """

    def __init__(self, text: str, signals: Mapping[str, tuple[Recording, str]], name: str = "") -> None:
        self._text, self._signals, self._name = text, dict(signals), name or text
        self.notes: list[str] = []
        if not signals or len(text) > LONGEST:
            self._refuse("it has no signal" if not signals else "it is too long")
        self._rows = next(iter(signals.values()))[0]
        try:
            self._tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            self._refuse("it is no formula")

    def evaluate(self) -> tuple[Array, str]:
        """Return the values at the rows of the first signal, and their unit."""
        self._time, self._unknown, self.notes = self._rows.read(TIME), dict[str, None](), []
        with np.errstate(all="ignore"):
            result = self._value(self._tree, 0)
        formula_units.check_result(result)
        values = np.broadcast_to(np.asarray(result.values, dtype=np.float64), self._time.shape).copy()
        if self._unknown and not result.unit:
            self.notes.append(
                Note(f"{self._name}: {' or '.join(self._unknown)} is no known unit, so that the result has none")
            )
        if not np.isfinite(values).any():
            self.notes.append(Note(f"{self._name} has no value in any row"))
        return values, result.unit

    def _value(self, node: ast.AST, depth: int) -> Quantity:
        if depth > DEEPEST:
            self._refuse("it is nested too deeply")
        match node:
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return Quantity(_finite(number), "", ast.unparse(node))
            case ast.Name(id=name):
                return self._signal(name)
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self._value(operand, depth + 1)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                inner = self._value(operand, depth + 1)
                return replace(inner, values=-inner.values, weight=-inner.weight, text=ast.unparse(node))
            case ast.BinOp(op=op, left=left, right=right):
                sides = self._value(left, depth + 1), self._value(right, depth + 1)
                return self._combine(op, *sides, ast.unparse(node))
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                return self._call(name, [self._value(each, depth + 1) for each in arguments], ast.unparse(node))
        return self._refuse("a part of it is not allowed")

    def _combine(self, operator: ast.operator, left: Quantity, right: Quantity, text: str) -> Quantity:
        match operator:
            case ast.Add():
                return formula_units.add(left, right, text)
            case ast.Sub():
                return formula_units.add(left, right, text, -1.0)
            case ast.Mult():
                return formula_units.product(left, right, text)
            case ast.Div():
                return formula_units.product(left, right, text, -1)
            case ast.Pow():
                return formula_units.power(left, right, text)
        return self._refuse("a part of it is not allowed")

    def _call(self, name: str, given: list[Quantity], text: str) -> Quantity:
        wanted = PLAIN[name][0] if name in PLAIN else OVER_TIME.get(name)
        if wanted != len(given):
            self._refuse(f"{name} is no function" if wanted is None else f"{name} takes {counted(wanted, 'argument')}")
        if name in PLAIN:
            _, function, rule = PLAIN[name]
            return rule(function, given, text)
        first = given[0] if name == "lowpass" else formula_units.absolute(given[0])
        values = np.broadcast_to(np.asarray(first.values, dtype=np.float64), self._time.shape)
        if name == "lowpass":
            constant = given[1].values
            if np.ndim(constant) or not float(constant) >= 0.0:
                self._refuse("the time constant of lowpass is a number of seconds")
            filtered = over_rows_with_values(lowpass, self._time, values, float(constant))
            return replace(first, values=filtered, text=text)
        if name == "der":
            return formula_units.per_time(first, over_rows_with_values(derivative, self._time, values), text)
        self._note_gaps(values)
        return formula_units.over_time(first, over_rows_with_values(integral, self._time, values), text)

    def _note_gaps(self, values: Array) -> None:
        """Note missing values between others, across which an integral goes on."""
        good = np.flatnonzero(np.isfinite(values))
        wide = np.flatnonzero(np.diff(good) > 1)
        if wide.size:
            longest = float(np.max(self._time[good[wide + 1]] - self._time[good[wide]]))
            self.notes.append(
                Note(
                    f"{self._name}: {counted(wide.size, 'gap')} without values, at most {longest:.3g} s, are bridged "
                    "by straight lines"
                )
            )

    def _signal(self, letter: str) -> Quantity:
        if letter == "t":
            return Quantity(self._time, "s", letter)
        if letter not in self._signals:
            names = ", ".join([*self._signals, "t"])
            raise InputError.at(Path("formula"), f"{letter} stands for no signal; use {names}")
        rows, name = self._signals[letter]
        unit, values = {**rows.units, **rows.added}.get(name, ""), rows.read(name)
        if rows is not self._rows:
            values = np.interp(self._time, rows.read(TIME), values, np.nan, np.nan)
        if unit and parse(unit) is None:
            self._unknown[unit] = None
        return formula_units.signal(values, unit, letter)

    def _refuse(self, reason: str) -> NoReturn:
        functions = ", ".join(FUNCTIONS)
        message = f"{self._text[:LONGEST]}: {reason}; use + - * / **, numbers, the letters of signals and {functions}"
        raise InputError.at(Path("formula"), message)


def _finite(number: float) -> float:
    """Return a number of a formula; one that no double holds is infinite."""
    try:
        return float(number)
    except OverflowError:
        return float("inf")
