"""Single values far from what their neighbours say: a recorder's, not a sensor's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cosim.arrays import Array, Flags, Rows
from cosim.logs.log import Log
from cosim.logs.noise import noise_level, surprise

JUMP = 0.05  # of the range of an input, and 8 times its usual change, that an output may answer by a kink
ANSWER = 0.1  # [s] after the jump, and 5 rows, in which it does
SCALE = (70 / 36) ** 0.5  # of what four equal neighbours do not say, to the noise
WILD = 12.0  # times the noise, from which a value out of line is left out


def out_of_line(log: Log, values: Array, least: float, *, answers: bool = True) -> tuple[Rows, Array]:
    """Rows that are further off their neighbours than `least`, and how far every row is.

    With `answers`, not where an input jumps: an output may answer.
    """
    place = np.concatenate(([0], np.cumsum(np.minimum(np.diff(log.grid), 5))))
    whole = np.full(place[-1] + 1, np.nan)
    whole[place] = values  # what stands on the far side of a pause is no neighbour
    seen = np.pad(np.isfinite(whole), 2)
    beside = np.lib.stride_tricks.sliding_window_view(seen, 5).all(axis=1)  # a slower sensor may miss motion
    off = SCALE * np.abs(np.nan_to_num(np.where(beside, surprise(whole), 0.0)[place]))
    if answers:
        off[_answering(log)] = 0.0
    around = np.max([np.roll(off, k) for k in (-2, -1, 1, 2)], axis=0)
    return np.flatnonzero((off > least) & (off >= around)), off


def cleaned(log: Log) -> tuple[Log, dict[str, int]]:
    """The log without readings wildly out of line, and how many each channel loses.

    A reading is wild where its neighbours agree among themselves when it is left out, and it is far from them.
    """
    outputs, lost = dict(log.outputs), dict[str, int]()
    for name, values in log.outputs.items():
        level = noise_level(values) * SCALE
        if not level > 0.0:
            continue
        rows, _ = out_of_line(log, values, WILD * level, answers=False)
        alone = [k for k in rows.tolist() if _neighbours_agree(values, k, WILD * level)]
        if alone:
            kept = values.copy()
            kept[alone] = np.nan
            outputs[name], lost[name] = kept, len(alone)
    return (replace(log, outputs=outputs), lost) if lost else (log, {})


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
