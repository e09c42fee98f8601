"""An FMU of C that slides: a mass with a force, in FMI 2.0 and 3.0. Logs of known truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.compiled import description, library, pack
from tests.corpus.inputs import FMU_SOURCES
from tests.logs import write_log

TRUTH = {"mass": 1.6, "gain": 2.0, "damping": 0.8, "offset": 0.0}
Array = NDArray[np.float64]


def slider_fmu(path: Path, version: int = 2, *, exchange: bool = False, follow: bool = False) -> Path:
    """Build the FMU; with `follow` its library takes the start values of modelDescription.xml."""
    name = f"slider{version}{'me' if exchange else 'cs'}"
    members = {"documentation/license.txt": "free", "resources/follow" if follow else "resources/none": ""}
    return pack(path, description(name), library(FMU_SOURCES / "slider.c"), members)


def slide(
    time: Array, truth: Mapping[str, float], start: tuple[float, float] = (0.0, 0.0), seed: int = 1
) -> dict[str, Array]:
    """Return time, force, position and velocity of the truth, by exact integration over each row."""
    rng = np.random.default_rng(seed)
    force = np.repeat(rng.uniform(-1.0, 1.0, time.size // 20 + 1), 20)[: time.size]
    d, x, v = truth["damping"], [start[0]], [start[1]]
    for k, h in enumerate(np.diff(time)):
        a = truth["gain"] / truth["mass"] * force[k] + truth["offset"]
        decay = np.exp(-d * h)
        x.append(x[-1] + a / d * h + (v[-1] - a / d) * (1.0 - decay) / d)
        v.append(a / d + (v[-1] - a / d) * decay)
    return {"time": time, "force": force, "position": np.array(x), "velocity": np.array(v)}


def slider_log(
    path: Path,
    truth: Mapping[str, float] = TRUTH,
    *,
    start: tuple[float, float] = (0.3, -0.4),
    seed: int = 1,
    seconds: float = 20.0,
    noise: tuple[float, float] = (2e-3, 1e-2),
    outputs: tuple[str, ...] = ("position", "velocity"),
) -> Path:
    """Write a log with white noise."""
    columns = slide(0.05 * np.arange(round(seconds / 0.05) + 1), truth, start, seed)
    rng = np.random.default_rng([seed, 1])
    for name, sigma in zip(("position", "velocity"), noise, strict=True):
        columns[name] = columns[name] + sigma * rng.standard_normal(columns[name].size)
    return write_log(path, {n: v for n, v in columns.items() if n in {"time", "force", *outputs}})


def slider_bench(folder: Path) -> Path:
    """Write the FMU and three logs; return their folder."""
    slider_fmu(folder / "slider.fmu")
    for seed, name in enumerate(("a.csv", "b.csv", "c.csv"), 1):
        slider_log(folder / name, seed=seed, start=(0.3 - 0.2 * seed, 0.1 * seed - 0.4), seconds=15.0)
    return folder
