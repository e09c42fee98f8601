"""What a page about a run shows beside its signals, of components that somebody has drawn a page for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.base import registry
from cosim.report.drawing import Drawing
from cosim.report.html_tables import Row
from cosim.simulation.report.recorded import Run


@dataclass(frozen=True)
class ComponentPage:
    """A page of its own for some components; without one, a run has its signals alone.

    template: extends run.html.j2
    values:   what it names beside what every page names
    tiles:    the handful of numbers a reader looks for first
    shown:    columns that it shows, so that they need not stand among the other signals
    data:     for its script
    """

    template: Path
    values: Mapping[str, Any] = field(default_factory=dict)
    tiles: Sequence[Row] = ()
    shown: frozenset[str] = frozenset()
    data: Mapping[str, Any] = field(default_factory=dict)


def component_page(run: Run, drawing: Drawing) -> ComponentPage | None:
    """Return the page that is registered for a component with these variables, None without one."""
    page: ComponentPage | None = None
    if declared := registry.page_for(run.variables.values()):
        page = registry.resolve(declared.subject)(run, drawing)
    return page


def figures_of(run: Run, folder: Path) -> list[Path]:
    """Return figures that are registered for a component with these variables; none without."""
    drawn: list[Path] = []
    if (page := registry.page_for(run.variables.values())) and page.figures:
        drawn = registry.resolve(page.figures)(run, folder)
    return drawn
