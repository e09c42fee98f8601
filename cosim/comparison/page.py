"""Pages and figures of comparisons: signals of two or more runs in the same charts, differences in tables."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.comparison import differences, several
from cosim.comparison.differences import criteria_of, sentence
from cosim.comparison.signals import Difference, format_share, format_size
from cosim.core.arrays import Array, far_beyond
from cosim.core.text import amount, counted, written
from cosim.core.version import __version__
from cosim.files.run_inputs import input_text
from cosim.report.charts import Charts
from cosim.report.panels import Panel, Trace, display_unit
from cosim.report.template import render

TEMPLATES = Path(__file__).with_name("templates")
MAX_PLOTTED = 24  # signals on the page of two runs, those with the largest differences
MOST_LABELS = 4  # runs whose legends have labels with inputs; legends of more runs have short names
MAX_ROWS = 200  # signals and inputs in a table; comparison.json has all
BASELINE, STYLES = "baseline", 15  # styles of lines: `run0` … `run14` for the others


def panels_of(c: Any, name: str, curves: Sequence[Array]) -> list[Panel]:
    """Return the panels of a signal."""
    if isinstance(c, differences.Compared):
        unit = next(d.unit for d in c.differences if d.name == name)
        return _pair_panels(name, unit, (c.a.name, c.b.name), curves)
    base = c.drawn.index(c.baseline)
    if name in c.equal:
        return [_panel(name, c.units[name], [("all runs", curves[base], BASELINE)])]
    labels, styles = [c.labels[k] for k in c.drawn], _styles(len(c.drawn), base)
    return [_panel(name, c.units[name], zip(labels, curves, styles, strict=True))]


def _panel(title: str, unit: str, curves: Any) -> Panel:
    """Return the panel of some curves, each with label, values and style."""
    label, factor = display_unit(unit)
    return Panel(title, label, [Trace(name, values * factor, style) for name, values, style in curves])


def _pair_panels(name: str, unit: str, runs: tuple[str, str], values: Sequence[Array]) -> list[Panel]:
    first, second = values
    both = [(f"a: {runs[0]}", first, "s0"), (f"b: {runs[1]}", second, "s1")]
    with np.errstate(invalid="ignore"):
        return [_panel(name, unit, both), _panel(f"{name}, b − a", unit, [("b − a", second - first, "error")])]


def _styles(count: int, baseline: int) -> list[str]:
    """Return a style of line for each run; that of the baseline is different from all others."""
    return [BASELINE if k == baseline else f"run{(k - (k > baseline)) % STYLES}" for k in range(count)]


@far_beyond
def comparison_page(c: differences.Compared | several.ComparedRuns) -> str:
    """Return the page of a comparison."""
    first = c if isinstance(c, differences.Compared) else c.comparisons[0]
    options, tolerance = list[str](), ""
    if first.tolerance is not None:
        base = "a" if c is first else "the baseline"
        tolerance = f"{first.tolerance:g} of each signal's range in {base}"
        tolerance += f" and {first.absolute:g} in its unit" if first.absolute else ""
        options = ["--tol", f"{first.tolerance:g}"]
    options += ["--abs", f"{first.absolute:g}"] if first.absolute else []
    charts = Charts()
    own = _pair_values(c, charts) if isinstance(c, differences.Compared) else _several_values(c, charts)
    repeat = shlex.join(["cosim", "compare", *map(str, own.pop("paths")), *options])
    tone = "plain" if not c.judged else "good" if c.same else "bad"
    common = {"tone": tone, "judged": c.judged, "tolerance": tolerance, "repeat": repeat, "version": __version__}
    template = "comparison.html.j2" if c is first else "several.html.j2"
    return render(TEMPLATES / template, {**common, **own, "data": charts.data()})


def _pair_values(c: differences.Compared, charts: Charts) -> dict[str, Any]:
    """Return the variables of the page of two runs."""
    numeric = [d for d in c.ranking if d.name in c.values]
    plotted, equal = [d for d in numeric if d.largest][:MAX_PLOTTED], [d for d in numeric if not d.largest]
    drawing, names = charts.over(c.time), (c.a.name, c.b.name)
    panels = [panel for d in plotted for panel in _pair_panels(d.name, d.unit, names, c.values[d.name])]
    plots = drawing.plots(panels)
    shown = equal[: MAX_PLOTTED - len(plotted)]
    return {
        "paths": (c.a.path, c.b.path),
        "a": c.a,
        "b": c.b,
        "outcome": sentence(c),
        "aligned": c.aligned,
        "rows": [
            {
                "name": d.name,
                "unit": written(d.unit),
                "largest": format_size(d, d.largest),
                "at": f"{d.at:.6g}\u00a0s",
                "rms": format_size(d, d.rms),
                "share": format_share(d),
                "beyond": d.beyond,
                "note": d.note,
            }
            for d in c.ranking
        ],
        "criteria": [(title, *map(_criterion_cell, both)) for title, both in criteria_of((c.a, c.b)).items()],
        "plots": plots,
        "undrawn": sum(d.largest > 0 for d in c.differences) - len(plotted),
        "equal_plots": drawing.plots(
            [_panel(d.name, d.unit, [("a and b", c.values[d.name][0], BASELINE)]) for d in shown]
        ),
        "equal_count": counted(len(equal), "signal"),
        "only_a": c.only_a,
        "only_b": c.only_b,
    }


def _several_values(c: several.ComparedRuns, charts: Charts) -> dict[str, Any]:
    """Return the variables of the page of several runs."""
    equal, short, base = {*c.equal}, c.shorts[c.baseline], c.drawn.index(c.baseline)
    differing = [(name, cells) for name, cells in c.table.items() if name not in equal]
    labels = [(c.labels if len(c.drawn) <= MOST_LABELS else c.shorts)[k] for k in c.drawn]
    styles, drawing = _styles(len(c.drawn), base), charts.over(c.time)
    panels, equal_panels = list[Panel](), list[Panel]()
    for name, values in c.values.items():
        unit, first = c.units[name], values[base]
        if name in equal:
            equal_panels.append(_panel(name, unit, [("all runs", first, BASELINE)]))
            continue
        curves = list(zip(labels, values, styles, strict=True))
        others = [(label, v - first, style) for label, v, style in curves if style != BASELINE]
        panels += [_panel(name, unit, curves), _panel(f"{name}, minus {short}", unit, others)]
    by_run, line_styles = dict(zip(c.others, c.comparisons, strict=True)), dict(zip(c.drawn, styles, strict=True))
    runs = []
    for k, run in enumerate(c.runs):
        of_run: dict[str, Any] = {"label": run.name, "style": line_styles.get(k, ""), "path": str(run.path)}
        of_run |= {"most": "baseline", "same": None, "note": ""}
        if k in by_run:
            d, missing = max(by_run[k].differences, key=lambda d: d.share), len(by_run[k].only_a)
            share = format_share(d).replace(" %", "\u00a0%")  # on one line
            most = f"{d.name}: {format_size(d, d.largest)} ({share})" if d.largest else "equal"
            notes = [f"{counted(missing, 'signal')} of the baseline missing" if missing else "", by_run[k].shorter]
            of_run |= {"most": most, "same": by_run[k].same, "note": "; ".join(filter(None, notes))}
        runs.append(of_run)
    inputs = []
    for row in c.inputs[:MAX_ROWS]:
        texts = [input_text(value) for value in row.values]
        names = [text.rpartition("/")[2] if text.startswith("/") else text for text in texts]  # the last part of paths
        inputs.append((row.name, row.kind, *(names if len({*names}) == len({*texts}) else texts)))
    criteria = []
    for title, outcomes in criteria_of(c.runs).items():
        limits = {_criterion_limit(entry) for entry in outcomes if entry is not None}
        is_one = len(limits) == 1  # which is told once
        cells = [_criterion_cell(entry, limit=not is_one) for entry in outcomes]
        criteria.append((f"{title}, at most {limits.pop()}" if is_one else title, *cells))
    unseen, left = len(c.runs) - len(c.drawn), len(differing) - len(panels) // 2
    parts = [f"the baseline and the {len(c.drawn) - 1} runs that differ most"] if unseen else []
    parts += [f"the {len(panels) // 2} signals that differ most"] if left else []
    rest = [counted(count, noun) for count, noun in ((unseen, "run"), (left, "signal")) if count]
    return {
        "paths": [c.runs[k].path for k in (c.baseline, *c.others)],
        "base": short,
        "count": counted(len(c.others), "run"),
        "outcome": c.summary,
        "runs": runs,
        "shorts": c.shorts,
        "inputs": inputs,
        "more_inputs": max(0, len(c.inputs) - MAX_ROWS),
        "criteria": criteria,
        "left_out": c.left_out,
        "signals": [(name, *map(_difference_cell, cells)) for name, cells in differing[:MAX_ROWS]],
        "more_signals": max(0, len(differing) - MAX_ROWS),
        "equal_names": c.equal,
        "equal_count": counted(len(equal), "signal"),
        "plots": drawing.plots(panels),
        "equal": drawing.plots(equal_panels),
        "is_drawn": f"Drawn: {', '.join(parts)}. Only in the tables: {' and '.join(rest)}." if parts else "",
        "baseline": c.baseline,
    }


def _difference_cell(d: Difference | None) -> tuple[str, str, bool]:
    """Return size, share and verdict of a difference."""
    if d is None:
        return "–", "", False
    return (format_size(d, d.largest), format_share(d), d.beyond) if d.largest else ("0", "", False)


def _criterion_limit(entry: Mapping[str, Any]) -> str:
    return amount(float(entry.get("max", np.nan)), str(entry.get("unit") or ""))


def _criterion_cell(entry: Mapping[str, Any] | None, *, limit: bool = True) -> tuple[str, str]:
    """Return the value as text, with its limit, and the tone of the outcome.

    The tone is good, bad, or "" for a run without the criterion.
    """
    if entry is None:
        return "not asked", ""
    value = entry.get("value")
    text = "never" if value is None else amount(float(value), str(entry.get("unit") or ""))
    return f"{text} of {_criterion_limit(entry)}" if limit else text, "good" if entry.get("met") else "bad"
