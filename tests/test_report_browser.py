"""Reports in a real browser: what is read out is a row, and each chart is zoomed, read and saved."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from cosim.files.results import Results
from cosim.report.charts import Charts, decimals_of
from cosim.report.panels import Panel, Trace
from cosim.report.template import render
from cosim.simulation.report.run_page import write_report
from tests.seen import CHROMIUM
from tests.test_live_browser import browser, opened
from tests.test_report import craft_run

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

__all__ = ["browser"]
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
COLUMNS = ("tank.level", "pump.measured", "pump.speed", "valve.opening")
LINKS = [{"from": "tank.level", "to": "pump.measured", "noise": {"variance": 1e-4, "bias": 0.0}}]
TEMPLATE = """{% from "plot.html.j2" import plots as drawn %}<!DOCTYPE html><html lang="en"><head><title>charts</title>
<style>{{ style | safe }}</style></head><body><main><h1>Charts</h1>{{ drawn(plots) }}<p id="row" hidden></p></main>
<script type="application/json" id="run-data">{{ data | safe }}</script><script>{{ script | safe }}</script></body>
</html>
"""
RNG = np.random.default_rng(7)
TIME = np.arange(801) * 0.05
LEVEL, MODEL = np.cumsum(RNG.normal(size=(2, 801)), axis=1)
STARTS = [0, 200, 400, 600]  # rows at which the model is started anew
POLES = np.array([-4 + 0j, -2 - 3j, -2 + 3j, 0j])  # two of them one above the other


def recorded(rows: int = 9001) -> Results:
    """Three minutes of a tank at 50 Hz: smooth, noisy, in steps, with gaps."""
    rng, time = np.random.default_rng(4), np.arange(rows) * 0.02
    level = 1.0 + 0.3 * np.sin(time / 7.0)
    measured = np.where(rng.random(rows) < 0.1, np.nan, level + 0.01 * rng.normal(size=rows))
    steps = np.repeat(rng.uniform(0.0, 300.0, 1 + rows // 250), 250)[:rows]
    values = np.column_stack([level, measured, steps, 1e-6 * rng.normal(size=rows)])
    return Results(time, COLUMNS, values, {"tank.level": "m", "pump.measured": "m", "pump.speed": "W"})


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The page of a run, and one with charts over different axes."""
    folder = tmp_path_factory.mktemp("pages")
    write_report(folder / "run.html", recorded(), {"scenario": {"name": "tank", "connections": LINKS}})
    charts = Charts()
    both = [Trace("level", LEVEL, "estimate"), Trace("model", MODEL, "true", anew=True)]
    plots = charts.over(TIME, breaks=STARTS).plots([Panel("Level", "m", both), Panel("Left", "m", both[:1])])
    poles = Panel("Poles", "rad/s", [Trace("imaginary part", POLES.imag, "s0 crosses", x=POLES.real)])
    also, reach = {"size": np.abs(POLES)}, (-4.0, 4.0)
    plots.append(charts.points(poles, (-5.0, 1.0), ("real part", "1/s"), also, reach=reach))
    (folder / "page.html.j2").write_text(TEMPLATE)
    (folder / "charts.html").write_text(render(folder / "page.html.j2", {"plots": plots, "data": charts.data()}))
    return {"run": folder / "run.html", "charts": folder / "charts.html"}


READY = "html[data-ready]"


@pytest.fixture
def page(browser: Browser, paths: dict[str, Path], request: pytest.FixtureRequest) -> Iterator[Page]:
    faults: list[str] = []
    path, size = paths[getattr(request, "param", "charts")], {"width": 1200, "height": 2400}
    page = opened(browser, path.as_uri(), faults, viewport=size)
    page.wait_for_selector(READY, state="attached")
    yield page
    page.close()
    assert faults == []


run_page = pytest.mark.parametrize("page", ["run"], indirect=True)


def read_outs(page: Page) -> dict[str, str]:
    """Label → what is read out of it, of every chart."""
    text = "entries => Object.fromEntries(entries.map(e => [e.children[1].textContent, e.children[2].textContent]))"
    found: dict[str, str] = page.locator(".legend .entry:has(output):has(svg)").evaluate_all(text)
    return {label.split(",")[0]: value.replace("\u2212", "-") for label, value in found.items()}


def point_at(page: Page, chart: int, share: float, up: float = 0.5) -> dict[str, float]:
    """Move the pointer in a chart; return the place of the chart."""
    there: Any = page.locator("[data-box]").nth(chart).bounding_box()
    page.mouse.move(there["x"] + share * there["width"], there["y"] + up * there["height"])
    return dict(there)


def shapes(page: Page) -> list[str]:
    found: list[str] = page.locator("[data-line]").evaluate_all("lines => lines.map(l => l.getAttribute('d'))")
    return found


def saved(page: Page, title: str, kind: str) -> bytes:
    with page.expect_download() as waiting:
        page.get_by_role("button", name=f"{title} as {kind}").first.click()
    return Path(waiting.value.path()).read_bytes()


def table_of(page: Page, title: str) -> list[list[str]]:
    return [*csv.reader(io.StringIO(saved(page, title, "CSV").decode()))]


def near(values: np.ndarray[Any, Any], told: str, value: float) -> bool:
    """Whether what is told of a signal is a value, to the decimals of the signal."""
    return float(told) == pytest.approx(value, abs=0.51 * 10.0 ** -decimals_of(values))


@run_page
def test_at_any_time_every_read_out_is_the_row(page: Page) -> None:
    results, rng = recorded(), np.random.default_rng(5)
    for t in rng.uniform(0.0, results.time[-1], 20):
        page.evaluate("t => { location.hash = '#t=' + t }", float(t))
        page.wait_for_function(
            "t => Math.abs(parseFloat(document.querySelector('.when').textContent) - t) < 0.011", arg=t
        )
        row = int(np.abs(results.time - t).argmin())
        assert page.locator(".when").first.inner_text() == f"{results.time[row]:g} s"
        for name, told in read_outs(page).items():
            value = results[name][row]
            assert told == "\u2013" if np.isnan(value) else near(results[name], told, value), name


@run_page
def test_dragging_across_one_chart_zooms_all_and_a_double_click_takes_it_back(page: Page) -> None:
    before = shapes(page)
    point_at(page, 1, 0.25)
    page.mouse.down()
    point_at(page, 1, 0.5)
    page.mouse.up()
    ticks = page.locator(".x-ticks").evaluate_all("all => all.map(e => e.textContent)")
    assert len(set(ticks)) == 1  # one axis for all
    assert ticks[0].startswith(("45", "50"))
    assert all(a != b for a, b in zip(shapes(page), before, strict=True))
    there = point_at(page, 1, 0.5)
    page.mouse.dblclick(there["x"] + 0.5 * there["width"], there["y"] + 40)
    page.wait_for_timeout(300)  # the labels of the axes have their width again
    assert shapes(page) == before


@run_page
def test_a_curve_is_hidden_by_its_name_and_a_chart_saves_what_it_shows(page: Page) -> None:
    results, title = recorded(), "tank.level → pump.measured"
    name = page.get_by_role("button", name="tank.level").first
    name.click()
    assert name.get_attribute("aria-pressed") == "false"
    assert not page.locator("[data-line]").nth(1).is_visible()
    name.click()
    header, *rows = table_of(page, title)
    assert (header[0], header[2]) == ("time [s]", "tank.level [m]")
    level = np.array([float(row[2]) for row in rows])
    assert np.abs(level - results["tank.level"]).max() <= 0.51e-4
    assert [row[1] == "" for row in rows] == np.isnan(results["pump.measured"]).tolist()
    assert saved(page, title, "SVG").startswith(b"<svg ")
    assert saved(page, title, "PNG").startswith(b"\x89PNG")


def test_a_run_of_one_row_shows_dots_and_a_page_without_scripts_says_so(browser: Browser, tmp_path: Path) -> None:
    results = Results(np.array([1.5]), ("tank.level", "tank.flow"), np.array([[0.25, -3.0]]), {"tank.level": "m"})
    write_report(tmp_path / "report.html", results, {"status": "failed"})
    address, faults = (tmp_path / "report.html").as_uri(), list[str]()
    page = opened(browser, address, faults)
    page.wait_for_selector(READY, state="attached")
    assert read_outs(page)["tank.level"] == "0.25000"
    assert [path.count("h0") for path in shapes(page)] == [1, 1]
    page.close()
    page = opened(browser, address, faults, java_script_enabled=False)
    assert page.locator("noscript").inner_text()
    assert "tank.level from 0.25 to 0.25" in page.locator(".summary").all_inner_texts()
    page.close()
    assert faults == []


def test_a_cursor_moves_in_the_charts_of_its_axis_alone_and_names_the_row_while_a_chart_is_read(page: Page) -> None:
    assert shapes(page)[1].count("M") == len(STARTS) + 1  # nothing before the first start but that row
    row, before = page.locator("#row"), page.locator(".when").all_inner_texts()
    assert row.is_hidden()
    point_at(page, 0, 0.5)
    after = page.locator(".when").all_inner_texts()
    assert after[0] == after[1] == "20 s"
    assert after[2:] == before[2:]
    assert "row 401 of 801, t = 20 s" in row.inner_text()
    assert near(MODEL, read_outs(page)["model"], MODEL[400])
    page.mouse.move(2, 2)
    assert row.is_hidden()


def test_of_points_in_a_plane_the_nearest_is_read_with_all_that_belongs_to_it(page: Page) -> None:
    for pole in POLES:
        x, y = (pole.real + 5.0) / 6.0, 0.5 - pole.imag / 8.0
        point_at(page, 2, x + 0.01, y - 0.02)
        told = page.locator("figure").nth(2).locator("output").all_inner_texts()
        assert [float(v.replace("\u2212", "-")) for v in told] == pytest.approx([pole.imag, abs(pole)], abs=1e-4)
    chart = page.locator("[data-box]").nth(2)
    chart.focus()
    for key in ("Home", "ArrowRight", "ArrowRight"):  # to the one above, at the same place of the axis
        chart.press(key)
    assert page.locator(".when").nth(2).inner_text().replace("\u2212", "-") == "-2 1/s"
    assert page.locator("figure").nth(2).locator("output").first.inner_text() == "3"


def test_the_picture_of_the_craft_follows_the_pointer(browser: Browser, tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", craft_run(4.0), {"status": "ok"})
    faults: list[str] = []
    page = opened(browser, (tmp_path / "report.html").as_uri(), faults, viewport={"width": 1200, "height": 2400})
    page.wait_for_selector(READY, state="attached")
    places = []
    for share in (0.1, 0.9):  # at rest, and 1 m ahead
        point_at(page, 0, share)
        places.append(page.locator(".craft").first.get_attribute("transform"))
    page.close()
    assert faults == []
    assert None not in places
    assert places[0] != places[1]
