"""The signal browser in a real browser: drag and keys, zoom and cursor, files, layouts."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from benchmarks.view import write_layout
from cosim.pages.layouts import Layouts
from cosim.pages.rows import TIME_COLUMN, Recording
from cosim.pages.runs import RunPlace, ViewedRun
from cosim.pages.server import ServedPage
from cosim.pages.view_page import view_page
from tests.seen import CHROMIUM
from tests.test_live_browser import browser, hindrances, opened, until

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

__all__ = ["browser"]
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
ROWS, MANY = 100_000, 10_000
DRAWN = "document.documentElement.dataset.view === 'drawn'"


@pytest.fixture
def page_of_runs(tmp_path: Path) -> Iterator[ServedPage]:
    """Two runs of 10⁵ rows with a peak in a single row, and one of 10 000 signals."""
    at = np.arange(ROWS) * 1e-3
    runs = []
    for k in range(2):
        position = np.sin(at / (1 + k))
        position[70_000] = 9.0
        columns = {"mass.x": position, "mass.v": np.cos(at), "mass.f": 1e4 * np.cos(at), "Mass.x": at}
        units = {"mass.x": "m", "mass.v": "m/s", "mass.f": "N", "Mass.x": "m"}
        runs.append(_run(tmp_path / f"r{k}.csv", k, Recording({TIME_COLUMN: at, **columns}, units)))
    names = [f"bus.n{k // 100}.s{k}" for k in range(MANY)]
    wide = {name: np.array([0.0, 1.0]) for name in names}
    recording = Recording({TIME_COLUMN: np.array([0.0, 100.0]), **wide}, dict.fromkeys(names, ""))
    runs.append(_run(tmp_path / "wide.csv", 2, recording))
    with view_page("3 runs", runs, Layouts(tmp_path / "view.json")) as page:
        yield page


def _run(file: Path, number: int, recording: Recording) -> ViewedRun:
    return ViewedRun(RunPlace(f"r{number}", f"run {number} (r{number})", file), rows=recording)


def _names(page: Page) -> list[str]:
    return page.locator(".legend .entry > button.entry").all_inner_texts()


def _shown(browser: Browser, served: ServedPage, faults: list[str], **settings: Any) -> Page:
    page = opened(browser, served.url, faults, viewport={"width": 1300, "height": 1000}, **settings)
    page.wait_for_selector("html[data-ready=view]", state="attached")
    return page


def _press(page: Page, *keys: str) -> None:
    for key in keys:
        page.keyboard.press(key)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_signals_are_searched_dragged_and_added_by_keys_and_the_page_is_accessible(
    browser: Browser, page_of_runs: ServedPage, scheme: str
) -> None:
    faults: list[str] = []
    page = _shown(browser, page_of_runs, faults, color_scheme=scheme)
    assert page.locator("[role=treeitem]").count() == 3
    assert "10008 signals of 3 runs" in page.locator("#count").inner_text()
    page.fill("#find", "mass.x")  # in any case
    row = page.locator("[role=treeitem]")
    assert [text.split("\n")[0] for text in row.all_inner_texts()][1:3] == ["mass.x", "Mass.x"]
    row.nth(1).drag_to(page.locator(".box").first)
    until(page, DRAWN)
    assert _names(page) == ["mass.x · run 0"]
    page.select_option("#group", "signal")
    page.fill("#find", "mass.f")
    page.locator("#tree").focus()
    page.keyboard.press("Enter")  # of both runs, on an axis of their unit
    assert _names(page) == ["mass.x · run 0", "mass.f · run 0", "mass.f · run 1"]
    assert page.locator(".axis-unit").all_inner_texts() == ["1: [m]", "2: [N]"]
    page.fill("#find", "mass.v")
    row.first.drag_to(page.locator(".y-ticks").first)  # to an axis, whatever its unit
    assert page.locator(".axis-unit").all_inner_texts() == ["1: [m, m/s]", "2: [N]"]
    page.keyboard.press("Escape")
    row.first.drag_to(page.locator("#new-plot"))
    assert page.locator("figure.plot").count() == 2
    page.locator(".where").first.select_option("plot")  # the first curve gets a plot of its own
    assert page.locator("figure.plot").count() == 3

    page.select_option("#group", "run")
    page.fill("#find", "bus")  # 10 000 signals: only those in sight are elements
    page.locator("#tree").focus()
    page.keyboard.press("End")
    assert page.locator("[role=treeitem].now").inner_text().startswith("bus.n99.s9999")
    assert page.locator("[role=treeitem]").count() < 80
    assert hindrances(page) == []
    page.set_viewport_size({"width": 360, "height": 740})
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    page.emulate_media(media="print")
    assert not page.locator("#tree").is_visible()
    page.close()
    assert faults == []


def test_zoom_cursor_files_and_layouts(browser: Browser, page_of_runs: ServedPage, tmp_path: Path) -> None:
    faults: list[str] = []
    page = _shown(browser, page_of_runs, faults)
    page.fill("#find", "mass.")
    page.locator("#tree").focus()
    _press(page, "ArrowDown", "Enter", "ArrowDown", "Shift+Enter")
    until(page, DRAWN)
    assert float(page.locator(".y-ticks").first.locator("span").all_inner_texts()[-1]) > 5.0  # the peak of one row
    box = page.locator(".box").first
    place = box.bounding_box()
    assert place is not None
    left, middle, width = place["x"], place["y"] + 80, place["width"]
    page.mouse.move(left + 0.1 * width, middle)
    page.mouse.down()
    page.mouse.move(left + 0.3 * width, middle, steps=3)
    page.mouse.up()
    until(page, DRAWN)
    begin, end = (float(page.input_value(name)) for name in ("#from", "#to"))
    assert (begin, end) == pytest.approx((10.0, 30.0), abs=0.5)
    page.mouse.move(left + 0.5 * width, middle)
    until(page, "!document.querySelector('output').textContent.includes('…')")
    time.sleep(0.2)
    first, second = (float(text.replace("−", "-")) for text in page.locator("output").all_inner_texts())
    assert math.hypot(first, second) == pytest.approx(1.0, abs=1e-3)  # sine and cosine at one time
    for share in (0.2, 0.6):  # marks of an interval
        page.mouse.click(left + share * width, middle)
    page.wait_for_selector(".statistics:not([hidden]) td")
    heads = page.locator(".statistics thead").first.inner_text().split()
    assert heads == ["signal", "min", "max", "mean", "RMS", "σ"]
    assert float(page.locator(".statistics caption").first.inner_text().split()[-2]) == pytest.approx(8.0, abs=0.3)
    page.mouse.click(left + 0.5 * width, middle)
    assert page.locator(".statistics:not([hidden])").count() == 0
    box.focus()
    page.keyboard.press("0")
    until(page, DRAWN)
    assert float(page.input_value("#to")) == 99.999  # of the runs that are drawn; another one ends at 100

    page.click("#add-plane")
    page.locator("#tree").focus()
    _press(page, "Home", "ArrowDown", "ArrowDown", "Enter", "ArrowDown", "Enter")
    until(page, DRAWN)
    assert len(page.locator(".box").last.locator("path.line").get_attribute("d") or "") > 1000
    for kind, begins in (("SVG", b"<svg"), ("PNG", b"\x89PNG"), ("CSV", b"time,mass.x [m]")):
        with page.expect_download() as waiting:
            page.locator(".tools").first.get_by_text(kind).click()
        assert Path(waiting.value.path()).read_bytes().startswith(begins)

    page.click("#add-spectrum")
    page.fill("#find", "1 mass.v")  # of the second run
    page.locator("#tree").focus()
    _press(page, "Home", "Enter")
    page.fill("#find", "")
    page.select_option("#columns", "2")
    until(page, "document.querySelector('.plots').lastElementChild.textContent.includes('peak')")
    page.click("#layouts summary")
    page.fill("#layout-name", "mine")
    page.click("#layout-form button:has-text('Save')")
    page.wait_for_selector("#layout-list li")
    kept = json.loads((tmp_path / "view.json").read_text())["layouts"]["mine"]
    assert [plot["kind"] for plot in kept["plots"]] == ["time", "time", "xy", "spectrum"]
    assert kept["columns"] == 2
    before = _names(page)
    page.reload()
    page.wait_for_selector("html[data-ready=view]", state="attached")
    until(page, DRAWN)
    assert _names(page) == before
    page.close()
    assert faults == []


def test_many_curves_are_painted_as_pixels_with_every_peak_and_printed_as_lines(
    browser: Browser, tmp_path: Path
) -> None:
    at, names = np.arange(ROWS) * 1e-3, [f"plant{k // 10}.x{k % 10}" for k in range(30)]
    columns = {name: np.full(ROWS, float(k)) for k, name in enumerate(names)}
    columns[names[0]][70_000] = 90.0
    run = _run(tmp_path / "r0.csv", 0, Recording({TIME_COLUMN: at, **columns}, dict.fromkeys(names, "m")))
    write_layout(tmp_path / "view.json", "r0", 30)
    faults: list[str] = []
    with view_page("a run", [run], Layouts(tmp_path / "view.json")) as served:
        page = _shown(browser, served, faults)
        until(page, DRAWN)
        inked = """() => {
          const canvas = document.querySelector(".box canvas"), { width, height } = canvas,
            { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
          const columns = [...Array(width).keys()];
          return columns.filter((k) => data[4 * (Math.round(height / 2) * width + k) + 3]).map((k) => k / width);
        }"""  # at half the height there is the peak alone
        (*_, last) = found = page.evaluate(inked)
        assert (found[0], last) == pytest.approx((0.7, 0.7), abs=0.01)
        assert page.locator(".box path.line").first.get_attribute("d") == ""
        page.emulate_media(media="print")
        until(page, "document.querySelector('.box path.line').getAttribute('d') !== ''")
        assert not page.locator(".box canvas").first.is_visible()
        page.close()
    assert faults == []
