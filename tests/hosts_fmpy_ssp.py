"""Run an SSP, or one FMU, by FMPy's own functions: a job as JSON on stdin, rows as JSON on stdout.

The rows of `simulate_ssp` bear the time at which a step begins and hold what came of it, so its first is our second;
in its first step inputs that are connected are zero, for it exchanges nothing before it.
"""

from __future__ import annotations

import json
import sys
import zipfile
from typing import Any

from fmpy import simulate_fmu
from fmpy.ssp.simulation import simulate_ssp
from fmpy.ssp.ssd import read_ssv


def rows_of(job: dict[str, Any]) -> list[list[float]]:
    with zipfile.ZipFile(job["ssp"]) as archive:
        start = read_ssv(job["ssp"], "resources/start.ssv") if "resources/start.ssv" in archive.namelist() else None
    step, steps = job["step"], job["steps"]
    # its time is a sum of steps: half a step keeps it from one too many
    made = simulate_ssp(job["ssp"], 0.0, step * (steps - 0.5), step, parameter_set=start)
    named = [made[column].tolist() for column in job["columns"]]
    return [[0.0] * len(named), *([float(v) for v in row] for row in zip(*named, strict=True))]


def rows_alone(job: dict[str, Any]) -> list[list[float]]:
    ((name, fmu),) = job["fmus"].items()
    columns = [column.partition(".")[2] for column in job["columns"]]
    step, steps = job["step"], job["steps"]
    made = simulate_fmu(
        fmu, fmi_type="CoSimulation", stop_time=step * steps, output_interval=step, step_size=step,
        start_values=job["start"][name], output=columns,
    )  # fmt: skip
    return [[float(row[column]) for column in columns] for row in made]


if __name__ == "__main__":
    given = json.load(sys.stdin)
    json.dump(rows_of(given) if "ssp" in given else rows_alone(given), sys.stdout)
