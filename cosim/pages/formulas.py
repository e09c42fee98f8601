"""Signals derived from others by a formula such as `a - b`, `der(a)` or `lowpass(a, 0.5)`, in numbers as drawn."""

from __future__ import annotations

import ast
import operator
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.core.text import counted
from cosim.pages.rows import TIME, Recording
from cosim.pages.runs import ViewedRun

LONGEST, DEEPEST = 500, 40  # characters of a formula, levels of brackets
LARGEST = 10**308  # of a number; larger ones are infinite
UNIFORM = 1e-6  # largest deviation of a step, relative to the steps


def derivative(time: Array, values: Array) -> Array:
    """Return the derivative by central differences; NaN at rows of one time, where the values may step."""
    if time.size < 2:
        return np.full(time.size, np.nan)
    rows = np.arange(time.size)
    before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, time.size - 1)
    is_jump = ((time == time[before]) & (before != rows)) | ((time == time[after]) & (after != rows))
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = (values[after] - values[before]) / (time[after] - time[before])
    return np.where(is_jump, np.nan, slopes)


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


UNARY = ["abs", "sqrt", "sin", "cos", "tan", "arcsin", "arccos", "arctan", "exp", "log", "log10"]
BINARY = {"atan2": np.arctan2, "hypot": np.hypot, "min": np.minimum, "max": np.maximum}
PLAIN: dict[str, Callable[..., Any]] = {name.replace("arc", "a"): getattr(np, name) for name in UNARY} | BINARY
OVER_TIME: dict[str, Callable[..., Array]] = {"der": derivative, "integral": integral, "lowpass": lowpass}
FUNCTIONS = (*OVER_TIME, *PLAIN)
OPERATORS: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: np.divide,
    ast.Pow: lambda base, exponent: np.power(np.asarray(base, dtype=np.float64), exponent),
}


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

    def evaluate(self) -> Array:
        """Return the values at the rows of the first signal."""
        self._time, self.notes = self._rows.read(TIME), []
        with np.errstate(all="ignore"):
            result = self._value(self._tree, 0)
        values = np.broadcast_to(np.asarray(result, dtype=np.float64), self._time.shape).copy()
        if not np.isfinite(values).any():
            self.notes.append(f"{self._name} has no value in any row")
        return values

    def _value(self, node: ast.AST, depth: int) -> Any:
        if depth > DEEPEST:
            self._refuse("it is nested too deeply")
        match node:
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return np.float64(number) if abs(number) < LARGEST else np.inf
            case ast.Name(id="t"):
                return self._time
            case ast.Name(id=letter) if letter in self._signals:
                rows, name = self._signals[letter]
                values = rows.read(name)
                is_own = rows is self._rows
                return values if is_own else np.interp(self._time, rows.read(TIME), values, np.nan, np.nan)
            case ast.Name(id=letter):
                names = ", ".join([*self._signals, "t"])
                raise InputError.at(Path("formula"), f"{letter} stands for no signal; use {names}")
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self._value(operand, depth + 1)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return -self._value(operand, depth + 1)
            case ast.BinOp(op=op, left=left, right=right) if type(op) in OPERATORS:
                return OPERATORS[type(op)](self._value(left, depth + 1), self._value(right, depth + 1))
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                return self._call(name, [self._value(each, depth + 1) for each in arguments])
        return self._refuse("a part of it is not allowed")

    def _call(self, name: str, given: Sequence[Any]) -> Any:
        if name not in FUNCTIONS:
            self._refuse(f"{name} is no function")
        count = 2 if name in BINARY or name == "lowpass" else 1
        if len(given) != count:
            self._refuse(f"{name} takes {counted(count, 'argument')}")
        if name in PLAIN:
            return PLAIN[name](*given)
        values = np.broadcast_to(np.asarray(given[0], dtype=np.float64), self._time.shape)
        good, out = np.isfinite(values), np.full(self._time.size, np.nan)
        if name == "lowpass" and (np.ndim(given[1]) or not float(given[1]) >= 0.0):
            self._refuse("the time constant of lowpass is a number of seconds")
        rows = np.flatnonzero(good)
        wide = np.flatnonzero(np.diff(rows) > 1)
        if name == "integral" and wide.size:
            longest = float(np.max(self._time[rows[wide + 1]] - self._time[rows[wide]]))
            gaps = f"{counted(wide.size, 'gap')} without values, at most {longest:.3g} s"
            self.notes.append(f"{self._name}: {gaps}, are bridged by straight lines")
        out[good] = OVER_TIME[name](self._time[good], values[good], *map(float, given[1:]))
        return out

    def _refuse(self, reason: str) -> NoReturn:
        cure = f"use + - * / **, numbers, the letters of signals and {', '.join(FUNCTIONS)}"
        raise InputError.at(Path("formula"), f"{self._text[:LONGEST]}: {reason}; {cure}")


# -- derived signals of all runs ------------------------------------------------------------------------

Signal = tuple[int, str]  # number of the run, name


@dataclass(frozen=True)
class Definition:
    """The formula of a derived signal, letter → signal, and its unit.

    Attributes:
        unit: Unit stated by the user; "" for that of the signal if the formula is one letter, else none.
    """

    formula: str
    of: Mapping[str, Signal]
    unit: str = ""


class Derivations:
    """Derived signals of runs, in the order of their first definition."""

    def __init__(self, runs: Sequence[ViewedRun]) -> None:
        self._runs, self._lock = runs, threading.Lock()
        self._definitions: dict[Signal, Definition] = {}
        self._notes: dict[Signal, list[str]] = {}

    def define(self, name: str, definition: Definition) -> list[dict[str, Any]]:
        """Add a derived signal to the run of its first signal, or replace it; return it and all that depend on it.

        Raises:
            InputError: The name is that of a signal of the run, the signal depends on itself, or the formula is wrong.
        """
        made = next(iter(definition.of.values()))[0], name
        run = self._runs[made[0]]
        if name in run.rows.units or name in run.rows.texts or name == TIME:
            raise InputError.at(Path("name"), f"{name} is a signal of the run; give another name")
        with self._lock:
            before = self._definitions.get(made)
            self._definitions[made] = definition
            try:
                return self._compute([made, *self._dependents([made])])  # only the first one may be wrong
            except (InputError, OSError, CycleError) as error:
                if before is None:
                    del self._definitions[made]
                else:
                    self._definitions[made] = before
                if not isinstance(error, CycleError):
                    raise
                cycle: list[Signal] = error.args[1][:0:-1]  # each is derived from the next, and the last from the first
                place = cycle.index(made)
                chain = " ← ".join(signal for _, signal in (*cycle[place:], *cycle[:place], made))
                reason = f"{name} would be derived from itself: {chain}; give another name"
                raise InputError.at(Path("name"), reason) from None

    def remove(self, number: int, name: str) -> None:
        """Remove a derived signal of a run.

        Raises:
            InputError: There is no such signal, or others depend on it.
        """
        signal = number, name
        with self._lock:
            if signal not in self._definitions:
                raise InputError.at(Path("name"), f"{name} is no derived signal")
            if others := [other for _, other in self._dependents([signal])]:
                raise InputError.at(Path("name"), f"{', '.join(others)} is derived from {name}; remove that first")
            del self._definitions[signal], self._notes[signal]
            self._runs[number].rows.remove(name)

    def renew(self, numbers: Collection[int]) -> None:
        """Compute the signals that depend on runs with new rows."""
        with self._lock:
            uses = [s for definition in self._definitions.values() for s in definition.of.values()]
            self._compute(self._dependents([s for s in uses if s[0] in numbers and s not in self._definitions]))

    def of_run(self, number: int) -> list[dict[str, Any]]:
        """Return the derived signals of a run."""
        return [self._about(signal) for signal in self._definitions if signal[0] == number]

    def _dependents(self, changed: Iterable[Signal]) -> list[Signal]:
        """Return the derived signals that depend on changed ones, in the order of their computation.

        Raises:
            CycleError: A signal depends on itself.
        """
        uses = {made: [*definition.of.values()] for made, definition in self._definitions.items()}
        affected, found = {*changed}, list[Signal]()
        for signal in TopologicalSorter(uses).static_order():
            if signal not in affected and affected & {*uses.get(signal, ())}:
                affected.add(signal)
                found.append(signal)
        return found

    def _compute(self, signals: Sequence[Signal]) -> list[dict[str, Any]]:
        for number, name in signals:
            definition = self._definitions[number, name]
            of = {letter: (self._runs[k].rows, other) for letter, (k, other) in definition.of.items()}
            formula, unit = Formula(definition.formula, of, name), definition.unit
            values = formula.evaluate()
            if not unit and definition.formula.strip() in of:
                rows, other = of[definition.formula.strip()]
                unit = rows.unit(other)
            self._runs[number].rows.add(name, values, unit)
            self._notes[number, name] = formula.notes
        return [self._about(signal) for signal in signals]

    def _about(self, signal: Signal) -> dict[str, Any]:
        number, name = signal
        definition, unit = self._definitions[signal], self._runs[number].rows.added[name]
        of = {letter: list(other) for letter, other in definition.of.items()}
        about = {"run": number, "name": name, "formula": definition.formula, "of": of, "unit": unit}
        return {**about, "stated_unit": definition.unit, "notes": self._notes[signal]}
