"""The live page in a real browser: rows appear, changes act, stop keeps the rows, keys do all."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from cosim.files.results import read_results
from tests.live_pages import live_command, slow_scenario
from tests.seen import CHROMIUM

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
PATIENCE = 60_000  # [ms] on a busy machine


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    api = pytest.importorskip("playwright.sync_api", reason="no playwright")
    with api.sync_playwright() as playwright:
        started = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        )
        yield started
        started.close()


def opened(browser: Browser, url: str, faults: list[str], **settings: object) -> Page:
    page = browser.new_page(reduced_motion="reduce", **settings)  # type: ignore[arg-type]
    page.set_default_timeout(PATIENCE)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda message: faults.append(message.text) if "Security" in message.text else None)
    page.goto(url)
    return page


def until(page: Page, expression: str) -> None:
    """Wait until JavaScript is true; the page's policy forbids Playwright's own way."""
    end = time.monotonic() + PATIENCE / 1000
    while not page.evaluate(f"() => Boolean({expression})"):
        assert time.monotonic() < end, expression
        page.wait_for_timeout(50)


def hindrances(page: Page) -> list[tuple[str, list[str]]]:
    """What axe finds on a page: rules and elements."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="no axe").Axe()
    found = axe.run(page).response["violations"]
    return [(v["id"], [node["html"] for node in v["nodes"]][:3]) for v in found]


INK = """[...document.querySelectorAll("figure .box")].reduce((sum, box) => {
  const canvas = box.querySelector("canvas"), lines = [...box.querySelectorAll(".line")];
  if (canvas.hidden || !canvas.width) return sum + lines.reduce((n, l) => n + (l.getAttribute("d") ?? "").length, 0);
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return sum + data.reduce((n, value) => n + (value > 0), 0);
}, 0)"""  # of all curves, as lines or as pixels


def ended_by() -> int:
    """Return the exit code of a stopped command, which gets SIGTERM where Ctrl-C is ignored (`command &` of sh)."""
    return 4 if signal.getsignal(signal.SIGINT) is signal.SIG_IGN else 130


@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.thorough)])
def test_rows_appear_changes_act_and_stop_keeps_the_rows(browser: Browser, tmp_path: Path, scheme: str) -> None:
    faults: list[str] = []
    arguments = ("run", slow_scenario(tmp_path), "--out", tmp_path / "o")
    with live_command(*arguments, folder=tmp_path) as (process, url):
        page = opened(browser, url, faults, viewport={"width": 1300, "height": 900}, color_scheme=scheme)
        page.wait_for_selector("html[data-live=running]", state="attached")
        until(page, f"{INK} > 20")  # rows appear
        rows = page.input_value("#to")
        until(page, f"Number(document.querySelector('#to').value) > {rows}")

        field = page.get_by_role("textbox", name="mill.r_in [rpm]")  # by keys alone
        field.focus()
        page.keyboard.press("Control+a")
        page.keyboard.type("3 kg")
        page.keyboard.press("Enter")
        page.wait_for_selector(".change .error:not([hidden])")
        assert "rpm" in page.locator(".change .error:not([hidden])").inner_text()
        page.keyboard.press("Control+a")
        page.keyboard.type("30")
        page.keyboard.press("Enter")
        page.wait_for_selector("#log li")
        page.get_by_role("slider", name="mill.gain").fill("4")
        until(page, "document.querySelectorAll('#log li').length === 2")
        until(
            page,
            "[...document.querySelectorAll('.legend > .entry')].some((e) =>"
            " e.children[0].textContent === 'mill.r_out' && parseFloat(e.children[1].textContent) > 100)",
        )  # the effect: r_out = 4·30

        page.get_by_role("button", name="Pause").click()
        page.wait_for_selector("html[data-live=paused]", state="attached")
        page.wait_for_timeout(300)
        held = page.locator("#now").inner_text()
        page.wait_for_timeout(300)
        assert page.locator("#now").inner_text() == held
        assert hindrances(page) == []
        page.set_viewport_size({"width": 360, "height": 740})
        page.wait_for_timeout(300)
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        page.reload()  # nothing is lost
        page.wait_for_selector("html[data-live=paused]", state="attached")
        assert page.locator("#log li").count() == 2
        page.get_by_role("button", name="Continue").click()
        until(page, f"document.querySelector('#now').textContent !== '{held}'")

        page.get_by_role("button", name="Stop").click()
        page.wait_for_selector("html[data-live=stopped]", state="attached")
        with page.context.expect_page() as popup:
            page.get_by_role("link", name="Open the report").click()
        popup.value.wait_for_selector("html[data-ready]", state="attached")
        assert popup.value.evaluate("fetch('events').then(() => 'read', () => 'refused')") == "refused"
        popup.value.close()
        page.close()
        _, errors = process.communicate(timeout=60)
        assert process.returncode == ended_by(), errors
    assert faults == []
    results = read_results(tmp_path / "o" / "results.csv")
    manifest = json.loads((tmp_path / "o" / "manifest.json").read_text())
    assert 10 < len(results.time) < 6000
    assert results["mill.r_out"][0] == 2.0
    assert results["mill.r_out"][-1] == 120.0
    assert [change["set"] for change in manifest["changes"]] == [{"mill.r_in": 30.0}, {"mill.gain": 4.0}]
    assert manifest["status"].startswith("failed: the run")
