"""What is said of a log on both sides of each limit: its clock, its inputs, its outputs, readings out of line."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.arrays import Array
from cosim.logs.gate import frame_findings, gate
from cosim.logs.log import Finding, Log, fill_holes, stretches

NOISE = 0.01


def log_of(time: Array, inputs: Any = None, outputs: Any = None, step: float = 0.02, **more: Any) -> Log:
    inputs, outputs = inputs or {}, outputs or {}
    units = dict.fromkeys((*inputs, *outputs, "v"), "m") | more.pop("units", {})
    return Log(
        Path("a.csv"), time, inputs, outputs, units, step, more.pop("written", {}), more.pop("unwrapped", {}), **more
    )


def moving(rows: int = 1500, step: float = 0.02, seed: int = 1, **more: Any) -> Log:
    rng, k = np.random.default_rng(seed), np.arange(rows)
    u = np.sin(0.11 * k) + 0.5 * np.sin(0.37 * k)
    return log_of(step * k, {"u": u}, {"y": np.sin(0.05 * k) + NOISE * rng.standard_normal(rows)}, step, **more)


def kinds(log: Log, rate: float | None = None, **more: Any) -> dict[str, Finding]:
    return {f.kind: f for f in gate(log, rate, **more)}


def without(log: Log, rows: Any) -> Log:
    keep = np.setdiff1d(np.arange(log.rows), rows)
    pick = lambda table: {name: values[keep] for name, values in table.items()}  # noqa: E731
    return replace(log, time=log.time[keep], inputs=pick(log.inputs), outputs=pick(log.outputs))


# -- the clock --------------------------------------------------------------------------------------


def test_rows_that_are_missing_are_counted_in_their_places() -> None:
    log = moving()
    found = kinds(without(log, [100, 200, 201, 202]))["dropouts"].numbers
    assert found == {"rows": 4, "places": 2, "first": pytest.approx(99 * 0.02), "longest": pytest.approx(0.08)}
    pause = kinds(without(log, range(100, 125)))  # 0.52 s without a row
    assert "dropouts" not in pause
    assert pause["gaps"].numbers == {
        "rows": 25,
        "places": 1,
        "first": pytest.approx(1.98),
        "longest": pytest.approx(0.52),
    }
    assert "gaps" not in kinds(without(log, range(100, 123)))  # 0.48 s
    both = kinds(without(log, [50, *range(100, 130)]))
    assert (both["dropouts"].numbers["rows"], both["gaps"].numbers["rows"]) == (1, 30)
    assert not {"dropouts", "gaps"} & kinds(log).keys()


@pytest.mark.parametrize(
    ("ratio", "severity"),
    [
        (1.0, None),
        (1.01, None),
        (1.3, "note"),
        (1.5, "note"),
        (1.6, "warning"),
        (0.5, "note"),
        (0.4, "note"),
        (1 / 49, "note"),
        (1 / 51, "warning"),
        (600.0, "fault"),
        (1900.0, "fault"),
        (2100.0, "warning"),
        (6e5, "fault"),
    ],
)
def test_rows_are_as_far_apart_as_the_steps_of_the_model(ratio: float, severity: Any) -> None:
    found = kinds(moving(), 0.02 / ratio).get("rate")
    assert (found and found.severity) == severity


# -- inputs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rho", "alike"), [(0.97, False), (0.99, True), (-0.97, False), (-0.99, True)])
def test_inputs_that_move_alike_cannot_be_separated(rho: float, alike: bool) -> None:
    k = 2.0 * np.pi * np.arange(1500) / 1500
    u, v = np.sin(20 * k), np.cos(20 * k)
    found = kinds(replace(moving(), inputs={"u": u, "v": rho * u + math.sqrt(1 - rho**2) * v})).get("alike")
    assert (found is not None) is alike
    if found:
        assert found.numbers["correlation"] == pytest.approx(rho, abs=1e-3)


# -- outputs ----------------------------------------------------------------------------------------


def with_output(values: Array, **more: Any) -> Log:
    return replace(moving(values.size, **more), outputs={"y": values})


def test_a_sensor_that_freezes_is_told_from_one_that_rests() -> None:
    y = moving().outputs["y"].copy()
    for rows, frozen in ((9, False), (10, False), (12, True), (300, True)):  # more than 0.2 s, ten rows at least
        stuck = y.copy()
        stuck[400 : 400 + rows] = stuck[400]
        found = kinds(with_output(stuck)).get("frozen")
        assert (found is not None) is frozen
        assert found is None or found.numbers == {"rows": rows, "first": pytest.approx(8.0)}
    for rows, frozen in ((9, False), (10, True)):
        slow = y.copy()
        slow[400 : 400 + rows] = slow[400]
        assert ("frozen" in kinds(replace(with_output(slow), step=0.1))) is frozen


# -- lost rows --------------------------------------------------------------------------------------


def test_lost_rows_are_put_on_the_line_of_an_input_that_runs_smoothly_and_held_otherwise() -> None:
    k = np.arange(60)
    smooth, held = 0.5 * k + np.sin(k / 9.0), np.repeat(np.arange(12.0), 5)
    log = without(log_of(0.02 * k, {"u": smooth, "v": held}, {"y": 1.0 * k}), [20, 41, 42, 43])
    found = fill_holes(log)
    assert found.time == pytest.approx(0.02 * k)
    assert found.inputs["v"][[20, 41, 42, 43]].tolist() == [3, 8, 8, 8]
    assert found.inputs["u"][20] == pytest.approx(0.5 * (smooth[19] + smooth[21]))
    assert found.inputs["u"][41:44] == pytest.approx(
        smooth[40] + (smooth[44] - smooth[40]) * np.array([0.25, 0.5, 0.75])
    )
    assert np.flatnonzero(np.isnan(found.outputs["y"])).tolist() == [20, 41, 42, 43]
    whole = log_of(0.02 * k, {"u": smooth}, {"y": 1.0 * k})
    assert fill_holes(whole) is whole
    assert fill_holes(without(whole, [58])).time == pytest.approx(0.02 * k)
    only_held = without(log_of(0.02 * k, {"v": held}, {"y": 1.0 * k}), [20])
    assert fill_holes(only_held) is only_held


def test_a_log_is_cut_where_rows_or_readings_pause() -> None:
    log = moving(200)
    assert stretches(log) == [log]
    parts = stretches(without(log, range(80, 110)))
    assert [(p.rows, p.time[0]) for p in parts] == [(80, 0.0), (90, pytest.approx(2.2))]
    assert len(stretches(without(log, range(80, 104)))) == 1  # 0.5 s from row to row
    y = log.outputs["y"].copy()
    y[80:110] = np.nan
    assert [p.rows for p in stretches(replace(log, outputs={"y": y}))] == [80, 90]
    y[:] = np.nan
    y[::40] = 1.0  # every 0.8 s: slow, no pause
    assert len(stretches(replace(log, outputs={"y": y}))) == 1
    y[:] = np.nan
    y[50:150] = 1.0  # nothing for a second before and after: these rows are no part
    assert [(p.rows, p.time[0]) for p in stretches(replace(log, outputs={"y": y}))] == [(100, pytest.approx(1.0))]
    y[30:180] = 1.0  # for 0.6 and 0.4 s
    assert [p.rows for p in stretches(replace(log, outputs={"y": y}))] == [170]


# -- frames -----------------------------------------------------------------------------------------


def test_angles_that_no_one_turns_are_taken_for_degrees() -> None:
    t = 0.02 * np.arange(1000)
    for size, told in ((6.2, False), (6.4, True)):
        log = log_of(t, {"tilt": size * np.sin(t)}, {}, units={"tilt": "rad"})
        assert [f.kind for f in frame_findings(log)] == (["degrees"] if told else [])
        assert [f.kind for f in frame_findings(replace(log, written={"tilt": "rad"}))] == []
    for size, told in ((125.0, False), (126.5, True)):
        log = log_of(t, {}, {"psi": size * t / t[-1]}, units={"psi": "rad"})
        assert [f.kind for f in frame_findings(log)] == (["degrees"] if told else [])
    jumpy = log_of(t, {}, {"psi": np.where(t >= 5.0, 3.2, 0.0)}, units={"psi": "rad"})
    (found,) = frame_findings(jumpy)
    assert (found.kind, found.numbers) == ("jumps", {"count": 1.0, "first": pytest.approx(5.0)})
    assert list(frame_findings(replace(jumpy, outputs={"psi": np.where(t >= 5.0, 3.1, 0.0)}))) == []
