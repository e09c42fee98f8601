"""Files and texts of a linear model: linear.json, linear.mat for MATLAB, linear.py for python-control, tables."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.drafts import draft_of
from cosim.core.text import MISSING, counted, plain
from cosim.core.version import __version__
from cosim.files.files import write_json, write_text
from cosim.linearization.linear_model import Linear, Pole, Structure

LINEARIZATION_FILES = ("linear.json", "linear.mat", "linear.py")
SIGNAL_GROUPS = ("states", "inputs", "outputs")
HEADER = 116  # bytes of text at the start of a .mat file, where scipy writes the time of day
SCRIPT = '''"""The linear model of linear.json beside this file, for python-control: `from linear import system`."""

import json
from pathlib import Path

import control

content = json.loads(Path(__file__).with_name("linear.json").read_text(encoding="utf-8"))
systems = [
    control.ss(
        m["A"], m["B"], m["C"], m["D"],
        states=content["states"], inputs=content["inputs"], outputs=content["outputs"], remove_useless_states=False,
    )
    for m in content["models"]
]
system = systems[0]
'''
MAX_TERMINAL_COLUMNS = 16  # of a matrix on a terminal
MAX_OSCILLATING_DAMPING = 0.9  # damping ratio of a pole pair above which its overshoot is below 0.2 %
POLE_COLUMNS = (
    "pole [1/s]",
    "times",
    "ωₙ [rad/s]",
    "ζ",
    "−1/Re [s]",
    "deviation",
    "controllable",
    "observable",
)


@dataclass(frozen=True)
class Outcome:
    """Linear models at one or more times, and poles and ranks of the first model."""

    name: str
    title: str
    linear: tuple[Linear, ...]
    structure: Structure
    notes: tuple[str, ...]
    folder: Path | None

    @property
    def first(self) -> Linear:
        """Return the first linear model."""
        return self.linear[0]


def write(folder: Path, outcome: Outcome) -> None:
    """Write all files, each completely or not at all."""
    write_json(folder / "linear.json", content(outcome), indent=1, allow_nan=False)
    with draft_of(folder / "linear.mat") as draft:
        draft.write_bytes(mat(outcome.linear))
    write_text(folder / "linear.py", SCRIPT)


def content(outcome: Outcome) -> dict[str, Any]:
    """Return the content of linear.json, with matrices as lists of rows; a number that is not finite becomes null."""
    first, structure = outcome.first, outcome.structure
    poles = []
    for p in structure.poles:
        numbers = {key: v if math.isfinite(v) else None for key, v in asdict(p).items() if key != "value"}
        poles.append({"real": p.value.real, "imag": p.value.imag, **numbers})
    condition = structure.condition if math.isfinite(structure.condition) else None
    return {
        "schema_version": 1,
        "version": __version__,
        "model": outcome.name,
        "title": outcome.title,
        "method": first.method,
        "notes": list(outcome.notes),
        **{group: list(getattr(first, group)) for group in SIGNAL_GROUPS},
        "units": {n: first.units.get(n, "") for group in SIGNAL_GROUPS for n in getattr(first, group)},
        "models": [{"time": m.point.time, **{n: v.tolist() for n, v in _arrays(m).items()}} for m in outcome.linear],
        "structure": {**asdict(structure), "poles": poles, "condition": condition},
    }


def _arrays(m: Linear) -> dict[str, Array]:
    point = {"x0": m.point.states, "u0": m.point.inputs, "y0": m.values, "f0": m.rates}
    return {**point, "A": m.A, "B": m.B, "C": m.C, "D": m.D}


def mat(linear: Sequence[Linear]) -> bytes:
    """Return a MATLAB 5 file: A, B, C, D, x0, u0, y0, f0 and names.

    Several times form the last axis.
    """
    from scipy.io import savemat

    values: dict[str, Any] = {}
    for name in ("A", "B", "C", "D", "x0", "u0", "y0", "f0"):
        stacked = np.stack([_arrays(m)[name] for m in linear], axis=-1)
        values[name] = stacked[..., 0] if stacked.ndim == 3 and len(linear) == 1 else stacked
    values["time"] = np.array([[m.point.time for m in linear]])
    values |= {group: np.array(getattr(linear[0], group), dtype=object) for group in SIGNAL_GROUPS}
    stream = io.BytesIO()
    savemat(stream, values)
    title = f"MATLAB 5.0 MAT-file, by cosim {__version__}".encode().ljust(HEADER)
    return title + stream.getvalue()[HEADER:]


def number(value: float) -> str:
    """Return a number as text with at most five significant digits."""
    return f"{value + 0.0:.5g}".replace("-", "\u2212") if math.isfinite(value) else MISSING


def headline(structure: Structure, linear: Linear) -> str:
    """Return a sentence on stability, and a sentence on controllability and observability."""
    n = len(linear.states)
    if not n:
        return "The model has no states: its outputs depend directly on its inputs."
    # Neighbouring trajectories may diverge although the poles at each of their points are in the left half-plane.
    if not linear.at_rest:
        share = "all" if structure.stable else "not all"
        stability = f"Not an equilibrium: the derivatives are not zero; {share} poles are in the left half-plane"
    elif structure.stable:
        slowest = max(structure.poles, key=lambda p: p.value.real)
        stability = f"Stable equilibrium: the slowest deviation {meaning(slowest)}"
    elif growing := [p for p in structure.poles if p.value.real > 0.0]:
        fastest = max(growing, key=lambda p: p.value.real)
        stability = f"Unstable equilibrium: the fastest deviation {meaning(fastest)}"
    else:
        on_axis = [p for p in structure.poles if p.value.real == 0.0]
        count = counted(sum(p.count for p in on_axis), "pole")
        longest = max(on_axis, key=lambda p: p.count)
        stability = f"Not asymptotically stable: {count} on the imaginary axis; a deviation {meaning(longest)}"
    reach = f"{structure.controllable} of {counted(n, 'state')} controllable, {structure.observable} observable"
    return f"{stability}. {reach}."


def meaning(p: Pole) -> str:
    """Return the behaviour of a deviation along a pole's mode, as the predicate of a sentence."""
    real, imag = p.value.real, abs(p.value.imag)
    if not p.value:
        return "stays" if p.count == 1 else "is constant or grows with a power of time (integrators)"
    oscillates = imag and p.damping_ratio < MAX_OSCILLATING_DAMPING
    oscillation = f"oscillates with a period of {plain(2 * math.pi / imag)} s" if oscillates else ""
    if not real:
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

    A matrix with more than MAX_TERMINAL_COLUMNS columns is a list of its nonzero entries.
    """
    if not matrix.size:
        return []
    if len(columns) > MAX_TERMINAL_COLUMNS:
        places = zip(*np.nonzero(matrix), strict=True)
        return [[name, "", ""], *([rows[i], columns[j], number(float(matrix[i, j]))] for i, j in places)]
    cells = [[n, *(number(float(v)) if v else "." for v in row)] for n, row in zip(rows, matrix, strict=True)]
    return [[name, *columns], *cells]
