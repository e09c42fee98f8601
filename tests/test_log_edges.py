"""What is said of a log on both sides of each limit: clock, inputs, outputs, windows, lags and units of a model."""

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
from cosim.logs.model_comparison import delay, delays, scales
from cosim.residuals.windows import window_rows

NOISE = 0.01


def log_of(time: Array, inputs: Any = None, outputs: Any = None, step: float = 0.02, **more: Any) -> Log:
    inputs, outputs = inputs or {}, outputs or {}
    units = dict.fromkeys((*inputs, *outputs, "v"), "m") | more.pop("units", {})
    return Log(Path("a.csv"), time, inputs, outputs, units, step, {}, {}, **more)


def moving(rows: int = 1500) -> Log:
    rng, k = np.random.default_rng(1), np.arange(rows)
    u = np.sin(0.11 * k) + 0.5 * np.sin(0.37 * k)
    return log_of(0.02 * k, {"u": u}, {"y": np.sin(0.05 * k) + NOISE * rng.standard_normal(rows)})


def kinds(log: Log, rate: float | None = None) -> dict[str, Finding]:
    return {f.kind: f for f in gate(log, rate)}


def without(log: Log, rows: Any) -> Log:
    keep = np.setdiff1d(np.arange(log.rows), rows)
    pick = lambda table: {name: values[keep] for name, values in table.items()}  # noqa: E731
    return replace(log, time=log.time[keep], inputs=pick(log.inputs), outputs=pick(log.outputs))


# -- the clock --------------------------------------------------------------------------------------


def test_rows_that_are_missing_are_counted_in_their_places() -> None:
    log = moving()
    found = kinds(without(log, [100, 200, 201, 202]))["dropouts"].numbers
    assert found == {"rows": 4, "places": 2, "first": pytest.approx(99 * 0.02), "longest": pytest.approx(0.08)}
    pause = kinds(without(log, [50, *range(100, 125)]))  # 0.52 s without a row
    assert pause["dropouts"].numbers["rows"] == 1
    assert (pause["gaps"].numbers["rows"], pause["gaps"].numbers["longest"]) == (25, pytest.approx(0.52))
    assert "gaps" not in kinds(without(log, range(100, 123)))  # 0.48 s
    assert not {"dropouts", "gaps"} & kinds(log).keys()


@pytest.mark.parametrize(
    ("ratio", "severity"),
    [
        (1.01, None),
        (1.5, "note"),
        (1.6, "warning"),
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


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_inputs_that_move_alike_cannot_be_separated(sign: float) -> None:
    k = 2.0 * np.pi * np.arange(1500) / 1500
    for rho, found in ((0.97, None), (0.99, pytest.approx(sign * 0.99, abs=1e-3))):
        v = sign * rho * np.sin(20 * k) + math.sqrt(1 - rho**2) * np.cos(20 * k)
        told = kinds(replace(moving(), inputs={"u": np.sin(20 * k), "v": v})).get("alike")
        assert (told and told.numbers["correlation"]) == found


# -- outputs ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("step", "rows", "is_frozen"),
    [(0.02, 10, False), (0.02, 12, True), (0.02, 300, True), (0.1, 9, False), (0.1, 10, True)],
)
def test_a_sensor_that_freezes_is_told_from_one_that_rests(step: float, rows: int, is_frozen: bool) -> None:
    y = moving().outputs["y"].copy()  # frozen is more than 0.2 s, ten rows at least
    y[400 : 400 + rows] = y[400]
    found = kinds(replace(moving(), outputs={"y": y}, step=step)).get("frozen")
    assert (found is not None) is is_frozen
    assert found is None or found.numbers == {"rows": rows, "first": pytest.approx(8.0)}


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
    log = moving(200)
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


# -- frames -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "size", "found"),
    [("tilt", 6.2, []), ("tilt", 6.4, ["degrees"]), ("psi", 125.0, []), ("psi", 126.5, ["degrees"])],
)
def test_angles_that_no_one_turns_are_taken_for_degrees(name: str, size: float, found: list[str]) -> None:
    t = 0.02 * np.arange(1000)
    if name == "tilt":
        log = log_of(t, {"tilt": size * np.sin(t)}, units={"tilt": "rad"})
    else:
        log = log_of(t, {}, {"psi": size * t / t[-1]}, units={"psi": "rad"})
    assert [f.kind for f in frame_findings(log)] == found
    assert [*frame_findings(replace(log, written={"tilt": "rad", "psi": "rad"}))] == []


# -- windows of a replay ----------------------------------------------------------------------------


def seconds(duration: float) -> Array:
    return 0.02 * np.arange(round(duration / 0.02) + 1)


def test_windows_are_consecutive_and_whole_and_begin_after_what_is_skipped() -> None:
    for duration, rows in ((9.98, [100, 200, 300]), (10.0, [100, 200, 300, 400]), (3.98, []), (4.0, [100])):
        assert window_rows(log_of(seconds(duration)), 2.0) == rows
    assert window_rows(log_of(seconds(3.0)), 0.5, 0.0) == [0, 25, 50, 75, 100, 125]
    assert window_rows(log_of(7.0 + seconds(3.0)), 0.5, 1.5) == [75, 100, 125]
    for early, rows in ((0.009, [100]), (0.011, [])):  # half a step short is whole: times of a recorder are rounded
        time = seconds(4.0)
        time[-1] -= early
        assert window_rows(log_of(time), 2.0) == rows


# -- against a model --------------------------------------------------------------------------------


def shaken(shift: float = 0.0) -> tuple[Log, Array]:
    """A log of a signal of many tones that trails its model by `shift` seconds."""
    t, rng = seconds(40.0), np.random.default_rng(7)
    tones = [(2 * math.pi * f, p) for f, p in zip(rng.uniform(0.4, 4.0, 12), rng.uniform(0, 6.28, 12), strict=True)]
    model, measured = (np.sum([np.sin(w * (t - s) + p) for w, p in tones], axis=0) for s in (0.0, shift))
    return log_of(t, {}, {"y": measured + NOISE * rng.standard_normal(t.size)}, units={"y": "rad"}), model


@pytest.mark.parametrize(("shift", "severity"), [(0.05, "warning"), (-0.05, "warning"), (0.013, "note")])
def test_a_delay_is_found_to_a_part_of_a_row(shift: float, severity: str) -> None:
    log, model = shaken(shift)
    found = delay(log, log.outputs["y"], model)
    assert found is not None
    assert found.time == pytest.approx(shift, abs=max(0.001, 3 * found.error))
    assert 0.02 * log.step <= found.error < 0.005
    assert list(delays(log, {"y": log.outputs["y"]})) == []
    (told,) = delays(log, {"y": model})
    assert (told.severity, told.sentence[:5]) == (severity, "trail" if shift > 0 else "leads")


@pytest.mark.parametrize(
    ("factors", "found"),
    [((1.0, 4.9, 40.0, 90.0), []), ((-1.0,), [("sign", "warning")]), ((45.0, 57.3), [("unit", "fault")])],
)
def test_a_signal_in_another_unit_moves_as_the_model_does_but_so_many_times_as_far(factors: Any, found: Any) -> None:
    log, model = shaken()
    for factor in factors:
        other = replace(log, outputs={"y": factor * log.outputs["y"]})
        told = list(scales(other, {"y": model}))
        assert [(f.kind, f.severity) for f in told] == found
        assert [f.numbers["slope"] for f in told] == [pytest.approx(factor, rel=0.01)] * len(found)
    assert list(scales(log, {"y": 0.0 * model})) == []
