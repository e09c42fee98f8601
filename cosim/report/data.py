"""Numbers for the page's script: every row of every signal in a chart, and safe inside a script element."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.arrays import Array, Rows
from cosim.report.packed import packed, power, power_of_time, whole
from cosim.report.panels import Panel

MOST_CELLS = 6_000_000  # values in a page; beyond, every n-th row
Numbers = list[float | None]


def sample_rows(count: int, limit: int) -> Rows:
    """Every n-th row and the last, at most about `limit`."""
    rows = np.arange(0, count, max(1, math.ceil(count / limit)))
    return rows if not count or rows[-1] == count - 1 else np.append(rows, count - 1)


def rounded(values: Array, digits: int) -> Numbers:
    """Plain numbers; what cannot be drawn becomes null, whole numbers lose their `.0`."""
    numbers: Numbers = []
    for value, good in zip(values.tolist(), np.isfinite(values).tolist(), strict=True):
        short = round(value, digits) if good else None
        numbers.append(int(short) if short is not None and short == int(short) and abs(short) < 1e15 else short)
    return numbers


class Series:
    """Signals of which the script knows every row, each under a short key.

    rows: those in the page: all, unless that would be more than MOST_CELLS
    """

    def __init__(self, time: Array, curves: int) -> None:
        self.time = time
        self.rows = sample_rows(time.size, max(2, MOST_CELLS // max(1, curves)))
        self.entries: dict[str, dict[str, Any]] = {}
        self.columns = [whole(time[self.rows], power_of_time(time))]

    def add(self, panel: Panel) -> list[str]:
        """Keys of the traces of a panel."""
        return [self.column(trace.values, held=trace.held) for trace in panel.traces]

    def band(self, panel: Panel) -> tuple[str, ...]:
        """Keys of the lower and the upper edge of a panel's band."""
        return (self.column(panel.band.lower), self.column(panel.band.upper)) if panel.band else ()

    def column(self, values: Array, *, held: bool = False) -> str:
        """Key of one signal."""
        key, kept = f"k{len(self.entries)}", values[self.rows]
        decimals, good = power(kept), np.isfinite(kept)
        gaps = not bool(good.all())
        self.columns.append(whole(kept, decimals))
        if gaps:
            self.columns.append(good.astype(np.int64))
        self.entries[key] = {"p": decimals, "h": int(held), "g": int(gaps)}
        return key


def to_json(series: Series, more: Mapping[str, Any] = MappingProxyType({})) -> str:
    """Everything the scripts need; `<`, `>` and `&` are escaped so that no text can end the script element.

    `row` and `of`: the n-th rows that are here, counted from 1, and how many there are in all.
    """
    every = int(series.rows[1] - series.rows[0]) if series.rows.size > 1 else 1
    data = {
        "rows": int(series.rows.size),
        "every": every,
        "of": int(series.time.size),
        "p": power_of_time(series.time),
        "series": series.entries,
        "packed": packed(series.columns),
        **more,
    }
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
