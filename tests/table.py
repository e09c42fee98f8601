"""The model of docs/own_model.md, as a reader would copy it, and logs of such a table that rubs."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from tests.logs import integrated, times, write_log

DOCS = Path(__file__).parent.parent / "docs"
TABLE = (DOCS / "own_model.md").read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]
INERTIA, DAMPING, STIFFNESS, RUBS = 0.02, 0.01, 0.5, 0.05


def table_log(path: Path, seed: int) -> None:
    """Return a log of a rotary table under a held torque, from an integrator and code independent of the page's."""
    rng, time = np.random.default_rng(seed), times(20.0)
    waves = zip((0.3, 0.2, 0.15), (1.1, 3.7, 6.3), rng.uniform(0, 6, 3), strict=True)
    torque = np.sum([a * np.sin(w * time + p) for a, w, p in waves], axis=0)

    def rates(x: np.ndarray, u: float) -> list[float]:
        return [x[1], (u - DAMPING * x[1] - STIFFNESS * x[0] - RUBS * math.tanh(x[1] / 0.05)) / INERTIA]

    angle, rate = integrated(rates, [0.0, 0.0], torque, 0.02).T
    noise = rng.standard_normal((2, time.size))
    write_log(path, {"time": time, "torque": torque, "angle": angle + 1e-3 * noise[0], "rate": rate + 1e-2 * noise[1]})
