"""Run a system of FMUs in ecos: a job as JSON on stdin, rows as JSON on stdout. Needs libtbb on the loader's path."""

from __future__ import annotations

import json
import sys
from typing import Any

from ecospy import EcosSimulation, EcosSimulationStructure
from ecospy.lib import EcosLib


def rows_of(simulation: EcosSimulation, job: dict[str, Any], parameters: str | None) -> list[list[float]]:
    """Rows of a simulation, from its initialization on."""
    if not simulation.init(parameter_set=parameters):
        raise SystemExit(EcosLib.get_last_error())
    columns = [column.replace(".", "::", 1) for column in job["columns"]]
    rows = [[simulation.get_real(c) for c in columns]]
    for _ in range(job["steps"]):
        simulation.step(1)
        rows.append([simulation.get_real(c) for c in columns])
    simulation.terminate()
    return rows


def main() -> None:
    job = json.load(sys.stdin)
    EcosLib.set_log_level("err")
    if "ssp" in job:
        with EcosSimulation(ssp_path=job["ssp"], step_size=job["step"]) as simulation:
            json.dump(rows_of(simulation, job, job["parameters"]), sys.stdout)
        return
    with EcosSimulationStructure() as structure:
        for name, path in job["fmus"].items():
            structure.add_model(name, path)
        for source, target in job["connections"]:
            structure.make_real_connection(source.replace(".", "::", 1), target.replace(".", "::", 1))
        starts = {f"{name}::{key}": v for name, values in job["start"].items() for key, v in values.items()}
        structure.add_parameter_set("start", starts)
        with EcosSimulation(structure=structure, step_size=job["step"]) as simulation:
            rows = rows_of(simulation, job, "start")
    json.dump(rows, sys.stdout)


if __name__ == "__main__":
    main()
