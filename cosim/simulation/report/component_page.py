"""Sections of a run's page for components with a registered page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.core import registry
from cosim.report.charts import Drawing
from cosim.report.html_tables import Row
from cosim.simulation.report.recorded import Run


@dataclass(frozen=True)
class ComponentPage:
    """Sections for some components, on a page with the signals of every run.

    Attributes:
        template: Extends run.html.j2.
        values: Values of the template besides the values of every page.
        tiles: Key figures.
        shown: Columns in these sections, omitted from the signals.
        data: Data of the script.
    """

    template: Path
    values: Mapping[str, Any] = field(default_factory=dict)
    tiles: Sequence[Row] = ()
    shown: frozenset[str] = frozenset()
    data: Mapping[str, Any] = field(default_factory=dict)


def component_page(run: Run, drawing: Drawing) -> ComponentPage | None:
    """Return the sections registered for the run's components, None without any."""
    entry = registry.page_for(run.variables.values())
    page: ComponentPage | None = registry.resolve(entry.subject)(run, drawing) if entry else None
    return page


def figures_of(run: Run, folder: Path) -> list[Path]:
    """Draw the figures registered for the run's components."""
    entry = registry.page_for(run.variables.values())
    paths: list[Path] = registry.resolve(entry.figures)(run, folder) if entry and entry.figures else []
    return paths
