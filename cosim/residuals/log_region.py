"""The record of credibility of an FMU: provenance of its logs, and the region that they cover."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from cosim.core.arrays import Array, Flags
from cosim.core.errors import SimulationError
from cosim.credibility.record import LogRecord
from cosim.credibility.region import Region, Stretch, distances, region_of
from cosim.logs.log import Log
from cosim.residuals.drive import Drive
from cosim.residuals.windows import Replay, start_parameters

MAX_LEVEL_ROWS = 400  # of the runs that show on which levels nothing depends
EQUAL_CHANGE_TOLERANCE = 1e-6  # of a difference, relative to its size

ReplayedLog = tuple[Log, Replay]


def log_records(logs: Sequence[Log]) -> list[LogRecord]:
    """Return the record of each log: file, hash, duration and so on."""
    found = []
    for log in logs:
        written = datetime.fromtimestamp(int(log.path.stat().st_mtime), UTC).isoformat()
        with log.path.open("rb") as stream:
            sha = hashlib.file_digest(stream, "sha256").hexdigest()
        duration = float(log.time[-1] - log.time[0])
        found.append(
            LogRecord(source=log.path.name, sha256=sha, time=written, rows=log.rows, duration=duration, step=log.step)
        )
    return found


def region_of_logs(drive: Drive, replayed: Sequence[ReplayedLog]) -> Region:
    """Return the region of inputs, outputs and rates that logs cover.

    Args:
        drive: Drive of the FMU along one of the logs.
        replayed: Logs with replays near the measurements; replayed outputs have no noise.
    """
    units = {s.name: s.unit for s in (*drive.block.inputs, *drive.block.outputs)}
    stretches = [_stretch(drive, log, replay) for log, replay in replayed]
    step = float(np.median([log.step for log, _ in replayed]))
    return region_of(stretches, [s.name for s in drive.block.inputs], units, step, _free_levels(drive))


def rows_inside(region: Region, drive: Drive, replayed: Sequence[ReplayedLog]) -> list[Flags]:
    """Return for each log True for rows in the region; all rows if there is no region."""
    found = []
    for log, replay in replayed:
        rows = np.ones(log.rows, bool)
        if not region.reason:
            away = distances(region, _stretch(drive, log, replay))
            rows = away.inside[np.searchsorted(away.time, log.time, side="right") - 1]
        found.append(rows)
    return found


def signals_along(drive: Drive, log: Log, replay: Replay) -> dict[str, Array]:
    """Return name → values, shape (rows,), of a log's inputs, constant inputs, and replayed outputs."""
    declared = {v.name: v.start for v in drive.description.modelVariables}
    held = {n: np.full(log.rows, float(drive.given.get(n, declared.get(n)) or 0.0)) for n in drive.free_inputs}
    return {**held, **log.inputs, **replay.outputs}


def _stretch(drive: Drive, log: Log, replay: Replay) -> Stretch:
    return Stretch(log.time, signals_along(drive, log, replay), sorted(replay.starts))


def _free_levels(drive: Drive) -> set[str]:
    """Return the outputs that another start value only shifts by a constant, such as a position."""
    found = set[str]()
    last = min(drive.log.rows - 1, MAX_LEVEL_ROWS)
    try:
        for parameter in start_parameters(drive).values():
            one, two = (drive.run(0, last, {parameter.name: value}) for value in parameter.tried)
            change = two - one
            size = np.abs(change).max(axis=0)
            moved = size > EQUAL_CHANGE_TOLERANCE * np.maximum(1.0, np.abs(one).max(axis=0))
            if np.all(np.ptp(change, axis=0)[moved] <= EQUAL_CHANGE_TOLERANCE * size[moved] * last):
                found |= {name for name, is_moved in zip(drive.outputs, moved, strict=True) if is_moved}
    except SimulationError:
        return set()
    return found
