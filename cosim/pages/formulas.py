"""Signals derived by a formula such as `a - b`, `der(a)` or `lowpass(a, 0.5)`, computed from displayed values."""

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
from cosim.core.text import counted, showing, shown_unit
from cosim.pages.rows import TIME, Recording
from cosim.pages.runs import ViewedRun

LONGEST = 500  # characters of a formula
LARGEST = 10**308  # largest number; larger ones become infinite


def derivative(time: Array, values: Array) -> Array:
    """Return the derivative by central differences; NaN at several rows of the same time, where values may jump."""
    if time.size < 2:
        return np.full(time.size, np.nan)
    rows = np.arange(time.size)
    before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, time.size - 1)
    is_jump = ((time == time[before]) & (before != rows)) | ((time == time[after]) & (after != rows))
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = (values[after] - values[before]) / (time[after] - time[before])
    return np.where(is_jump, np.nan, slopes)


def integral(time: Array, values: Array) -> Array:
    """Return the integral from the first row by the trapezoidal rule."""
    return np.concatenate(([0.0], np.cumsum(np.diff(time) * (values[1:] + values[:-1]) / 2)))[: time.size]


def lowpass(time: Array, values: Array, constant: float) -> Array:
    """Return the output of 1/(constant·s + 1), starting at the first value.

    Each value is constant until the next row, and the steps are exact for any row spacing.
    """
    steps = np.diff(time)
    gains = -np.expm1(-steps / constant) if constant > 0.0 else np.ones_like(steps)
    out = values[:1].tolist()
    for value, gain in zip(values[:-1].tolist(), gains.tolist(), strict=True):
        out.append(out[-1] + gain * (value - out[-1]))
    return np.array(out)


UNARY = ["abs", "sqrt", "sin", "cos", "tan", "arcsin", "arccos", "arctan", "exp", "log", "log10"]
BINARY = {"atan2": np.arctan2, "hypot": np.hypot, "min": np.minimum, "max": np.maximum}
PLAIN: dict[str, Callable[..., Any]] = {name.replace("arc", "a"): getattr(np, name) for name in UNARY} | BINARY
OVER_TIME: dict[str, Callable[..., Array]] = {"der": derivative, "integral": integral, "lowpass": lowpass}
FUNCTIONS = (*OVER_TIME, *PLAIN)
OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}


def evaluate(text: str, signals: Mapping[str, tuple[Recording, str]], name: str = "") -> tuple[Array, list[str]]:
    """Return the values of a formula at the rows of its first signal, and notes on them.

    Args:
        signals: Letter → signal. A signal of another run is interpolated linearly.
        name: Name of the derived signal, for the notes.

    Raises:
        InputError: The formula is invalid, or uses a letter without a signal.
    """
    notes: list[str] = []

    def refuse(reason: str) -> NoReturn:
        cure = f"use + - * / **, numbers, letters of signals, and {', '.join(FUNCTIONS)}"
        raise InputError.at(Path("formula"), f"{text[:LONGEST]}: {reason}; {cure}")

    def value(node: ast.AST) -> Any:
        match node:
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return np.float64(number) if abs(number) < LARGEST else np.float64(np.inf)
            case ast.Name(id="t"):
                return time
            case ast.Name(id=letter) if letter in signals:
                rows, signal = signals[letter]
                values = rows.read(signal)
                return values if rows is own else np.interp(time, rows.read(TIME), values, np.nan, np.nan)
            case ast.Name(id=letter):
                names = ", ".join([*signals, "t"])
                raise InputError.at(Path("formula"), f"{letter} is not assigned to a signal; use {names}")
            case ast.UnaryOp(op=op, operand=operand) if type(op) in OPERATORS:
                return OPERATORS[type(op)](value(operand))
            case ast.BinOp(op=op, left=left, right=right) if type(op) in OPERATORS:
                return OPERATORS[type(op)](value(left), value(right))
            case ast.Call(func=ast.Name(id=function), args=arguments, keywords=[]):
                return call(function, [value(each) for each in arguments])
        return refuse("a part of it is not allowed")

    def call(function: str, arguments: Sequence[Any]) -> Any:
        if function not in FUNCTIONS:
            refuse(f"{function} is not a function")
        count = 2 if function in BINARY or function == "lowpass" else 1
        if len(arguments) != count:
            refuse(f"{function} takes {counted(count, 'argument')}")
        if function in PLAIN:
            return PLAIN[function](*arguments)
        if function == "lowpass" and (np.ndim(arguments[1]) or not float(arguments[1]) >= 0.0):
            refuse("the time constant of lowpass must be a number [s]")
        values, out = np.broadcast_to(arguments[0], time.shape), np.full(time.size, np.nan)
        rows = np.flatnonzero(np.isfinite(values))
        wide = np.flatnonzero(np.diff(rows) > 1)
        if function == "integral" and wide.size:
            longest = float(np.max(time[rows[wide + 1]] - time[rows[wide]]))
            gaps = f"{counted(wide.size, 'gap')} without values, at most {longest:.3g} s"
            notes.append(f"{name or text}: {gaps}, interpolated linearly")
        out[rows] = OVER_TIME[function](time[rows], values[rows], *map(float, arguments[1:]))
        return out

    if not signals or len(text) > LONGEST:
        refuse("it has no signal" if not signals else "it is too long")
    own = next(iter(signals.values()))[0]
    time = own.read(TIME)
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        refuse("it is not a formula")
    with np.errstate(all="ignore"):
        values = np.broadcast_to(value(tree), time.shape).astype(np.float64)
    if not np.isfinite(values).any():
        notes.append(f"{name or text} has no value in any row")
    return values, notes


# -- derived signals of all runs ------------------------------------------------------------------------

Signal = tuple[int, str]  # (number of the run, name)


@dataclass(frozen=True)
class Definition:
    """The formula of a derived signal, letter → signal, and its unit.

    Attributes:
        unit: Unit stated by the user; "" means the signal's unit if the formula is a single letter, otherwise no unit.
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
        """Define or replace a derived signal in the run of its first signal; return all signals with new values.

        Raises:
            InputError: The name is that of a signal of the run, the signal depends on itself, or the formula is wrong.
        """
        made = next(iter(definition.of.values()))[0], name
        rows = self._runs[made[0]].rows
        if name in rows.units or name in rows.texts or name == TIME:
            raise InputError.at(Path("name"), f"{name} is a signal of the run; give another name")
        with self._lock:
            before, self._definitions = self._definitions, {**self._definitions, made: definition}
            try:
                return self._compute([made, *self._dependents([made])])  # only the new definition may be wrong
            except CycleError as error:
                self._definitions = before
                # a cycle: each is derived from the next, and the last from the first
                cycle: list[Signal] = error.args[1][:0:-1]
                place = cycle.index(made)
                chain = " ← ".join(signal for _, signal in (*cycle[place:], *cycle[:place], made))
                reason = f"{name} would depend on itself: {chain}; use another name"
                raise InputError.at(Path("name"), reason) from None
            except (InputError, OSError):
                self._definitions = before
                raise

    def remove(self, number: int, name: str) -> None:
        """Remove the derived signal `name` of the run with this number.

        Raises:
            InputError: The run has no derived signal of this name, or other signals are derived from it.
        """
        signal = number, name
        with self._lock:
            if signal not in self._definitions:
                raise InputError.at(Path("name"), f"{name} is not a derived signal")
            if others := [other for _, other in self._dependents([signal])]:
                raise InputError.at(Path("name"), f"{', '.join(others)} is derived from {name}; remove it first")
            del self._definitions[signal], self._notes[signal]
            self._runs[number].rows.remove(name)

    def renew(self, numbers: Collection[int]) -> None:
        """Recompute the signals that depend on runs with new rows."""
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
            values, self._notes[number, name] = evaluate(definition.formula, of, name)
            rows, signal = of.get(definition.formula.strip(), (None, ""))
            unit = definition.unit or (rows.unit(signal) if rows is not None else "")
            self._runs[number].rows.add(name, values, unit)
        return [self._about(signal) for signal in signals]

    def _about(self, signal: Signal) -> dict[str, Any]:
        number, name = signal
        definition, unit = self._definitions[signal], self._runs[number].rows.added[name]
        of = {letter: list(other) for letter, other in definition.of.items()}
        with showing(*(run.record for run in self._runs)):
            shown = shown_unit(unit)
        about = {"run": number, "name": name, "formula": definition.formula, "of": of, "unit": shown}
        return {**about, "stated_unit": definition.unit, "notes": self._notes[signal]}
