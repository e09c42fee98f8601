"""`python -m benchmarks.live [ROWS]`: processor time of a run with and without an open live page, one JSON line.

The run is the hovercraft's loop of two compiled FMUs. The page is open in Chromium, whose own time does not count. The
figures are medians of three runs each, in turn.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.bench_native import native_scenario
from benchmarks.view import chromium
from cosim.pages.work_pages import LiveRun
from cosim.simulation.workflow import run

H, ROWS, ROUNDS = 0.02, 100_000, 3


def processor_time(scenario: Path, folder: Path, observers: Sequence[Any]) -> float:
    """Return the processor time [s] of a run, in this process and its worker."""
    before = os.times()
    run(scenario, folder, report=False, format="parquet", observers=observers)
    after = os.times()
    return sum(after[:4]) - sum(before[:4])


def live_figures(place: Path, rows: int) -> dict[str, object]:
    """Return the processor times with and without a page."""
    scenario = native_scenario(place, rows * H)
    times: dict[str, list[float]] = {"without_s": [], "with_page_s": []}
    with chromium() as tab:
        for number in range(ROUNDS):
            times["without_s"].append(processor_time(scenario, place / f"bare{number}", ()))
            with LiveRun("native", 0) as page:
                tab.goto(page.url)
                times["with_page_s"].append(processor_time(scenario, place / f"page{number}", (page,)))
                drawn = tab.evaluate("document.documentElement.dataset")
                tab.goto("about:blank")
    figures: dict[str, object] = {name: round(median(each), 2) for name, each in times.items()}
    return {"rows": rows, **figures, "page": drawn}


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(live_figures(Path(folder), int([*sys.argv, str(ROWS)][1]))))
