"""Descriptions of a linear model in words and tables, for terminal and page."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cosim.base.arrays import Array
from cosim.base.text import MISSING, counted
from cosim.linearization.linear_model import Linear
from cosim.linearization.system_structure import Pole, Structure

SHOWN = 16  # columns of a matrix on a terminal


def number(value: float) -> str:
    """Return at most five significant digits."""
    return f"{value + 0.0:.5g}".replace("-", "\u2212") if math.isfinite(value) else MISSING


def headline(found: Structure, linear: Linear) -> str:
    """Return the summary in one sentence."""
    n = len(linear.states)
    if not n:
        return "It has no states: D alone says how outputs follow inputs."
    if linear.at_rest:
        slowest = sum(p.count for p in found.poles if p.value.real >= -1e-9)
        at = f" ({counted(slowest, 'pole')} not to the left of the imaginary axis)" if slowest else ""
        told = ("Asymptotically stable" if found.stable else "Not asymptotically stable") + at
    else:  # Trajectories near a motion may diverge although all poles of each point are in the left half plane.
        told = f"No equilibrium; {'all' if found.stable else 'not all'} poles lie to the left of the imaginary axis"
    reach = f"inputs reach {found.controllable} of {counted(n, 'state')}, outputs show {found.observable}"
    return f"{told}; {reach}."


def pole_rows(found: Structure) -> list[dict[str, str]]:
    """Return the table of poles; a pair has one row."""
    return [_row(p) for p in found.poles if p.value.imag >= 0.0]


def _row(p: Pole) -> dict[str, str]:
    pair = f" ± {number(p.value.imag)}j" if p.value.imag else ""
    return {
        "pole": number(p.value.real) + pair,
        "count": str(p.count),
        "blocks": " + ".join(map(str, p.blocks)),
        "frequency": number(p.natural_frequency),
        "damping": number(p.damping_ratio),
        "time": "∞" if math.isinf(p.time_constant) else number(p.time_constant),
        "reached": "yes" if p.controllable else "no",
        "shown": "yes" if p.observable else "no",
    }


HEAD = ("pole [1/s]", "times", "Jordan blocks", "ωₙ [rad/s]", "ζ", "−1/Re [s]", "controllable", "observable")


def pole_table(found: Structure) -> list[tuple[str, ...]]:
    """Return the rows under HEAD."""
    return [tuple(row.values()) for row in pole_rows(found)]


def matrix_lines(name: str, matrix: Array, rows: Sequence[str], columns: Sequence[str]) -> list[list[str]]:
    """Return a matrix as rows of cells with a header.

    A matrix with more than SHOWN columns is a list of its nonzero entries.
    """
    if not matrix.size:
        return []
    if len(columns) > SHOWN:
        places = zip(*np.nonzero(matrix), strict=True)
        return [[name, "", ""], *([rows[i], columns[j], number(float(matrix[i, j]))] for i, j in places)]
    cells = [[n, *(number(float(v)) if v else "." for v in row)] for n, row in zip(rows, matrix, strict=True)]
    return [[name, *columns], *cells]
