"""Findings on a table, a log of a model without states: independent rows without clock, neighbours or sampling."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np

from cosim.base.arrays import Array
from cosim.base.messages import Note
from cosim.base.text import amount, counted, percent, plain
from cosim.logs.finding import Finding
from cosim.logs.frames import angle_cure
from cosim.logs.log import Log
from cosim.model.traits import Traits

LEAST = 2  # rows, so that one can be held out
FEW = 8  # rows below which a table says little
ALIKE = 0.98  # correlation of two inseparable inputs
STILL = 1e-9  # share of the largest value within which a column is constant


def table_findings(log: Log, traits: Traits | None = None) -> Iterator[Finding]:
    """Yield findings on time, few rows, constant columns, correlated inputs and degrees."""
    if "time" in log.written:
        yield Finding(
            "note", "time", "time", Note("time is not read: the model has no states, each row stands for itself")
        )
    measured = int(np.isfinite(np.column_stack(list(log.outputs.values()))).any(axis=1).sum())
    rows = counted(measured, "row")
    if measured < LEAST:
        message = f"something is measured in {rows}; it takes {LEAST}, and a dozen to be of use"
        yield Finding("fault", "short", "", message, {"rows": float(measured)})
    elif measured < FEW:
        yield Finding(
            "warning",
            "short",
            "",
            f"something is measured in {rows}; a dozen and more tell more",
            {"rows": float(measured)},
        )
    yield from _inputs(log)
    yield from _outputs(log)
    yield from _angles(log, traits.bounds if traits else {})


def _angles(log: Log, bounds: Mapping[str, tuple[float, float]]) -> Iterator[Finding]:
    """Yield a fault for each angle beyond declared limits."""
    columns = {**log.inputs, **log.outputs}
    for name, (low, high) in bounds.items():
        if name not in columns or log.units[name] != "rad":
            continue
        values = columns[name]
        if np.nanmin(values) < low or np.nanmax(values) > high:
            size, cure = plain(float(np.nanmax(np.abs(values)))), angle_cure(log, name)
            message = f"reaches {size} rad, beyond what the model allows ({plain(low)} to {plain(high)}); {cure}"
            yield Finding("fault", "degrees", name, message)


def _inputs(log: Log) -> Iterator[Finding]:
    moving = {}
    for name, values in log.inputs.items():
        if np.ptp(values) <= STILL * np.abs(values).max():
            value = amount(float(values[0]), log.units[name])
            yield Finding(
                "note",
                "constant",
                name,
                Note(f"is constant at {value}: effects that act only through it cannot be identified"),
            )
        else:
            moving[name] = values
    if log.inputs and not moving:
        yield Finding(
            "warning", "no_excitation", "", "no input varies: such a table says next to nothing about a model"
        )
    yield from alike_inputs(moving, "goes")


def alike_inputs(inputs: Mapping[str, Array], verb: str) -> Iterator[Finding]:
    """Yield a note on each pair of inputs too similar to separate; `verb` begins the sentence, such as `moves`."""
    for one, other in combinations(inputs, 2):
        rho = float(np.corrcoef(inputs[one], inputs[other])[0, 1])
        if abs(rho) > ALIKE:
            direction, correlation = "with" if rho > 0 else "against", plain(rho, 3)
            message = Note(
                f"{verb} {direction} {other} (correlation {correlation}): what one does cannot be separated from "
                "what the other does"
            )
            yield Finding("note", "alike", one, message, {"correlation": rho})


def _outputs(log: Log) -> Iterator[Finding]:
    for name, values in log.outputs.items():
        readings = values[np.isfinite(values)]
        share = readings.size / values.size
        if share < 1.0:
            yield Finding("note", "missing", name, Note(f"measured in {percent(share)} of the rows"), {"share": share})
        if np.ptp(readings) <= STILL * np.abs(readings).max():
            value = amount(float(readings[0]), log.units[name])
            yield Finding(
                "warning", "constant", name, f"is constant at {value} throughout; check that the sensor is connected"
            )
