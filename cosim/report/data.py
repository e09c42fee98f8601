"""Numbers for the page's script: thinned, rounded, and safe inside a script element."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.arrays import Array, Rows
from cosim.report.panels import Panel

SHOWN_DECIMALS = {"m": 3, "m/s": 3, "°": 2, "°/s": 1, "N": 3, "%": 2}  # read out, where that leaves LEAST digits
DIGITS, LEAST = 4, 2  # of the largest value: kept, and read out at least
Numbers = list[float | None]


def sample_rows(count: int, limit: int) -> Rows:
    """Every n-th row and the last, at most about `limit`."""
    rows = np.arange(0, count, max(1, math.ceil(count / limit)))
    return rows if not count or rows[-1] == count - 1 else np.append(rows, count - 1)


def decimals(values: Array) -> int:
    """Decimals that keep DIGITS digits of the largest value."""
    good = values[np.isfinite(values)]
    largest = float(np.max(np.abs(good))) if good.size else 0.0
    return 3 if largest == 0 else min(9, max(0, DIGITS - 1 - math.floor(math.log10(largest))))


def rounded(values: Array, digits: int) -> Numbers:
    """Plain numbers; what cannot be drawn becomes null, whole numbers lose their `.0`."""
    numbers: Numbers = []
    for value, good in zip(values.tolist(), np.isfinite(values).tolist(), strict=True):
        short = round(value, digits) if good else None
        numbers.append(int(short) if short is not None and short == int(short) and abs(short) < 1e15 else short)
    return numbers


class Series:
    """Signals the script can read out at any time, each under a short key."""

    def __init__(self, rows: Rows) -> None:
        self.rows = rows
        self.entries: dict[str, dict[str, Any]] = {}

    def add(self, panel: Panel) -> list[str]:
        """Keys of the traces of a panel."""
        keys = []
        for trace in panel.traces:
            key = f"k{len(self.entries)}"
            values = trace.values[self.rows]
            digits = decimals(values)
            shown = min(digits, max(SHOWN_DECIMALS.get(panel.unit, 6), digits - DIGITS + LEAST))
            self.entries[key] = {"v": rounded(values, digits), "d": shown, "h": int(trace.held)}
            keys.append(key)
        return keys


def to_json(time: Array, series: Series, more: Mapping[str, Any] = MappingProxyType({})) -> str:
    """Everything the scripts need; `<`, `>` and `&` are escaped so that no text can end the script element.

    `row` and `of`: the rows that are here, counted from 1, and how many there are in all.
    """
    rows = {"row": (series.rows + 1).tolist(), "of": int(time.size)}
    data = {"t": rounded(time[series.rows], 6), **rows, "series": series.entries, **more}
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
