"""Charts of results in a notebook."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from html import escape

import numpy as np

from cosim.files.results import Results, is_rounded
from cosim.report.cell.cell import MAX_CURVES, cell_of, rows_to_show
from cosim.simulation.report.run_page import drawable_run, signal_panels

MOST_NAMES = 5  # in a note


def results_cell(results: Results, names: Sequence[str], title: str) -> str:
    """Return HTML with an interactive chart of the first of the named signals; those of one unit share a panel.

    A note names signals of texts, which are not drawn, and integers that doubles round.
    """
    shown = tuple(names[:MAX_CURVES])
    rows = rows_to_show([results[name] for name in shown])  # first of all: a long run is not copied
    values = np.column_stack([results[name][rows] for name in shown]) if shown else np.empty((rows.size, 0))
    run = drawable_run(replace(results, time=results.time[rows], columns=shown, values=values, exact={}), {})
    omitted = len(names) - len(shown)
    page = cell_of(run.time, signal_panels(run), title, rows=results.time.size, omitted=omitted)
    texts = [name for name in results.exact if name not in results]
    rounded = [name for name in shown if name in results.exact and is_rounded(results[name])]
    parts = [f"{_names(texts)} not drawn: texts"] if texts else []
    parts += [f"{_names(rounded)} above 2⁵³ drawn as the nearest doubles"] if rounded else []
    note = f"<p><small>{escape('; '.join(parts))}.</small></p>" if parts else ""
    return page + note


def _names(names: Sequence[str]) -> str:
    return ", ".join(names[:MOST_NAMES]) + (f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else "")
