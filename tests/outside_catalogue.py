"""Studies of public FMUs whose logs come from other truths, most of them outside the catalogue of terms.

    python -m tests.outside_catalogue FMUS OUT [NAME…]

FMUS holds VanDerPol.fmu and Dahlquist.fmu of Reference-FMUs (FMI 2.0). OUT/NAME/study.yaml is for `cosim refine`. A
claim is wrong if it names what the truth does not have.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pythonfmu.builder import FmuBuilder
from scipy.integrate import solve_ivp

from tests.logs import Array, write_log

TANK = Path(__file__).resolve().parents[1] / "examples" / "tanks" / "tank.py"
LOGS = ("e1", "e2", "v1")
Added = Callable[[float, Array], float]  # addition to the last derivative at a time and state


class Truth(NamedTuple):
    """A truth: FMU, seed of starts, inputs and noise, and the addition to its equation."""

    fmu: str
    seed: int
    added: Added
    outlet: float = 0.5  # exponent of the tank's outlet


TRUTHS = {
    "vdp_none": Truth("VanDerPol", 101, lambda t, x: 0.0),
    "vdp_quintic": Truth("VanDerPol", 102, lambda t, x: -0.01 * float(x[0]) ** 5),
    "vdp_periodic": Truth("VanDerPol", 103, lambda t, x: 0.2 * math.sin(1.7 * t)),
    "vdp_one_sided": Truth("VanDerPol", 105, lambda t, x: -0.15 * max(float(x[1]), 0.0)),
    "dahl_none": Truth("Dahlquist", 201, lambda t, x: 0.0),
    "dahl_square": Truth("Dahlquist", 202, lambda t, x: -0.3 * float(x[0]) ** 2),
    "tank_leak": Truth("Tank", 301, lambda t, x: -0.012 * float(x[0]) / 0.5),
    "tank_none": Truth("Tank", 302, lambda t, x: 0.0),
    "tank_power": Truth("Tank", 304, lambda t, x: 0.0, outlet=0.8),
}


def columns_of(truth: Truth, number: int, rng: np.random.Generator) -> Mapping[str, Any]:
    """Return the columns of a log, with noise."""
    if truth.fmu == "Tank":
        return _tank(truth, rng)
    names: tuple[str, ...]
    time = 0.05 * np.arange(401 if truth.fmu == "VanDerPol" else 201)
    if truth.fmu == "VanDerPol":
        phase, start = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(-2.0, 2.0, 2) if number else np.array([2.0, 0.0])

        def rates(t: float, x: Array) -> list[float]:
            return [x[1], (1.0 - x[0] ** 2) * x[1] - x[0] + truth.added(t + phase, x)]

        names, noise = ("x0", "x1"), 0.02
    else:
        start = rng.uniform(0.5, 2.0, 1)

        def rates(t: float, x: Array) -> list[float]:
            return [-x[0] + truth.added(t, x)]

        names, noise = ("x",), 0.005
    states = solve_ivp(rates, (0.0, time[-1]), start, "LSODA", time, rtol=1e-10, atol=1e-12).y
    read = {n: x + noise * rng.standard_normal(time.size) for n, x in zip(names, states, strict=True)}
    return {"time": time, **read}


def _tank(truth: Truth, rng: np.random.Generator) -> Mapping[str, Any]:
    """Return a log of a tank with a new inflow every 20 s and 1 mm of noise."""
    time, level = 0.5 * np.arange(401), [1.0]
    flow = np.repeat(rng.uniform(0.01, 0.05, 11), 40)[: time.size]
    for t, q in zip(time[:-1], flow[:-1], strict=True):
        h = level[-1]
        for _ in range(100):
            h += 0.005 * ((q - 0.02 * max(h, 0.0) ** truth.outlet) / 0.5 + truth.added(float(t), np.array([h])))
        level.append(h)
    return {"time": time, "inflow": flow, "level": np.array(level) + 1e-3 * rng.standard_normal(time.size)}


def write_study(name: str, fmus: Path, out: Path) -> Path:
    """Write FMU, logs and study.yaml of a truth; return the study."""
    truth, folder = TRUTHS[name], out / name
    folder.mkdir(parents=True, exist_ok=True)
    if truth.fmu == "Tank":
        FmuBuilder.build_FMU(TANK, folder)
    else:
        shutil.copy(fmus / f"{truth.fmu}.fmu", folder)
    rng = np.random.default_rng(truth.seed)
    for number, log in enumerate(LOGS):
        write_log(folder / f"{log}.csv", {**columns_of(truth, number, rng)})
    path = folder / "study.yaml"
    lists = {"estimation": ["e1.csv", "e2.csv"], "validation": ["v1.csv"]}
    path.write_text(json.dumps({"model": f"{truth.fmu}.fmu", "logs": lists}))
    return path


if __name__ == "__main__":
    for chosen in sys.argv[3:] or TRUTHS:
        print(write_study(chosen, Path(sys.argv[1]), Path(sys.argv[2])))
