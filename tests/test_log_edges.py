"""What becomes of lost rows and pauses of a log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.arrays import Array
from cosim.logs.log import Log, fill_holes, stretches


def log_of(time: Array, inputs: Any = None, outputs: Any = None) -> Log:
    return Log(Path("a.csv"), time, inputs or {}, outputs or {}, {}, 0.02, {}, {})


def without(log: Log, rows: Any) -> Log:
    keep = np.setdiff1d(np.arange(log.rows), rows)
    pick = lambda table: {name: values[keep] for name, values in table.items()}  # noqa: E731
    return replace(log, time=log.time[keep], inputs=pick(log.inputs), outputs=pick(log.outputs))


# -- lost rows --------------------------------------------------------------------------------------


def test_lost_rows_are_put_on_the_line_of_an_input_that_runs_smoothly_and_held_otherwise() -> None:
    k, lost = np.arange(60), [20, 41, 42, 43]
    smooth, held = k**2 / 9.0, np.repeat(np.arange(12.0), 5)
    found = fill_holes(without(log_of(0.02 * k, {"u": smooth, "v": held}, {"y": 1.0 * k}), lost))
    assert found.time == pytest.approx(0.02 * k)
    assert found.inputs["v"][lost].tolist() == [3, 8, 8, 8]
    assert found.inputs["u"][lost] == pytest.approx(np.interp(lost, np.delete(k, lost), np.delete(smooth, lost)))
    assert np.flatnonzero(np.isnan(found.outputs["y"])).tolist() == lost
    for whole in (found, without(log_of(0.02 * k, {"v": held}, {"y": 1.0 * k}), [20])):  # the other has only held ones
        assert fill_holes(whole) is whole


def test_a_log_is_cut_where_rows_or_readings_pause() -> None:
    log = log_of(0.02 * np.arange(200), {}, {"y": np.sin(0.05 * np.arange(200))})
    assert stretches(log) == [log]
    parts = stretches(without(log, range(80, 110)))
    assert [(p.rows, p.time[0]) for p in parts] == [(80, 0.0), (90, pytest.approx(2.2))]
    assert len(stretches(without(log, range(80, 104)))) == 1  # 0.5 s from row to row
    k = np.arange(200)
    for seen, rows in (
        ((k < 80) | (k >= 110), [80, 90]),
        (k % 40 == 0, [200]),  # every 0.8 s: slow, no pause
        ((k >= 50) & (k < 150), [100]),  # nothing for a second before and after: these rows are no part
        ((k >= 30) & (k < 180), [170]),  # nothing for 0.6 and 0.4 s
    ):
        y = np.where(seen, 1.0, np.nan)
        assert [part.rows for part in stretches(replace(log, outputs={"y": y}))] == rows
