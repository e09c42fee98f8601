"""The report: complete in itself, safe with any name, honest about what the data show."""

from __future__ import annotations

import base64
import json
import math
import re
import zlib
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.arrays import Array
from cosim.files.results import Results
from cosim.report.charts import Charts, decimals_of
from cosim.report.panels import Panel, Trace
from cosim.simulation.report import write_figures, write_report
from cosim.simulation.report.recorded import Run
from cosim.simulation.report.run_page import judged_panels, signal_panels
from fmus.report.craft import find_crafts, responses, saturation
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
    assert (len(body["u"]), data["groups"][0]["of"]) == (len(data["few"]), results.time.size)
    # Forward along world X is up: −1000 mm at the end, within the rounding to whole millimetres.
    assert body["v"][-1] == pytest.approx(-1000 * results["plant.x_world"][-1], abs=0.5)
    speed = next(c for c in data["charts"] if c["title"] == "Forward speed")
    (shown,) = (data["columns"][t["y"]] for t in speed["traces"] if t["style"] == "true")
    assert np.isnan(shown).nonzero()[0].tolist() == [*range(50, 60)]


def test_a_page_has_every_row_to_five_digits() -> None:
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
    assert [decimals_of(np.full(3, size)) for size in (0.5, 1e-5, 250.0, 1e-310)] == [5, 9, 2, 300]
    assert decimals_of(np.array([100.0, 100.1])) == 5  # of what it moves


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


@pytest.mark.thorough
@pytest.mark.parametrize("rows", [0, 1, 2, 3])
def test_a_run_of_a_few_rows_gives_a_page_and_figures(tmp_path: Path, rows: int) -> None:
    whole = craft_run(1.0)
    results = Results(whole.time[:rows], whole.columns, whole.values[:rows], whole.units)
    text = page(tmp_path, results, manifest(status="failed: plant stopped at t = 0.04 s"))
    assert ("No rows were recorded" in text) is (rows == 0)
    assert embedded(text)["groups"][0]["of"] == rows
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


@pytest.mark.thorough
def test_nothing_serious_hinders_who_uses_keys_or_sees_little_in_the_page_of_a_run(tmp_path: Path) -> None:
    page(tmp_path, craft_run(10.0, noise=0.01), manifest())
    assert faults(tmp_path / "report.html", dark=True) == []


def test_settling_is_measured_from_the_last_step() -> None:
    (craft,) = find_crafts(Run(craft_run(10.0), manifest()))
    (answer,) = responses(craft, "x")
    # 1 − e^(−2t) enters ±0.02 at t = ln(50)/2; the last sample outside lies at most one step before.
    assert answer.time == pytest.approx(1.0)
    assert 0 <= math.log(50) / 2 - answer.settling <= 0.02


def test_saturation_is_the_share_of_time_at_the_limit() -> None:
    results = changed(craft_run(10.0), "plant.tilt_right", math.radians(12), slice(0, 125))
    (craft,) = find_crafts(Run(results, manifest()))
    assert saturation(craft, "right") == pytest.approx(0.25)  # 125 of 500 commands
    assert saturation(craft, "left") == 0
    beyond = changed(craft_run(1.0), "plant.tilt_right", math.radians(53))
    assert find_crafts(Run(beyond, manifest(scenario={})))[0].tilt_limit is None  # not stated, and exceeded


def test_roles_are_found_through_connections_whatever_the_names() -> None:
    one, two = craft_run(1.0, plant="a", control="k"), craft_run(1.0, plant="b", control="l")
    both = Results(one.time, one.columns + two.columns, np.hstack([one.values, two.values]))
    links = [("a.psi", "sensor.psi"), ("sensor.psi", "l.psi"), ("b.psi", "k.psi"), ("guide.x", "l.x_ref")]
    record = {"scenario": {"connections": [{"from": source, "to": target} for source, target in links]}}
    assert [(craft.name, craft.estimator) for craft in find_crafts(Run(both, record))] == [("a", "l"), ("b", "k")]


def test_without_a_craft_every_signal_is_plotted(tmp_path: Path) -> None:
    names = (*(f"mass.q{i}" for i in range(9)), "spring.force")
    units = dict.fromkeys(names[:-1], "m") | {"spring.force": "N"}
    results = Results(np.arange(3.0), names, np.ones((3, 10)), units)
    charts = embedded(page(tmp_path, results, {}))["charts"]
    assert sorted(t["label"] for chart in charts for t in chart["traces"]) == sorted(names)
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
    charts = embedded(page(tmp_path, results, {"criteria": goals}))["charts"]
    assert [chart["title"] for chart in charts][:2] == ["tank.level", "tank.flow"]
    labels = [t["label"] for chart in charts for t in chart["traces"]]
    assert labels.count("tank.level") == 1  # and not among the other signals again


def test_items_of_an_enumeration_are_read_by_their_names_and_drawn_as_steps(tmp_path: Path) -> None:
    values = np.array([[1.0], [1.0], [2.0]])
    results = Results(np.arange(3.0), ("a.gear",), values, {}, whole=frozenset({"a.gear"}))
    data = embedded(page(tmp_path, results, {"items": {"a.gear": {"first": 1, "second": 2}}}))
    ((trace,),) = (chart["traces"] for chart in data["charts"])
    assert (trace["items"], trace["form"]) == ({"1": "first", "2": "second"}, "held")
    assert data["columns"][trace["y"]].tolist() == [1, 1, 2]


def test_of_very_many_signals_the_first_are_drawn_and_the_rest_is_said(tmp_path: Path) -> None:
    names = tuple(f"a.y{k}" for k in range(1003))
    text = page(tmp_path, Results(np.arange(2.0), names, np.zeros((2, 1003))), {})
    labels = [t["label"] for chart in embedded(text)["charts"] for t in chart["traces"]]
    assert labels == [f"a.y{k}" for k in range(1000)]


def test_figures_are_png_files_with_safe_names(tmp_path: Path) -> None:
    one, two = craft_run(1.0, plant="../$a_{", control="k"), craft_run(1.0, plant="_b", control="l")
    both = Results(one.time, one.columns + two.columns, np.hstack([one.values, two.values]))
    paths = write_figures(tmp_path / "figures", both, {})
    assert sorted(tmp_path.joinpath("figures").iterdir()) == sorted(paths)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)
