"""Table of parameters per log: fitted values of groups, final filter estimates for other logs."""

from __future__ import annotations

from typing import NamedTuple

from cosim.core.text import MISSING, amount
from cosim.refinement.record import PerLog
from cosim.refinement.refinement import Refinement


class PerLogRow(NamedTuple):
    """A parameter of one group as text."""

    name: str
    group: str
    value: str
    interval: str
    how: str


def per_log_rows(r: Refinement) -> list[PerLogRow]:
    """Return a row for each parameter and group, fitted values first."""
    rows = []
    for name, entry in r.record.get("per_log", {}).items():
        parameter = PerLog.model_validate(entry)
        for group, e in parameter.groups.items():
            low, high = (amount(bound, parameter.unit, 3) for bound in e.ci95)
            rows.append(PerLogRow(name, group, amount(e.value, parameter.unit, 4), f"{low} … {high}", "fitted"))
        for group, f in parameter.followed.items():
            from_, by = amount(f.expected, parameter.unit, 3), amount(f.spread, parameter.unit, 2)
            how = f"by the filter at the end of the log, from {from_} ± {by} (one standard deviation)"
            rows.append(PerLogRow(name, group, amount(f.value, parameter.unit, 4), MISSING, how))
    return rows
