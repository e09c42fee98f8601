"""Replay: the recorded commands drive an FMU, freely from the first row or in windows; its outputs beside the log's.

A free run over a long log is no measure for a model whose states integrate; the windows
are: each starts at row k, at time t_k, from a state known by then, and runs for a horizon.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.fmi.state import Memory, Own
from cosim.logs.log import Log, stretches
from cosim.residuals.drive import Drive, as_columns, rows_of
from cosim.residuals.residual_statistics import FREE_RUN
from cosim.residuals.starts import (
    FIRST,
    PAST,
    StartParameter,
    first_start,
    kept,
    noise_levels,
    readable,
    start_parameters,
    window_start,
)

SKIPPED = 2.0  # [s] at the start of a log, while a filter settles
HORIZONS = (0.5, 2.0)  # [s], the second is the measure


@dataclass(frozen=True, eq=False)
class Replay:
    """Outputs of an FMU at the rows of a log.

    horizon: [s], FREE_RUN where it is one run over the whole log
    starts:  first row of each run → start values it was given
    outputs: name → (rows,), NaN where nothing was predicted
    states:  row where a chain of windows may start → the state of an FMU of ours there; nothing of another
    """

    time: Array
    horizon: float
    starts: Mapping[int, Mapping[str, Any]]
    outputs: Mapping[str, Array]
    units: Mapping[str, str]
    states: Mapping[int, Own] = field(default_factory=dict)

    def errors(self, log: Log) -> dict[str, Array]:
        """Channel → measured − model, NaN where one of them is missing."""
        return {name: values - self.outputs[name] for name, values in log.outputs.items()}


@dataclass(frozen=True)
class Chain:
    """Windows one after the other: each begins at a row where the one before it ends, `begin` the first that counts."""

    rows: tuple[int, ...]
    begin: int


def free_run(drive: Drive, start: Mapping[str, Any] | None = None) -> Replay:
    """Return the whole log as one run, from `start` (FMU parameters by name) or else from its first measurements."""
    log, parameters = drive.log, start_parameters(drive)
    chosen = first_start(drive, parameters) if start is None else start
    rows = {c.rows[0] for span in horizons(log) for c in chains(log, span)} if readable(parameters) else set()
    table, states = drive.run_and_keep(0, log.rows - 1, chosen, rows)
    return Replay(log.time, FREE_RUN, {0: chosen}, as_columns(table, drive.outputs), drive.units, states)


def row_by_row(drive: Drive, start: Mapping[str, Any]) -> Replay:
    """The rows of a table, each predicted by the FMU from its own inputs."""
    table = drive.rows(start)
    return Replay(drive.log.time, FREE_RUN, {0: dict(start)}, as_columns(table, drive.outputs), drive.units)


def windows(
    drive: Drive,
    starts: Mapping[int, Mapping[str, Any]],
    horizon: float,
    memories: Mapping[int, Memory] = MappingProxyType({}),
) -> Replay:
    """Return runs of `horizon` seconds, each from row k at time t_k with the start values `starts[k]`.

    A row belongs to the run that ends there; the row of a start is not predicted by it.
    memories: row → what an FMU of ours keeps there
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
    """Consecutive windows that start from the measurements and, in what these do not show, from the window before.

    The free run carries to the first of each chain. An output that is first measured later is predicted from then on:
    before, nobody knew where it was. None where FMU or log do not allow windows.
    """
    log, found = drive.log, chains(drive.log, horizon)
    if not found or not parameters.keys() & log.outputs.keys():
        return None
    table, starts, sigma = np.full((log.rows, len(drive.outputs)), np.nan), {}, noise_levels(log, free.outputs)
    carried = table.copy()
    for chain in found:
        own, carrier, since = free.states.get(chain.rows[0]), free.outputs, 0
        for first, last in pairwise(chain.rows):
            start = window_start(drive, parameters, sigma, carrier, since, first)
            memory = None if own is None else kept(own, parameters, start)
            carried[first : last + 1] = drive.run(first, last, start, memory)
            own, carrier, since = own and drive.state(), dict(zip(drive.outputs, carried.T, strict=True)), first
            if first >= chain.begin:
                starts[first] = start
                table[first + 1 : last + 1] = carried[first + 1 : last + 1]
    for j, name in enumerate(drive.outputs):
        if name in log.outputs:
            table[: _known_from(log, name, list(starts)) + 1, j] = np.nan
    return Replay(log.time, horizon, starts, as_columns(table, drive.outputs), drive.units)


def _known_from(log: Log, name: str, starts: Sequence[int]) -> int:
    """First window that an output had been measured before, for as long as is left out at the start of the log."""
    seen = log.time[np.isfinite(log.outputs[name])]
    begins = [k for k in starts if seen.size and log.time[k] >= seen[0] + SKIPPED * log.slowness - 1e-6 * log.step]
    return min(begins, default=log.rows)


def horizons(log: Log) -> tuple[float, ...]:
    """HORIZONS [s], the measure last; longer where rows are slower than 50 ms, so that they span as many."""
    return tuple(horizon * log.slowness for horizon in HORIZONS)


def chains(log: Log, horizon: float) -> list[Chain]:
    """Windows that start from the measurements; over a pause nothing is known, there a chain ends and another begins.

    After a pause the state settles in short windows, for as long as is left out at the start of the log.
    """
    found, skipped = [], SKIPPED * log.slowness
    for part in stretches(log):
        first = int(np.searchsorted(log.time, part.time[0]))
        if rows := window_rows(part, horizon, skipped):
            settle = [
                k for k in window_rows(part, PAST * log.slowness, 0.0 if first else FIRST * log.slowness) if k < rows[0]
            ]
            edges = (*settle, *rows, rows_of(part, rows[-1], horizon))
            found.append(Chain(tuple(first + k for k in edges), first + rows[0]))
    return found


def window_rows(log: Log, horizon: float, skipped: float = SKIPPED) -> list[int]:
    """First rows of consecutive windows, the first `skipped` seconds left out, the last window whole."""
    rows: list[int] = []
    k = int(np.searchsorted(log.time, log.time[0] + skipped - 1e-6 * log.step))
    while k < log.rows - 1 and log.time[k] + horizon <= log.time[-1] + 0.5 * log.step:
        last = rows_of(log, k, horizon)
        if last > k:
            rows.append(k)
        k = max(last, k + 1)
    return rows
