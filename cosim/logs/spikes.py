"""Outliers of the recorder: single readings that neither their neighbours nor the model explain.

`check`, `replay` and `refine` use the same rule. A reading is suspect if its neighbours agree with each other and the
reading is far from them. A suspect reading is kept if the model changes as sharply, for example with an inrush current.
Without a model, a suspect reading is kept directly after a jump of an input.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from cosim.core.arrays import Array, NamedArrays, Rows
from cosim.logs.log import Log, noise_level, surprise

MIN_JUMP_SHARE = 0.05  # share of an input's range, and 8 times its usual change, that may cause a kink
RESPONSE_S = 0.1  # [s] after the jump, and 5 rows, for the response
DEVIATION_SCALE = (70 / 36) ** 0.5  # deviation from four equal neighbours relative to the noise
WILD = 12.0  # multiple of the noise from which a reading is suspect
MOST, ADJACENT = 3, 2  # outliers in a group, and in sequence; more are motion
REACH, SIDE = 12, 3  # readings that a group may affect; readings on each side for comparison
ASTRAY = 0.4  # share of WILD that suffices for members of a group, since two in a row partly hide each other
UNCERTAINTY, LATENESS = 2.0, 2  # uncertainty of a sharp prediction: factor of its size, and rows of its time

Spikes = Mapping[str, Rows]
Prediction = Callable[[Spikes], NamedArrays]  # model outputs by name, computed without suspect readings


def find_spikes(log: Log, predict: Prediction | None = None) -> dict[str, Rows]:
    """Return the outlier rows of each channel.

    Args:
        predict: Function that returns model outputs in the rows of the log; called only if readings are suspect.
    """
    suspects = {name: rows for name, values in log.outputs.items() if (rows := _suspects(values)).size}
    if not suspects:
        return {}
    model = {} if predict is None else predict(suspects)
    jumps = np.zeros(log.rows)
    for values in log.inputs.values():
        change = np.abs(np.diff(values, prepend=values[0]))
        jumps += (change > MIN_JUMP_SHARE * np.ptp(values)) & (change > 8.0 * np.median(change))
    after = max(5, round(RESPONSE_S / log.step))
    after_jumps = np.convolve(jumps, np.ones(after + 3))[2 : 2 + log.rows] > 0.5
    spikes = {}
    for name, rows in suspects.items():
        genuine = after_jumps[rows]
        if predict is not None and name not in model:
            genuine = np.zeros(rows.size, bool)
        elif predict is not None:  # near sharp motion of the model
            values, predicted = log.outputs[name], model[name]
            moving = np.where(np.isfinite(values) & np.isfinite(predicted), predicted, np.nan)
            motion, deviation = (DEVIATION_SCALE * np.nan_to_num(np.abs(surprise(each))) for each in (moving, values))
            near = np.lib.stride_tricks.sliding_window_view(np.pad(motion, LATENESS), 2 * LATENESS + 1).max(axis=1)
            genuine = UNCERTAINTY * near[rows] >= deviation[rows]
        if not genuine.all():
            spikes[name] = rows[~genuine]
    return spikes


def drop_outliers(log: Log, spikes: Spikes) -> Log:
    """Return the log with outliers replaced by NaN."""
    outputs = dict(log.outputs)
    for name, rows in spikes.items():
        outputs[name] = outputs[name].copy()
        outputs[name][rows] = np.nan
    return replace(log, outputs=outputs) if spikes else log


def out_of_line(log: Log, values: Array) -> Array:
    """Return the deviation of each reading from its neighbours; 0 with too few neighbours."""
    place = np.concatenate(([0], np.cumsum(np.minimum(np.diff(log.grid), 5))))
    whole = np.full(place[-1] + 1, np.nan)
    whole[place] = values  # readings beyond a pause do not count as neighbours
    measured = np.pad(np.isfinite(whole), 2)
    complete = np.lib.stride_tricks.sliding_window_view(measured, 5).all(axis=1)  # a slower sensor may miss motion
    return np.asarray(DEVIATION_SCALE * np.abs(np.nan_to_num(np.where(complete, surprise(whole), 0.0)[place])))


def _suspects(values: Array) -> Rows:
    """Return the rows of outliers, alone or in groups.

    Among consecutive deviating readings, outliers are those that deviate from the cubic through three readings on each
    side.
    """
    rows, limit = np.flatnonzero(np.isfinite(values)), WILD * DEVIATION_SCALE * noise_level(values)
    if not limit > 0.0:
        return rows[:0]
    deviation = np.nan_to_num(np.abs(surprise(values[rows]))) * DEVIATION_SCALE
    astray = deviation > ASTRAY * limit
    astray[1:-1] |= astray[:-2] & astray[2:]
    edges = np.flatnonzero(np.diff(np.concatenate(([False], astray, [False])).astype(int)))
    usual = float(np.median(np.diff(rows))) if rows.size > 1 else 1.0
    outliers: list[int] = []
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if deviation[first:last].max() < limit or last - first > REACH or not SIDE <= first < last <= rows.size - SIDE:
            continue
        stretch = rows[first - SIDE : last + SIDE]
        if np.diff(stretch).max() > 3.0 * usual:  # readings beyond a pause do not count as neighbours
            continue
        wild = _rows_off_cubic(values[stretch], stretch, limit)
        runs = np.split(wild, np.flatnonzero(np.diff(wild) > 1) + 1)
        if 0 < wild.size <= MOST and max(run.size for run in runs) <= ADJACENT:
            outliers += wild.tolist()
    return np.array(outliers, np.intp)


def _rows_off_cubic(y: Array, rows: Rows, limit: float) -> Rows:
    """Return the rows whose readings y deviate by more than `limit` from a cubic; none at a step.

    The cubic is fitted to SIDE readings on each side. Readings with less than half of the largest deviation do not
    count, because an outlier also moves the cubic.
    """
    time = (rows - rows[0]).astype(np.float64)
    sides = [slice(None, SIDE), slice(-SIDE, None)]
    around = np.concatenate([np.arange(y.size)[s] for s in sides])
    inside = np.arange(SIDE, y.size - SIDE)
    cubic = np.polyfit(time[around], y[around], 3)
    deviation = np.abs(y[inside] - np.polyval(cubic, time[inside]))
    (t0, t1), (y0, y1) = ([float(v[s].mean()) for s in sides] for v in (time, y))
    slope = np.mean([np.polyfit(time[s], y[s], 1)[0] for s in sides])
    if abs(y1 - y0 - slope * (t1 - t0)) > 0.5 * deviation.max():  # a step, not an outlier
        return rows[:0]
    return np.asarray(rows[inside[(deviation > limit) & (deviation > 0.5 * deviation.max())]])
