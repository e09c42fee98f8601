"""Writing of a linear model: linear.json, linear.mat for MATLAB and Octave, linear.py for python-control."""

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
from cosim.core.version import __version__
from cosim.files.files import write_json, write_text
from cosim.linearization.linear_model import Linear
from cosim.linearization.system_structure import Structure

FILES = ("linear.json", "linear.mat", "linear.py")
GROUPS = ("states", "inputs", "outputs")
HEADER = 116  # bytes of text at the start of a .mat file, in which scipy writes the time of day
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


@dataclass(frozen=True)
class Outcome:
    """Linear models for one or more times, and the structure of the first."""

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
    """Return the content of linear.json, with matrices as lists of rows; a number that is not finite is null."""
    first, structure = outcome.first, outcome.structure
    poles = [
        {
            "real": p.value.real,
            "imag": p.value.imag,
            **{key: v if math.isfinite(v) else None for key, v in asdict(p).items() if key != "value"},
        }
        for p in structure.poles
    ]
    condition = structure.condition if math.isfinite(structure.condition) else None
    return {
        "schema_version": 1,
        "version": __version__,
        "model": outcome.name,
        "title": outcome.title,
        "method": first.method,
        "notes": list(outcome.notes),
        **{group: list(getattr(first, group)) for group in GROUPS},
        "units": {n: first.units.get(n, "") for group in GROUPS for n in getattr(first, group)},
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
    values |= {group: np.array(getattr(linear[0], group), dtype=object) for group in GROUPS}
    stream = io.BytesIO()
    savemat(stream, values)
    title = f"MATLAB 5.0 MAT-file, by cosim {__version__}".encode().ljust(HEADER)
    return title + stream.getvalue()[HEADER:]
