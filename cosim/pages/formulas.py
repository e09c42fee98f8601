"""Signals derived by a formula such as `a - b`, `der(a)` or `lowpass(a, 0.5)`, computed from displayed values."""

from __future__ import annotations

import ast
import operator
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.core.text import counted, showing, shown_unit
from cosim.pages.rows import TIME_COLUMN, Recording
from cosim.pages.runs import ViewedRun

MAX_FORMULA_CHARACTERS = 500  # characters of a formula
MAX_NUMBER = 10**308  # largest number; larger ones become infinite


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

    Each value holds until the next row; the result is exact for any spacing of the rows.
    """
    steps = np.diff(time)
    gains = -np.expm1(-steps / constant) if constant > 0.0 else np.ones_like(steps)
    out = values[:1].tolist()
    for value, gain in zip(values[:-1].tolist(), gains.tolist(), strict=True):
        out.append(out[-1] + gain * (value - out[-1]))
    return np.array(out)


OF_ONE = ["abs", "sqrt", "sin", "cos", "tan", "arcsin", "arccos", "arctan", "exp", "log", "log10"]
OF_TWO = {"atan2": np.arctan2, "hypot": np.hypot, "min": np.minimum, "max": np.maximum}
POINTWISE: dict[str, Callable[..., Any]] = {name.replace("arc", "a"): getattr(np, name) for name in OF_ONE} | OF_TWO
OVER_TIME: dict[str, Callable[..., Array]] = {"der": derivative, "integral": integral, "lowpass": lowpass}
FORMULA_FUNCTIONS = (*OVER_TIME, *POINTWISE)
OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}


def evaluate(text: str, signals: Mapping[str, tuple[Recording, str]]) -> Array:
    """Return the values of a formula at the rows of its first signal.

    Args:
        signals: Letter → signal. A signal of another run is interpolated linearly.

    Raises:
        InputError: The formula is invalid, or uses a letter without a signal.
    """

    def refuse(reason: str) -> NoReturn:
        functions = ", ".join(FORMULA_FUNCTIONS)
        cure = f"allowed are + - * / **, numbers, the letter of each signal in the legend, and {functions}"
        raise InputError.at(Path("formula"), f"{text[:MAX_FORMULA_CHARACTERS]}: {reason}; {cure}")

    def value(node: ast.AST) -> Any:
        match node:
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return np.float64(number) if abs(number) < MAX_NUMBER else np.float64(np.inf)
            case ast.Name(id="t"):
                return time
            case ast.Name(id=letter) if letter in signals:
                rows, signal = signals[letter]
                values = rows.read(signal)
                return values if rows is own else np.interp(time, rows.read(TIME_COLUMN), values, np.nan, np.nan)
            case ast.UnaryOp(op=op, operand=operand) if type(op) in OPERATORS:
                return OPERATORS[type(op)](value(operand))
            case ast.BinOp(op=op, left=left, right=right) if type(op) in OPERATORS:
                return OPERATORS[type(op)](value(left), value(right))
            case ast.Call(func=ast.Name(id=function), args=arguments, keywords=[]) if function in FORMULA_FUNCTIONS:
                count = 2 if function in OF_TWO or function == "lowpass" else 1
                if len(arguments) != count:
                    refuse(f"{function} takes {counted(count, 'argument')}")
                numbers = [value(each) for each in arguments]
                return POINTWISE[function](*numbers) if function in POINTWISE else over_time(function, *numbers)
        return refuse(f"{ast.unparse(node)} is not allowed")

    def over_time(function: str, values: Any, *constants: Any) -> Array:
        if any(np.ndim(c) or not float(c) >= 0.0 for c in constants):
            refuse("the time constant of lowpass must be a number [s]")
        values, out = np.broadcast_to(values, time.shape), np.full(time.size, np.nan)
        rows = np.isfinite(values)
        out[rows] = OVER_TIME[function](time[rows], values[rows], *map(float, constants))
        return out

    if not signals or len(text) > MAX_FORMULA_CHARACTERS:
        refuse("it has no signal" if not signals else "it is too long")
    own = next(iter(signals.values()))[0]
    time = own.read(TIME_COLUMN)
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        refuse("it is not a formula")
    with np.errstate(all="ignore"):
        return np.broadcast_to(value(tree), time.shape).astype(np.float64)


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

    def define(self, name: str, definition: Definition) -> list[dict[str, Any]]:
        """Define or replace a derived signal in the run of its first signal; return all signals with new values.

        Raises:
            InputError: The name is that of a signal of the run, the signal depends on itself, or the formula is wrong.
        """
        made = next(iter(definition.of.values()))[0], name
        rows = self._runs[made[0]].rows
        if name in rows.units or name in rows.texts or name == TIME_COLUMN:
            raise InputError.at(Path("name"), f"{name} is a signal of the run; give another name")
        with self._lock:
            before, self._definitions = self._definitions, {**self._definitions, made: definition}
            try:
                return self._compute({made})  # only the new definition, which comes first, may be wrong
            except (CycleError, InputError) as error:
                self._definitions = before
                if not isinstance(error, CycleError):
                    raise
                chain = " → ".join(signal for _, signal in error.args[1])
                reason = f"{name} would depend on itself: {chain}; use another name"
                raise InputError.at(Path("name"), reason) from None

    def remove(self, number: int, name: str) -> None:
        """Remove the derived signal `name` of the run with this number.

        Raises:
            InputError: The run has no derived signal of this name, or other signals are derived from it.
        """
        signal = number, name
        with self._lock:
            if signal not in self._definitions:
                raise InputError.at(Path("name"), f"{name} is not a derived signal")
            if others := [n for (_, n), definition in self._definitions.items() if signal in definition.of.values()]:
                raise InputError.at(Path("name"), f"{', '.join(others)} uses {name}; remove {', '.join(others)} first")
            del self._definitions[signal]
            self._runs[number].rows.remove(name)

    def renew(self, numbers: Collection[int]) -> None:
        """Recompute the signals that depend on runs with new rows."""
        with self._lock:
            uses = {signal for definition in self._definitions.values() for signal in definition.of.values()}
            self._compute({signal for signal in uses - {*self._definitions} if signal[0] in numbers})

    def of_run(self, number: int) -> list[dict[str, Any]]:
        """Return the derived signals of a run."""
        return [self._about(signal) for signal in self._definitions if signal[0] == number]

    def _compute(self, changed: set[Signal]) -> list[dict[str, Any]]:
        """Compute changed signals, and all that depend on them; return these.

        Raises:
            CycleError: A signal depends on itself.
        """
        found = []
        uses = {made: [*definition.of.values()] for made, definition in self._definitions.items()}
        for signal in TopologicalSorter(uses).static_order():
            if signal not in uses or not changed & {signal, *uses[signal]}:
                continue
            changed, definition, (number, name) = {*changed, signal}, self._definitions[signal], signal
            of = {letter: (self._runs[k].rows, other) for letter, (k, other) in definition.of.items()}
            rows, same = of.get(definition.formula.strip(), (None, ""))
            unit = definition.unit or (rows.unit(same) if rows is not None else "")
            self._runs[number].rows.add(name, evaluate(definition.formula, of), unit)
            found.append(self._about(signal))
        return found

    def _about(self, signal: Signal) -> dict[str, Any]:
        number, name = signal
        definition, unit = self._definitions[signal], self._runs[number].rows.added[name]
        of = {letter: list(other) for letter, other in definition.of.items()}
        with showing(*(run.record for run in self._runs)):
            shown = shown_unit(unit)
        about = {"run": number, "name": name, "formula": definition.formula, "of": of}
        return {**about, "unit": shown, "stated_unit": definition.unit}
