"""`cosim compare`: differences of all signals, curves of both runs, and criteria side by side."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cosim.base.arrays import far_beyond
from cosim.base.errors import InputError
from cosim.base.text import amount, written
from cosim.base.version import __version__
from cosim.comparison import messages
from cosim.comparison.differences import Compared, compare_runs, criteria_of, sentence
from cosim.comparison.signal_panels import panels_of
from cosim.comparison.signals import Difference, format_share, format_size
from cosim.report.chart_data import to_json
from cosim.report.drawing import Drawing
from cosim.report.template import render
from cosim.simulation.run_files import RecordedRun
from cosim.storage.files import FilePath, check_writable, named_path, write_json, write_text
from cosim.storage.folder_lock import folder_locks
from cosim.storage.folders import check_overwritable, folder_named, keep_earlier

TEMPLATE = Path(__file__).with_name("templates") / "comparison.html.j2"
MAX_PLOTTED = 24  # signals with the largest differences
FILES = ("comparison.json", "report.html")


@folder_locks()
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
) -> tuple[Compared, Path]:
    """Compare run b with run a; write comparison.json and report.html.

    Args:
        tolerance: Share of each signal's range in a.
        absolute: Size in the signal's unit, added to the share.
        write: Whether to write files.
        force: Whether to overwrite the files of another command.

    Returns:
        The comparison and its folder.

    Raises:
        InputError: The runs have no common signal or time.
    """
    for name, value in (("--tol", tolerance), ("--abs", absolute)):
        if value is not None and not (math.isfinite(value) and value >= 0):
            raise InputError.at(a.path, messages.NEGATIVE_TOLERANCE(option=name, value=value))
    comparison = compare_runs(a, b, tolerance, absolute)
    place = folder_named(f"{a.name} and {b.name}") if folder is None else named_path(folder)
    if not write:
        return comparison, place
    read = [p / "manifest.json" if p.is_dir() else p for p in (a.path, b.path)]
    check_overwritable(place, "cosim compare", str(a.path), str(b.path), force=force, keep=folder is None)
    check_writable(place, FILES, read)
    if folder is None:
        keep_earlier(place, "cosim compare")
    write_json(place / "comparison.json", comparison.as_json())
    (place / "report.html").unlink(missing_ok=True)
    if report:
        write_text(place / "report.html", render(TEMPLATE, context(comparison)))
    return comparison, place


def context(c: Compared) -> Mapping[str, Any]:
    """Return the variables of the page's template."""
    plotted = [d for d in c.ranking if d.name in c.values][:MAX_PLOTTED]
    drawing = Drawing(c.time, 3 * len(plotted))
    panels = [panel for d in plotted for panel in panels_of(d.name, d.unit, (c.a.name, c.b.name), c.values[d.name])]
    plots = drawing.plots(panels)  # before its series
    return {
        "a": c.a,
        "b": c.b,
        "outcome": sentence(c),
        "tone": "plain" if not c.judged else "good" if c.same else "bad",
        "judged": c.judged,
        "tolerance": _tolerance(c),
        "aligned": c.aligned,
        "rows": [_row(d) for d in c.ranking],
        "criteria": [(title, _verdict(a), _verdict(b)) for title, a, b in criteria_of(c)],
        "plots": plots,
        "undrawn": len(c.differences) - len(plotted),
        "only_a": c.only_a,
        "only_b": c.only_b,
        "data": to_json(drawing.series),
        "repeat": shlex.join(["cosim", "compare", str(c.a.path), str(c.b.path), *_options(c)]),
        "version": __version__,
    }


def _options(c: Compared) -> list[str]:
    options = ["--tol", f"{c.tolerance:g}"] if c.tolerance is not None else []
    return options + (["--abs", f"{c.absolute:g}"] if c.absolute else [])


def _tolerance(c: Compared) -> str:
    if c.tolerance is None:
        return ""
    parts = [f"{c.tolerance:g} of each signal's range in a"] + ([f"{c.absolute:g} in its unit"] if c.absolute else [])
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


def _verdict(entry: dict[str, Any] | None) -> tuple[str, str]:
    if entry is None:
        return "not asked", ""
    value = entry.get("value")
    text = "never" if value is None else amount(float(value), str(entry.get("unit") or ""))
    return f"{text} of {amount(float(entry.get('max', math.nan)), str(entry.get('unit') or ''))}", (
        "good" if entry.get("met") else "bad"
    )
