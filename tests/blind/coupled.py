"""Studies of two coupled pendulums, most of them with an effect in the coupling that imitates another stiffness.

    python -m tests.blind.coupled FOLDER gap --seed 1 --way co_simulation
    cosim refine FOLDER/study.yaml

`CASES` lists the hidden changes. The truth is simulated here, by scipy; the FMU is own C. The stiffness of a case is
that of the truth; the FMU has 1 N·m/rad. All other numbers are off by N(0, 1 %), or 3 % for friction.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from tests.blind.field_rig import Array, Random
from tests.blind.fmu_build import PLANTS, WAYS, build
from tests.logs import write_log

STEP, ROWS, NOISE = 0.02, 2001, 1e-3  # [s], rows of a log, noise of both angles [rad]
PUSH, LASTS = 8e-4, 0.5  # disturbing torque [N·m] and its correlation time [s]
TOLERANCE = {"J1": 0.03, "J2": 0.03, "c1": 0.03, "c2": 0.03, "k": 0.03, "d1": 0.1, "d2": 0.1}
# changed parameters; gap, cubic, dry, skew of the coupling; dry1, drag1 of the first
CASES: dict[str, dict[str, float]] = {
    "nothing": {},
    "stiffness": {"k": 0.9},
    "inertia": {"J1": 0.115},
    "gravity": {"c2": 0.65},
    "gap": {"k": 0.9, "gap": 0.02},
    "gap_alone": {"gap": 0.03},
    "wide_gap": {"k": 0.9, "gap": 0.05},
    "cubic": {"cubic": 6.0},
    "small_cubic": {"k": 0.9, "cubic": 2.0},
    "dry": {"k": 0.9, "dry": 0.03},
    "skew": {"k": 0.9, "skew": 0.15},
    "dry_hinge": {"k": 0.9, "dry1": 0.02},
    "drag": {"drag1": 0.01},
}


def coupling(case: Mapping[str, float], d: float, speed: float) -> float:
    """Return the torque through the coupling at a deflection and its rate."""
    spring = case.get("k", 1.0) * math.copysign(max(0.0, abs(d) - case.get("gap", 0.0)), d)
    spring *= 1.0 + math.copysign(case.get("skew", 0.0), d)
    return spring + case.get("cubic", 0.0) * d**3 + case.get("dry", 0.0) * math.tanh(speed / 1e-3)


def torque(rng: Random) -> Array:
    """Return steps, ramps and sines, one after another."""
    u, row = np.zeros(ROWS), 0
    while row < ROWS:
        part = u[row : row + int(rng.integers(15, 120))]
        size, time = rng.uniform(-0.8, 0.8), STEP * np.arange(part.size)
        shapes = np.ones(part.size), np.linspace(0.0, 1.0, part.size), np.sin(time * rng.uniform(1.5, 7.0))
        part[:] = size * shapes[rng.integers(3)]
        row += part.size
    return u


def run(case: Mapping[str, float], numbers: Mapping[str, float], rng: Random) -> dict[str, Any]:
    """Return the columns of a log."""
    u, push, fades = torque(rng), np.zeros(ROWS), math.exp(-STEP / LASTS)
    for row in range(1, ROWS):
        push[row] = fades * push[row - 1] + PUSH * math.sqrt(1.0 - fades**2) * rng.standard_normal()

    def rates(_: float, x: Any, drive: float) -> list[float]:
        through = coupling(case, x[0] - x[2], x[1] - x[3])
        lost = numbers["d1"] * x[1] + case.get("drag1", 0.0) * x[1] * abs(x[1])
        lost += case.get("dry1", 0.0) * math.tanh(x[1] / 1e-3)
        first = drive - numbers["c1"] * math.sin(x[0]) - lost - through
        second = through - numbers["c2"] * math.sin(x[2]) - numbers["d2"] * x[3]
        return [x[1], first / numbers["J1"], x[3], second / numbers["J2"]]

    method = "LSODA" if {"dry", "dry1"} & case.keys() else "DOP853"
    states = [0.1 * rng.standard_normal(4) * (rng.random() < 0.5)]
    for drive in (u + push)[:-1]:
        solution = solve_ivp(rates, (0.0, STEP), states[-1], method, args=(drive,), rtol=1e-7, atol=1e-9)
        states.append(solution.y[:, -1])
    angles = np.array(states)[:, [0, 2]] + NOISE * rng.standard_normal((ROWS, 2))
    return {"time": STEP * np.arange(ROWS), "torque": u, "phi1": angles[:, 0], "phi2": angles[:, 1]}


def write(folder: Path, name: str, seed: int, way: str) -> dict[str, float]:
    """Write FMU, logs and study.yaml; return the changes and the true numbers."""
    folder.mkdir(parents=True, exist_ok=True)
    build(folder / "plant.fmu", "coupled", ways=(way,))
    case, rng = CASES[name], np.random.default_rng([seed, list(CASES).index(name)])
    off = {n: 0.03 if n.startswith("d") else 0.01 for n in TOLERANCE if n != "k"}
    given = {p.name: p.start for p in PLANTS["coupled"].parameters}
    numbers = {n: given[n] * (1.0 + share * rng.standard_normal()) for n, share in off.items()}
    numbers |= {n: v for n, v in case.items() if n in numbers}
    for log in ("e1", "e2", "v1"):
        write_log(folder / f"{log}.csv", run(case, numbers, rng))
    logs = {"estimation": ["e1.csv", "e2.csv"], "validation": ["v1.csv"]}
    study = {"model": "plant.fmu", "logs": logs, "tolerance": TOLERANCE}
    (folder / "study.yaml").write_text(json.dumps(study))
    return {**numbers, **case}


def main() -> None:
    """Write a study and print its answer."""
    parser = argparse.ArgumentParser(prog="python -m tests.blind.coupled", description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("case", choices=CASES)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--way", choices=WAYS, default=WAYS[0])
    given = parser.parse_args()
    print(json.dumps(write(given.folder, given.case, given.seed, given.way)))


if __name__ == "__main__":
    main()
