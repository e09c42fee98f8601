"""Dropouts of load cells: single readings far off all their neighbours, within the range of the converter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.logs.log import Log
from cosim.logs.spikes import find_spikes, out_of_line
from plant.bench import Bench
from plant.identification.recordings import Recording

MIRRORED_ROWS = 12  # rows before the first one, the mirrored rest, so that the first rows have neighbours

NEAR_ROWS = 15  # rows before and after a reading that show the response to a jump
MIN_RESPONSE = 0.25  # least size of a response, as a share of the range of all readings


@dataclass(frozen=True)
class Dropout:
    """Dropouts of a channel: their rows, and the largest distance from the neighbours [V]."""

    channel: str
    rows: Rows
    distance: float


def dropouts(bench: Bench, r: Recording) -> Iterator[Dropout]:
    """Yield the dropouts of each channel by the rule for logs, `cosim.logs.spikes`.

    A sharp reading directly after a jump of a command may be genuine, unless its distance from the other readings of
    the response exceeds the size of the response.
    """
    log = _log(bench, r)
    unlike_neighbours = find_spikes(log, lambda _: {})  # no model: each suspect counts
    unexplained = find_spikes(log)
    for channel, rows in unlike_neighbours.items():
        values = log.outputs[channel]
        outside = [k for k in rows.tolist() if _outside(values, k, rows)]
        rows = np.union1d(outside, unexplained.get(channel, [])).astype(np.intp)
        distance = out_of_line(log, values)
        if (own := rows[rows >= MIRRORED_ROWS]).size:
            yield Dropout(channel, own - MIRRORED_ROWS, float(distance[own].max()))


def _outside(values: Array, row: int, suspects: Rows) -> bool:
    """Return True for a reading outside the range of the response about it by more than the size of the response."""
    others = np.delete(np.arange(values.size), suspects)
    near = values[others[np.abs(others - row) <= NEAR_ROWS]]
    size = max(float(np.ptp(near)), MIN_RESPONSE * float(np.ptp(values[others])))
    return bool(values[row] < near.min() - size or values[row] > near.max() + size)


def _log(bench: Bench, r: Recording) -> Log:
    """Return the recording as log, preceded by mirrored rows."""
    rng = np.random.default_rng(0)

    def mirror(values: Array) -> Array:
        return np.concatenate((values[MIRRORED_ROWS:0:-1], values))

    def dither(volts: Array) -> Array:
        """Return readings with random noise of the rounding, since rounding hides the noise of a quiet cell."""
        changes = np.abs(np.diff(volts))
        step = max(
            bench.converter_range / bench.converter_levels, float(np.min(changes[changes > 0.0], initial=np.inf))
        )
        return volts + (step if np.isfinite(step) else 0.0) * rng.uniform(-0.5, 0.5, volts.size)

    time = np.concatenate((2.0 * r.time[0] - r.time[MIRRORED_ROWS:0:-1], r.time))
    inputs = {"duty": mirror(r.duty), "servo_duty": mirror(r.servo_duty)}
    outputs = {c: mirror(dither(volts)) for c, volts in r.volts.items()}
    return Log(r.path or Path(r.label), time, inputs, outputs, {}, r.step, {}, {})
