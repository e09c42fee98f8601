"""The page of estimators: a verdict each, and how normalised errors and innovations went over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.estimators.consistency import CONSISTENT, Row
from cosim.report.drawing import Charts
from cosim.report.panels import Band, Panel, Trace
from cosim.report.svg import Plot
from cosim.report.tables import Badge
from cosim.report.template import render
from cosim.text import counted, percent, plain
from cosim.version import __version__

TEMPLATE = Path(__file__).with_name("templates") / "consistency.html.j2"


def page(rows: Sequence[Row], steps: int, seed: int) -> str:
    """One self-contained page."""
    charts, runs = Charts(), rows[0].result.runs
    cases = {case: [row for row in rows if row.case == case] for case in dict.fromkeys(row.case for row in rows)}
    right = sum(all(row.result.verdict == CONSISTENT for row in of) for of in cases.values())
    return render(
        TEMPLATE,
        {
            "badges": [
                Badge(f"{counted(runs, 'run')} of {counted(steps, 'sample')} each"),
                Badge(f"{right} of {counted(len(cases), 'case')} consistent"),
            ],
            "rows": [_cells(row) for row in rows],
            "cases": [(case, [_plot(row, charts) for row in of]) for case, of in cases.items()],
            "data": charts.data(),
            "repeat": f"cosim consistency --runs {runs} --steps {steps} --seed {seed}",
            "version": __version__,
        },
    )


def _cells(row: Row) -> Mapping[str, Any]:
    r = row.result
    verdict, _, more = r.sentence.partition(": ")
    return {
        "case": row.case, "of": row.of, "degrees": str(r.degrees), "mean": plain(r.mean, 4),
        "region": f"{plain(r.region[0], 4)} … {plain(r.region[1], 4)}", "above": percent(r.above),
        "below": percent(r.below), "most": percent(r.most), "verdict": verdict, "more": more,
        "good": verdict == CONSISTENT,
    }  # fmt: skip


def _plot(row: Row, charts: Charts) -> Plot:
    """The mean over the runs at each time, and where a consistent estimator has it in 95 of 100."""
    r = row.result
    low, high = (np.full(row.at.size, edge) for edge in r.at_time)
    panel = Panel(
        row.of, "1", (Trace(f"mean of {counted(r.runs, 'run')}", r.at_times, "true"),),
        Band("95 % of a consistent one", low, high), (float(r.degrees),), "its mean",
    )  # fmt: skip
    (plot,) = charts.over(row.at, 1).plots([panel])
    return plot
