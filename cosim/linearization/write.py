"""Writing of a linear model: linear.json, linear.mat for MATLAB and Octave, linear.py for python-control."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.drafts import draft_of
from cosim.base.version import __version__
from cosim.linearization.linear_model import Linear
from cosim.linearization.system_structure import Structure
from cosim.storage.files import write_json, write_text

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
    """Return the content of linear.json, with matrices as lists of rows."""
    first = outcome.first
    models = []
    for m in outcome.linear:
        models.append({"time": m.point.time, **{name: values.tolist() for name, values in _arrays(m).items()}})
    return {
        "schema_version": 1,
        "version": __version__,
        "model": outcome.name,
        "title": outcome.title,
        "method": first.method,
        "notes": list(outcome.notes),
        **{group: list(getattr(first, group)) for group in GROUPS},
        "units": {n: first.unit(n) for group in GROUPS for n in getattr(first, group)},
        "models": models,
        "structure": _plain(outcome.structure),
    }


def _arrays(m: Linear) -> dict[str, Array]:
    point = {"x0": m.point.states, "u0": m.point.inputs, "y0": m.values, "f0": m.rates}
    return {**point, "A": m.A, "B": m.B, "C": m.C, "D": m.D}


def _plain(structure: Structure) -> dict[str, Any]:
    def number(value: float) -> float | None:
        return value if math.isfinite(value) else None

    poles = [
        {
            "real": p.value.real,
            "imag": p.value.imag,
            "count": p.count,
            "natural_frequency": p.natural_frequency,
            "damping_ratio": number(p.damping_ratio),
            "time_constant": number(p.time_constant),
            "controllable": p.controllable,
            "observable": p.observable,
        }
        for p in structure.poles
    ]
    rest = {k: v for k, v in asdict(structure).items() if k != "poles"}
    return {"poles": poles, **rest, "condition": number(structure.condition)}


def mat(linear: Sequence[Linear]) -> bytes:
    """Return a MATLAB 5 file: A, B, C, D, x0, u0, y0, f0 and names.

    Several times form the last axis.
    """
    from scipy.io import savemat

    def stack(matrices: Sequence[Any]) -> Any:
        return np.asarray(matrices[0]) if len(matrices) == 1 else np.stack(matrices, axis=-1)

    values: dict[str, Any] = {n: stack([getattr(m, n) for m in linear]) for n in "ABCD"}
    values |= {n: np.array([_arrays(m)[n] for m in linear]).T for n in ("x0", "u0", "y0", "f0")}
    values["time"] = np.array([[m.point.time for m in linear]])
    values |= {group: np.array(getattr(linear[0], group), dtype=object) for group in GROUPS}
    stream = io.BytesIO()
    savemat(stream, values)
    title = f"MATLAB 5.0 MAT-file, by cosim {__version__}".encode().ljust(HEADER)
    return title + stream.getvalue()[HEADER:]
