"""The cells of a log: what is wrong with one that is no number, and with a number that no sensor ever read."""

from __future__ import annotations

import re

import numpy as np

from cosim.arrays import Array, Rows

DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
BEYOND = 1e6  # times the usual size of a column, from which a value is none
ORDINARY = 1e9  # in any SI unit, up to which a column that mostly rests may jump
NEVER = 1e30  # in any SI unit


def no_number(text: str, name: str) -> tuple[str, str]:
    """What cells like this one are called where there are many, and what is said of it."""
    shown = text.strip()[:30]
    if DECIMAL_COMMA.fullmatch(shown):
        return f"cells of {name} with a decimal comma", f'"{shown}" in column {name} has a decimal comma: write a point'
    message = f'"{shown}" in column {name} is no number; leave the cell empty where there is none'
    return f"cells of {name} that are no number", message


def wrong_length(cells: int, header: int) -> str:
    """What is said of a row that has not as many cells as the header."""
    cure = "delete the row, or leave cells empty where nothing was measured"
    if cells == 2 * header:
        cure = "is each number cut in two by a decimal comma? Write a point"
    return f"has {cells} {'cell' if cells == 1 else 'cells'}, the header {header}; {cure}"


def absurd(values: Array) -> Rows:
    """Rows of values so far beyond the column's usual size that they are a logger's mark, as 3.4e38 for `invalid`."""
    size = np.abs(values)
    seen = size[~np.isnan(size)]
    if not seen.size:
        return np.zeros(0, np.intp)
    limit = min(max(BEYOND * float(np.median(seen)), ORDINARY), NEVER)
    return np.flatnonzero(size > limit)
