"""Findings on a table with independent rows: no clock, neighbours or sampling."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np

from cosim.base.arrays import Array
from cosim.base.text import amount, counted, percent, plain
from cosim.logs.finding import Finding
from cosim.logs.frames import degrees_or
from cosim.logs.log import Log
from cosim.model.traits import Traits

LEAST = 2  # rows, so that one can be held out
FEW = 8  # rows below which a table says little
ALIKE = 0.98  # correlation of two inseparable inputs
STILL = 1e-9  # share of the largest value within which a column is constant


def table_findings(log: Log, traits: Traits | None = None) -> Iterator[Finding]:
    """Yield findings on time, few rows, constant columns, correlated inputs and degrees."""
    if "time" in log.written:
        yield Finding("note", "time", "time", "time is not read: the model has no states, each row stands for itself")
    measured = int(np.isfinite(np.column_stack(list(log.outputs.values()))).any(axis=1).sum())
    if measured < LEAST:
        text = f"something is measured in {counted(measured, 'row')}; it takes {LEAST}, and a dozen to be of use"
        yield Finding("fault", "short", "", text, {"rows": float(measured)})
    elif measured < FEW:
        text = f"something is measured in {counted(measured, 'row')}; a dozen and more tell more"
        yield Finding("warning", "short", "", text, {"rows": float(measured)})
    yield from _inputs(log)
    yield from _outputs(log)
    yield from _angles(log, traits.bounds if traits else {})


def _angles(log: Log, bounds: Mapping[str, tuple[float, float]]) -> Iterator[Finding]:
    """Yield faults of angles beyond the model's limits, probably in degrees."""
    columns = {**log.inputs, **log.outputs}
    for name, (low, high) in bounds.items():
        if name not in columns or log.units[name] != "rad":
            continue
        values = columns[name]
        if np.nanmin(values) < low or np.nanmax(values) > high:
            text = f"reaches {plain(float(np.nanmax(np.abs(values))))} rad, beyond what the model allows"
            cure = degrees_or(log, name)
            yield Finding("fault", "degrees", name, f"{text} ({plain(low)} to {plain(high)}); {cure}")


def _inputs(log: Log) -> Iterator[Finding]:
    moving = {}
    for name, values in log.inputs.items():
        if np.ptp(values) <= STILL * np.abs(values).max():
            where = amount(float(values[0]), log.units[name])
            text = f"stands at {where}: what acts through it alone cannot be identified"
            yield Finding("note", "constant", name, text)
        else:
            moving[name] = values
    if log.inputs and not moving:
        text = "no input varies: such a table says next to nothing about a model"
        yield Finding("warning", "no_excitation", "", text)
    yield from alike(moving, "goes")


def alike(inputs: Mapping[str, Array], verb: str) -> Iterator[Finding]:
    """Yield a note on each pair of inseparable inputs."""
    for one, other in combinations(inputs, 2):
        rho = float(np.corrcoef(inputs[one], inputs[other])[0, 1])
        if abs(rho) > ALIKE:
            way = f"{verb} {'with' if rho > 0 else 'against'} {other} (correlation {plain(rho, 3)})"
            text = f"{way}: what one does cannot be separated from what the other does"
            yield Finding("note", "alike", one, text, {"correlation": rho})


def _outputs(log: Log) -> Iterator[Finding]:
    for name, values in log.outputs.items():
        seen = values[np.isfinite(values)]
        if seen.size < values.size:
            share = seen.size / values.size
            yield Finding("note", "missing", name, f"measured in {percent(share)} of the rows", {"share": share})
        if np.ptp(seen) <= STILL * np.abs(seen).max():
            where = amount(float(seen[0]), log.units[name])
            yield Finding("warning", "constant", name, f"stands at {where} throughout: is the sensor connected?")
