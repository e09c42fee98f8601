"""The page of a run in a real browser: what it reads out is a row, and what it shows can be looked into."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from cosim.report.packed import power
from cosim.simulation.report import write_report
from cosim.storage.results import Results

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
COLUMNS = ("tank.level", "pump.measured", "pump.speed", "valve.opening")
LINKS = [{"from": "tank.level", "to": "pump.measured", "noise": {"variance": 1e-4, "bias": 0.0}}]


def recorded(rows: int = 9001) -> Results:
    """Three minutes of a tank at 50 Hz: smooth, noisy, in steps, with gaps."""
    rng, time = np.random.default_rng(4), np.arange(rows) * 0.02
    level = 1.0 + 0.3 * np.sin(time / 7.0)
    measured = np.where(rng.random(rows) < 0.1, np.nan, level + 0.01 * rng.normal(size=rows))
    steps = np.repeat(rng.uniform(0.0, 300.0, 1 + rows // 250), 250)[:rows]
    values = np.column_stack([level, measured, steps, 1e-6 * rng.normal(size=rows)])
    return Results(time, COLUMNS, values, {"tank.level": "m", "pump.measured": "m", "pump.speed": "W"})


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    api = pytest.importorskip("playwright.sync_api", reason="no playwright")
    with api.sync_playwright() as playwright:
        started = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        )
        yield started
        started.close()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Results]:
    path, results = tmp_path_factory.mktemp("page") / "report.html", recorded()
    write_report(path, results, {"scenario": {"name": "tank", "connections": LINKS}})
    return path, results


@pytest.fixture
def page(browser: Browser, report: tuple[Path, Results]) -> Iterator[Page]:
    opened = browser.new_page(viewport={"width": 1200, "height": 900}, reduced_motion="reduce")
    faults: list[str] = []
    opened.on("pageerror", lambda error: faults.append(str(error)))
    opened.goto(report[0].as_uri())
    opened.wait_for_selector("html[data-ready]", state="attached")
    yield opened
    opened.close()
    assert faults == []


def read_outs(page: Page) -> dict[str, str]:
    """Label → what is read out of it, of every chart."""
    text = "entries => Object.fromEntries(entries.map(e => [e.children[1].textContent, e.children[2].textContent]))"
    found: dict[str, str] = page.locator(".legend .entry:has(output)").evaluate_all(text)
    return {label.split(",")[0]: value.replace("\u2212", "-") for label, value in found.items()}


def box(page: Page, number: int) -> dict[str, float]:
    chart = page.locator("[data-box]").nth(number)
    chart.scroll_into_view_if_needed()
    found: Any = chart.bounding_box()
    return dict(found)


def shapes(page: Page) -> list[str]:
    found: list[str] = page.locator("[data-line]").evaluate_all("lines => lines.map(l => l.getAttribute('d'))")
    return found


@pytest.mark.thorough
def test_at_any_time_every_read_out_is_the_row(page: Page, report: tuple[Path, Results]) -> None:
    results, rng = report[1], np.random.default_rng(5)
    shown = {c: results[c] for c in COLUMNS}
    for t in rng.uniform(0.0, results.time[-1], 20):
        page.evaluate("t => { location.hash = '#t=' + t }", float(t))
        page.wait_for_function(
            "t => Math.abs(parseFloat(document.querySelector('.when').textContent) - t) < 0.011", arg=t
        )
        when = page.locator(".when").first.inner_text()
        row = int(np.abs(results.time - t).argmin())
        assert when == f"{results.time[row]:g} s"
        for name, told in read_outs(page).items():
            value, decimals = shown[name][row], power(shown[name])
            if np.isnan(value):
                assert told == "\u2013"
            else:
                assert float(told) == pytest.approx(value, abs=0.5000001 * 10.0**-decimals), name


def test_dragging_across_one_chart_zooms_all_and_a_double_click_takes_it_back(page: Page) -> None:
    before, there = shapes(page), box(page, 1)
    y = there["y"] + 40
    page.mouse.move(there["x"] + 0.25 * there["width"], y)
    page.mouse.down()
    page.mouse.move(there["x"] + 0.5 * there["width"], y, steps=5)
    page.mouse.up()
    ticks = page.locator(".x-ticks").evaluate_all("all => all.map(e => e.textContent)")
    assert len(set(ticks)) == 1  # one axis for all
    assert ticks[0].startswith("45") or ticks[0].startswith("50")
    assert all(a != b for a, b in zip(shapes(page), before, strict=True))
    page.mouse.dblclick(there["x"] + 0.5 * there["width"], y)
    assert shapes(page) == before


@pytest.mark.thorough  # keys move the cursor in test_report_charts
def test_a_chart_takes_keys_when_it_has_the_focus_and_the_page_scrolls_as_any(page: Page) -> None:
    page.keyboard.press("Space")
    page.wait_for_function("scrollY > 100")
    chart = page.locator("[data-box]").first
    chart.focus()
    chart.press("Home")
    page.wait_for_timeout(600)  # until it has scrolled
    place = page.evaluate("scrollY")
    for _ in range(3):
        chart.press("ArrowRight")
    assert page.locator(".when").first.inner_text() == "0.06 s"
    spoken = page.locator("p[role=status].unseen").inner_text()
    assert spoken.startswith("t = 0.06 s: pump.measured")
    chart.press("+")
    assert "zoomed" in (page.locator("html").get_attribute("class") or "")
    chart.press("Escape")
    assert "zoomed" not in (page.locator("html").get_attribute("class") or "")
    assert page.evaluate("scrollY") == place


def test_a_curve_is_hidden_and_shown_by_its_name(page: Page) -> None:
    name = page.get_by_role("button", name="tank.level").first
    line = page.locator("[data-line]").nth(1)
    name.click()
    assert name.get_attribute("aria-pressed") == "false"
    assert not line.is_visible()
    name.click()
    assert line.is_visible()


def test_every_chart_is_saved_under_a_name_of_its_own_with_its_unit_where_titles_are_alike(
    browser: Browser, tmp_path: Path
) -> None:
    time = np.arange(3.0)
    columns = ("tank.a", "tank.b", "tank.c", "valve.e")
    results = Results(time, columns, np.outer(time, range(4)), {"tank.a": "m", "tank.b": "m/s", "tank.c": "rad"})
    write_report(tmp_path / "report.html", results, {"scenario": {"name": "tank"}})
    opened = browser.new_page()
    opened.goto((tmp_path / "report.html").as_uri())
    opened.wait_for_selector("html[data-ready]", state="attached")
    titles = opened.eval_on_selector_all("[data-chart]", "all => all.map((c) => c.dataset.title)")
    names = []
    for button in opened.get_by_role("button", name="as CSV").all():
        with opened.expect_download() as waiting:
            button.click()
        names.append(waiting.value.suggested_filename)
    opened.close()
    assert len(set(names)) == len(names) == len(titles) > len(set(titles))
    assert {"tank_m.csv", "tank_m_s.csv", "tank_deg.csv"} <= set(names)


@pytest.mark.thorough
def test_what_a_chart_shows_is_saved_as_numbers_and_as_pictures(page: Page, report: tuple[Path, Results]) -> None:
    results = report[1]
    kept = {}
    for kind in ("CSV", "SVG", "PNG"):
        with page.expect_download() as waiting:
            page.get_by_role("button", name=f"as {kind}").first.click()
        kept[kind] = Path(waiting.value.path()).read_bytes()
    header, *rows = csv.reader(io.StringIO(kept["CSV"].decode()))
    assert header[0] == "time [s]"
    assert header[2] == "tank.level [m]"
    assert len(rows) == results.time.size
    level = np.array([float(row[2]) for row in rows])
    assert np.abs(level - results["tank.level"]).max() <= 0.51e-4
    assert [row[1] == "" for row in rows] == np.isnan(results["pump.measured"]).tolist()
    assert kept["SVG"].startswith(b"<svg ")
    assert kept["PNG"].startswith(b"\x89PNG")
