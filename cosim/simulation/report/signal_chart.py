"""Charts of results in a notebook."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cosim.report.cell.cell import MAX_CURVES, cell_of, rows_to_show
from cosim.simulation.report.run_page import drawable_run, signal_panels
from cosim.storage.results import Results


def results_cell(results: Results, names: Sequence[str], title: str) -> str:
    """Return HTML with an interactive chart of the first of the named signals; those of one unit share a panel."""
    shown = tuple(names[:MAX_CURVES])
    rows = rows_to_show([results[name] for name in shown])  # first of all: a long run is not copied
    values = np.column_stack([results[name][rows] for name in shown]) if shown else np.empty((rows.size, 0))
    run = drawable_run(replace(results, time=results.time[rows], columns=shown, values=values, exact={}), {})
    omitted = len(names) - len(shown)
    return cell_of(run.time, signal_panels(run), title, rows=results.time.size, omitted=omitted)
