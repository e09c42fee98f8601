"""Studies of two coupled pendulums, some with an effect in the coupling or a hinge that imitates another stiffness.

The truth is simulated here, by scipy; the FMU is own C. The stiffness of a case is that of the truth; the FMU has
1 N·m/rad. All other numbers are off by N(0, 1 %), or 3 % for friction.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from tests.blind.field_rig import LOGS, Array, Random
from tests.blind.fmu_build import PLANTS, build
from tests.logs import write_log

STEP, ROWS, NOISE = 0.02, 2001, 1e-3  # [s], rows of a log, noise of both angles [rad]
PUSH, LASTS = 8e-4, 0.5  # disturbing torque [N·m] and its correlation time [s]
TOLERANCE = {p.name: p.tolerance for p in PLANTS["coupled"].parameters}
# number of the random stream; stiffness and play of the coupling, dry friction of the first hinge
CASES = {
    "nothing": (0, 1.0, 0.0, 0.0),
    "stiffness": (1, 0.9, 0.0, 0.0),
    "gap": (4, 0.9, 0.02, 0.0),
    "dry_hinge": (11, 0.9, 0.0, 0.02),
}


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


def run(case: str, numbers: dict[str, float], rng: Random) -> dict[str, Any]:
    """Return the columns of a log."""
    _, stiffness, gap, dry = CASES[case]
    u, push, fades = torque(rng), np.zeros(ROWS), math.exp(-STEP / LASTS)
    for row in range(1, ROWS):
        push[row] = fades * push[row - 1] + PUSH * math.sqrt(1.0 - fades**2) * rng.standard_normal()

    def rates(_: float, x: Any, drive: float) -> list[float]:
        bent = x[0] - x[2]
        through = stiffness * math.copysign(max(0.0, abs(bent) - gap), bent)
        lost = numbers["d1"] * x[1] + dry * math.tanh(x[1] / 1e-3)
        first = drive - numbers["c1"] * math.sin(x[0]) - lost - through
        second = through - numbers["c2"] * math.sin(x[2]) - numbers["d2"] * x[3]
        return [x[1], first / numbers["J1"], x[3], second / numbers["J2"]]

    states = [0.1 * rng.standard_normal(4) * (rng.random() < 0.5)]
    for drive in (u + push)[:-1]:
        method = "LSODA" if dry else "DOP853"
        solution = solve_ivp(rates, (0.0, STEP), states[-1], method, args=(drive,), rtol=1e-7, atol=1e-9)
        states.append(solution.y[:, -1])
    angles = np.array(states)[:, [0, 2]] + NOISE * rng.standard_normal((ROWS, 2))
    return {"time": STEP * np.arange(ROWS), "torque": u, "phi1": angles[:, 0], "phi2": angles[:, 1]}


def write(folder: Path, case: str, seed: int, way: str) -> None:
    """Write FMU, logs and study.yaml."""
    build(folder / "plant.fmu", "coupled", ways=(way,))
    rng = np.random.default_rng([seed, CASES[case][0]])
    given = {p.name: p.start for p in PLANTS["coupled"].parameters}
    shares = {n: 0.03 if n.startswith("d") else 0.01 for n in TOLERANCE if n != "k"}
    numbers = {n: given[n] * (1.0 + share * rng.standard_normal()) for n, share in shares.items()}
    for log in LOGS:
        write_log(folder / f"{log}.csv", run(case, numbers, rng))
    logs = {"estimation": ["e1.csv", "e2.csv"], "validation": ["v1.csv"]}
    (folder / "study.yaml").write_text(json.dumps({"model": "plant.fmu", "logs": logs, "tolerance": TOLERANCE}))
