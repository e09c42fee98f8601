"""Windows of a replay, row by row; lags and units at both sides of their limits."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.arrays import Array
from cosim.logs.log import Log
from cosim.logs.model_comparison import delay, delays, scales
from cosim.residuals.windows import window_rows


def log_of(time: Array, step: float = 0.02, outputs: Any = None, inputs: Any = None, **more: Any) -> Log:
    named = {"y": np.sin(time)} if outputs is None else outputs
    units = dict.fromkeys((*named, *(inputs or {})), "rad") | more.pop("units", {})
    return Log(Path("a.csv"), time, inputs or {}, named, units, step, more.pop("written", {}), {}, **more)


def seconds(duration: float, step: float = 0.02) -> Array:
    return step * np.arange(round(duration / step) + 1)


# -- windows ----------------------------------------------------------------------------------------


def test_windows_are_consecutive_and_whole_and_begin_after_what_is_skipped() -> None:
    for duration, rows in ((9.98, [100, 200, 300]), (10.0, [100, 200, 300, 400]), (3.96, []), (3.98, []), (4.0, [100])):
        assert window_rows(log_of(seconds(duration)), 2.0) == rows
    assert window_rows(log_of(seconds(3.0)), 0.5, 0.0) == [0, 25, 50, 75, 100, 125]
    assert window_rows(log_of(7.0 + seconds(3.0)), 0.5, 1.5) == [75, 100, 125]
    # half a step short is whole: times of a recorder are rounded
    short = seconds(4.0)
    for early, count in ((0.009, 1), (0.011, 0)):
        assert len(window_rows(log_of(short - early * (np.arange(short.size) == short.size - 1)), 2.0)) == count


# -- against a model --------------------------------------------------------------------------------


def shaken(shift: float = 0.0, noise: float = 0.01, duration: float = 40.0) -> tuple[Log, Array]:
    """A log of a signal of many tones that trails its model by `shift` seconds."""
    t, rng = seconds(duration), np.random.default_rng(7)
    tones = [(2 * math.pi * f, p) for f, p in zip(rng.uniform(0.4, 4.0, 12), rng.uniform(0, 6.28, 12), strict=True)]
    model, measured = (np.sum([np.sin(w * (t - s) + p) for w, p in tones], axis=0) for s in (0.0, shift))
    return log_of(t, outputs={"y": measured + noise * rng.standard_normal(t.size)}), model


@pytest.mark.parametrize("shift", [0.05, -0.05, 0.013, 0.2])
def test_a_delay_is_found_to_a_part_of_a_row(shift: float) -> None:
    log, model = shaken(shift)
    found = delay(log, log.outputs["y"], model)
    assert found is not None
    assert found.time == pytest.approx(shift, abs=max(0.001, 3 * found.error))
    assert 0.02 * log.step <= found.error < 0.005
    (told,) = delays(log, {"y": model})
    assert told.severity == ("warning" if abs(shift) > 0.02 else "note")
    assert told.sentence.startswith("trails" if shift > 0 else "leads")
    assert list(delays(log, {"other": model})) == []


def test_no_delay_is_told_of_less_than_half_a_row_or_of_what_is_unlike() -> None:
    log, model = shaken(0.006)
    assert list(delays(log, {"y": model})) == []
    other = np.random.default_rng(9).standard_normal(model.size)
    assert delay(log, log.outputs["y"], other) is None
    far, model = shaken(0.6)  # beyond the longest
    found = delay(far, far.outputs["y"], model)
    assert found is None or abs(found.time) <= 0.5


@pytest.mark.parametrize(
    ("factor", "kind"),
    [(1.0, None), (-1.0, "sign"), (57.3, "unit"), (40.0, None), (45.0, "unit"), (90.0, None), (4.9, None)],
)
def test_a_signal_in_another_unit_moves_as_the_model_does_but_so_many_times_as_far(factor: float, kind: Any) -> None:
    log, model = shaken()
    log = replace(log, outputs={"y": factor * log.outputs["y"]})
    found = list(scales(log, {"y": model}))
    assert [f.kind for f in found] == ([kind] if kind else [])
    if kind:
        assert found[0].numbers["slope"] == pytest.approx(factor, rel=0.01)
        assert found[0].severity == ("warning" if kind == "sign" else "fault")
    assert list(scales(log, {"y": 0.0 * model})) == []
