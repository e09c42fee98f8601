"""Numbers on the records of fitted FMUs: `python -m tests.credible_studies [STUDIES] [FIRST_SEED]`, one JSON line.

In each study a slider with quadratic drag, which its FMU lacks, is logged under small random forces. The FMU is fitted
to three logs. A fourth, sealed log measures the coverage of the 90 % bands within the region, and false alarms. A
mission with growing forces measures whether the indicator fires before an error exceeds three bands.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import cosim
from cosim.credibility.found import read_credibility
from tests.logs import integrated, write_log
from tests.slider import TRUTH, slider_fmu

STEP, DRAG, NOISE = 0.05, 0.15, {"position": 2e-3, "velocity": 1e-2}  # [s], [1/m]
LOG, MISSION = 30.0, 60.0  # [s]
FIRST_SIZE, LAST_SIZE = 0.3, 8.0  # of the forces of a mission [N]; those of the logs are at most 1


def log(path: Path, seed: int, size: NDArray[np.float64]) -> Path:
    """Write a log with a new force every second, of the given sizes [N]."""
    rng, time = np.random.default_rng(seed), STEP * np.arange(size.size)
    force = np.repeat(rng.uniform(-1.0, 1.0, size.size // 20 + 1), 20)[: size.size] * size

    def rates(state: NDArray[np.float64], push: float) -> list[float]:
        v = state[1]
        return [v, TRUTH["gain"] / TRUTH["mass"] * push - TRUTH["damping"] * v - DRAG * abs(v) * v]

    states = integrated(rates, [0.0, 0.0], force, STEP)
    columns = {"time": time, "force": force, "position": states[:, 0], "velocity": states[:, 1]}
    return write_log(path, {n: v + NOISE.get(n, 0.0) * rng.standard_normal(v.size) for n, v in columns.items()})


def study(seed: int, folder: Path) -> dict[str, Any]:
    """Return the numbers of one study."""
    small, grow = np.ones(round(LOG / STEP) + 1), np.linspace(FIRST_SIZE, LAST_SIZE, round(MISSION / STEP) + 1)
    logs = [log(folder / f"{k}.csv", 100 * seed + k, small) for k in range(4)]
    mission = log(folder / "mission.csv", 100 * seed + 9, grow)
    fmu, quick = slider_fmu(folder / "slider.fmu"), {"in_process": True, "report": False}
    vary: dict[str, Any] = {"vary": ["mass", "damping"], "start": {"gain": 2.0}}
    fitted = cosim.fit(logs[:3], fmu, out=folder / "out", sealed=[logs[3]], **vary, **quick)
    bands = read_credibility(folder / "out" / "fitted.fmu").record.bands  # type: ignore[union-attr]
    replayed = cosim.replay(mission, fmu=folder / "out" / "fitted.fmu", **quick)
    ages = np.minimum(replayed.time - replayed.time[0], bands.horizons[-1])  # the last band, as none is for later
    error = np.abs(replayed.residual["free_run.velocity"])  # type: ignore[index]
    exceeds = np.flatnonzero(error > 3.0 * bands.at("velocity", ages))
    outside = replayed.validity["outside"]
    return {
        "coverage": fitted.record["coverage"]["outputs"],
        "inside": fitted.record["coverage"]["inside"],
        "fires": outside[0][0] if outside else None,
        "exceeds": float(replayed.time[exceeds[0]]) if exceeds.size else None,
    }


def main(count: int, first: int) -> None:
    """Print the numbers of all studies."""
    found = []
    for seed in range(first, first + count):
        with tempfile.TemporaryDirectory() as folder:
            found.append(study(seed, Path(folder)))
    late = [s["fires"] is None or s["fires"] > s["exceeds"] for s in found if s["exceeds"] is not None]
    means = {n: float(np.mean([s["coverage"][n] for s in found])) for n in found[0]["coverage"]}
    alarms = float(np.mean([1.0 - s["inside"] for s in found]))
    print(
        json.dumps(
            {"studies": found, "coverage": means, "false_alarms": alarms, "exceed": len(late), "late": sum(late)}
        )
    )


if __name__ == "__main__":
    given = [int(word) for word in sys.argv[1:3]]
    main(*given, *(6, 1)[len(given) :])
