"""Description of a linear model by sentences and tables, for the terminal and the report page."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cosim.core.arrays import Array
from cosim.core.text import MISSING, counted, plain
from cosim.linearization.linear_model import Linear
from cosim.linearization.system_structure import Pole, Structure

MAX_COLUMNS = 16  # of a matrix on a terminal
MAX_OSCILLATING_DAMPING = 0.9  # damping ratio of a pair of poles, from which its overshoot is below 0.2 %
AXIS_TOLERANCE = 1e-9  # [1/s] real part of a pole on the imaginary axis
HEAD = (
    "pole [1/s]",
    "times",
    "ωₙ [rad/s]",
    "ζ",
    "−1/Re [s]",
    "deviation",
    "controllable",
    "observable",
)


def number(value: float) -> str:
    """Return at most five significant digits."""
    return f"{value + 0.0:.5g}".replace("-", "\u2212") if math.isfinite(value) else MISSING


def headline(structure: Structure, linear: Linear) -> str:
    """Return a sentence on stability, and a sentence on controllability and observability."""
    n = len(linear.states)
    if not n:
        return "The model has no states: its outputs follow its inputs without delay."
    if not linear.at_rest:  # neighbours of a motion may part though the poles of each of its points lie to the left
        share = "all" if structure.stable else "not all"
        stability = f"No equilibrium: the model moves here; {share} poles are to the left of the imaginary axis"
    elif structure.stable:
        slowest = max(structure.poles, key=lambda p: p.value.real)
        stability = f"Stable equilibrium: the slowest deviation {meaning(slowest)}"
    elif growing := [p for p in structure.poles if p.value.real > AXIS_TOLERANCE]:
        fastest = max(growing, key=lambda p: p.value.real)
        stability = f"Unstable equilibrium: the fastest deviation {meaning(fastest)}"
    else:
        on_axis = [p for p in structure.poles if p.value.real >= -AXIS_TOLERANCE]
        count = counted(sum(p.count for p in on_axis), "pole")
        longest = max(on_axis, key=lambda p: p.count)
        stability = f"Not asymptotically stable: {count} on the imaginary axis; a deviation {meaning(longest)}"
    reach = (
        f"The inputs reach {structure.controllable} of {counted(n, 'state')}; the outputs show {structure.observable}"
    )
    return f"{stability}. {reach}."


def meaning(p: Pole) -> str:
    """Return the behaviour of a deviation along a pole, as the predicate of a sentence."""
    real, imag = p.value.real, abs(p.value.imag)
    if not p.value:
        return "stays" if p.count == 1 else "stays or grows with a power of time (integrators)"
    oscillates = imag and p.damping_ratio < MAX_OSCILLATING_DAMPING
    oscillation = f"oscillates with a period of {plain(2 * math.pi / imag)} s" if oscillates else ""
    if abs(real) <= AXIS_TOLERANCE:
        return f"{oscillation} without damping"
    time = f"{'grows' if real > 0 else 'decays'} with a time constant of {plain(1.0 / abs(real))} s"
    return f"{oscillation} and {time}" if oscillates else time


def pole_rows(structure: Structure) -> list[dict[str, str]]:
    """Return the rows of the pole table; a complex pair has one row."""
    return [
        {
            "pole": number(p.value.real) + (f" ± {number(p.value.imag)}j" if p.value.imag else ""),
            "count": str(p.count),
            "frequency": number(p.natural_frequency),
            "damping": number(p.damping_ratio),
            "time": "∞" if math.isinf(p.time_constant) else number(p.time_constant),
            "meaning": meaning(p),
            "reached": "yes" if p.controllable else "no",
            "shown": "yes" if p.observable else "no",
        }
        for p in structure.poles
        if p.value.imag >= 0.0
    ]


def matrix_lines(name: str, matrix: Array, rows: Sequence[str], columns: Sequence[str]) -> list[list[str]]:
    """Return a matrix as cells with a header.

    A matrix with more than MAX_COLUMNS columns is a list of its nonzero entries.
    """
    if not matrix.size:
        return []
    if len(columns) > MAX_COLUMNS:
        places = zip(*np.nonzero(matrix), strict=True)
        return [[name, "", ""], *([rows[i], columns[j], number(float(matrix[i, j]))] for i, j in places)]
    cells = [[n, *(number(float(v)) if v else "." for v in row)] for n, row in zip(rows, matrix, strict=True)]
    return [[name, *columns], *cells]
