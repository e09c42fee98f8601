"""Expected results of an FMU in the form of a run: elements of arrays, Booleans and exact integers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.storage.results import Results

WORDS = {"true": 1.0, "false": 0.0}


def in_form_of(run: Results, expected: Results) -> tuple[Results, list[str]]:
    """Return expected results with the names and kinds of values of a run, and the names that the run has not.

    An array is one column with its elements separated by spaces in the expected results, and a column for each element
    in a run.
    """
    numbers: dict[str, Array] = {}
    exact: dict[str, Sequence[Any]] = {}
    missing = []
    for name in (*expected.columns, *expected.exact):
        texts = expected.exact.get(name)
        column = expected[name] if texts is None else texts
        elements = [c for c in (*run.columns, *run.exact) if c.startswith(f"{name}[")]  # of an array
        if name in run:
            numbers[name] = np.array([_number(v) for v in column])
        elif name in run.exact:
            exact[name] = [_exact(value, type(run.exact[name][0])) for value in column]
        elif elements:
            numbers |= zip(elements, _elements(column, len(elements)), strict=True)
        else:
            missing.append(name)
    values = np.column_stack(list(numbers.values())) if numbers else np.empty((expected.time.size, 0))
    return replace(expected, columns=tuple(numbers), values=values, exact=exact, whole=frozenset()), missing


def _elements(column: Iterable[Any], count: int) -> Iterator[Array]:
    """Yield each element of an array over time, from texts with elements separated by spaces; NaN if missing."""
    rows = [str(value).split() for value in column]
    for place in range(count):
        yield np.array([_number(row[place]) if place < len(row) else np.nan for row in rows])


def _exact(value: Any, kind: type) -> Any:
    """Return an integer, binary data from hexadecimal digits, or the text itself if it is none of this kind."""
    with suppress(ValueError):
        return int(value) if kind is int else bytes.fromhex(value) if kind is bytes else value
    return value


def _number(value: Any) -> float:
    """Return a number, of a Boolean too; NaN for other text."""
    try:
        return WORDS.get(value, np.nan) if value in WORDS else float(value)
    except ValueError:
        return np.nan
