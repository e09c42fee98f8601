"""Replays of recorded commands through an FMU, as a free run or in windows.

A long free run is no useful measure for a model with integrating states. A window starts at row k, at time t_k, from a
state estimated from past data, and lasts one horizon.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.fmi.state import MEMORY, STATE, Memory, Own
from cosim.logs.log import Log, stretches
from cosim.residuals.drive import Drive, as_columns, coarse_rounding, rows_of
from cosim.residuals.residual_statistics import FREE_RUN
from cosim.residuals.starts import (
    FIRST,
    PAST,
    StartParameter,
    first_start,
    noise_levels,
    readable,
    start_parameters,
    window_start,
)

SKIPPED = 2.0  # [s] at the start of a log, in which a filter settles
HORIZONS = (0.5, 2.0)  # [s], the second one is decisive


@dataclass(frozen=True, eq=False)
class Replay:
    """Outputs of an FMU at the rows of a log.

    Attributes:
        horizon: Length of each run [s], FREE_RUN for one run over the whole log.
        starts: First row of each run → start values.
        outputs: Name → (rows,), NaN without a prediction.
        states: Possible first row of a chain of windows → state of a cosim FMU.
    """

    time: Array
    horizon: float
    starts: Mapping[int, Mapping[str, Any]]
    outputs: Mapping[str, Array]
    units: Mapping[str, str]
    states: Mapping[int, Own] = field(default_factory=dict)

    def errors(self, log: Log) -> dict[str, Array]:
        """Return channel → measured − model, NaN if incomplete."""
        return {name: values - self.outputs[name] for name, values in log.outputs.items()}


def free_run(drive: Drive, start: Mapping[str, Any] | None = None) -> Replay:
    """Return the whole log as one run, with start values of its parameters or those of the first measurements."""
    log, parameters = drive.log, start_parameters(drive)
    chosen = first_start(drive, parameters) if start is None else start
    rows = {chain[0] for span in horizons(log) for chain, _ in chains(log, span)} if readable(parameters) else set()
    table, states = drive.run_and_keep(0, log.rows - 1, chosen, rows)
    return Replay(log.time, FREE_RUN, {0: chosen}, as_columns(table, drive.outputs), drive.units, states)


def windows(
    drive: Drive,
    starts: Mapping[int, Mapping[str, Any]],
    horizon: float,
    memories: Mapping[int, Memory] = MappingProxyType({}),
) -> Replay:
    """Return runs of `horizon` seconds from the given starts.

    A row belongs to the run that ends there; a run does not predict its start row.

    Args:
        starts: First row → start values.
        memories: First row → state of a cosim FMU, for states that `starts` does not set.
    """
    table = np.full((drive.log.rows, len(drive.outputs)), np.nan)
    done = -1
    for first in sorted(starts):
        last = rows_of(drive.log, first, horizon)
        if first < done:
            raise ValueError(f"the window at row {first} begins before the one before it ends, at row {done}")
        if last > first:
            table[first + 1 : last + 1] = drive.run(first, last, starts[first], memories.get(first))[1:]
        done = last
    return Replay(drive.log.time, horizon, dict(starts), as_columns(table, drive.outputs), drive.units)


def self_started(drive: Drive, parameters: Mapping[str, StartParameter], free: Replay, horizon: float) -> Replay | None:
    """Return consecutive windows started from measurements.

    The free run provides the start of each chain. An output first measured later is predicted from then on. The result
    is None if the FMU or the log allows no windows.
    """
    log, runs = drive.log, chains(drive.log, horizon)
    if not runs or not parameters.keys() & log.outputs.keys():
        return None
    table, starts, sigma = np.full((log.rows, len(drive.outputs)), np.nan), {}, noise_levels(log, free.outputs)
    carried = table.copy()
    for rows, begin in runs:
        own, carrier, since = free.states.get(rows[0]), free.outputs, 0
        for first, last in pairwise(rows):
            start = window_start(drive, parameters, sigma, carrier, since, first)
            memory = None
            if own is not None:  # what the start values do not set
                started = {(STATE, k) for p in parameters.values() if p.name in start for k in p.places}
                whole = {(part, k): value for part in (STATE, MEMORY) for k, value in enumerate(own[part])}
                memory = {place: value for place, value in whole.items() if place not in started}
            carried[first : last + 1] = drive.run(first, last, start, memory)
            own, carrier, since = own and drive.state(), dict(zip(drive.outputs, carried.T, strict=True)), first
            if first >= begin:
                starts[first] = start
                table[first + 1 : last + 1] = carried[first + 1 : last + 1]
    for j, name in enumerate(drive.outputs):
        if name in log.outputs:  # predicted from the first window with sufficient past measurements
            times = log.time[np.isfinite(log.outputs[name])]
            earliest = times[0] + SKIPPED * log.slowness - coarse_rounding(log) if times.size else np.inf
            table[: min((k for k in starts if log.time[k] >= earliest), default=log.rows) + 1, j] = np.nan
    return Replay(log.time, horizon, starts, as_columns(table, drive.outputs), drive.units)


def horizons(log: Log) -> tuple[float, ...]:
    """Return the horizons of windows [s], longer for rows slower than 50 ms; the last one decides the verdict."""
    return tuple(horizon * log.slowness for horizon in HORIZONS)


def chains(log: Log, horizon: float) -> list[tuple[list[int], int]]:
    """Return chains of consecutive windows of a log, each with the first row that counts; a pause begins a new one.

    At the start of each chain the state settles in short windows, which do not count.
    """
    result, skipped = [], SKIPPED * log.slowness
    for part in stretches(log):
        first = int(np.searchsorted(log.time, part.time[0]))
        if rows := window_rows(part, horizon, skipped):
            settle = [
                k for k in window_rows(part, PAST * log.slowness, 0.0 if first else FIRST * log.slowness) if k < rows[0]
            ]
            edges = [*settle, *rows, rows_of(part, rows[-1], horizon)]
            result.append(([first + k for k in edges], first + rows[0]))
    return result


def window_rows(log: Log, horizon: float, skipped: float = SKIPPED) -> list[int]:
    """Return the first rows of consecutive whole windows, after the first `skipped` seconds."""
    rows: list[int] = []
    k = int(np.searchsorted(log.time, log.time[0] + skipped - coarse_rounding(log)))
    while k < log.rows - 1 and log.time[k] + horizon <= log.time[-1] + 0.5 * log.step:
        last = rows_of(log, k, horizon)
        if last > k:
            rows.append(k)
        k = max(last, k + 1)
    return rows
