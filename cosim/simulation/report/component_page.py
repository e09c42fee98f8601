"""Sections of a run's page for components with a registered page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.report.html_tables import Row


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
