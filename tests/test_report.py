"""The report: complete in itself, safe with any name, honest about what the data show."""

from __future__ import annotations

import base64
import json
import math
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lxml import html

from cosim.core.arrays import Array
from cosim.files.results import Results
from cosim.report.charts import Charts
from cosim.report.panels import Panel, Trace
from cosim.simulation.report.recorded import Run
from cosim.simulation.report.run_page import judged_panels, write_report
from fmus.report.craft import find_crafts, reference_track, responses, true_track
from tests.seen import faults

PLANT = """x y x_world y_world psi phi vx vy psi_dot phi_dot ax thrust_right thrust_left tilt_right_actual
    tilt_left_actual duty_right duty_left tilt_right tilt_left"""
CONTROLLER = """psi psi_dot ax x_ref psi_ref duty_right duty_left tilt_right tilt_left x_hat vx_hat psi_hat
    psi_dot_hat a_hat x_sigma psi_sigma"""
UNITS = {
    **dict.fromkeys(("x", "x_hat", "x_sigma", "x_ref"), "m"),
    **dict.fromkeys(("psi", "psi_hat", "psi_ref"), "rad"),
}
HOSTILE = "</script><script>alert(1)</script>"


def craft_run(seconds: float = 30.0, plant: str = "plant", control: str = "controller") -> Results:
    """A craft that drives 1 m forward from t = 1 s along world X."""
    t: Array = np.arange(round(seconds / 0.02) + 1).astype(np.float64) * 0.02
    way = np.where(t < 1, 0.0, 1 - np.exp(-2 * (t - 1)))
    parts = ((plant, PLANT), (control, CONTROLLER))
    columns = {f"{part}.{name}": np.zeros(t.size) for part, names in parts for name in names.split()}
    columns[f"{plant}.x"] = columns[f"{plant}.x_world"] = columns[f"{control}.x_hat"] = way
    columns[f"{control}.x_sigma"] = 0.05 * np.sqrt(t)
    columns[f"{control}.x_ref"] = np.where(t < 1, 0.0, 1.0)
    units = {name: UNITS.get(name.partition(".")[2], "") for name in columns}
    return Results(t, tuple(columns), np.column_stack(list(columns.values())), units)


def manifest(**changes: Any) -> dict[str, Any]:
    scenario = {
        "name": "forward",
        "components": {"controller": {"fmu": "controller.fmu", "start": {"tilt_max": "12 deg"}}},
        "connections": [
            {"from": "plant.psi", "to": "controller.psi", "noise": {"variance": 2.613e-5, "bias": 0.0}},
            {"from": "controller.tilt_right", "to": "plant.tilt_right"},
        ],
    }
    return {"scenario": scenario, "seed": 7, "status": "ok"} | changes


def page(tmp_path: Path, results: Results, record: dict[str, Any]) -> str:
    write_report(tmp_path / "report.html", results, record)
    return (tmp_path / "report.html").read_text(encoding="utf-8")


def embedded(text: str) -> dict[str, Any]:
    """What the page has for its script, with the columns of its charts as arrays."""
    found = re.search(r'<script type="application/json" id="run-data">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    data: dict[str, Any] = json.loads(found.group(1), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    return data | {"columns": columns(data)}


def columns(data: dict[str, Any]) -> list[Array]:
    """The columns as the page's script reads them."""
    raw, at, found = np.frombuffer(zlib.decompress(base64.b64decode(data["packed"])), np.uint8), 0, list[Array]()
    for rows, decimals, has_gaps in data["columns"]:
        planes = raw[at : at + 7 * rows].reshape(7, rows).astype(np.float64)
        zigzag = np.sum(planes * 256.0 ** np.arange(7)[:, None], axis=0)
        values = np.cumsum(np.where(zigzag % 2, -(zigzag + 1) / 2, zigzag / 2)) / 10.0**decimals
        at += 7 * rows
        if has_gaps:
            values[raw[at : at + rows] == 0] = np.nan
            at += rows
        found.append(values)
    return found


def changed(results: Results, column: str, values: Any, rows: slice = slice(None)) -> Results:
    table = results.values.copy()
    table[rows, results.columns.index(column)] = values
    return Results(results.time, results.columns, table, results.units)


def only_craft(results: Results, **changes: Any) -> Any:
    (craft,) = find_crafts(Run(results, manifest(**changes)))
    return craft


def test_a_page_loads_nothing_and_names_never_become_markup(tmp_path: Path) -> None:
    record = manifest(warnings=[HOSTILE], status=f"failed: {HOSTILE}", fmus={HOSTILE: {"guid": HOSTILE}})
    record["scenario"] |= {"name": HOSTILE, "description": HOSTILE}
    record["scenario"]["connections"].append({"from": HOSTILE, "to": HOSTILE})
    text = page(tmp_path, craft_run(2.0, plant="<i>p", control='"><i>c'), record)
    elements = [*html.fromstring(text).iter("*")]
    assert [element.tag for element in elements if element.tag in {"script", "i"}] == ["script"] * 2  # data, its own
    loaded = [e.get(name, "#") for e in elements for name in ("src", "href", "data", "poster", "srcset")]
    assert [target for target in loaded if not target.startswith(("#", "data:"))] == []
    assert re.search(r"https?://|@import|url\(|fetch\(|XMLHttpRequest|import\(", text) is None


def test_embedded_data_is_json_that_matches_the_run(tmp_path: Path) -> None:
    results = changed(craft_run(4.0), "plant.vx", np.nan, slice(50, 60))
    data = embedded(page(tmp_path, results, manifest()))
    # Forward along world X is up: −1000 mm at the end, within the rounding to whole millimetres.
    assert data["crafts"][0]["true"][1][-1] == pytest.approx(-1000 * results["plant.x_world"][-1], abs=0.5)
    speed = next(c for c in data["charts"] if c["title"] == "Forward speed")
    (shown,) = (data["columns"][t["y"]] for t in speed["traces"] if t["style"] == "true")
    assert np.isnan(shown).nonzero()[0].tolist() == [*range(50, 60)]


def test_a_page_has_every_row_to_five_digits() -> None:
    rng = np.random.default_rng(3)
    time, noise = np.cumsum(rng.uniform(1e-4, 0.1, 3000)), rng.normal(size=3000)
    signals = {
        "huge": 1e12 * noise,
        "tiny": 1e-12 * noise,
        "pressure": 101325.0 + 0.01 * noise,  # moves little beside its size
        "gaps": np.where(rng.random(3000) < 0.3, np.nan, noise),
        "none": np.full(3000, np.nan),
        "zero": np.zeros(3000),
        "steps": np.repeat(rng.integers(-(10**6), 10**6, 30), 100).astype(np.float64),
    }
    charts = Charts()
    charts.over(time).plots([Panel("All", "1", [Trace(name, values, "true") for name, values in signals.items()])])
    t, *found = columns(json.loads(charts.data()))
    assert np.abs(t - time).max() < 1e-6
    for (name, values), read in zip(signals.items(), found, strict=True):
        good = np.isfinite(values)
        assert np.array_equal(np.isfinite(read), good), name
        if good.any() and np.ptp(values[good]) > 0:
            finest = min(1e-5 * np.abs(values[good]).max(), 1e-3 * np.ptp(values[good]))
            assert np.abs(read - values)[good].max() <= 5.01 * finest, name


def test_forward_is_up_a_left_turn_turns_left_and_a_reference_path_follows_the_reference_heading() -> None:
    results = changed(craft_run(1.0), "plant.psi", math.pi / 2)
    results = changed(changed(results, "plant.x_world", 2.0), "plant.y_world", 1.0)
    # 1 m to the left and 2 m forward; SVG turns clockwise, so a left turn is negative.
    assert true_track(only_craft(results)).drawn(np.arange(1)) == [[-1000], [-2000], [-90]]
    track = reference_track(only_craft(changed(craft_run(4.0), "controller.psi_ref", -math.pi / 2)))
    assert track is not None
    # A right turn, then 1 m forward: world Y, which points left, falls to −1.
    assert (track.x[-1], track.y[-1]) == pytest.approx((0.0, -1.0), abs=1e-12)


@pytest.mark.parametrize("rows", [0, 1])
def test_a_run_of_a_few_rows_gives_a_page(tmp_path: Path, rows: int) -> None:
    whole = craft_run(1.0)
    results = Results(whole.time[:rows], whole.columns, whole.values[:rows], whole.units)
    assert embedded(page(tmp_path, results, manifest(status="failed")))["groups"][0]["of"] == rows


def test_a_manifest_may_lack_anything(tmp_path: Path) -> None:
    for record in ({}, {"scenario": {"components": {"controller": {"start": {"tilt_max": "wide"}}}}}):
        assert "<h1>Run</h1>" in page(tmp_path, craft_run(1.0), record)


@pytest.mark.thorough
def test_nothing_serious_hinders_who_uses_keys_or_sees_little_in_the_page_of_a_run(tmp_path: Path) -> None:
    page(tmp_path, craft_run(10.0), manifest())
    assert faults(tmp_path / "report.html", dark=True) == []


def test_settling_is_measured_from_the_last_step() -> None:
    (answer,) = responses(only_craft(craft_run(10.0)), "x")
    # 1 − e^(−2t) enters ±0.02 at t = ln(50)/2; the last sample outside lies at most one step before.
    assert answer.time == pytest.approx(1.0)
    assert 0 <= math.log(50) / 2 - answer.settling <= 0.02


def test_a_page_with_criteria_draws_the_judged_signals_first_the_missed_ones_before(tmp_path: Path) -> None:
    goals: list[dict[str, Any]] = [
        {"kind": "peak", "of": "tank.flow", "value": 1.0, "max": 4.0, "unit": "m3/s", "met": True},
        {"kind": "final_error", "of": "tank.level", "to": 0.5, "value": 0.5, "max": 0.1, "unit": "m", "met": False},
    ]
    names = ("tank.flow", "tank.level", "tank.other")
    results = Results(np.arange(3.0), names, np.ones((3, 3)), {"tank.level": "m"})
    panels = judged_panels(Run(results, {"criteria": goals}))
    assert [(p.title, p.limits) for p in panels] == [("tank.level", (0.4, 0.6)), ("tank.flow", (4.0,))]
    charts = embedded(page(tmp_path, results, {"criteria": goals}))["charts"]
    assert [chart["title"] for chart in charts] == ["tank.level", "tank.flow", "tank"]


def test_items_of_an_enumeration_are_read_by_their_names_and_of_very_many_signals_the_first_are_drawn(
    tmp_path: Path,
) -> None:
    names = ("a.gear", *(f"a.y{k}" for k in range(1003)))
    results = Results(np.arange(2.0), names, np.ones((2, 1004)), {}, whole=frozenset({"a.gear"}))
    data = embedded(page(tmp_path, results, {"items": {"a.gear": {"first": 1, "second": 2}}}))
    traces = {trace["label"]: trace for chart in data["charts"] for trace in chart["traces"]}
    assert sorted(traces) == sorted(names[:1000])
    assert (traces["a.gear"]["items"], traces["a.gear"]["form"]) == ({"1": "first", "2": "second"}, "held")
