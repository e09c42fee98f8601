"""The two ways to look at a run: a page for people to read, figures to put elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.files import atomic_write
from cosim.report.template import TEMPLATES, render
from cosim.results import Results

LARGEST = 1e100  # a run that has blown up; squares beyond it overflow


def write_report(path: Path, results: Results, manifest: Mapping[str, Any]) -> None:
    """Write one self-contained HTML page about a run; `manifest` may lack any of its keys."""
    from cosim.report.page import context
    from cosim.report.roles import Run

    page = render(TEMPLATES / "report.html.j2", context(Run(_drawable(results), manifest)))
    with atomic_write(path) as stream:
        stream.write(page)


def write_figures(folder: Path, results: Results, manifest: Mapping[str, Any]) -> list[Path]:
    """Write PNG figures of a run into `folder` and return their paths."""
    from cosim.report.figures import draw
    from cosim.report.roles import Run

    return draw(folder, Run(_drawable(results), manifest))


def _drawable(results: Results) -> Results:
    """The rows that have a time, with NaN for what no axis can hold: one kind of gap for everything after."""
    timed = np.isfinite(results.time)
    values = results.values[timed]
    return replace(results, time=results.time[timed], values=np.where(np.abs(values) < LARGEST, values, np.nan))
