"""Signals derived from others by a formula such as `a - b`, `der(a)` or `lowpass(a, 0.5)`."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.base.units import factor
from cosim.viewing import messages
from cosim.viewing.pyramid import TIME, Recording

LONGEST, DEEPEST = 500, 40  # characters of a formula, levels of brackets
UNIFORM = 1e-6  # largest deviation of a step, relative to the steps


@dataclass(frozen=True)
class Quantity:
    """Values at all rows of a run, or one number, with their unit."""

    values: Array | float
    unit: str


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
    """Return the integral from the first row by trapezoids; a missing value adds nothing."""
    areas = np.diff(time) * (values[1:] + values[:-1]) / 2
    return np.concatenate(([0.0], np.cumsum(np.nan_to_num(areas, nan=0.0))))[: time.size]


def lowpass(time: Array, values: Array, constant: float) -> Array:
    """Return the output of 1/(constant·s + 1), which starts at the first value; gaps stay gaps.

    Each value acts until the next row, and the steps are exact for any distances of the rows.
    """
    steps = np.diff(time)
    gains = -np.expm1(-steps / constant) if constant > 0.0 else np.ones_like(steps)
    is_uniform = steps.size > 0 and float(np.ptp(steps)) <= UNIFORM * float(np.mean(steps))
    if is_uniform and np.isfinite(values).all():
        from scipy.signal import lfilter

        gain = float(np.mean(gains))
        rest, _ = lfilter([0.0, gain], [1.0, gain - 1.0], values, zi=[values[0]])
        return np.asarray(rest, dtype=np.float64)
    state, before, out = np.nan, np.nan, np.empty(time.size)
    for row, (value, gain) in enumerate(zip(values.tolist(), [0.0, *gains.tolist()], strict=True)):
        if np.isfinite(before):
            state = before if np.isnan(state) else state + gain * (before - state)
        before = value
        out[row] = (value if np.isnan(state) else state) if np.isfinite(value) else np.nan
    return out


ARITHMETIC: dict[type[ast.operator], Callable[..., Array]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
}
PLAIN: dict[str, tuple[int, Callable[..., Array]]] = {  # number of arguments and function
    "abs": (1, np.abs),
    "sqrt": (1, np.sqrt),
    "sin": (1, np.sin),
    "cos": (1, np.cos),
    "tan": (1, np.tan),
    "exp": (1, np.exp),
    "log": (1, np.log),
    "atan2": (2, np.arctan2),
    "hypot": (2, np.hypot),
    "min": (2, np.minimum),
    "max": (2, np.maximum),
}
KEEPS_UNIT = {"abs", "hypot", "min", "max"}
FUNCTIONS = ("der", "integral", "lowpass", *PLAIN)


class Formula:
    """A formula over signals that are called by letters; a signal of another run is interpolated linearly.

    Raises:
        InputError: The formula is not understood, or uses a letter without a signal.
    """

    def __init__(self, text: str, signals: Mapping[str, tuple[Recording, str]]) -> None:
        self._text, self._signals = text, dict(signals)
        if not signals or len(text) > LONGEST:
            self._refuse("it has no signal" if not signals else "it is too long")
        self._rows = next(iter(signals.values()))[0]
        try:
            self._tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            self._refuse("it is no formula")

    def evaluate(self) -> tuple[Array, str]:
        """Return the values at the rows of the first signal, and their unit."""
        self._time = self._rows.read(TIME)
        with np.errstate(all="ignore"):
            result = self._value(self._tree, 0)
        return np.broadcast_to(np.asarray(result.values, dtype=np.float64), self._time.shape).copy(), result.unit

    def _value(self, node: ast.AST, depth: int) -> Quantity:
        if depth > DEEPEST:
            self._refuse("it is nested too deeply")
        match node:
            case ast.Constant(value=int() | float() as number):
                return Quantity(float(number), "")
            case ast.Name(id=name):
                return self._signal(name)
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self._value(operand, depth + 1)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                inner = self._value(operand, depth + 1)
                return Quantity(-inner.values, inner.unit)
            case ast.BinOp(op=op, left=left, right=right) if type(op) in ARITHMETIC:
                return self._combine(type(op), self._value(left, depth + 1), self._value(right, depth + 1))
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                return self._call(name, [self._value(each, depth + 1) for each in arguments])
        return self._refuse("a part of it is not allowed")

    def _combine(self, kind: type[ast.operator], left: Quantity, right: Quantity) -> Quantity:
        unit, second = "", right.values
        if kind in {ast.Add, ast.Sub}:
            by = factor(right.unit, left.unit) if left.unit and right.unit else None
            second = second * by if by is not None else second
            unit = left.unit if by is not None or not right.unit else ""
        elif kind in {ast.Mult, ast.Div} and np.ndim(right.values) == 0:
            unit = left.unit
        elif kind is ast.Mult and np.ndim(left.values) == 0:
            unit = right.unit
        return Quantity(ARITHMETIC[kind](left.values, second), unit)

    def _call(self, name: str, given: list[Quantity]) -> Quantity:
        wanted = PLAIN[name][0] if name in PLAIN else {"der": 1, "integral": 1, "lowpass": 2}.get(name)
        if wanted != len(given):
            self._refuse(f"{name} is no function" if wanted is None else f"{name} takes {wanted} arguments")
        unit = given[0].unit
        if name in PLAIN:
            return Quantity(PLAIN[name][1](*(each.values for each in given)), unit if name in KEEPS_UNIT else "")
        values = np.broadcast_to(np.asarray(given[0].values, dtype=np.float64), self._time.shape)
        if name == "lowpass":
            constant = given[1].values
            if np.ndim(constant) or not float(constant) >= 0.0:
                self._refuse("the time constant of lowpass is a number of seconds")
            return Quantity(lowpass(self._time, values, float(constant)), unit)
        if name == "der":
            return Quantity(derivative(self._time, values), f"{unit}/s" if unit else "")
        return Quantity(integral(self._time, values), f"{unit}.s" if unit else "")

    def _signal(self, letter: str) -> Quantity:
        if letter == "t":
            return Quantity(self._time, "s")
        if letter not in self._signals:
            names = ", ".join([*self._signals, "t"])
            raise InputError.at(Path("formula"), messages.UNKNOWN_NAME(name=letter, names=names))
        rows, name = self._signals[letter]
        unit, values = {**rows.units, **rows.added}.get(name, ""), rows.read(name)
        if rows is self._rows:
            return Quantity(values, unit)
        return Quantity(np.interp(self._time, rows.read(TIME), values, np.nan, np.nan), unit)

    def _refuse(self, reason: str) -> Quantity:
        functions = ", ".join(FUNCTIONS)
        message = messages.WRONG_FORMULA(text=self._text[:LONGEST], reason=reason, functions=functions)
        raise InputError.at(Path("formula"), message)
