"""What a page looks like to those who see little or use keys alone: axe in a real browser."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
GRAVE = {"serious", "critical"}
# All charts are made by one template: one of a section stands for the others.
WHERE = {"exclude": [[".plots > :nth-child(n + 2)"]]}
ASKED = {"resultTypes": ["violations"], "runOnly": ["wcag2a", "wcag2aa", "wcag21aa"]}

# Least contrast of any curve with the paper, with its opacity, as WCAG computes it; and how many curves there are.
CONTRAST = """() => {
  const one = (c) => { c /= 255; return c <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4; };
  const light = ([r, g, b]) => 0.2126 * one(r) + 0.7152 * one(g) + 0.0722 * one(b);
  const parts = (text) => text.match(/[\\d.]+/g).slice(0, 3).map(Number);
  const paper = parts(getComputedStyle(document.body).backgroundColor), lines = [...document.querySelectorAll(".box .line")];
  const ratios = lines.map((line) => {
    const look = getComputedStyle(line), a = Number(look.opacity);
    const [p, q] = [light(parts(look.stroke).map((c, k) => a * c + (1 - a) * paper[k])), light(paper)].sort((x, y) => y - x);
    return (p + 0.05) / (q + 0.05);
  });
  return [Math.min(...ratios), ratios.length];
}"""  # noqa: E501


def faults(path: Path, *, dark: bool = False) -> list[str]:
    """Return serious findings of axe on a page with all details open; skip without a browser.

    On request, dark mode is tested too. A curve with contrast below 3 : 1 to the paper is a fault.
    """
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    api = pytest.importorskip("playwright.sync_api", reason="no playwright")
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="no axe-playwright-python")
    found = []
    with api.sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        for scheme in ("light", "dark"):  # curves in both
            page = browser.new_page(color_scheme=scheme, viewport={"width": 1200, "height": 900})
            page.goto(path.as_uri())
            page.wait_for_selector("html[data-ready]", state="attached")
            page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
            asked = dark or scheme == "light"
            for violation in axe.Axe().run(page, context=WHERE, options=ASKED).response["violations"] if asked else ():
                if violation["impact"] in GRAVE:
                    where = ", ".join(node["html"][:120] for node in violation["nodes"][:3])
                    found.append(f"{scheme}: {violation['id']}: {violation['help']}: {where}")
            least, curves = page.evaluate(CONTRAST)
            if curves == 0 or least < 3.0:
                found.append(f"{scheme}: of {curves} curves one has a contrast of {least:.2f}")
        browser.close()
    return found
