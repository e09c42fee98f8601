"""The recorded part of a run: which signals and which rows.

All rows are computed, and the recorded part is selected before writing. Recording settings therefore do not change
values or outcomes of criteria.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cosim.blocks.fmu import FmuBlock
from cosim.core.arrays import Array, Rows
from cosim.core.text import did_you_mean, join_names
from cosim.files.results import Results
from cosim.fmi.description import matches
from cosim.scenario.scenario import Recording
from cosim.system.wiring import Building


@dataclass(frozen=True)
class RecordedPart:
    """Recorded signals, as indices in the row and beside it, and the number of steps between recorded rows."""

    columns: tuple[int, ...]
    beside: tuple[int, ...]
    every: int = 1

    def rows(self, count: int) -> Rows:
        """Return the indices of recorded rows among the first `count` rows; the last row is always recorded."""
        rows = np.arange(0, count, self.every)
        return rows if not count or rows[-1] == count - 1 else np.append(rows, count - 1)


def take_signals(part: RecordedPart | None, results: Results) -> Results:
    """Return results with the recorded signals only, from results with all signals."""
    if part is None:
        return results
    every = [*results.exact]
    names, texts = [results.columns[k] for k in part.columns], [every[k] for k in part.beside]
    values: Array = np.array(results.values[:, list(part.columns)])
    units = {name: unit for name, unit in results.units.items() if name in {*names, *texts}}
    exact, whole = {name: results.exact[name] for name in texts}, results.whole & {*names}
    return replace(results, columns=tuple(names), values=values, units=units, exact=exact, whole=whole)


def recorded_part(building: Building) -> RecordedPart | None:
    """Return the recorded part of a run; None for all signals in every row. Faults of the key `record` are added."""
    scenario, record = building.scenario, building.scenario.record
    place = ("record", "signals") if isinstance(record, Recording) else ("record",)
    for k, pattern in enumerate(scenario.recorded):
        if objection := _objection(building, pattern):
            building.note((*place, k), objection)
    if not isinstance(record, Recording):
        return None
    steps = 1 if record.every is None else round(record.every / scenario.step)
    columns, beside = (
        tuple(k for k, c in enumerate(names) if record.signals is None or any(_is_meant(p, c) for p in record.signals))
        for names in (building.columns, building.beside)
    )
    return RecordedPart(columns, beside, max(1, steps))


def _is_meant(pattern: str, column: str) -> bool:
    """Return True if a pattern matches a column, or names the array that contains the column."""
    component, _, variable = column.partition(".")
    return matches(pattern, component, variable) or column.startswith(f"{pattern}[")


def _objection(building: Building, pattern: str) -> str | None:
    """Return why a pattern matches no signal, with similar names; None if it matches or its component has a fault."""
    scenario, components = building.scenario, building.components
    columns, name = [*building.columns, *building.beside], pattern.partition(".")[0]
    if any(_is_meant(pattern, column) for column in columns):
        return None
    if "*" not in name and name not in scenario.components:
        return (
            f'no component "{name}"{did_you_mean(name, scenario.components)}; write component.* or component.variable'
        )
    # The signal may belong to a component with a fault.
    if not ({*scenario.components} if "*" in name else {name}) <= {*components}:
        return None
    others = columns if "*" in name else [column for column in columns if column.startswith(f"{name}.")]
    if isinstance(component := components.get(name), FmuBlock):
        others += [f"{name}.{v.name}" for v in component.description.modelVariables if v.causality != "independent"]
    near = did_you_mean(pattern.replace("*", ""), others)
    return f'no signal matches "{pattern}"{near or f"; there are {join_names(others)}"}'
