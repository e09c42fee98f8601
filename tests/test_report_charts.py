"""Charts of one page over different axes, in a real browser: each is read, zoomed and saved by itself."""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from cosim.report.chart_data import Abscissa
from cosim.report.drawing import Charts
from cosim.report.packed import power
from cosim.report.panels import Band, Panel, Trace
from cosim.report.svg import make_axis
from cosim.report.template import render
from tests.test_report_browser import CHROMIUM, box, browser, read_outs, shapes

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

__all__ = ["browser"]
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
TEMPLATE = """{% from "plot.html.j2" import plot %}<!DOCTYPE html><html lang="en"><head><title>charts</title>
<style>{{ style | safe }}</style></head><body><main><h1>Charts</h1>
<div class="plots">{% for p, label in plots %}{{ plot(p, label) }}{% endfor %}</div><p id="row" hidden></p></main>
<script type="application/json" id="run-data">{{ data | safe }}</script>
<script>{{ script | safe }}</script></body></html>
"""
RNG = np.random.default_rng(7)
TIME = np.arange(801) * 0.05
LEVEL, MODEL = np.cumsum(RNG.normal(size=(2, 801)), axis=1)
STARTS = [0, 200, 400, 600]  # rows at which the model is started anew
FLOW, MEAN = np.sort(RNG.uniform(0.0, 9.0, 15)), RNG.normal(size=15)
FINE = np.linspace(0.0, 9.0, 60)
CURVE = np.cos(FINE)
LAGS, RHO = np.arange(1, 31) * 0.1, RNG.uniform(-1.0, 1.0, 30)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    charts, folder = Charts(), tmp_path_factory.mktemp("charts")
    drawing = charts.over(TIME, 4, Abscissa(breaks=STARTS))
    both = [Trace("level", LEVEL, "estimate"), Trace("model", MODEL, "true", anew=True)]
    plots = [(p, "time [s]") for p in drawing.plots([Panel("Level", "m", both), Panel("Left", "m", both[:1])])]
    data = Trace("data", MEAN - 0.2, "warm", x=FLOW, upper=MEAN + 0.2)
    traces = [data, Trace("mean", MEAN, "s1 dots", x=FLOW), Trace("claim", CURVE, "true", x=FINE)]
    band = Band("95 %", CURVE - 0.1, CURVE + 0.1, FINE)
    alone = charts.alone(Panel("Loss against flow", "kW", traces, band), make_axis(0.0, 9.0, 6), ("flow", "l/s"))
    plots.append((alone, "flow [l/s]"))
    stems = Panel("Autocorrelation", "1", [Trace("residual", RHO, "error", stems=True)])
    over = charts.over(LAGS, 1, Abscissa(("lag", "s"), (0.05, 3.05)))
    plots.append((over.plots([stems])[0], "lag [s]"))
    (folder / "page.html.j2").write_text(TEMPLATE)
    page = folder / "page.html"
    page.write_text(render(folder / "page.html.j2", {"plots": plots, "data": charts.data()}))
    return page


@pytest.fixture
def page(browser: Browser, path: Path) -> Iterator[Page]:
    opened = browser.new_page(viewport={"width": 1200, "height": 900}, reduced_motion="reduce")
    faults: list[str] = []
    opened.on("pageerror", lambda error: faults.append(str(error)))
    opened.goto(path.as_uri())
    opened.wait_for_selector("html[data-ready]", state="attached")
    yield opened
    opened.close()
    assert faults == []


@pytest.mark.thorough
def test_of_curves_with_points_of_their_own_the_nearest_are_read(page: Page) -> None:
    there = box(page, 2)
    for share in np.random.default_rng(8).uniform(0.02, 0.98, 12):
        page.mouse.move(there["x"] + share * there["width"], there["y"] + 50)
        at = float(page.locator(".when").nth(2).inner_text().split()[0])
        every = np.concatenate((FLOW, FINE))
        assert np.abs(every - at).min() < 1e-4  # it is where some point is, and none is nearer to the pointer
        assert abs(at - 9.0 * share) <= np.abs(every - 9.0 * share).min() + 9.0 * 1.5 / there["width"]
        read, k, j = read_outs(page), int(np.abs(FLOW - at).argmin()), int(np.abs(FINE - at).argmin())
        assert float(read["mean"]) == pytest.approx(MEAN[k], abs=0.51 * 10.0 ** -power(MEAN))
        low, high = (float(v) for v in read["data"].split(" … "))
        assert (low, high) == pytest.approx((MEAN[k] - 0.2, MEAN[k] + 0.2), abs=1e-4)
        assert float(read["claim"]) == pytest.approx(CURVE[j], abs=0.51 * 10.0 ** -power(CURVE))


def test_a_cursor_moves_in_the_charts_of_its_axis_alone(page: Page) -> None:
    before = page.locator(".when").all_inner_texts()
    there = box(page, 0)
    page.mouse.move(there["x"] + 0.5 * there["width"], there["y"] + 50)
    after = page.locator(".when").all_inner_texts()
    assert after[0] == after[1] == "20 s"
    assert after[2:] == before[2:]
    assert page.locator("#row").inner_text() == "numbers: row 401 of 801, t = 20 s"
    assert float(read_outs(page)["model"]) == pytest.approx(MODEL[400], abs=0.51 * 10.0 ** -power(MODEL))


def test_the_row_is_named_only_while_a_chart_is_read(page: Page) -> None:
    row = page.locator("#row")
    assert row.is_hidden()
    there = box(page, 0)
    page.mouse.move(there["x"] + 0.5 * there["width"], there["y"] + 50)
    assert row.is_visible()
    page.mouse.move(2, 2)
    assert row.is_hidden()
    first = page.locator("[data-box]").first
    first.focus()
    first.press("ArrowLeft")
    assert row.is_visible()
    first.blur()
    assert row.is_hidden()


def test_a_zoom_changes_the_charts_of_its_axis_alone_and_lines_still_begin_anew(page: Page) -> None:
    before = shapes(page)
    assert before[1].count("M") == len(STARTS) + 1  # nothing before the first start but that row
    first = page.locator("[data-box]").first
    first.focus()
    page.mouse.move(0, 0)
    for key in ("Home", "+"):
        first.press(key)
    after = shapes(page)
    assert [a != b for a, b in zip(after, before, strict=True)] == [True, True, True, False, False, False, False]
    assert after[0].count("M") == 1
    assert after[1].count("M") == 3  # half of the rows: those after two starts, and the first row
    first.press("Escape")
    assert shapes(page) == before


@pytest.mark.parametrize(("chart", "curves", "marks"), [(2, (3, 4, 5), None), (3, (6,), 9)])
def test_marks_are_drawn_again_where_they_are_looked_at(
    page: Page, chart: int, curves: tuple[int, ...], marks: int | None
) -> None:
    before, figure = shapes(page), page.locator("[data-box]").nth(chart)
    figure.focus()
    figure.press("Home")
    for _ in range(2):
        figure.press("+")
    after = shapes(page)
    for k in curves:
        assert after[k] != before[k]
        # all marks of a curve with points of its own; of lags a quarter of 30, and the one beyond the end
        assert after[k].count("M") == (marks or before[k].count("M"))
    assert [a for k, a in enumerate(after) if k not in curves] == [b for k, b in enumerate(before) if k not in curves]


def test_keys_go_from_point_to_point_and_say_what_is_there(page: Page) -> None:
    chart = page.locator("[data-box]").nth(3)
    chart.focus()
    chart.press("Home")
    chart.press("ArrowRight")
    assert page.locator(".when").nth(3).inner_text() == "0.2 s"
    said = page.locator("p.told").inner_text()
    assert said == f"lag = 0.2 s: residual {RHO[1]:.{power(RHO)}f} 1".replace("-", "\u2212")


def test_the_numbers_of_a_chart_with_bars_are_saved_with_both_ends(page: Page) -> None:
    with page.expect_download() as waiting:
        page.get_by_role("button", name="Loss against flow as CSV").click()
    header, *rows = csv.reader(io.StringIO(Path(waiting.value.path()).read_text()))
    assert header == ["flow [l/s]", "data, lower [kW]", "data, upper [kW]", "mean [kW]", "claim [kW]"]
    assert len(rows) == FLOW.size + FINE.size
    means = np.array([(float(row[0]), float(row[3])) for row in rows if row[3]])
    assert means == pytest.approx(np.column_stack((FLOW, MEAN)), abs=1e-4)
    with page.expect_download() as waiting:
        page.get_by_role("button", name="Autocorrelation as SVG").click()
    assert Path(waiting.value.path()).read_bytes().count(b"V") >= LAGS.size
    with page.expect_download() as waiting:
        page.get_by_role("button", name="Loss against flow as SVG").click()
    paths = re.findall(r"<path [^>]*>", Path(waiting.value.path()).read_text())
    dots = [path for path in paths if path.count("h0") == FLOW.size]
    assert len(dots) == 1
    assert 'stroke-linecap="round"' in dots[0]  # else a dot has no size


OMEGA = np.geomspace(0.01, 1000.0, 501)
GAIN = -10.0 * np.log10(1.0 + OMEGA**2)
POLES = np.array([-4 + 0j, -2 - 3j, -2 + 3j, 0j])  # two of them one above the other


@pytest.fixture
def plane(browser: Browser, tmp_path: Path) -> Iterator[Page]:
    charts = Charts()
    gain = charts.over(OMEGA, 1, Abscissa(("frequency", "rad/s"), log=True)).plots(
        [Panel("Gain", "dB", [Trace("y", GAIN, "s0")])]
    )
    panel = Panel("Poles", "rad/s", [Trace("imaginary part", POLES.imag, "s0 crosses", x=POLES.real)])
    axes, also = (make_axis(-5.0, 1.0, 6), make_axis(-4.0, 4.0, 5)), {"size": np.abs(POLES)}
    drawn = charts.points(panel, axes, ("real part", "1/s"), also)
    (tmp_path / "page.html.j2").write_text(TEMPLATE)
    plots = [(gain[0], "frequency [rad/s]"), (drawn, "real part [1/s]")]
    page = tmp_path / "page.html"
    page.write_text(render(tmp_path / "page.html.j2", {"plots": plots, "data": charts.data()}))
    opened = browser.new_page(viewport={"width": 1200, "height": 900}, reduced_motion="reduce")
    faults: list[str] = []
    opened.on("pageerror", lambda error: faults.append(str(error)))
    opened.goto(page.as_uri())
    opened.wait_for_selector("html[data-ready]", state="attached")
    yield opened
    opened.close()
    assert faults == []


def test_over_decades_the_frequency_that_is_read_is_a_row_of_the_response(plane: Page) -> None:
    there = box(plane, 0)
    for share in (0.1, 0.4, 0.77):
        plane.mouse.move(there["x"] + share * there["width"], there["y"] + 50)
        omega = float(plane.locator(".when").first.inner_text().split()[0])
        row = int(np.abs(np.log(OMEGA / omega)).argmin())
        assert omega == pytest.approx(OMEGA[row], rel=1e-4)
        assert np.log10(omega) == pytest.approx(-2.0 + 5.0 * share, abs=0.01)
        told = plane.locator("output").first.inner_text().replace("\u2212", "-")
        assert float(told) == pytest.approx(GAIN[row], abs=0.51 * 10.0 ** -power(GAIN))
    chart = plane.locator("[data-box]").first
    chart.focus()
    for _ in range(4):
        chart.press("+")
    ticks = plane.locator(".x-ticks").first.locator("span").all_inner_texts()
    assert len(ticks) >= 3
    assert all(float(a) < float(b) for a, b in itertools.pairwise(ticks))
    with plane.expect_download() as waiting:
        plane.get_by_role("button", name="Gain as CSV").click()
    header, *rows = csv.reader(io.StringIO(Path(waiting.value.path()).read_text()))
    assert header[0] == "frequency [rad/s]"
    shown = np.array([float(row[0]) for row in rows])
    assert np.abs(np.log(shown[:, None] / OMEGA)).min(axis=1).max() < 1e-4


@pytest.mark.thorough
def test_of_points_in_a_plane_the_nearest_is_read_with_all_that_belongs_to_it(plane: Page) -> None:
    there, chart = box(plane, 1), plane.locator("[data-box]").nth(1)
    for number, pole in enumerate(POLES):
        x, y = (pole.real + 5.0) / 6.0, 0.5 - pole.imag / 8.0
        plane.mouse.move(there["x"] + x * there["width"] + 6, there["y"] + y * there["height"] - 5)
        shown = plane.locator("figure").nth(1).locator("output").all_inner_texts()
        assert [float(v.replace("\u2212", "-")) for v in shown] == pytest.approx([pole.imag, abs(pole)], abs=1e-4)
        assert plane.locator("#row").inner_text().startswith(f"numbers: point {number + 1} of 4")
        ring = plane.locator(".ring").bounding_box()
        assert ring is not None
        assert ring["x"] + ring["width"] / 2 == pytest.approx(there["x"] + x * there["width"], abs=2.0)
        assert ring["y"] + ring["height"] / 2 == pytest.approx(there["y"] + y * there["height"], abs=2.0)
    chart.focus()
    chart.press("Home")
    chart.press("ArrowRight")
    chart.press("ArrowRight")  # to the one above, at the same place of the axis
    said = plane.locator("p.told").inner_text().replace("\u2212", "-")
    assert said == "real part = -2 1/s: imaginary part 3 rad/s, size 3.6056"
