"""A tank as a model of one's own, and logs of one that leaks: by another integrator, sharing no code with the model."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from tests.conftest import ROOT
from tests.logs import integrated, write_log

AREA, OUTLET, LEAK, STEP, NOISE = 0.5, 0.02, 0.012, 0.5, 1e-3
MODEL = (ROOT / "examples" / "tanks" / "model.py").read_text(encoding="utf-8")


def tank_log(
    path: Path, seed: int, seconds: float = 400.0, step: float = STEP, *, offset: float = 0.0, held: int = 40
) -> Path:
    """Return a log of a tank with leak LEAK·h, filled in steps of some rows, with a noisy gauge that may be off."""
    rng = np.random.default_rng(seed)
    time = step * np.arange(round(seconds / step) + 1)
    inflow = np.repeat(rng.uniform(0.01, 0.05, time.size // held + 1), held)[: time.size]

    def rates(h: np.ndarray, q: float) -> list[float]:
        return [(q - OUTLET * math.sqrt(max(h[0], 1e-6)) - LEAK * h[0]) / AREA]

    level = integrated(rates, [1.0], inflow, step)[:, 0]
    read = level + offset + NOISE * rng.standard_normal(time.size)
    return write_log(path, {"time": time, "inflow": inflow, "level": read})


def tank_study(folder: Path) -> Path:
    """tank.py, three logs and a study."""
    (folder / "tank.py").write_text(MODEL, encoding="utf-8")
    for seed, name in enumerate(("e1.csv", "e2.csv", "v1.csv")):
        tank_log(folder / name, seed)
    study = folder / "study.yaml"
    study.write_text("model: tank.py:Tank\nlogs:\n  estimation: [e1.csv, e2.csv]\n  validation: [v1.csv]\n")
    return study
