"""Derived signals of all runs: definition, dependence on each other, and values."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cosim.base.errors import InputError
from cosim.viewing.derived_signals import Formula
from cosim.viewing.pyramid import TIME
from cosim.viewing.viewed_runs import ViewedRun

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
            try:
                self._ordered({made: definition})
            except CycleError as error:
                cycle: list[Signal] = error.args[1][:0:-1]  # each is derived from the next, and the last from the first
                place = cycle.index(made)
                chain = " ← ".join(signal for _, signal in (*cycle[place:], *cycle[:place], made))
                raise InputError.at(
                    Path("name"), f"{name} would be derived from itself: {chain}; give another name"
                ) from None
            changed = {made: definition}
            changed |= {signal: self._definitions[signal] for signal in self._dependents(made)}
            before = {signal: self._definitions[signal] for signal in changed if signal in self._definitions}
            try:
                return [self._compute(signal, definition) for signal, definition in changed.items()]
            except InputError:
                for signal, definition in before.items():
                    self._compute(signal, definition)
                raise

    def remove(self, number: int, name: str) -> None:
        """Remove a derived signal of a run.

        Raises:
            InputError: There is no such signal, or others depend on it.
        """
        signal = number, name
        with self._lock:
            if signal not in self._definitions:
                raise InputError.at(Path("name"), f"{name} is no derived signal")
            if others := [other for _, other in self._dependents(signal)]:
                raise InputError.at(Path("name"), f"{', '.join(others)} is derived from {name}; remove that first")
            del self._definitions[signal], self._notes[signal]
            self._runs[number].rows.remove(name)

    def of_run(self, number: int) -> list[dict[str, Any]]:
        """Return the derived signals of a run."""
        return [self._about(signal) for signal in self._definitions if signal[0] == number]

    def _dependents(self, made: Signal) -> Iterator[Signal]:
        """Yield the dependents of a signal in the order of their computation."""
        changed = {made}
        for signal in self._ordered():
            if signal not in changed and changed & {*self._definitions[signal].of.values()}:
                changed.add(signal)
                yield signal

    def _ordered(self, more: Mapping[Signal, Definition] = MappingProxyType({})) -> list[Signal]:
        """Return all derived signals, with further ones, in the order of their computation, or raise CycleError."""
        definitions = {**self._definitions, **more}
        uses = {made: [s for s in d.of.values() if s in definitions] for made, d in definitions.items()}
        return [*TopologicalSorter(uses).static_order()]

    def _compute(self, signal: Signal, definition: Definition) -> dict[str, Any]:
        number, name = signal
        signals = {letter: (self._runs[k].rows, other) for letter, (k, other) in definition.of.items()}
        formula = Formula(definition.formula, signals, name)
        values, unit = formula.evaluate(), definition.unit
        if not unit and definition.formula.strip() in signals:
            rows, other = signals[definition.formula.strip()]
            unit = {**rows.units, **rows.added}.get(other, "")
        self._runs[number].rows.add(name, values, unit)
        self._definitions[signal] = definition
        self._notes[signal] = list(formula.notes)
        return self._about(signal)

    def _about(self, signal: Signal) -> dict[str, Any]:
        number, name = signal
        definition, rows = self._definitions[signal], self._runs[number].rows
        of = {letter: list(other) for letter, other in definition.of.items()}
        about = {"run": number, "name": name, "formula": definition.formula, "of": of, "unit": rows.added[name]}
        return {**about, "stated_unit": definition.unit, "notes": self._notes[signal]}
