"""The page of estimators: verdicts, normalised errors and innovations over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from controller.consistency import CONSISTENT, CaseResult, ConsistencyRow, by_case, headline, worst
from cosim.base.text import counted, percent, plain
from cosim.base.version import __version__
from cosim.report.charts import Charts, Plot
from cosim.report.html_tables import Badge
from cosim.report.panels import Band, Panel, Trace
from cosim.report.template import render

TEMPLATE = Path(__file__).with_name("templates") / "consistency.html.j2"


def page(rows: Sequence[ConsistencyRow], steps: int, seed: int) -> str:
    """Return the self-contained HTML page of a consistency test."""
    charts, runs, results = Charts(), rows[0].result.runs, by_case(rows)
    flights, main = {row.flight: row.motion for row in rows}, worst(results) or results[0]
    return render(
        TEMPLATE,
        {
            "badges": [Badge(f"{counted(runs, 'run')} of {counted(steps, 'sample')} each"), Badge(f"seed {seed}")],
            "headline": headline(rows),
            "tone": "good" if all(r.consistent for r in results) else "bad",
            "shown": f"{main.rows[0].case}, {main.rows[0].flight}",
            "first": [_plot(row, charts) for row in main.rows],
            "flights": list(flights.items()),
            "judged": [_summary(case, results, list(flights)) for case in dict.fromkeys(row.case for row in rows)],
            "rows": [_cells(row) for row in rows],
            "cases": [
                (f"{r.rows[0].case}; {r.rows[0].flight}", [_plot(row, charts) for row in r.rows]) for r in results
            ],
            "data": charts.data(),  # after all drawings
            "repeat": f"cosim consistency --runs {runs} --steps {steps} --seed {seed}",
            "version": __version__,
        },
    )


def _summary(case: str, results: Sequence[CaseResult], flights: Sequence[str]) -> Mapping[str, Any]:
    """Return a case's row of the summary table: its verdict on each flight.

    The number `factor` is the mean squared error divided by the claimed variance.
    """
    own = {r.rows[0].flight: r for r in results if r.rows[0].case == case}
    cells = {f: {"verdict": r.verdict, "good": r.consistent, "factor": plain(r.factor, 3)} for f, r in own.items()}
    return {"case": case, "flights": [cells.get(flight) for flight in flights]}


def _cells(row: ConsistencyRow) -> Mapping[str, Any]:
    r = row.result
    verdict, _, more = r.sentence.partition(": ")
    return {
        "case": row.case,
        "flight": row.flight,
        "of": row.of,
        "degrees": str(r.degrees),
        "mean": plain(r.mean, 4),
        "region": f"{plain(r.region[0], 4)} … {plain(r.region[1], 4)}",
        "above": percent(r.above),
        "below": percent(r.below),
        "most": percent(r.most),
        "verdict": verdict,
        "more": more,
        "good": verdict == CONSISTENT,
    }


def _plot(row: ConsistencyRow, charts: Charts) -> Plot:
    """Draw the mean over the runs and the 95 % range of a consistent estimator."""
    r = row.result
    low, high = (np.full(row.at.size, edge) for edge in r.at_time)
    traces = (Trace(f"mean of {counted(r.runs, 'run')}", r.at_times, "true"),)
    band = Band("95 % range of a consistent estimator", low, high)
    panel = Panel(row.of, "1", traces, band, (float(r.degrees),), "expected mean")
    (plot,) = charts.over(row.at).plots([panel])
    return plot
