"""`cosim compare`: differences of all signals, curves of both runs, and criteria side by side."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from cosim.base.arrays import far_beyond
from cosim.base.errors import InputError
from cosim.base.text import counted, written
from cosim.base.version import __version__
from cosim.comparison.differences import (
    Compared,
    compare_runs,
    criteria_of,
    criterion_cell,
    is_one_run,
    sentence,
    tone_of,
)
from cosim.comparison.several import ComparedRuns, RunSource, compare_several, label_runs
from cosim.comparison.several_page import several_page
from cosim.comparison.signal_panels import equal_panel, panels_of
from cosim.comparison.signals import format_share, format_size
from cosim.report.charts import Charts
from cosim.report.template import render
from cosim.simulation.run_files import RecordedRun
from cosim.storage.files import FilePath, check_writable, write_json, write_text
from cosim.storage.folders import new_run, remove_earlier

TEMPLATE = Path(__file__).with_name("templates") / "comparison.html.j2"
MAX_PLOTTED = 24  # signals with the largest differences
FILES = ("comparison.json", "report.html")
LONGEST_NAME, NUMBERED = 80, "run "  # characters of the name of a folder; the beginning of the name of a numbered run


@far_beyond
def compare(
    sources: Sequence[RunSource],
    folder: FilePath | None = None,
    *,
    baseline: int = 0,
    as_pair: bool = False,
    tolerance: float | None = None,
    absolute: float = 0.0,
    report: bool = True,
    write: bool = True,
    force: bool = False,
) -> tuple[Compared | ComparedRuns, Path]:
    """Compare runs with a baseline; write comparison.json and report.html.

    Args:
        baseline: Index of the baseline.
        as_pair: Whether to return the comparison of two runs as `Compared`.
        tolerance: Share of each signal's range in the baseline.
        absolute: Size in the signal's unit, added to the share.
        write: Whether to write files.
        force: Whether `folder` may have files.

    Returns:
        The comparison and its folder, the current one without files.

    Raises:
        InputError: Runs cannot be read, or have no common signal or time.
    """
    ordered = [sources[baseline], *(source for k, source in enumerate(sources) if k != baseline)]
    for option, value in (("--tol", tolerance), ("--abs", absolute)):
        if value is not None and not (math.isfinite(value) and value >= 0):
            raise InputError.at(ordered[0].path, f"{option} {value:g}: give a number that is not negative")
    comparison: Compared | ComparedRuns
    if as_pair:
        comparison = compare_runs(*_read_pair(ordered), tolerance, absolute)
    else:
        comparison = compare_several(sources, baseline, tolerance, absolute)
    if not write:
        return comparison, Path()
    shorts, compared = [source.short for source in ordered], [source.path for source in ordered]
    numbers = [short.removeprefix(NUMBERED) for short in shorts]
    name = f"runs {'-'.join(numbers)}" if all(map(str.isdecimal, numbers)) else " and ".join(shorts)
    if len(name) > LONGEST_NAME:
        name = f"{shorts[0]} and {len(shorts) - 1} others"
    with new_run(folder, name, "cosim compare", force=force) as place:
        check_writable(place, FILES, compared)
        remove_earlier(place, read=compared)
        write_json(place / "comparison.json", comparison.as_json())
        if report:
            about = _tolerance(tolerance, absolute, "the baseline"), _options(tolerance, absolute)
            if isinstance(comparison, Compared):
                page = render(TEMPLATE, context(comparison))
            else:
                page = several_page(comparison, *about)
            write_text(place / "report.html", page)
    return comparison, place


def _read_pair(sources: Sequence[RunSource]) -> tuple[RecordedRun, RecordedRun]:
    """Return two runs with names that differ."""
    runs = [source.read() for source in sources]
    shorts = [source.short for source in sources]
    if is_one_run(*runs):
        runs = [replace(runs[0], name=shorts[0]), replace(runs[1], name="the same run")]
    elif shorts[0] == shorts[1] or shorts != [run.name for run in runs]:
        labels, _ = label_runs(runs, shorts, [source.longer or source.short for source in sources])
        runs = [replace(run, name=label) for run, label in zip(runs, labels, strict=True)]
    return runs[0], runs[1]


def context(c: Compared) -> Mapping[str, Any]:
    """Return the variables of the page's template."""
    numeric = [d for d in c.ranking if d.name in c.values]
    plotted, equal = [d for d in numeric if d.largest][:MAX_PLOTTED], [d for d in numeric if not d.largest]
    shown = equal[: MAX_PLOTTED - len(plotted)]
    charts = Charts()
    drawing = charts.over(c.time)
    panels = [panel for d in plotted for panel in panels_of(d.name, d.unit, (c.a.name, c.b.name), c.values[d.name])]
    plots = drawing.plots(panels)
    equal_plots = drawing.plots([equal_panel(d.name, d.unit, c.values[d.name][0], "a and b") for d in shown])
    return {
        "a": c.a,
        "b": c.b,
        "outcome": sentence(c),
        "tone": tone_of(judged=c.judged, same=c.same),
        "judged": c.judged,
        "tolerance": _tolerance(c.tolerance, c.absolute),
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
        "criteria": [(title, *map(criterion_cell, both)) for title, both in criteria_of((c.a, c.b)).items()],
        "plots": plots,
        "undrawn": sum(d.largest > 0 for d in c.differences) - len(plotted),
        "equal_plots": equal_plots,
        "equal_count": counted(len(equal), "signal"),
        "only_a": c.only_a,
        "only_b": c.only_b,
        "data": charts.data(),
        "repeat": shlex.join(["cosim", "compare", str(c.a.path), str(c.b.path), *_options(c.tolerance, c.absolute)]),
        "version": __version__,
    }


def _options(tolerance: float | None, absolute: float) -> list[str]:
    options = ["--tol", f"{tolerance:g}"] if tolerance is not None else []
    return options + (["--abs", f"{absolute:g}"] if absolute else [])


def _tolerance(tolerance: float | None, absolute: float, base: str = "a") -> str:
    if tolerance is None:
        return ""
    parts = [f"{tolerance:g} of each signal's range in {base}"] + ([f"{absolute:g} in its unit"] if absolute else [])
    return " and ".join(parts)
