"""A comparison at its edges: exactly at a tolerance, at times that are all but one, in every sentence it may say."""

from __future__ import annotations

import itertools
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.comparison.differences import Compared, compare_runs
from cosim.comparison.several import RunSource
from cosim.comparison.workflow import compare
from cosim.simulation.run_files import RecordedRun
from cosim.storage.results import Results

TIME = np.linspace(0.0, 1.0, 101)
EPS = float(np.finfo(float).eps)


def ran(
    name: str, time: Array = TIME, /, text: Any = None, units: Any = None, criteria: Any = (), **signals: Any
) -> RecordedRun:
    table = (
        np.column_stack([np.broadcast_to(v, time.shape) for v in signals.values()])
        if signals
        else np.zeros((time.size, 0))
    )
    results = Results(time, tuple(signals), table, units or {}, exact=text or {})
    return RecordedRun(Path(name), name, results, {"criteria": list(criteria)})


def held(a: Any, b: Any, tolerance: float | None = None, absolute: float = 0.0) -> Compared:
    return compare_runs(ran("a", x=a), ran("b", x=b), tolerance, absolute)


def test_a_difference_of_the_tolerance_itself_is_within_it() -> None:
    a = 4.0 * TIME
    b = a + np.where(TIME == 0.0, 1.0, 0.0)
    for tolerance, absolute in ((0.25, 0.0), (0.0, 1.0), (0.125, 0.5)):
        assert held(a, b, tolerance, absolute).same
        assert not held(a, b, tolerance * (1 - 1e-9), absolute * (1 - 1e-9)).same


def test_largest_rms_scale_and_share_are_their_formulas() -> None:
    rows = np.arange(101.0)
    (found,) = held(0.04 * rows - 1.0, 0.04 * rows - 1.0 + np.where(rows % 10 == 0, -0.5, 0.0)).differences
    assert (found.largest, found.scale, found.share, found.at) == (
        pytest.approx(0.5), pytest.approx(4.0), pytest.approx(0.125), found.at,
    )  # fmt: skip
    assert round(100 * found.at) % 10 == 0
    assert found.rms == pytest.approx(0.5 * math.sqrt(11 / 101))
    assert held(np.full(101, -3.0), np.full(101, -3.3)).differences[0].share == pytest.approx(0.1)
    assert held(0.0, 0.25).differences[0].share == 0.25  # a signal that is zero has no size: 1 in its unit
    (found,) = held(np.where(TIME > 0.5, np.nan, 2.0 * TIME), TIME).differences
    assert (found.scale, found.largest, found.rms) == (pytest.approx(1.0), math.inf, math.inf)


def test_a_change_of_unit_there_and_back_is_no_difference_and_a_little_more_is() -> None:
    degrees = np.linspace(1.0, 100.0, 101)
    radians = ran("a", units={"x": "rad"}, x=np.radians(degrees))
    assert compare_runs(radians, ran("b", units={"x": "deg"}, x=degrees), 0.0).same
    found = compare_runs(radians, ran("b", units={"x": "deg"}, x=degrees * (1.0 + 20 * EPS)), 0.0)
    assert not found.same
    assert found.differences[0].note == "deg in b, converted"
    for size in (1e-6, 1e6):  # rounding is a share of the value, however large that is
        small = ran("a", units={"x": "rad"}, x=size * np.radians(degrees))
        assert compare_runs(small, ran("b", units={"x": "deg"}, x=size * degrees), 0.0).same
        off = size * degrees * (1.0 + 20 * EPS)
        assert not compare_runs(small, ran("b", units={"x": "deg"}, x=off), 0.0).same
    # without a change of unit the last bit counts
    assert not held(degrees, degrees * (1.0 + EPS), 0.0).same


def test_signals_after_one_that_cannot_be_compared_are_compared() -> None:
    a = ran("a", text={"mode": ["on"] * 101}, units={"x": "m", "y": "s"}, x=TIME, y=TIME)
    b = ran("b", text={"mode": ["on"] * 50 + ["off"] * 51}, units={"x": "kg", "y": "s"}, x=TIME, y=TIME + 1.0)
    found = compare_runs(a, b, 0.1)
    assert [d.name for d in found.differences] == ["x", "y", "mode"]
    x, y, mode = found.differences
    assert (x.alike, x.beyond, y.largest, y.beyond) == (False, True, 1.0, True)
    assert (mode.largest, mode.at, mode.rms, mode.share, mode.beyond) == (1.0, 0.5, 1.0, 1.0, True)
    assert [d.beyond for d in compare_runs(a, b).differences] == [False, False, False]
    assert found.reasons == ["2 signals beyond the tolerance", "x is in m in one, in kg in the other"]


def test_a_spike_between_rows_counts_by_its_size_and_its_time() -> None:
    fine = np.linspace(0.0, 1.0, 1001)
    spike = 2.0 * fine + np.where(np.arange(1001) == 505, 0.5, 0.0)
    found = compare_runs(ran("a", x=2.0 * TIME), ran("b", fine, x=spike), 0.2)
    (one,) = found.differences
    # the rows of a around 0.505 s say 1.00 … 1.02
    assert (one.largest, one.at, one.share, one.beyond) == (pytest.approx(0.49), 0.505, pytest.approx(0.245), True)
    assert one.note == "between rows of a"
    assert compare_runs(ran("a", x=2.0 * TIME), ran("b", fine, x=spike), 0.25).same
    assert compare_runs(ran("a", x=2.0 * TIME), ran("b", fine, x=spike), 0.0, 0.5).same


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_a_tolerance_that_is_none_is_refused(value: float, tmp_path: Path) -> None:
    sources = [RunSource(name, Path(name), partial(ran, name, x=TIME)) for name in "abc"]
    for count, option in itertools.product((2, 3), ("tolerance", "absolute")):
        with pytest.raises(InputError):
            compare(sources[:count], tmp_path / "out", as_pair=count == 2, **{option: value})  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()
