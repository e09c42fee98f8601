"""Build the site into docs/_site: reports and thumbnails of the gallery, pages by Sphinx; then check every link."""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from cosim.core.version import __version__

DOCS = Path(__file__).resolve().parent
ROOT, MADE, SITE = DOCS.parent, DOCS / "_made", DOCS / "_site"
SLOW = "--set criteria={settling_time: {of: Tank.level, to: 1.5, band: 0.02, max: 100}}"
TANKS = (
    "build/Tank.fmu build/Controller.fmu --out tanks.yaml",
    "--set components.Controller.start.gain=0.1 --set components.Controller.start.reset=0.004",
)
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
REPORTS: tuple[tuple[str, str], ...] = (  # name of the page, "" for none; command
    ("", "build --model hovercraft --out build"),
    ("run", "run scenarios/manoeuvre.yaml --out results/run"),
    ("", f"init {TANKS[0]}"),
    ("two-fmus", "run tanks.yaml --out results/two-fmus"),
    ("missed", f"run tanks.yaml {shlex.quote(SLOW[:5])} {shlex.quote(SLOW[6:])} --out results/missed"),
    ("failed", "run tanks.yaml --set components.Tank.start.area=0 --out results/failed"),
    ("", f"run tanks.yaml {TANKS[1]} --out results/firm"),
    ("compare", "compare results/two-fmus results/firm --out results/compare"),
    ("replay", "replay examples/tanks/e1.csv --fmu build/Tank.fmu --out results/replay"),
    ("refine", "refine examples/tanks/study.yaml --out results/refine"),
    ("identify", "identify examples/bench/protocol.yaml --out results/identify"),
    ("sweep", "sweep examples/hovercraft/sweep.yaml --out results/sweep"),
    ("consistency", "consistency --out results/consistency"),
    ("linearize", "linearize base --at scenarios/regulate.yaml@1.5 --out results/linearize"),
)


def gallery() -> None:
    """Write the reports of the gallery in a temporary project; check the exit codes."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    (MADE / "gallery").mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("scenarios", "examples"):
            shutil.copytree(ROOT / part, folder / part)
        build = "import sys; from pythonfmu.__main__ import cli_main; cli_main()"
        for slave in ("tank", "level_control"):
            command = ["build", "-f", f"examples/tanks/{slave}.py", "--dest", "build"]
            subprocess.run([sys.executable, "-c", build, *command], cwd=folder, check=True, capture_output=True)
        subprocess.run([sys.executable, "examples/tanks/make_logs.py"], cwd=folder, check=True, capture_output=True)
        for page, words in REPORTS:
            print(f"cosim {words}", flush=True)
            command = [sys.executable, "-m", "cosim", *shlex.split(words)]
            done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
            wanted = {"missed": 5, "failed": 4}.get(page, 0)
            if done.returncode != wanted:
                sys.exit(f"cosim {words}: exit code {done.returncode}, not {wanted}\n{done.stderr}")
            if page:
                shutil.copy(folder / "results" / page / "report.html", MADE / "gallery" / f"{page}.html")
        draw_signals(folder)


def draw_signals(folder: Path) -> None:
    """Draw `cosim view` with two runs, if there are Playwright and a Chromium."""
    sys.path.insert(0, str(ROOT))
    from benchmarks.view import chromium, served, wait_ready

    runs = ("two-fmus", "firm")
    axes = [
        [{"curves": [{"run": run, "name": name, "colour": 2 * k + place} for place, run in enumerate(runs)]}]
        for k, name in enumerate(("Tank.level", "Controller.pump_flow"))
    ]
    plots = [{"kind": "time", "across": None, "axes": axes[0] + axes[1]}]
    plots.append({"kind": "xy", "across": {"run": runs[0], "name": "Tank.level"}, "axes": axes[1]})
    layout = folder / "view.json"
    layout.write_text(json.dumps({"schema_version": 1, "layouts": {"last": {"plots": plots}}}))
    with ExitStack() as stack:
        try:
            page = stack.enter_context(chromium())
        except Exception:
            print("no Playwright or no Chromium: docs/view.md has no picture")
            return
        files = (str(folder / "results" / run) for run in runs)
        url, _ = stack.enter_context(served(*files, "--layout", str(layout)))
        page.goto(url)
        wait_ready(page)
        (MADE / "gallery" / "view.png").write_bytes(page.screenshot())


def draw_thumbnails() -> None:
    """Draw a thumbnail of every report of the gallery, if there is a Chromium."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        print("no Chromium: the gallery has no thumbnails")
        return
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--hide-scrollbars"]
    for page in sorted((MADE / "gallery").glob("*.html")):
        with tempfile.TemporaryDirectory() as profile:
            size = ["--window-size=1200,900", "--force-device-scale-factor=0.4", f"--user-data-dir={profile}"]
            picture = f"--screenshot={page.with_suffix('.png')}"
            command = [browser, *options, *size, picture, page.as_uri()]
            subprocess.run(command, check=True, capture_output=True, timeout=120)


class Page(HTMLParser):
    """Links, loaded files and link targets of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.places: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect links and targets."""
        given = {name: value or "" for name, value in attrs}
        self.places |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        elif tag in ("script", "img", "link", "iframe", "source"):
            self.loads += [given[name] for name in ("src", "href") if given.get(name)]


def faults(site: Path) -> list[str]:
    """Return broken links within a site, and loads of external content."""
    pages = {path: Page(path) for path in sorted(site.rglob("*.html"))}
    found = []
    for path, page in pages.items():
        where = path.relative_to(site)
        for link in (*page.links, *page.loads):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                if link in page.loads and parts.scheme != "data":
                    found.append(f"{where} loads {link}")
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            if not target.exists():
                found.append(f"{where}: {link} leads nowhere")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].places:
                found.append(f"{where}: {link}: no such place in {target.relative_to(site)}")
    return found


def publish(site: Path, folder: Path, version: str) -> None:
    """Copy a site to the folder of its version, and write the page that lists all versions."""
    shutil.rmtree(folder / version, ignore_errors=True)
    shutil.copytree(site, folder / version)
    names = [path.name for path in folder.iterdir() if (path / "index.html").is_file()]
    names.sort(key=lambda name: [int(part) for part in re.findall(r"\d+", name)], reverse=True)
    items = "".join(f'<li><a href="{name}/index.html">{name}</a></li>' for name in names)
    head = '<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>cosim: versions</title>'
    (folder / "index.html").write_text(f"{head}<h1>cosim</h1><ul>{items}</ul></html>\n", encoding="utf-8")


def main() -> int:
    """Build the site; return 1 for a broken link."""
    options = argparse.ArgumentParser(description="Build the site into docs/_site and check every link.")
    options.add_argument("--external", action="store_true", help="check links to other sites too")
    options.add_argument("--no-gallery", action="store_true", help="keep the reports of the previous build")
    options.add_argument("--publish", type=Path, metavar="FOLDER", help="copy the site to FOLDER/VERSION")
    chosen = options.parse_args()
    if not chosen.no_gallery:
        gallery()
        draw_thumbnails()
    shutil.rmtree(SITE, ignore_errors=True)
    sphinx = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-d", str(MADE.parent / "_site.doctrees")]
    subprocess.run([*sphinx, "-b", "html", str(DOCS), str(SITE)], check=True)
    if chosen.external:
        subprocess.run([*sphinx, "-b", "linkcheck", str(DOCS), str(SITE) + ".links"], check=True)
    found = faults(SITE)
    print(
        "\n".join(found)
        or f"{len(list(SITE.rglob('*.html')))} pages, every link leads somewhere: {SITE / 'index.html'}"
    )
    if chosen.publish and not found:
        publish(SITE, chosen.publish, __version__)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
