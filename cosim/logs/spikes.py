"""Single readings that neither their neighbours nor the model explain: a recorder's, not a sensor's.

One rule for `check`, `replay` and `refine`. A reading is suspect if its neighbours agree among themselves when it is
left out, and it is far from them. A suspect is genuine if the model moves as sharply there: an inrush current is out of
line with its neighbours too. Of a log without a model, a suspect is genuine where an input has just jumped.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from cosim.base.arrays import Array, Flags, Rows
from cosim.logs.channel_noise import noise_level, surprise
from cosim.logs.log import Log

JUMP = 0.05  # of the range of an input, and 8 times its usual change, that an output may answer by a kink
ANSWER = 0.1  # [s] after the jump, and 5 rows, in which it does
SCALE = (70 / 36) ** 0.5  # of what four equal neighbours do not say, to the noise
WILD = 12.0  # times the noise, from which a value out of line is suspect
MOST, ADJACENT = 3, 2  # of a few that stand close together, and one after the other: more are motion
REACH, SIDE = 12, 3  # readings that these may lead astray; on each side, that say what there should be
ASTRAY = 0.4  # of what is wild, from which a reading belongs to such a stretch: two in a row hide each other in part
UNCERTAINTY, LATENESS = 2.0, 2  # of a prediction that moves sharply: factor of its size, and rows of its time

Spikes = Mapping[str, Rows]
Prediction = Callable[[Spikes], Mapping[str, Array]]  # outputs of a model by name, made without the suspect readings


def find_spikes(log: Log, predict: Prediction | None = None) -> dict[str, Rows]:
    """Return the rows of each channel at which a recorder's reading stands.

    predict: outputs of the model in the rows of the log; called only if a reading is suspect
    """
    suspects = {name: rows for name, values in log.outputs.items() if (rows := _suspects(log, values)).size}
    if not suspects:
        return {}
    model = {} if predict is None else predict(suspects)
    answering = _answering(log)
    spikes = {}
    for name, rows in suspects.items():
        values = log.outputs[name]
        genuine = answering[rows] if predict is None else _moves_too(values, model.get(name), rows)
        if not genuine.all():
            spikes[name] = rows[~genuine]
    return spikes


def without(log: Log, spikes: Spikes) -> Log:
    """Return the log with empty cells in place of spikes."""
    outputs = dict(log.outputs)
    for name, rows in spikes.items():
        outputs[name] = outputs[name].copy()
        outputs[name][rows] = np.nan
    return replace(log, outputs=outputs) if spikes else log


def out_of_line(log: Log, values: Array) -> Array:
    """Return how far each reading is from its neighbours; 0 where it has too few."""
    place = np.concatenate(([0], np.cumsum(np.minimum(np.diff(log.grid), 5))))
    whole = np.full(place[-1] + 1, np.nan)
    whole[place] = values  # what stands on the far side of a pause is no neighbour
    seen = np.pad(np.isfinite(whole), 2)
    beside = np.lib.stride_tricks.sliding_window_view(seen, 5).all(axis=1)  # a slower sensor may miss motion
    return np.asarray(SCALE * np.abs(np.nan_to_num(np.where(beside, surprise(whole), 0.0)[place])))


def _suspects(log: Log, values: Array) -> Rows:
    """Rows whose neighbours agree among themselves when the reading is left out, and that are far from them."""
    level = noise_level(values) * SCALE
    if not level > 0.0:
        return np.zeros(0, np.intp)
    kept = values.copy()
    kept[_close_together(values, WILD * level)] = np.nan
    off = out_of_line(log, kept)
    around = np.max([np.roll(off, k) for k in (-2, -1, 1, 2)], axis=0)
    peaks = np.flatnonzero((off > WILD * level) & (off >= around))
    kept[[k for k in peaks.tolist() if _neighbours_agree(kept, k, WILD * level)]] = np.nan
    return np.flatnonzero(np.isfinite(values) & np.isnan(kept))


def _moves_too(values: Array, model: Array | None, rows: Rows) -> Flags:
    """Whether the model is as far out of line near each of these rows, by its uncertainty in size and in time."""
    if model is None:
        return np.zeros(rows.size, bool)
    there = np.isfinite(values)
    moved = _off_neighbours(np.where(there & np.isfinite(model), model, np.nan))
    near = np.lib.stride_tricks.sliding_window_view(np.pad(moved, LATENESS), 2 * LATENESS + 1).max(axis=1)
    return np.asarray(UNCERTAINTY * near[rows] >= _off_neighbours(values)[rows])


def _off_neighbours(values: Array) -> Array:
    """How far each reading is from what the four nearest readings say."""
    return SCALE * np.nan_to_num(np.abs(surprise(values)))


def _close_together(values: Array, apart: float) -> list[int]:
    """Rows of wild readings beside a missing one or another that is wild, where those around agree without them.

    Of a stretch whose readings are all out of line with their neighbours, the readings that are off the cubic through
    three on each side of it.
    """
    rows = np.flatnonzero(np.isfinite(values))
    off_line = np.nan_to_num(np.abs(surprise(values[rows]))) * SCALE
    astray = off_line > ASTRAY * apart
    astray[1:-1] |= astray[:-2] & astray[2:]
    edges = np.flatnonzero(np.diff(np.concatenate(([False], astray, [False])).astype(int)))
    usual = float(np.median(np.diff(rows))) if rows.size > 1 else 1.0
    found: list[int] = []
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if off_line[first:last].max() < apart or last - first > REACH or not SIDE <= first < last <= rows.size - SIDE:
            continue
        stretch = rows[first - SIDE : last + SIDE]
        if np.diff(stretch).max() > 3.0 * usual:  # what stands on the far side of a pause is no neighbour
            continue
        wild = _off_the_others(values[stretch], stretch, apart)
        runs = np.split(wild, np.flatnonzero(np.diff(wild) > 1) + 1)
        if 0 < wild.size <= MOST and max(run.size for run in runs) <= ADJACENT:
            found += wild.tolist()
    return found


def _off_the_others(y: Array, rows: Rows, apart: float) -> Rows:
    """Rows of a stretch that are off the cubic through SIDE readings on each side; none where the sides disagree."""
    time = (rows - rows[0]).astype(np.float64)
    sides = [slice(None, SIDE), slice(-SIDE, None)]
    around = np.concatenate([np.arange(y.size)[s] for s in sides])
    inside = np.arange(SIDE, y.size - SIDE)
    cubic = np.polyfit(time[around], y[around], 3)
    off = np.abs(y[inside] - np.polyval(cubic, time[inside]))
    (t0, t1), (y0, y1) = ([float(v[s].mean()) for s in sides] for v in (time, y))
    slope = np.mean([np.polyfit(time[s], y[s], 1)[0] for s in sides])
    if abs(y1 - y0 - slope * (t1 - t0)) > 0.5 * off.max():  # a step, not a reading
        return rows[:0]
    return np.asarray(rows[inside[(off > apart) & (off > 0.5 * off.max())]])


def _neighbours_agree(values: Array, k: int, apart: float) -> bool:
    """The two readings on each side, without the one between, change evenly."""
    if not 2 <= k < values.size - 2:
        return False
    left, right = values[k - 2 : k], values[k + 1 : k + 3]
    slope = (right[0] - left[1]) / 2.0
    bends = (left[1] - left[0] - slope, right[1] - right[0] - slope)
    middle = abs(values[k] - 0.5 * (left[1] + right[0]))
    return bool(max(map(abs, bends)) < 0.5 * min(middle, apart) or max(map(abs, bends)) < 0.25 * middle)


def _answering(log: Log) -> Flags:
    """Rows at which an input has just jumped, or that have such a row as a neighbour."""
    jumps = np.zeros(log.rows)
    for values in log.inputs.values():
        change = np.abs(np.diff(values, prepend=values[0]))
        jumps += (change > JUMP * np.ptp(values)) & (change > 8.0 * np.median(change))
    after = max(5, round(ANSWER / log.step))
    near = np.convolve(jumps, np.ones(after + 3))[2 : 2 + log.rows]
    return np.asarray(near > 0.5)
