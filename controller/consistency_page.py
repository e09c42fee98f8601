"""The page of estimators: verdicts, normalised errors and innovations over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from controller.consistency import CONSISTENT, ConsistencyRow, by_case, common_verdict, headline
from cosim.core.text import counted, plain
from cosim.core.version import __version__
from cosim.report.charts import Charts, Plot
from cosim.report.html_tables import Badge
from cosim.report.panels import Band, Panel, Trace
from cosim.report.template import render

TEMPLATE = Path(__file__).with_name("templates") / "consistency.html.j2"


def page(rows: Sequence[ConsistencyRow], steps: int, seed: int) -> str:
    """Return the self-contained HTML page of a consistency test."""
    charts, runs, cases = Charts(), rows[0].result.runs, by_case(rows)
    flights = {row.flight: row.motion for row in rows}
    judged: dict[str, dict[str, Any]] = {}
    for case in cases:
        verdict, first = common_verdict(case), case[0]
        cell = {"verdict": verdict, "good": verdict == CONSISTENT, "factor": plain(first.result.factor, 3)}
        judged.setdefault(first.case, dict.fromkeys(flights))[first.flight] = cell
    cells = [
        {**row.as_text(), "verdict": verdict, "more": more, "good": verdict == CONSISTENT}
        for row in rows
        for verdict, _, more in [row.result.sentence.partition(": ")]
    ]
    return render(
        TEMPLATE,
        {
            "badges": [Badge(f"{counted(runs, 'run')} of {counted(steps, 'sample')} each"), Badge(f"seed {seed}")],
            "headline": headline(rows),
            "tone": "good" if all(common_verdict(case) == CONSISTENT for case in cases) else "bad",
            "flights": list(flights.items()),
            "judged": [{"case": name, "flights": list(of.values())} for name, of in judged.items()],
            "rows": cells,
            "cases": [(f"{case[0].case}; {case[0].flight}", [_plot(row, charts) for row in case]) for case in cases],
            "data": charts.data(),  # after all drawings
            "repeat": f"cosim consistency --runs {runs} --steps {steps} --seed {seed}",
            "version": __version__,
        },
    )


def _plot(row: ConsistencyRow, charts: Charts) -> Plot:
    """Draw the mean over the runs and the 95 % range of a consistent estimator."""
    r = row.result
    low, high = (np.full(row.at.size, edge) for edge in r.at_time)
    traces = (Trace(f"mean of {counted(r.runs, 'run')}", r.at_times, "true"),)
    band = Band("95 % range of a consistent estimator", low, high)
    panel = Panel(row.of, "1", traces, band, (float(r.degrees),), "expected mean")
    (plot,) = charts.over(row.at).plots([panel])
    return plot
