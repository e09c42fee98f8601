"""Report of a run: a self-contained HTML page, or a folder of PNG figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cosim.files.results import Results
from cosim.simulation.report.figures import write_figures
from cosim.simulation.report.run_page import write_report

__all__ = ["write_figures", "write_pages", "write_report"]


def write_pages(
    folder: Path, results: Results, manifest: Mapping[str, Any], *, report: bool = True, figures: bool = False
) -> None:
    """Write the report and the figures of a run into its folder."""
    if report:
        write_report(folder / "report.html", results, manifest)
    if figures:
        write_figures(folder / "figures", results, manifest)
