"""The report: complete in itself, safe with any name, honest about what the data show."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.base.arrays import Array
from cosim.report.chart_data import Series, to_json
from cosim.report.drawing import Drawing
from cosim.report.packed import power
from cosim.report.panels import Band, Panel, Trace
from cosim.report.svg import log_axis, make_axis, thin
from cosim.simulation.report import write_figures, write_report
from cosim.simulation.report.figures import sheet
from cosim.simulation.report.recorded import Run
from cosim.simulation.report.run_page import connection_panels, judged_panels, signal_panels
from cosim.simulation.report.run_rows import connections
from cosim.storage.results import Results
from fmus.report.figures_of_run import belief, reference_steps, responses, saturation
from fmus.report.lines import state_panels
from fmus.report.roles import find_crafts
from fmus.report.topview import pose, reference_track, true_track
from tests.seen import faults

ROOT = Path(__file__).parent.parent
PLANT = """x y x_world y_world psi phi vx vy psi_dot phi_dot ax thrust_right thrust_left tilt_right_actual
    tilt_left_actual duty_right duty_left tilt_right tilt_left"""
CONTROLLER = """psi psi_dot ax x_ref psi_ref duty_right duty_left tilt_right tilt_left x_hat vx_hat psi_hat
    psi_dot_hat a_hat x_sigma psi_sigma"""
UNITS = {
    **dict.fromkeys(("x", "x_hat", "x_sigma", "x_ref"), "m"),
    **dict.fromkeys(("psi", "psi_hat", "psi_ref"), "rad"),
}
BELIEFS = ("controller.x_hat", "controller.psi_hat", "controller.x_sigma", "controller.x_ref")
HOSTILE = "</script><script>alert(1)</script>"


def craft_run(
    seconds: float = 30.0, off: float = 0.0, noise: float = 0.0, plant: str = "plant", control: str = "controller"
) -> Results:
    """A craft that drives 1 m forward from t = 1 s along world X; it ends `off` [m] short, unseen by its estimator."""
    t: Array = np.arange(round(seconds / 0.02) + 1).astype(np.float64) * 0.02
    rng = np.random.default_rng(1)
    way = np.where(t < 1, 0.0, 1 - np.exp(-2 * (t - 1)))
    columns = {f"{plant}.{name}": np.zeros(t.size) for name in PLANT.split()}
    columns |= {f"{control}.{name}": np.zeros(t.size) for name in CONTROLLER.split()}
    columns |= {name: column + noise * rng.normal(size=t.size) for name, column in columns.items()}
    columns[f"{plant}.x"] = columns[f"{plant}.x_world"] = way * (1 - off)
    columns[f"{plant}.psi"] = noise * rng.normal(size=t.size)
    columns[f"{control}.x_hat"] = way
    columns[f"{control}.x_sigma"] = 0.05 * np.sqrt(t)
    columns[f"{control}.x_ref"] = np.where(t < 1, 0.0, 1.0)
    units = {name: UNITS.get(name.partition(".")[2], "") for name in columns}
    return Results(t, tuple(columns), np.column_stack(list(columns.values())), units)


def manifest(**changes: Any) -> dict[str, Any]:
    noise = {"variance": 2.613e-5, "bias": 0.0}
    connections = [
        {"from": "plant.psi", "to": "controller.psi", "noise": noise},
        {"from": "controller.tilt_right", "to": "plant.tilt_right"},
    ]
    scenario = {
        "name": "forward",
        "components": {"controller": {"fmu": "controller.fmu", "start": {"tilt_max": "12 deg"}}},
        "connections": connections,
    }
    return {"scenario": scenario, "seed": 7, "status": "ok"} | changes


def page(tmp_path: Path, results: Results, record: dict[str, Any]) -> str:
    write_report(tmp_path / "report.html", results, record)
    return (tmp_path / "report.html").read_text(encoding="utf-8")


def embedded(text: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="run-data">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    data: dict[str, Any] = json.loads(found.group(1), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    return data


def changed(results: Results, column: str, values: Any, rows: slice = slice(None)) -> Results:
    table = results.values.copy()
    table[rows, results.columns.index(column)] = values
    return Results(results.time, results.columns, table, results.units)


class Elements(HTMLParser):
    """Counts elements and collects what they load."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.loads: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loads += [value or "" for name, value in attrs if name in ("src", "href", "data", "poster", "srcset")]


def test_page_loads_nothing(tmp_path: Path) -> None:
    text = page(tmp_path, craft_run(), manifest())
    assert [target for target in Elements(text).loads if not target.startswith(("#", "data:"))] == []
    assert re.search(r"https?://|@import|url\(|fetch\(|XMLHttpRequest|import\(", text) is None


def test_names_never_become_markup(tmp_path: Path) -> None:
    record = manifest(warnings=[HOSTILE], status=f"failed: {HOSTILE}", fmus={HOSTILE: {"guid": HOSTILE}})
    record["scenario"] |= {"name": HOSTILE, "description": HOSTILE}
    record["scenario"]["connections"].append({"from": HOSTILE, "to": HOSTILE})
    results = craft_run(2.0, plant="<i>p", control='"><i>c')
    elements = Elements(page(tmp_path, results, record))
    assert elements.tags.count("script") == 2  # the data and the page's own
    assert "i" not in elements.tags


def test_embedded_data_is_json_that_matches_the_run(tmp_path: Path) -> None:
    results = changed(craft_run(4.0), "plant.vx", np.nan, slice(50, 60))
    data = embedded(page(tmp_path, results, manifest()))
    assert data["few"][-1] == pytest.approx(4.0)
    body = data["crafts"][0]
    assert (len(body["u"]), data["rows"]) == (len(data["few"]), results.time.size)
    # Forward along world X is up: −1000 mm at the end, within the rounding to whole millimetres.
    assert body["v"][-1] == pytest.approx(-1000 * results["plant.x_world"][-1], abs=0.5)
    assert sum(series["g"] for series in data["series"].values()) == 2  # the speed with a gap, and its error


def test_forward_is_up_and_a_left_turn_turns_left() -> None:
    results = changed(craft_run(1.0), "plant.psi", math.pi / 2)
    results = changed(changed(results, "plant.x_world", 2.0), "plant.y_world", 1.0)
    (craft,) = find_crafts(Run(results, manifest()))
    # 1 m to the left and 2 m forward; SVG turns clockwise, so a left turn is negative.
    assert pose(true_track(craft), 0) == "translate(-1000 -2000) rotate(-90.00)"


def test_reference_path_follows_the_reference_heading() -> None:
    results = changed(craft_run(4.0), "controller.psi_ref", -math.pi / 2)
    (craft,) = find_crafts(Run(results, manifest()))
    track = reference_track(craft)
    assert track is not None
    # A right turn, then 1 m forward: world Y, which points left, falls to −1.
    assert (track.x[-1], track.y[-1]) == pytest.approx((0.0, -1.0), abs=1e-12)


@pytest.mark.parametrize(("off", "told"), [(0.0, False), (0.01, False), (0.05, True), (0.4, True)])
def test_a_wandering_craft_is_told_if_and_only_if_it_wanders(tmp_path: Path, off: float, told: bool) -> None:
    text = page(tmp_path, craft_run(off=off), manifest())
    assert ("The estimator believes it has settled; the craft has not." in text) is told


def test_an_estimator_that_has_not_settled_is_not_said_to_believe_it() -> None:
    results = craft_run(off=0.4)
    (craft,) = find_crafts(Run(changed(results, "controller.x_hat", results["plant.x"]), manifest()))
    seen = belief(craft)
    assert seen is not None
    assert seen.true == pytest.approx(0.4, abs=1e-3)  # e^(−2·26) of the approach is left
    assert not seen.wanders


def test_a_craft_that_comes_in_at_the_end_is_not_said_to_wander() -> None:
    late = changed(craft_run(10.0, off=0.4), "plant.x", 0.99, slice(-3, None))
    (craft,) = find_crafts(Run(late, manifest()))
    seen = belief(craft)
    assert seen is not None
    assert math.isfinite(responses(craft, "x")[-1].settling)
    assert not seen.wanders


@pytest.mark.thorough
@pytest.mark.parametrize("rows", [0, 1, 2, 3])
def test_a_run_of_a_few_rows_gives_a_page_and_figures(tmp_path: Path, rows: int) -> None:
    whole = craft_run(1.0)
    results = Results(whole.time[:rows], whole.columns, whole.values[:rows], whole.units)
    text = page(tmp_path, results, manifest(status="failed: plant stopped at t = 0.04 s"))
    assert ("No rows were recorded" in text) is (rows == 0)
    assert embedded(text)["rows"] == rows
    assert len(write_figures(tmp_path / "figures", results, manifest())) == (0 if rows == 0 else 4)


@pytest.mark.thorough
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300, 1e60])
def test_rows_that_are_not_finite_leave_a_gap(tmp_path: Path, bad: float) -> None:
    whole = craft_run(2.0)
    columns = ("plant.x", "plant.x_world", "plant.psi", "plant.thrust_right", "plant.tilt_right", *BELIEFS, None)
    for column in columns:
        results = Results(whole.time, whole.columns, np.full_like(whole.values, bad), whole.units)
        if column is not None:
            results = changed(whole, column, bad, slice(50, 60))
        text = page(tmp_path, results, manifest())
        assert re.search(r'\b(d|transform|style)="[^"]*(nan|inf)', text) is None, column


def test_a_manifest_may_lack_or_garble_anything(tmp_path: Path) -> None:
    garbled = {"scenario": [], "criteria": [1, {}], "warnings": "one", "fmus": 3, "git": None, "timings": {"load": "x"}}
    for record in ({}, garbled, {"scenario": {"components": {"controller": {"start": {"tilt_max": "wide"}}}}}):
        assert "<h1>Run</h1>" in page(tmp_path, craft_run(1.0), record)


def test_thirty_noisy_seconds_stay_small(tmp_path: Path) -> None:
    # Noise on every signal is the worst there is to compress: no level stretches, every digit used.
    assert len(page(tmp_path, craft_run(30.0, noise=0.1), manifest()).encode()) < 600_000


@pytest.mark.thorough
def test_nothing_serious_hinders_who_uses_keys_or_sees_little_in_the_page_of_a_run(tmp_path: Path) -> None:
    page(tmp_path, craft_run(10.0, noise=0.01), manifest())
    assert faults(tmp_path / "report.html", dark=True) == []


@pytest.mark.thorough
def test_half_an_hour_at_50_hz_is_whole_in_a_few_megabytes(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    results = craft_run(1800.0)
    for name in ("plant.psi", "controller.psi", "controller.psi_dot", "controller.ax", "controller.x_hat"):
        results = changed(results, name, results[name] + 0.01 * rng.normal(size=results.time.size))
    text = page(tmp_path, results, manifest())
    assert embedded(text)["rows"] == results.time.size == 90_001
    assert len(text) < 4e6


def test_what_was_sent_and_what_arrived_stand_in_one_chart(tmp_path: Path) -> None:
    time, rng = np.arange(100) * 0.1, np.random.default_rng(1)
    sent = np.sin(time)
    values = np.column_stack([sent, sent + 0.1 * rng.normal(size=100), sent, sent])
    results = Results(time, ("tank.level", "pump.measured", "pump.speed", "tank.speed"), values, {"tank.level": "m"})
    noise = {"variance": 0.01, "bias": 0.0}
    links = [
        {"from": "tank.level", "to": "pump.measured", "noise": noise},
        {"from": "pump.speed", "to": "tank.speed"},
    ]
    results = Results(results.time, results.columns, results.values, {"tank.level": "m", "pump.measured": "m"})
    text = page(tmp_path, results, {"scenario": {"connections": links}})
    run = Run(results, {"scenario": {"connections": links}})
    noisy, same = connection_panels(run, connections(run)).values()
    assert [t.label for t in noisy.traces] == ["pump.measured, σ\u00a0=\u00a00.100\u00a0m", "tank.level"]
    assert [t.label for t in same.traces] == ["pump.speed"]  # one line, where both are the same
    assert "<h2>Connections</h2>" in text
    assert "Other signals" not in text  # all are shown


def test_thinning_keeps_every_peak_and_gap() -> None:
    values = np.zeros(100_000)
    values[[777, 50_001]] = 1.0, -2.0
    values[70_000] = np.nan
    rows = thin(values, 1000)
    assert {0, 777, 50_001, 70_000, 99_999} <= set(rows.tolist())
    assert rows.size <= 1003  # two a bucket, the ends and the gap


def test_figures_of_merit_use_every_row() -> None:
    spike = changed(craft_run(60.0), "plant.x", 1.5, slice(1733, 1734))
    (craft,) = find_crafts(Run(spike, manifest()))
    assert responses(craft, "x")[-1].overshoot == pytest.approx(0.5)


def test_a_step_a_ramp_and_a_hold_are_told_apart() -> None:
    t = np.arange(0, 10, 0.02)
    reference = np.where(t < 2, 0.0, 1.0) + np.clip(t - 5, 0, 2)
    steps = reference_steps(t, reference)
    assert [(t[s.begin], t[s.arrived]) for s in steps] == [
        pytest.approx((0, 0)),
        pytest.approx((2, 2)),
        pytest.approx((5.02, 7), abs=0.021),  # the ramp's first and last change, to a row
    ]
    assert [s.end for s in steps] == [*(s.begin for s in steps[1:]), t.size]


def test_settling_is_measured_from_the_last_step() -> None:
    (craft,) = find_crafts(Run(craft_run(10.0), manifest()))
    (answer,) = responses(craft, "x")
    # 1 − e^(−2t) enters ±0.02 at t = ln(50)/2; the last sample outside lies at most one step before.
    assert answer.time == pytest.approx(1.0)
    assert 0 <= math.log(50) / 2 - answer.settling <= 0.02


def test_a_craft_that_never_arrives_is_not_settled(tmp_path: Path) -> None:
    text = page(tmp_path, craft_run(off=0.4), manifest())
    assert "<dd>not within ±0.02\xa0m</dd>" in text


def test_a_tile_goes_by_the_band_of_the_criterion_so_that_it_does_not_contradict_it(tmp_path: Path) -> None:
    asked = {"kind": "settling_time", "of": "plant.x", "band": 0.5, "value": 1.25, "max": 4.0, "unit": "s", "met": True}
    text = page(tmp_path, craft_run(off=0.4), manifest(criteria=[asked]))  # 0.4 m off for good, within 0.5 m
    assert "The criterion was met." in text
    tile = text.split("Settling of x</dt>")[1].split("</div>")[0]
    assert "1.25\xa0s" in tile
    assert "±0.5\xa0m" in tile
    assert "not settled" not in text


ROWS = """
const data = %s, cells = [{dataset: {key: "k0"}, textContent: ""}], row = {hidden: true, textContent: ""};
globalThis.CustomEvent = class { constructor(name, more) { Object.assign(this, more, {type: name}); } };
globalThis.location = {hash: "#t=%s"};
globalThis.window = {addEventListener() {}};
let rows;
globalThis.document = {
  getElementById: () => ({textContent: JSON.stringify(data)}),
  querySelector: (s) => (s === "#row" ? row : null),
  querySelectorAll: (s) => (s === "[data-key]" ? cells : []),
  documentElement: {style: {setProperty() {}}, classList: {toggle() {}}, dataset: {}}, body: {classList: {add() {}}},
  dispatchEvent: (event) => { if (event.type === "rows") rows = event.detail.data; },
};
(%s).then(() => {
  const columns = Object.values(rows.series).map((s) => [...s.v].map((v) => (Number.isNaN(v) ? null : v)));
  console.log(JSON.stringify([cells[0].textContent, row.hidden, row.textContent, [...rows.t], columns]));
});
"""
with_node = pytest.mark.skipif(shutil.which("node") is None, reason="no node to run the page's script")


def told_by_the_script(series: Series, t: str) -> Any:
    """What the page's script reads out at a time, and every row that it has unpacked."""
    script = (ROOT / "cosim/report/templates/report.js").read_text()
    script = script[script.index("(async") :].rstrip().removesuffix(";")
    code = ROWS % (to_json(series), t, script)
    done = subprocess.run(["node", "-e", code], capture_output=True, text=True, check=True, timeout=60)
    return json.loads(done.stdout)


@with_node
@pytest.mark.parametrize(("t", "nearest"), [("33.3", 4), ("46.9", 6), ("50", 6)])
def test_a_read_out_is_of_a_recorded_row_and_names_it(t: str, nearest: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cosim.report.chart_data.MOST_CELLS", 6)  # more rows than the page may hold
    time = np.arange(5001) * 0.01
    series = Series(time, 1)
    values = np.full(5001, -100.0)  # between the rows in the page all is otherwise
    values[series.rows] = 7.5
    series.add(Panel("Rate", "°/s", [Trace("a", values, "true")]))
    shown, hidden, told, _, _ = told_by_the_script(series, t)
    assert shown == "7.5000"
    assert not hidden
    row = int(series.rows[nearest])
    assert told.startswith(f"numbers: row {row + 1} of 5001, t = {time[row]:g} s; 7 of the rows are in")


@with_node
def test_no_row_is_named_before_a_chart_is_read() -> None:
    series = Series(np.arange(5.0), 1)
    series.add(Panel("Rate", "°/s", [Trace("a", np.arange(5.0), "true")]))
    shown, hidden, *_ = told_by_the_script(series, "")
    assert float(shown) == 4.0
    assert hidden


@with_node
def test_the_script_has_every_row_to_five_digits() -> None:
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(1e-4, 0.1, 3000))
    signals = {
        "noise": rng.normal(size=3000),
        "huge": 1e12 * rng.normal(size=3000),
        "tiny": 1e-12 * rng.normal(size=3000),
        "pressure": 101325.0 + 0.01 * rng.normal(size=3000),  # moves little beside its size
        "gaps": np.where(rng.random(3000) < 0.3, np.nan, rng.normal(size=3000)),
        "first missing": np.where(np.arange(3000) < 7, np.nan, 1.0),
        "none": np.full(3000, np.nan),
        "zero": np.zeros(3000),
        "steps": np.repeat(rng.integers(-(10**6), 10**6, 30), 100).astype(np.float64),
    }
    series = Series(time, len(signals))
    series.add(Panel("All", "1", [Trace(name, values, "true") for name, values in signals.items()]))
    *_, t, columns = told_by_the_script(series, "1")
    assert np.abs(np.array(t) - time).max() < 1e-6
    for (name, values), column in zip(signals.items(), columns, strict=True):
        read = np.array(column, dtype=np.float64)  # null → NaN
        good = np.isfinite(values)
        assert np.array_equal(np.isfinite(read), good), name
        if good.any() and np.ptp(values[good]) > 0:
            finest = min(1e-5 * np.abs(values[good]).max(), 1e-3 * np.ptp(values[good]))
            assert np.abs(read - values)[good].max() <= 5.01 * finest, name


def test_saturation_is_the_share_of_time_at_the_limit(tmp_path: Path) -> None:
    results = changed(craft_run(10.0), "plant.tilt_right", math.radians(12), slice(0, 125))
    (craft,) = find_crafts(Run(results, manifest()))
    assert saturation(craft, "right") == pytest.approx(0.25)  # 125 of 500 commands
    assert saturation(craft, "left") == 0
    assert "limit of ±12.0° for 25\u00a0% of the time on the right" in page(tmp_path, results, manifest())


def test_an_unstated_limit_is_not_drawn_where_commands_exceed_it() -> None:
    results = changed(craft_run(1.0), "plant.tilt_right", math.radians(53))
    record = manifest(scenario={})
    (craft,) = find_crafts(Run(results, record))
    assert craft.tilt_limit is None


def test_angles_are_shown_in_degrees() -> None:
    results = changed(craft_run(1.0), "plant.psi", math.pi / 2)
    (craft,) = find_crafts(Run(results, manifest()))
    heading = next(panel for panel in state_panels(craft) if panel.symbol == "ψ")
    assert heading.unit == "°"
    assert heading.traces[-1].values[-1] == pytest.approx(90.0)


def test_roles_are_found_through_connections_whatever_the_names() -> None:
    one, two = craft_run(1.0, plant="a", control="k"), craft_run(1.0, plant="b", control="l")
    both = Results(one.time, one.columns + two.columns, np.hstack([one.values, two.values]))
    links = [("a.psi", "sensor.psi"), ("sensor.psi", "l.psi"), ("b.psi", "k.psi"), ("guide.x", "l.x_ref")]
    record = {"scenario": {"connections": [{"from": source, "to": target} for source, target in links]}}
    assert [(craft.name, craft.estimator) for craft in find_crafts(Run(both, record))] == [("a", "l"), ("b", "k")]


def test_without_a_craft_every_signal_is_plotted(tmp_path: Path) -> None:
    columns = (*(f"mass.q{i}" for i in range(9)), "spring.force")
    units = dict.fromkeys(columns[:-1], "m") | {"spring.force": "N"}
    results = Results(np.arange(3.0), columns, np.ones((3, 10)), units)
    text = page(tmp_path, results, {})
    assert all(text.count(f"</svg><span>{name}</span>") == 1 for name in columns)
    panels = signal_panels(Run(results, {}))
    assert [(panel.unit, len(panel.traces)) for panel in panels] == [("m", 6), ("m", 3), ("N", 1)]


def test_signals_without_a_unit_share_an_axis_only_if_each_is_seen_on_it(tmp_path: Path) -> None:
    time = np.linspace(0.0, 1.0, 11)
    signals = {
        "a.small": time,
        "a.large": 100.0 * time,  # on its axis a.small would be flat
        "a.similar": 8.0 * time,
        "a.constant": np.full(11, 50.0),  # would squeeze a.small, and not a.large
        "a.high": 1000.0 + time,  # as large as a.small, and far from it
        "b.metres": time,
        "b.far": 1e6 * time,  # of one unit: meant to be compared
    }
    results = Results(time, tuple(signals), np.column_stack(list(signals.values())), {"b.metres": "m", "b.far": "m"})
    panels = signal_panels(Run(results, {}))
    assert [[t.label for t in panel.traces] for panel in panels] == [
        ["a.small", "a.similar"], ["a.large", "a.constant"], ["a.high"], ["b.metres", "b.far"],
    ]  # fmt: skip


def test_a_page_without_criteria_opens_with_what_was_simulated(tmp_path: Path) -> None:
    record = {
        "scenario": {"components": {name: {} for name in ("tank", "pump", "valve", "level")}},
        "timings": {"load": 0.1, "simulate": 0.2, "real_time_factor": 9.2},
    }
    results = Results(np.arange(3.0), ("tank.level",), np.ones((3, 1)), {"tank.level": "m"})
    text = page(tmp_path, results, record)
    opening = text[text.index("<h1>") : text.index("<section")]
    assert all(words in opening for words in ("tank, pump, valve and 1 more", "2\u00a0s in 2 communication steps"))
    assert "real time" not in opening
    assert "9.2 times as fast as real time" in text


def test_a_page_with_criteria_draws_the_judged_signals_first_the_missed_ones_before(tmp_path: Path) -> None:
    goals = [
        {"kind": "peak", "of": "tank.flow", "value": 1.0, "max": 4.0, "unit": "m3/s", "met": True},
        {"kind": "final_error", "of": "tank.level", "to": 0.5, "value": 0.5, "max": 0.1, "unit": "m", "met": False},
        {
            "kind": "settling_time",
            "of": "tank.level",
            "to": "tank.set",
            "value": 1.0,
            "max": 2.0,
            "unit": "s",
            "met": True,
        },
    ]
    names = ("tank.flow", "tank.level", "tank.set", "tank.other")
    results = Results(np.arange(3.0), names, np.ones((3, 4)), {"tank.level": "m", "tank.set": "m"})
    panels = judged_panels(Run(results, {"criteria": goals}))
    assert [(p.title, p.limits) for p in panels] == [("tank.level", (0.4, 0.6)), ("tank.flow", (-4.0, 4.0))]
    text = page(tmp_path, results, {"criteria": goals})
    titles = re.findall(r'class="plot-title">([^<]+?) <', text)
    assert titles[:2] == ["tank.level", "tank.flow"]
    assert text.count("</svg><span>tank.level</span>") == 1  # and not among the other signals again
    assert text.index('class="plot-title"') < text.index("<table")


def test_text_and_items_are_spelled_out_with_the_times_of_their_changes(tmp_path: Path) -> None:
    exact = {"a.said": ["<b>", "<b>", "x", "x"], "a.raw": [b"\x00\xff"] * 4, "a.n": [2**63 - 1 + k for k in range(4)]}
    results = Results(np.arange(4.0), ("a.gear",), np.array([[1.0], [1.0], [2.0], [7.0]]), exact=exact)
    text = page(tmp_path, results, {"items": {"a.gear": {"first": 1, "second": 2}}})
    cells = ("first; from 2 s second; from 3 s 7", "&lt;b&gt;; from 2 s x", "00ff", f"{2**63 - 1}; from 1 s {2**63}; ")
    assert all(f'<td class="wrap">{cell}' in text for cell in cells)
    many = replace(results, time=np.arange(20.0), values=np.arange(20.0)[:, None], exact={})
    text = page(tmp_path, many, {"items": {"a.gear": {"first": 1}}})
    assert "0; from 1 s first; from 2 s 2;" in text
    assert "from 8 s 8; and 11 more changes</td>" in text


def test_of_very_many_signals_the_first_are_drawn_and_the_rest_is_said(tmp_path: Path) -> None:
    names = tuple(f"a.y{k}" for k in range(1003))
    text = page(tmp_path, Results(np.arange(2.0), names, np.zeros((2, 1003))), {})
    assert "The first 1000 of 1003 signals; the file of rows has all." in text
    assert "a.y999" in text
    assert "a.y1000" not in text


def test_of_very_many_connections_the_first_are_listed_and_the_rest_is_said(tmp_path: Path) -> None:
    links = [{"from": f"a.y{k}", "to": f"b.u{k}"} for k in range(1003)]
    text = page(tmp_path, Results(np.arange(2.0), (), np.empty((2, 0))), {"scenario": {"connections": links}})
    assert '<th scope="row">a.y999</th>' in text
    assert ">a.y1000<" not in text
    assert "And 3 more: all of them are in manifest.json." in text


def test_missed_criteria_are_named_with_their_margin(tmp_path: Path) -> None:
    goals = [
        {"kind": "settling_time", "of": "plant.psi", "value": 1.5, "max": 4.0, "unit": "s", "met": True},
        {"kind": "final_error", "of": "plant.psi", "to": 0.0, "value": 0.2, "max": 0.1, "unit": "rad", "met": False},
        {"kind": "settling_time", "of": "plant.x", "value": None, "max": 4.0, "unit": "s", "met": False},
    ]
    text = page(tmp_path, craft_run(1.0), manifest(criteria=goals))
    assert "2 of 3 criteria were missed (first, final error of plant.psi to 0°: 11.5°, allowed ≤ 5.73°)." in text
    assert all(words in text for words in ("2.50\u00a0s left", "5.73° over", ">not settled</td>"))


def test_a_run_of_any_fmus_shows_its_own_criteria_first_those_that_are_missed(tmp_path: Path) -> None:
    goals = [
        {"kind": "settling_time", "of": "tank.level", "value": 1.5, "max": 4.0, "unit": "s", "met": True},
        {"kind": "final_error", "of": "tank.level", "to": 0.0, "value": 0.2, "max": 0.1, "unit": "m", "met": False},
    ]
    results = Results(np.arange(3.0), ("tank.level",), np.ones((3, 1)), {"tank.level": "m"})
    text = page(tmp_path, results, {"criteria": goals})
    tiles = re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd><dd class=\"note\">(.*?)</dd>", text)
    assert [note.partition(",")[0] for _, _, note in tiles] == ["missed", "met"]
    assert tiles[0][:2] == ("final error of tank.level to 0\u00a0m", "0.200\u00a0m")


def test_ticks_lie_on_the_axis_and_are_told_apart() -> None:
    for low, high in [(0, 1), (-3e-9, 5e-9), (0, 720), (1e8, 1e8 + 50), (2, 2), (-1e90, 1e90), (0.1, 0.30001)]:
        for angle in (False, True):
            axis = make_axis(low, high, 5, angle)
            assert 2 <= len(axis.ticks) <= 12, (low, high)
            assert all(-1e-6 <= tick.at <= 100 + 1e-6 for tick in axis.ticks)
            assert len({tick.label for tick in axis.ticks}) == len(axis.ticks)


def test_a_tick_times_the_power_of_ten_of_its_axis_is_the_value_there() -> None:
    raised = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻\u2212", "0123456789--")
    for low, high in [(0, 1), (-3e-9, 5e-9), (1e8, 1e8 + 50), (-1e12, 1e12), (2e-4, 9e-4)]:
        axis = make_axis(low, high, 5)
        power = int(axis.factor.removeprefix("×10").translate(raised) or 0)
        assert (power != 0) is (not 1e-3 <= max(abs(low), abs(high)) < 1e6)
        for tick in axis.ticks:
            value = float(tick.label.translate(raised)) * 10.0**power
            assert value == pytest.approx(low + tick.at / 100 * (high - low), abs=1e-6 * (high - low))


@with_node
def test_a_view_that_is_zoomed_to_has_the_ticks_of_a_first_view_of_that_range() -> None:
    rng = np.random.default_rng(3)
    middle, reach = rng.normal(size=200) * 10.0 ** rng.uniform(-9, 9, 200), 10.0 ** rng.uniform(-12, 9, 200)
    ends = [(float(m - r), float(m + r)) for m, r in zip(middle, reach, strict=True)]
    ends += [(0.0, 1.0), (2.0, 2.0), (-3e-9, 5e-9), (0.0, 720.0), (-179.9, 180.0), (1e8, 1e8 + 50), (-1e90, 1e90)]
    cases = [(low, high, count, angle) for low, high in ends for count in (5, 6) for angle in (False, True)]
    low, wide = rng.uniform(-12, 12, 60), rng.uniform(0.05, 12, 60)
    decades = [(float(a), float(a + b)) for a, b in zip(low, wide, strict=True)]
    script = (ROOT / "cosim/report/templates/axes.js").read_text()
    calls = f"[{json.dumps(cases)}.map((c) => axis(...c)), {json.dumps(decades)}.map((c) => logAxis(...c))].flat()"
    code = f"{script}\nconsole.log(JSON.stringify({calls}))"
    done = subprocess.run(["node", "-e", code], capture_output=True, text=True, check=True, timeout=60)
    expected = [make_axis(*case) for case in cases] + [log_axis(*ends) for ends in decades]
    for axis, drawn in zip(expected, json.loads(done.stdout), strict=True):
        where = (axis.low, axis.high)
        assert [t["label"] for t in drawn["ticks"]] == [t.label for t in axis.ticks], where
        assert [t["at"] for t in drawn["ticks"]] == pytest.approx([t.at for t in axis.ticks], abs=1e-6), where
        assert (drawn["low"], drawn["high"], drawn["factor"]) == (*where, axis.factor)


def test_a_run_of_one_row_shows_its_values_and_no_time_but_that_row_s(tmp_path: Path) -> None:
    results = Results(np.array([1.5]), ("tank.level", "tank.flow"), np.array([[0.25, -3.0]]), {"tank.level": "m"})
    text = page(tmp_path, results, {"status": "failed"})
    assert "One row was recorded, at t = 1.5 s" in text
    assert re.findall(r'<output data-key="\w+">(.*?)</output>', text) == ["0.25", "\u22123"]
    for ticks in re.findall(r'class="x-ticks"[^>]*>(.*?)</div>', text):
        assert re.findall(r">([^<]+)<", ticks) == ["1.5"]
    assert text.count('class="line s0 dots"') == 4  # two charts, each with its curve and its name


def test_items_of_an_enumeration_are_read_by_their_names_and_drawn_as_steps(tmp_path: Path) -> None:
    values = np.array([[1.0], [1.0], [2.0]])
    results = Results(np.arange(3.0), ("a.gear",), values, {}, whole=frozenset({"a.gear"}))
    series = embedded(page(tmp_path, results, {"items": {"a.gear": {"first": 1, "second": 2}}}))["series"]
    (entry,) = series.values()
    assert entry["i"] == {"1": "first", "2": "second"}
    assert (entry["h"], entry["p"]) == (1, 0)


def test_figures_are_png_files_with_safe_names(tmp_path: Path) -> None:
    one, two = craft_run(1.0, plant="../$a_{", control="k"), craft_run(1.0, plant="_b", control="l")
    both = Results(one.time, one.columns + two.columns, np.hstack([one.values, two.values]))
    paths = write_figures(tmp_path / "figures", both, {})
    assert sorted(tmp_path.joinpath("figures").iterdir()) == sorted(paths)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)


@pytest.mark.parametrize("variable", ["XDG_CONFIG_HOME", pytest.param("XDG_CACHE_HOME", marks=pytest.mark.thorough)])
def test_without_a_place_for_its_lists_matplotlib_says_nothing_and_leaves_nothing(
    variable: str, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "temporary").mkdir()
    without = {name: value for name, value in os.environ.items() if name != "MPLCONFIGDIR"}
    done = subprocess.run(
        [sys.executable, "-c", "from cosim.report.figure import new_figure; new_figure(3.0, 2.0)"],
        env=without | {variable: str(tmp_path / "file"), "TMPDIR": str(tmp_path / "temporary")},
        capture_output=True,
        text=True,
        check=True,
    )
    assert (done.stdout, done.stderr) == ("", "")
    assert list((tmp_path / "temporary").iterdir()) == []


def test_a_figure_has_the_axes_of_the_page() -> None:
    time = np.linspace(0.0, 12.0, 20_001)
    turn = Trace("heading", 170.0 * np.sin(time), "true")
    wild = Band("believed", np.full(time.size, -1e12), np.full(time.size, 1e12))  # of a filter that has diverged
    panels = [Panel("Heading", "°", [turn], limits=(180.0,)), Panel("Height", "m", [turn], wild)]
    figure, (heading, height) = sheet(time, panels), Drawing(time, 2).plots(panels)
    for ax, plot in zip(figure.axes, (heading, height), strict=True):
        for axis, of in ((ax.xaxis, plot.x), (ax.yaxis, plot.y)):
            assert tuple(axis.get_view_interval()) == (of.low, of.high)
            assert axis.get_majorticklocs() == pytest.approx(
                [of.low + t.at / 100 * (of.high - of.low) for t in of.ticks]
            )
        assert len(ax.lines[0].get_xdata()) <= 4100
    figure.axes[0].set_xlim(2.0, 3.0)  # as in a notebook
    assert len(figure.axes[0].xaxis.get_majorticklocs()) >= 4


def test_a_small_signal_is_read_out_with_digits_of_its_own() -> None:
    assert [power(np.full(3, size)) for size in (0.5, 1e-5, 250.0)] == [5, 9, 2]
    assert power(np.array([100.0, 100.1])) == 5  # and one that moves little, of what it moves
    assert power(np.array([1e-310])) == 300


def test_importing_the_report_loads_neither_jinja2_nor_matplotlib() -> None:
    code = "import sys, cosim.report; print([m for m in ('jinja2', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
