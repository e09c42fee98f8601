"""Numbers for the page's script: every row of the charts' signals, safe inside a script element."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.base.messages import printable_json
from cosim.report.packed import on_grid, pack, power, power_of_time
from cosim.report.panels import HELD, LINE, Panel, Trace

MOST_CELLS = 6_000_000  # values in a page; beyond, every n-th row
COUNTS = 1e9  # held whole numbers below have no decimals
TIME = ("time", "s")  # default x axis of a page
Numbers = list[float | None]


def sample_rows(count: int, limit: int) -> Rows:
    """Return about `limit` row numbers at equal distance, and the last row."""
    rows = np.arange(0, count, max(1, math.ceil(count / limit)))
    return rows if not count or rows[-1] == count - 1 else np.append(rows, count - 1)


def round_values(values: Array, digits: int) -> Numbers:
    """Return values rounded for JSON; a value that is not finite becomes null."""
    numbers = [round(value, digits) if math.isfinite(value) else None for value in values.tolist()]
    return [int(n) if n is not None and n == int(n) and abs(n) < 1e15 else n for n in numbers]


@dataclass(frozen=True)
class Abscissa:
    """The x axis of charts.

    Attributes:
        over: Name and unit.
        ends: Limits of the axis, by default its first and last value.
        sparse: Signals have values at few rows each; a missing value is no gap in a line.
        breaks: Rows after which traces with `anew` restart.
        log: x holds logarithms to base 10 of the displayed values.
        points: The cursor reads the nearest point of a plane.
    """

    over: tuple[str, str] = TIME
    ends: tuple[float, float] | None = None
    sparse: bool = False
    breaks: Sequence[int] = ()
    log: bool = False
    points: bool = False

    @property
    def label(self) -> str:
        """Return name and unit in words."""
        return f"{self.over[0]} in {self.over[1] or '1'}"

    def about(self, rows: Rows) -> dict[str, Any]:
        """Return the axis settings for the page's script."""
        about: dict[str, Any] = {"over": self.over} if self.over != TIME else {}
        about |= {"ends": self.ends} if self.ends else {}
        about |= {flag: 1 for flag in ("sparse", "log", "points") if getattr(self, flag)}
        return about | ({"breaks": np.searchsorted(rows, list(self.breaks), "right").tolist()} if self.breaks else {})


OVER_TIME = Abscissa()


class Series:
    """Signals over one axis for the script, each under a short key.

    Attributes:
        rows: Rows in the page; every n-th row if all signals together exceed MOST_CELLS.
    """

    def __init__(self, time: Array, curves: int, abscissa: Abscissa = OVER_TIME, *, name: str = "") -> None:
        self.time, self.name = time, name
        self.rows = sample_rows(time.size, max(2, MOST_CELLS // max(1, curves)))
        self.entries: dict[str, dict[str, Any]] = {}
        self.columns = [on_grid(time[self.rows], power_of_time(time))]
        self.about = abscissa.about(self.rows)

    def add(self, panel: Panel) -> list[str]:
        """Add a panel's traces and return their keys."""
        return [self.trace(trace, trace.values, trace.upper) for trace in panel.traces]

    def trace(self, trace: Trace, values: Array, upper: Array | None = None) -> str:
        """Add a trace and return its key."""
        more: dict[str, Any] = {"b": 1} if trace.anew else {}
        more |= {"s": trace.shift} if trace.shift else {}
        more |= {"u": self.column(upper)} if upper is not None else {}
        more |= {"i": {f"{value:.16g}": name for value, name in trace.items.items()}} if trace.items else {}
        return self.column(values, form=trace.form, more=more)

    def band(self, panel: Panel) -> tuple[str, ...]:
        """Add a band's edges and return their keys."""
        return (self.column(panel.band.lower), self.column(panel.band.upper)) if panel.band else ()

    def column(self, values: Array, *, form: int = LINE, more: Mapping[str, Any] = MappingProxyType({})) -> str:
        """Add a signal; return its key in the script."""
        key, values = f"{self.name}k{len(self.entries)}", values[self.rows]
        good = np.isfinite(values)
        finite = values[good]
        are_counts = form == HELD and bool(np.all(np.abs(finite) < COUNTS)) and np.array_equal(finite, np.rint(finite))
        decimals, has_gaps = 0 if are_counts else power(values), not bool(good.all())
        self.columns.append(on_grid(values, decimals))
        if has_gaps:
            self.columns.append(good.astype(np.int64))
        self.entries[key] = {"p": decimals, "h": form, "g": int(has_gaps), **more}
        return key


def to_json(series: Series, more: Mapping[str, Any] = MappingProxyType({}), *, further: Sequence[Series] = ()) -> str:
    """Return all series as JSON for the page's script.

    `<`, `>` and `&` are escaped, since no text may end the script element.

    Args:
        further: Signals over further axes, each series with its own name.
    """
    data = {**_block(series), **({"further": [_block(s) for s in further]} if further else {}), **more}
    text = printable_json(json.dumps(data, separators=(",", ":"), allow_nan=False))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _block(series: Series) -> dict[str, Any]:
    """Return the data of an axis for the script.

    Key `every` is the distance between the rows in the page, `of` the number of all rows.
    """
    every = int(series.rows[1] - series.rows[0]) if series.rows.size > 1 else 1
    return {
        "rows": int(series.rows.size),
        "every": every,
        "of": int(series.time.size),
        "p": power_of_time(series.time),
        "series": series.entries,
        "packed": pack(series.columns),
        **series.about,
    }
