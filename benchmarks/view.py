"""`python -m benchmarks.view`: time of opening, zoom and cursor of `cosim view` in Chromium, one JSON line.

The tables and their conversions stay in the folder for the next time.
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
import psutil

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


@contextmanager
def chromium() -> Iterator[Any]:
    """Yield an empty page of Playwright in Chromium."""
    from playwright.sync_api import sync_playwright

    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu"])
        yield browser.new_page(viewport={"width": 1400, "height": 1000})
        browser.close()


def cpu_seconds() -> float:
    """Return the processor time of this process and its descendants."""
    process = psutil.Process()
    return sum(sum(part.cpu_times()[:2]) for part in (process, *process.children(recursive=True)))


def wait_ready(page: Any) -> None:
    """Wait until the page has drawn all curves."""
    end = time.monotonic() + 60
    while not page.evaluate(READY):
        if time.monotonic() > end:
            raise TimeoutError("the page draws nothing")
        time.sleep(0.01)


def measure(page: Any, folder: Path, numbers: list[int]) -> dict[str, float]:
    """Return medians and 90 % quantiles of zoom and cursor [ms], and the seconds until 20 runs are shown."""
    found: dict[str, float] = {}
    for curves in numbers:
        layout = folder / f"layout{curves}.json"
        write_layout(layout, "run00", curves)
        with served(str(folder / "wide" / "run00"), "--layout", str(layout)) as (url, _):
            page.goto(url)
            wait_ready(page)
            for name, script in (("zoom", ZOOM), ("cursor", CURSOR)):
                used = cpu_seconds()
                times = page.evaluate(script)
                found[f"{name}_{curves}_cpu_ms"] = 1000 * (cpu_seconds() - used) / len(times)
                found |= {f"{name}_{curves}_curves_ms": times[len(times) // 2], f"{name}_{curves}_p90_ms": times[-3]}
    runs = [str(path) for path in sorted((folder / "many").iterdir()) if path.is_dir()]
    with served(*runs, "--layout", str(folder / "none.json")) as (url, started):
        begin = time.monotonic()
        page.goto(url)
        wait_ready(page)
        found |= {"open_command_s": started, "open_page_s": time.monotonic() - begin}
    return {name: round(value, 3 if name.endswith("_s") else 1) for name, value in found.items()}


def main() -> None:
    """Write and convert the tables, and measure."""
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
    with chromium() as page:
        figures = measure(page, chosen.folder, chosen.curves)
    about = {"load": round(load, 1), "cores": os.cpu_count()}
    print(json.dumps({**about, "rows": chosen.rows, "signals": chosen.signals, "runs": chosen.runs, **figures}))


if __name__ == "__main__":
    main()
