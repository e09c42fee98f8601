"""The page of several runs: all runs in the same charts, inputs that differ, criteria and differences in tables."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.base.text import counted
from cosim.base.version import __version__
from cosim.comparison.differences import Compared, criterion_cell, criterion_limit, tone_of
from cosim.comparison.several import ComparedRuns, sentence
from cosim.comparison.signal_panels import differences, equal_panel, overlay, styles_of
from cosim.comparison.signals import Difference, format_share, format_size
from cosim.history.inputs import DifferingInput, input_text
from cosim.report.charts import Charts
from cosim.report.template import render

TEMPLATE = Path(__file__).with_name("templates") / "several.html.j2"
MOST_LABELS = 4  # runs whose legends have labels with inputs; legends of more runs have short names
MAX_ROWS = 200  # signals and inputs in a table; comparison.json has all


def several_page(c: ComparedRuns, tolerance: str, options: Sequence[str]) -> str:
    """Return the page.

    Args:
        tolerance: The tolerance as a phrase, "" without one.
        options: Options of the command that repeats the comparison.
    """
    return render(TEMPLATE, _context(c, tolerance, options))


def _context(c: ComparedRuns, tolerance: str, options: Sequence[str]) -> Mapping[str, Any]:
    paths = [str(c.runs[k].path) for k in (c.baseline, *c.others)]
    equal = {*c.equal}
    differing = {name: cells for name, cells in c.table.items() if name not in equal}
    return {
        "base": c.shorts[c.baseline],
        "count": counted(len(c.others), "run"),
        "outcome": sentence(c),
        "tone": tone_of(judged=c.judged, same=c.same),
        "tolerance": tolerance,
        "judged": c.judged,
        "runs": _run_rows(c),
        "shorts": c.shorts,
        "inputs": [(i.name, i.kind, *_input_cells(i)) for i in c.inputs[:MAX_ROWS]],
        "more_inputs": max(0, len(c.inputs) - MAX_ROWS),
        "criteria": [_criterion_row(title, outcomes) for title, outcomes in c.criteria.items()],
        "left_out": c.left_out,
        "signals": [(name, *map(_difference_cell, cells)) for name, cells in list(differing.items())[:MAX_ROWS]],
        "more_signals": max(0, len(differing) - MAX_ROWS),
        "equal_names": c.equal,
        "equal_count": counted(len(equal), "signal"),
        **_charts(c),
        "is_drawn": _drawn(c),
        "baseline": c.baseline,
        "repeat": shlex.join(["cosim", "compare", *paths, *options]),
        "version": __version__,
    }


def _charts(c: ComparedRuns) -> dict[str, Any]:
    """Return charts of signals that differ and of equal ones, with their data."""
    base, short = c.drawn.index(c.baseline), c.shorts[c.baseline]
    labels = [(c.labels if len(c.drawn) <= MOST_LABELS else c.shorts)[k] for k in c.drawn]
    charts = Charts()
    drawing = charts.over(c.time)
    differing, equal, every_equal = [], [], {*c.equal}
    for name, curves in c.curves.items():
        about = name, c.units[name], labels, curves, base
        if name in every_equal:
            equal.append(equal_panel(name, c.units[name], curves[base]))
        else:
            differing += [overlay(*about), differences(*about, short=short)]
    plots, equal_plots = drawing.plots(differing), drawing.plots(equal)
    return {"plots": plots, "equal": equal_plots, "data": charts.data()}


def _input_cells(row: DifferingInput) -> list[str]:
    """Return the values of an input as texts; of paths their last part, if it tells them apart."""
    texts = [input_text(value) for value in row.values]
    names = [text.rpartition("/")[2] if text.startswith("/") else text for text in texts]
    return names if len({*names}) == len({*texts}) else texts


def _criterion_row(title: str, outcomes: Sequence[Mapping[str, Any] | None]) -> tuple[Any, ...]:
    """Return a criterion and its cells; a limit that is the same in all runs is told once."""
    limits = {criterion_limit(entry) for entry in outcomes if entry is not None}
    if len(limits) == 1:
        return f"{title}, at most {limits.pop()}", *(criterion_cell(entry, limit=False) for entry in outcomes)
    return title, *map(criterion_cell, outcomes)


def _run_rows(c: ComparedRuns) -> list[dict[str, Any]]:
    styles = dict(zip(c.drawn, styles_of(len(c.drawn), c.drawn.index(c.baseline)), strict=True))
    by_run = dict(zip(c.others, c.comparisons, strict=True))
    return [
        {
            "label": run.name,
            "style": styles.get(k, ""),
            "path": str(run.path),
            "most": _largest(by_run[k]) if k in by_run else "baseline",
            "same": by_run[k].same if k in by_run else None,
            "note": _note(by_run[k]) if k in by_run else "",
        }
        for k, run in enumerate(c.runs)
    ]


def _largest(comparison: Compared) -> str:
    d = max(comparison.differences, key=lambda d: d.share)
    share = format_share(d).replace(" %", "\u00a0%")  # on one line
    return f"{d.name}: {format_size(d, d.largest)} ({share})" if d.largest else "equal"


def _note(comparison: Compared) -> str:
    """Return a note on missing signals and on the ends of a run."""
    missing = len(comparison.only_a)
    parts = [f"{counted(missing, 'signal')} of the baseline missing" if missing else "", str(comparison.shorter)]
    return "; ".join(filter(None, parts))


def _difference_cell(d: Difference | None) -> tuple[str, str, bool]:
    """Return size, share and verdict of a difference."""
    if d is None:
        return "–", "", False
    return (format_size(d, d.largest), format_share(d), d.beyond) if d.largest else ("0", "", False)


def _drawn(c: ComparedRuns) -> str:
    """Return a sentence on the runs and differing signals that are drawn, "" if all are."""
    drawn = len({*c.curves} - {*c.equal})
    runs, signals = len(c.runs) - len(c.drawn), len(c.ranking) - len(c.equal) - drawn
    parts = [f"the baseline and the {len(c.drawn) - 1} runs that differ most"] if runs else []
    parts += [f"the {drawn} signals that differ most"] if signals else []
    rest = [counted(count, noun) for count, noun in ((runs, "run"), (signals, "signal")) if count]
    return f"Drawn: {', '.join(parts)}. Only in the tables: {' and '.join(rest)}." if parts else ""
