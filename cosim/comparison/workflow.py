"""`cosim compare`: differences of all signals, curves of both runs, and criteria side by side."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from cosim.base.arrays import far_beyond
from cosim.base.errors import InputError
from cosim.base.text import counted, written
from cosim.base.version import __version__
from cosim.comparison.criterion_cells import criterion_cell, tone_of
from cosim.comparison.differences import Compared, compare_runs, criteria_of, sentence
from cosim.comparison.several import ComparedRuns, RunSource, compare_several
from cosim.comparison.several_page import several_page
from cosim.comparison.signal_panels import equal_panel, panels_of
from cosim.comparison.signals import Difference, format_share, format_size
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
    a: RecordedRun,
    b: RecordedRun,
    folder: FilePath | None = None,
    *,
    tolerance: float | None = None,
    absolute: float = 0.0,
    report: bool = True,
    write: bool = True,
    force: bool = False,
    shorts: Sequence[str] | None = None,
) -> tuple[Compared, Path]:
    """Compare run b with run a; write comparison.json and report.html.

    Args:
        tolerance: Share of each signal's range in a.
        absolute: Size in the signal's unit, added to the share.
        write: Whether to write files.
        force: Whether `folder` may have files.
        shorts: Short names of both runs, for the name of the default folder.

    Returns:
        The comparison and its folder, the current one without files.

    Raises:
        InputError: The runs have no common signal or time.
    """
    _check_tolerance(a.path, tolerance, absolute)
    comparison = compare_runs(a, b, tolerance, absolute)
    if not write:
        return comparison, Path()
    with new_run(folder, _name_of(shorts or (a.name, b.name)), "cosim compare", force=force) as place:
        page = partial(render, TEMPLATE, context(comparison)) if report else None
        _write(place, comparison.as_json(), page, [a.path, b.path])
    return comparison, place


@far_beyond
def compare_all(
    sources: Sequence[RunSource],
    folder: FilePath | None = None,
    *,
    baseline: int = 0,
    tolerance: float | None = None,
    absolute: float = 0.0,
    report: bool = True,
    write: bool = True,
    force: bool = False,
) -> tuple[ComparedRuns, Path]:
    """Compare several runs with a baseline; write comparison.json and report.html.

    Args:
        baseline: Index of the baseline.
        tolerance: Share of each signal's range in the baseline.
        absolute: Size in the signal's unit, added to the share.
        write: Whether to write files.
        force: Whether `folder` may have files.

    Returns:
        The comparison and its folder, the current one without files.

    Raises:
        InputError: Runs cannot be read, or have no common signal or time.
    """
    base = sources[baseline]
    _check_tolerance(base.path, tolerance, absolute)
    comparison = compare_several(sources, baseline, tolerance, absolute)
    if not write:
        return comparison, Path()
    names = [base.short, *(s.short for k, s in enumerate(sources) if k != baseline)]
    with new_run(folder, _name_of(names), "cosim compare", force=force) as place:
        about = _tolerance(tolerance, absolute, "the baseline"), _options(tolerance, absolute)
        page = partial(several_page, comparison, *about) if report else None
        _write(place, comparison.as_json(), page, [source.path for source in sources])
    return comparison, place


def _name_of(names: Sequence[str]) -> str:
    """Return the name of a comparison: `runs 1-2-3`, or `a and 5 others`."""
    numbers = [name.removeprefix(NUMBERED) for name in names]
    text = f"runs {'-'.join(numbers)}" if all(map(str.isdecimal, numbers)) else " and ".join(names)
    return text if len(text) <= LONGEST_NAME else f"{names[0]} and {len(names) - 1} others"


def _check_tolerance(path: Path, tolerance: float | None, absolute: float) -> None:
    for name, value in (("--tol", tolerance), ("--abs", absolute)):
        if value is not None and not (math.isfinite(value) and value >= 0):
            raise InputError.at(path, f"{name} {value:g}: give a number that is not negative")


def _write(place: Path, content: Mapping[str, Any], page: Callable[[], str] | None, compared: Sequence[Path]) -> None:
    """Write comparison.json and report.html; what is compared stays where it is."""
    check_writable(place, FILES, compared)
    remove_earlier(place, read=compared)
    write_json(place / "comparison.json", content)
    if page is not None:
        write_text(place / "report.html", page())


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
        "rows": [_row(d) for d in c.ranking],
        "criteria": [(title, criterion_cell(a), criterion_cell(b)) for title, a, b in criteria_of(c)],
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


def _row(d: Difference) -> dict[str, Any]:
    return {
        "name": d.name,
        "unit": written(d.unit),
        "largest": format_size(d, d.largest),
        "at": f"{d.at:.6g}\u00a0s",
        "rms": format_size(d, d.rms),
        "share": format_share(d),
        "beyond": d.beyond,
        "note": d.note,
    }
