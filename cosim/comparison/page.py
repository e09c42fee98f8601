"""Page and charts of comparisons: signals of all runs in the same axes, differences from the baseline in tables."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.comparison.differences import MAX_LISTED, Difference, criteria_of, format_share, format_size
from cosim.comparison.several import ComparedRuns
from cosim.core.arrays import Array, far_beyond
from cosim.core.text import amount, counted, display, displayed, is_difference, some
from cosim.core.version import __version__
from cosim.credibility.validity import bands_of_run
from cosim.files.run_inputs import input_text
from cosim.report.charts import Charts
from cosim.report.panels import Band, Panel, Trace, axis_unit
from cosim.report.template import render

TEMPLATE = Path(__file__).with_name("templates") / "comparison.html.j2"
MOST_LABELS = 4  # largest number of runs with labels including inputs in legends; more runs have short names
MAX_ROWS = 200  # signals and inputs in a table; comparison.json has all
BASELINE, STYLES = "baseline", 15  # styles of lines: `run0` … `run14` for the others
OTHER_TIMES = "interpolated linearly at the times of the baseline"


def styles_of(c: ComparedRuns) -> dict[int, str]:
    """Return the line style of each drawn run; the baseline has a unique style."""
    others = (k for k in c.drawn if k != c.baseline)
    return {c.baseline: BASELINE} | {k: f"run{place % STYLES}" for place, k in enumerate(others)}


def panels_of(c: ComparedRuns, name: str, curves: Sequence[Array], *, on_page: bool = False) -> list[Panel]:
    """Return the chart panel of a signal in all runs. For two runs, and on a page, a panel of differences is added."""
    own = c.units[name]
    unit, (fine, factor) = axis_unit(own), display(own)
    by_run, styles = dict(zip(c.drawn, curves, strict=True)), styles_of(c)
    labels = c.shorts if on_page and len(c.drawn) > MOST_LABELS else c.labels
    base = by_run[c.baseline]
    if name in c.equal:
        return [Panel(name, unit, [Trace("all runs", displayed(base, own), BASELINE)])]
    panels = [Panel(name, unit, [Trace(labels[k], displayed(v, own), styles[k]) for k, v in by_run.items()])]
    half = bands_of_run(c.runs[c.baseline].manifest, name, c.time)
    if half is not None:
        edges = (displayed(edge, own) for edge in (base - half, base + half))
        panels = [replace(panels[0], band=Band("error band of the baseline", *edges))]
    if on_page or len(by_run) == 2:
        with np.errstate(invalid="ignore"):
            differences = {k: (values - base) * factor for k, values in by_run.items() if k != c.baseline}
        traces = [Trace(labels[k], values, styles[k]) for k, values in differences.items()]
        band = None if half is None else Band("error band of the baseline", -half * factor, half * factor)
        panels.append(Panel(f"{name} minus {c.shorts[c.baseline]}", fine or unit, traces, band))
    return panels


@far_beyond
def comparison_page(runs: ComparedRuns) -> str:
    """Return the page of a comparison."""
    first, table, equal = runs.comparisons[0], runs.table, runs.equal
    base, others = runs.shorts[runs.baseline], [runs.shorts[k] for k in runs.others]
    paths, options, tolerance = [runs.runs[k].path for k in (runs.baseline, *runs.others)], list[str](), ""
    if first.tolerance is not None:
        tolerance = f"{first.tolerance:g} of each signal's range in the baseline"
        tolerance += f" and {first.absolute:g} in its unit" if first.absolute else ""
        options = ["--tol", f"{first.tolerance:g}"]
    options += ["--abs", f"{first.absolute:g}"] if first.absolute else []
    charts = Charts()
    drawing, panels, equal_panels = charts.over(runs.time), list[Panel](), list[Panel]()
    for name, curves in runs.values.items():
        (equal_panels if name in equal else panels).extend(panels_of(runs, name, curves, on_page=True))
    differing = [(name, cells) for name, cells in table.items() if name not in equal]
    unseen, left = len(runs.runs) - len(runs.drawn), len(differing) - len(panels) // 2
    parts = [f"the baseline and the {len(runs.drawn) - 1} runs that differ most"] if unseen else []
    parts += [f"the {len(panels) // 2} signals that differ most"] if left else []
    rest = [counted(number, noun) for number, noun in ((unseen, "run"), (left, "signal")) if number]
    inputs = []
    for row in runs.inputs[:MAX_ROWS]:
        texts = [input_text(value) for value in row.values]
        # shorten paths to their last part
        names = [text.rpartition("/")[2] if text.startswith("/") else text for text in texts]
        inputs.append((row.name, row.kind, *(names if len({*names}) == len({*texts}) else texts)))
    criteria = []
    for title, outcomes in criteria_of(runs.runs).items():
        limits = {_criterion_limit(entry) for entry in outcomes if entry is not None}
        is_one = len(limits) == 1  # state a common limit once
        cells = [_criterion_cell(entry, limit=not is_one) for entry in outcomes]
        criteria.append((f"{title}, at most {limits.pop()}" if is_one else title, *cells))
    context = {
        "tone": "plain" if not runs.judged else "good" if runs.same else "bad",
        "judged": runs.judged,
        "tolerance": tolerance,
        "repeat": shlex.join(["cosim", "compare", *map(str, paths), *options]),
        "version": __version__,
        "title": f"{others[0] if len(others) == 1 else counted(len(others), 'run')} against {base}",
        "outcomes": [*filter(None, (runs.summary_of_criteria, runs.summary_of_differences))],
        "runs": _run_rows(runs),
        "shorts": runs.shorts,
        "inputs": inputs,
        "more_inputs": max(0, len(runs.inputs) - MAX_ROWS),
        "criteria": criteria,
        "left_out": runs.left_out,
        "signals": [(name, *map(_difference_cell, cells)) for name, cells in differing[:MAX_ROWS]],
        "more_signals": max(0, len(differing) - MAX_ROWS),
        "equal_names": equal,
        "equal_count": counted(len(equal), "signal"),
        "plots": drawing.plots(panels),
        "equal": drawing.plots(equal_panels),
        "is_drawn": f"Drawn: {', '.join(parts)}. Only in the tables: {' and '.join(rest)}." if parts else "",
        "baseline": runs.baseline,
    }
    return render(TEMPLATE, {**context, "data": charts.data()})  # after all drawings


def _run_rows(c: ComparedRuns) -> list[dict[str, Any]]:
    """Return label, path, largest difference, verdict and notes of each run."""
    by_run, styles, rows = c.by_run, styles_of(c), []
    for k, run in enumerate(c.runs):
        row: dict[str, Any] = {"label": run.name, "style": styles.get(k, ""), "path": str(run.path)}
        row |= {"most": "baseline", "same": None, "note": ""}
        if compared := by_run.get(k):
            d = max(compared.differences, key=lambda d: d.share)
            share = format_share(d).replace(" %", "\u00a0%")  # on one line
            row["most"] = f"{d.name}: {format_size(d, d.largest)} ({share})" if d.largest else "equal"
            lists = (("of the baseline missing", compared.only_a), ("only here", compared.only_b))
            notes = [f"{counted(len(n), 'signal')} {what}: {some(n, MAX_LISTED)}" for what, n in lists if n]
            notes += [compared.shorter, "" if compared.aligned else OTHER_TIMES]
            row |= {"same": compared.same, "note": "; ".join(filter(None, notes))}
        rows.append(row)
    return rows


def _difference_cell(d: Difference | None) -> tuple[str, str, bool]:
    """Return largest difference, share, time and note as text; True if it exceeds the tolerance."""
    if d is None:
        return "–", "", False
    if not d.largest:
        return "0", d.note, False
    about = (format_share(d), f"at {d.at:.6g}\u00a0s", d.note)
    return format_size(d, d.largest), ", ".join(filter(None, about)), d.beyond


def _criterion_limit(entry: Mapping[str, Any]) -> str:
    return amount(float(entry.get("max", np.nan)), str(entry.get("unit") or ""), difference=is_difference(entry))


def _criterion_cell(entry: Mapping[str, Any] | None, *, limit: bool) -> tuple[str, str]:
    """Return the value of a criterion as text, optionally with its limit, and the tone of the outcome.

    The tone is good, bad, or "" for a run without the criterion.
    """
    if entry is None:
        return "not asked", ""
    value = entry.get("value")
    text = (
        "never"
        if value is None
        else amount(float(value), str(entry.get("unit") or ""), difference=is_difference(entry))
    )
    return f"{text} of {_criterion_limit(entry)}" if limit else text, "good" if entry.get("met") else "bad"
