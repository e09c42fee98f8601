"""Run an SSP by FMPy's own `simulate_ssp`: a job as JSON on stdin, rows as JSON on stdout.

Its rows bear the time at which a step begins and hold what came of it, so its first is our second; in its first step
inputs that are connected are zero, for it exchanges nothing before it.
"""

from __future__ import annotations

import json
import sys
import zipfile
from typing import Any

from fmpy.ssp.simulation import simulate_ssp
from fmpy.ssp.ssd import read_ssv


def rows_of(job: dict[str, Any]) -> list[list[float]]:
    with zipfile.ZipFile(job["ssp"]) as archive:
        start = read_ssv(job["ssp"], "resources/start.ssv") if "resources/start.ssv" in archive.namelist() else None
    step, steps = job["step"], job["steps"]
    # its time is a sum of steps: half a step keeps it from one too many
    made = simulate_ssp(job["ssp"], 0.0, step * (steps - 0.5), step, parameter_set=start)
    columns = ["system." + column for column in job["columns"]]
    named = [made[c if c in made.dtype.names else c.removeprefix("system.")].tolist() for c in columns]
    return [[float("nan")] * len(columns), *([float(v) for v in row] for row in zip(*named, strict=True))]


if __name__ == "__main__":
    json.dump(rows_of(json.load(sys.stdin)), sys.stdout)
