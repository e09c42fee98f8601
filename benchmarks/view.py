"""`python -m benchmarks.view`: time of opening, zoom and cursor of `cosim view` in Chromium and Firefox, one JSON line.

The tables and their conversions stay in the folder for the next time. Firefox is driven by WebDriver BiDi.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

READY = "document.documentElement.dataset.ready === 'view' && document.documentElement.dataset.view === 'drawn'"
ZOOM = """(async () => {
  const box = document.querySelector(".box"), frame = box.getBoundingClientRect(), times = [];
  const root = document.documentElement.dataset;
  for (let k = 0; k < 16; k++) {
    const at = { clientX: frame.left + frame.width * (0.3 + 0.01 * k), clientY: frame.top + 50 };
    const start = performance.now();
    root.view = "asked";
    const deltaY = k % 8 < 6 ? -100 : 100;
    box.dispatchEvent(new WheelEvent("wheel", { ...at, deltaY, bubbles: true, cancelable: true }));
    while (root.view !== "drawn") await new Promise((done) => requestAnimationFrame(done));
    times.push(performance.now() - start);
  }
  return times.sort((a, b) => a - b);
})()"""
CURSOR = """(async () => {
  const box = document.querySelector(".box"), frame = box.getBoundingClientRect(), times = [];
  const cells = [...document.querySelectorAll(".legend output")].slice(0, 2);
  for (let k = 0; k < 16; k++) {
    const start = performance.now(),
      at = { clientX: frame.left + frame.width * (0.1 + 0.05 * k), clientY: frame.top + 9 };
    box.dispatchEvent(new PointerEvent("pointermove", { ...at, bubbles: true }));
    while (cells.some((cell) => !cell.textContent || cell.textContent.includes("…")))
      await new Promise((done) => requestAnimationFrame(done));
    times.push(performance.now() - start);
  }
  return times.sort((a, b) => a - b);
})()"""


def make_runs(folder: Path, runs: int, rows: int, signals: int) -> None:
    """Write missing runs as Parquet."""
    import pyarrow as pa
    from pyarrow import parquet

    for number in range(runs):
        file = folder / f"run{number:02d}" / "results.parquet"
        if file.is_file():
            continue
        file.parent.mkdir(parents=True, exist_ok=True)
        rng, at = np.random.default_rng(number), np.arange(rows) * 1e-3
        columns = {f"plant{k // 10}.x{k % 10}": np.cumsum(rng.standard_normal(rows)) for k in range(signals)}
        parquet.write_table(pa.table({"time": at, **columns}), file, row_group_size=65_536, use_dictionary=False)


def write_layout(file: Path, run: str, curves: int) -> None:
    """Write a layout of four plots."""
    names = [f"plant{k // 10}.x{k % 10}" for k in range(curves)]
    plots = [
        {
            "kind": "time",
            "across": None,
            "axes": [{"curves": [{"run": run, "name": n, "colour": k} for k, n in enumerate(part)]}],
        }
        for part in (names[k::4] for k in range(4))
    ]
    file.write_text(json.dumps({"schema_version": 1, "layouts": {"last": {"plots": plots}}}))


@contextmanager
def served(*words: str) -> Iterator[tuple[str, float]]:
    """Start `cosim view`; yield its address and the duration of its start [s]."""
    begin = time.monotonic()
    command = [sys.executable, "-m", "cosim", "view", *words, "--no-browser"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None
        try:
            for line in process.stderr:
                if found := re.search(r"http://\S+", line):
                    yield found.group(), time.monotonic() - begin
                    break
        finally:
            process.terminate()


class Chromium:
    """Chromium, driven by Playwright."""

    def __init__(self) -> None:
        from playwright.sync_api import sync_playwright

        path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
        self._api = sync_playwright().start()
        self._browser = self._api.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu"])
        self._page = self._browser.new_page(viewport={"width": 1400, "height": 1000})

    def open(self, url: str) -> None:
        """Open an address."""
        self._page.goto(url)

    def evaluate(self, text: str) -> Any:
        """Return the value of JavaScript."""
        return self._page.evaluate(text)

    def screenshot(self) -> bytes:
        """Return a picture of the page as PNG."""
        picture: bytes = self._page.screenshot()
        return picture

    def close(self) -> None:
        """End the browser."""
        self._browser.close()
        self._api.stop()


class Firefox:
    """Firefox, driven by WebDriver BiDi."""

    def __init__(self) -> None:
        from websockets.sync.client import connect

        path = shutil.which("firefox-esr") or shutil.which("firefox")
        if path is None:
            raise FileNotFoundError("no Firefox")
        self._folder = tempfile.TemporaryDirectory(prefix="view-firefox-", ignore_cleanup_errors=True)
        command = [path, "--headless", "--no-remote", "--profile", self._folder.name, "--remote-debugging-port", "0"]
        size = {"MOZ_HEADLESS_WIDTH": "1400", "MOZ_HEADLESS_HEIGHT": "1000", "HOME": self._folder.name}
        self._process = subprocess.Popen(
            command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, env={**os.environ, **size}
        )
        assert self._process.stderr is not None
        address = next(found for line in self._process.stderr if (found := re.search(r"ws://\S+", line)))
        self._socket, self._number = connect(f"{address.group()}/session", max_size=None, open_timeout=60), 0
        self._send("session.new", {"capabilities": {}})
        self._context = self._send("browsingContext.getTree", {})["contexts"][0]["context"]

    def _send(self, method: str, parameters: Any) -> Any:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv())
            if answer.get("id") == self._number:
                if answer["type"] == "error":
                    raise RuntimeError(f"{method}: {answer['message']}")
                return answer["result"]

    def open(self, url: str) -> None:
        """Open an address."""
        self._send("browsingContext.navigate", {"context": self._context, "url": url, "wait": "interactive"})

    def evaluate(self, text: str) -> Any:
        """Return the value of JavaScript, by way of JSON."""
        expression = f"(async () => JSON.stringify(await ({text})))()"
        target = {"target": {"context": self._context}, "expression": expression, "awaitPromise": True}
        return json.loads(self._send("script.evaluate", target)["result"]["value"])

    def screenshot(self) -> bytes:
        """Return a picture of the page as PNG."""
        import base64

        picture = self._send("browsingContext.captureScreenshot", {"context": self._context})["data"]
        return base64.b64decode(picture)

    def close(self) -> None:
        """End the browser."""
        self._socket.close()
        self._process.terminate()
        self._process.wait()
        self._folder.cleanup()


def cpu_seconds() -> float:
    """Return the processor time of this process and its descendants; 0 without /proc."""
    if sys.platform == "win32":
        return 0.0
    parents, times = dict[int, int](), dict[int, float]()
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents[int(stat.parent.name)] = int(fields[1])
        times[int(stat.parent.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    below = {os.getpid()}
    for _ in range(10):
        below |= {child for child, parent in parents.items() if parent in below}
    return sum(seconds for process, seconds in times.items() if process in below)


def wait_ready(browser: Any) -> None:
    """Wait until the page has drawn all curves."""
    end = time.monotonic() + 60
    while not browser.evaluate(READY):
        if time.monotonic() > end:
            raise TimeoutError("the page draws nothing")
        time.sleep(0.01)


def measure(browser: Any, folder: Path, numbers: list[int]) -> dict[str, float]:
    """Return medians and 90 % quantiles of zoom and cursor [ms], and the seconds until 20 runs are shown."""
    found: dict[str, float] = {}
    for curves in numbers:
        layout = folder / f"layout{curves}.json"
        write_layout(layout, "run00", curves)
        with served(str(folder / "wide" / "run00"), "--layout", str(layout)) as (url, _):
            browser.open(url)
            wait_ready(browser)
            for name, script in (("zoom", ZOOM), ("cursor", CURSOR)):
                used = cpu_seconds()
                times = browser.evaluate(script)
                found[f"{name}_{curves}_cpu_ms"] = 1000 * (cpu_seconds() - used) / len(times)
                found |= {f"{name}_{curves}_curves_ms": times[len(times) // 2], f"{name}_{curves}_p90_ms": times[-3]}
    runs = [str(path) for path in sorted((folder / "many").iterdir()) if path.is_dir()]
    with served(*runs, "--layout", str(folder / "none.json")) as (url, started):
        begin = time.monotonic()
        browser.open(url)
        wait_ready(browser)
        found |= {"open_command_s": started, "open_page_s": time.monotonic() - begin}
    return {name: round(value, 3 if name.endswith("_s") else 1) for name, value in found.items()}


def main() -> None:
    """Write and convert the tables, and measure in each installed browser."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "cosim-bench-view")
    options.add_argument("--rows", type=int, default=1_000_000)
    options.add_argument("--signals", type=int, default=100)
    options.add_argument("--runs", type=int, default=20)
    options.add_argument("--curves", type=int, nargs="*", default=[8, 100], help="curves of four plots")
    chosen = options.parse_args()
    make_runs(chosen.folder / "wide", 1, chosen.rows, chosen.signals)
    make_runs(chosen.folder / "many", chosen.runs, chosen.rows, 4)
    tables = [str(path) for path in sorted(chosen.folder.glob("*/run*"))]
    subprocess.run([sys.executable, "-m", "cosim", "view", *tables, "--prepare", "-q"], check=True)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else -1.0  # of other programs, which slow all down
    results: dict[str, Any] = {
        "load": round(load, 1),
        "cores": os.cpu_count(),
        "rows": chosen.rows,
        "signals": chosen.signals,
        "runs": chosen.runs,
    }
    for kind in (Chromium, Firefox):
        try:
            browser: Any = kind()
        except Exception as error:  # It is not here.
            results[kind.__name__.lower()] = f"not measured: {error}"
            continue
        try:
            results[kind.__name__.lower()] = measure(browser, chosen.folder, chosen.curves)
        finally:
            browser.close()
    print(json.dumps(results))


if __name__ == "__main__":
    main()
