"""Page and charts of comparisons: signals of all runs in the same axes, differences from the baseline in tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.comparison.differences import MAX_LISTED_SIGNALS, Difference, criteria_of, format_share, format_size
from cosim.comparison.several import ComparedRuns
from cosim.core.arrays import Array, far_beyond
from cosim.core.text import MISSING, amount, counted, display, is_difference, some
from cosim.credibility.validity import bands_of_run
from cosim.files.run_inputs import input_text
from cosim.report.charts import Charts
from cosim.report.panels import Band, Panel, Trace, axis_unit, signal_panel
from cosim.report.template import command, render

TEMPLATE = Path(__file__).with_name("templates") / "comparison.html.j2"
MOST_LABELS = 4  # largest number of runs with labels including inputs in legends; more runs have short names
MAX_TABLE_ROWS = 200  # signals and inputs in a table; comparison.json has all
BASELINE, AGAIN = "baseline", ("", " again", " third")  # styles of lines: five colours three times for the others
OTHER_TIMES = "interpolated linearly at the times of the baseline"


def panels_of(c: ComparedRuns, name: str, curves: Sequence[Array], *, on_page: bool = False) -> list[Panel]:
    """Return the chart panel of a signal in all runs. For two runs, and on a page, a panel of differences is added."""
    unit, (fine, factor) = c.units[name], display(c.units[name])
    styles, labels = styles_of(c), c.shorts if on_page and len(c.drawn) > MOST_LABELS else c.labels
    by_run, base = dict(zip(c.drawn, curves, strict=True)), curves[c.drawn.index(c.baseline)]
    if name not in c.differing:
        return [signal_panel(name, unit, [("all runs", base, BASELINE)])]
    half = bands_of_run(c.runs[c.baseline].manifest, name, c.time)
    band = None if half is None else ("error band of the baseline", base - half, base + half)
    panels = [signal_panel(name, unit, [(labels[k], v, styles[k]) for k, v in by_run.items()], band)]
    if on_page or len(by_run) == 2:
        with np.errstate(invalid="ignore"):
            apart = {k: (values - base) * factor for k, values in by_run.items() if k != c.baseline}
        traces = [Trace(labels[k], values, styles[k]) for k, values in apart.items()]
        around = None if half is None else Band("error band of the baseline", -half * factor, half * factor)
        panels.append(Panel(f"{name} minus {c.shorts[c.baseline]}", fine or axis_unit(unit), traces, around))
    return panels


def styles_of(c: ComparedRuns) -> dict[int, str]:
    """Return the line style of each drawn run; the baseline has a unique style."""
    others = (k for k in c.drawn if k != c.baseline)
    return {c.baseline: BASELINE} | {k: f"s{place % 5}{AGAIN[place // 5]}" for place, k in enumerate(others)}


@far_beyond
def comparison_page(runs: ComparedRuns) -> str:
    """Return the self-contained HTML page of a comparison."""
    first, differing, charts = runs.comparisons[0], runs.differing, Charts()
    base, others = runs.shorts[runs.baseline], [runs.shorts[k] for k in runs.others]
    paths, tolerance = [str(runs.runs[k].path) for k in (runs.baseline, *runs.others)], ""
    options = {"--tol": [] if first.tolerance is None else [f"{first.tolerance:g}"]}
    options["--abs"] = [f"{first.absolute:g}"] if first.absolute else []
    if first.tolerance is not None:
        tolerance = f"{first.tolerance:g} of each signal's range in the baseline"
        tolerance += f" and {first.absolute:g} in its unit" if first.absolute else ""
    drawing, panels, equal_panels = charts.over(runs.time), list[Panel](), list[Panel]()
    for name, curves in runs.values.items():
        (panels if name in differing else equal_panels).extend(panels_of(runs, name, curves, on_page=True))
    unseen, left = len(runs.runs) - len(runs.drawn), len(differing) - len(panels) // 2
    note = f"Drawn: the {counted(len(runs.drawn), 'run')} and {counted(len(panels) // 2, 'signal')} that differ most; "
    note += f"only in the tables: {counted(unseen, 'run')} and {counted(left, 'signal')}."
    criteria = []
    for title, outcomes in criteria_of(runs.runs).items():
        limits = {_size(entry, "max") for entry in outcomes if entry is not None}
        is_one = len(limits) == 1  # state a common limit once
        cells = [_criterion_cell(entry, limit=not is_one) for entry in outcomes]
        criteria.append((f"{title}, at most {limits.pop()}" if is_one else title, *cells))
    values = {
        "tone": "plain" if not runs.judged else "good" if runs.same else "bad",
        "judged": runs.judged,
        "tolerance": tolerance,
        "repeat": command("cosim", "compare", *paths, options=options),
        "title": f"{others[0] if len(others) == 1 else counted(len(others), 'run')} against {base}",
        "outcomes": [*filter(None, runs.sentences)],
        "runs": _run_rows(runs),
        "shorts": runs.shorts,
        "inputs": [(row.name, row.kind, *_short(map(input_text, row.values))) for row in runs.inputs[:MAX_TABLE_ROWS]],
        "more_inputs": len(runs.inputs[MAX_TABLE_ROWS:]),
        "criteria": criteria,
        "left_out": runs.left_out,
        "signals": [(name, *map(_difference_cell, cells)) for name, cells in [*differing.items()][:MAX_TABLE_ROWS]],
        "more_signals": len([*differing][MAX_TABLE_ROWS:]),
        "equal_names": [name for name in runs.table if name not in differing],
        "plots": drawing.plots(panels),
        "equal": drawing.plots(equal_panels),
        "is_drawn": note if unseen or left else "",
        "baseline": runs.baseline,
    }
    return render(TEMPLATE, values, charts)


def _short(texts: Iterable[str]) -> list[str]:
    """Return texts in which file names replace paths, if the file names differ too."""
    whole = [*texts]
    names = [text.rpartition("/")[2] if text.startswith("/") else text for text in whole]
    return names if len({*names}) == len({*whole}) else whole


def _run_rows(c: ComparedRuns) -> list[dict[str, Any]]:
    """Return label, path, largest difference, verdict and notes of each run."""
    styles, rows = styles_of(c), []
    for k, run in enumerate(c.runs):
        most, same, notes = "baseline", None, list[str]()
        if compared := c.by_run.get(k):
            d, same = max(compared.differences, key=lambda d: d.share), compared.same
            most = f"{d.name}: {format_size(d, d.largest)} ({format_share(d)})" if d.largest else "equal"
            lists = (("of the baseline missing", compared.only_a), ("only here", compared.only_b))
            notes = [f"{counted(len(n), 'signal')} {what}: {some(n, MAX_LISTED_SIGNALS)}" for what, n in lists if n]
            notes += [compared.shorter, "" if compared.aligned else OTHER_TIMES]
        row = {"label": run.name, "style": styles.get(k, ""), "path": str(run.path), "most": most, "same": same}
        rows.append({**row, "note": "; ".join(filter(None, notes))})
    return rows


def _difference_cell(d: Difference | None) -> tuple[str, str, bool]:
    """Return largest difference, share, time and note as text; True if it exceeds the tolerance."""
    if d is None or not d.largest:
        return (MISSING, "", False) if d is None else ("0", d.note, False)
    about = (format_share(d), f"at {d.at:.6g}\u00a0s", d.note)
    return format_size(d, d.largest), ", ".join(filter(None, about)), d.beyond


def _size(entry: Mapping[str, Any], key: str) -> str:
    size = entry.get(key)
    unit = str(entry.get("unit") or "")
    return "never" if size is None else amount(float(size), unit, difference=is_difference(entry))


def _criterion_cell(entry: Mapping[str, Any] | None, *, limit: bool) -> tuple[str, str]:
    """Return the value of a criterion as text, optionally with its limit, and the tone of the outcome.

    The tone is good, bad, or "" for a run without the criterion.
    """
    if entry is None:
        return "not asked", ""
    text = f"{_size(entry, 'value')} of {_size(entry, 'max')}" if limit else _size(entry, "value")
    return text, "good" if entry.get("met") else "bad"
