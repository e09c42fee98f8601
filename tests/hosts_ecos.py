"""Run a system of FMUs in ecos: a job as JSON on stdin, rows as JSON on stdout. Needs libtbb on the loader's path."""

from __future__ import annotations

import json
import sys

from ecospy import EcosSimulation, EcosSimulationStructure
from ecospy.lib import EcosLib


def main() -> None:
    job = json.load(sys.stdin)
    EcosLib.set_log_level("err")
    columns, rows = [column.replace(".", "::", 1) for column in job["columns"]], []
    with EcosSimulationStructure() as structure:
        for name, path in job.get("fmus", {}).items():
            structure.add_model(name, path)
        for source, target in job.get("connections", []):
            structure.make_real_connection(source.replace(".", "::", 1), target.replace(".", "::", 1))
        starts = {f"{name}::{key}": v for name, values in job.get("start", {}).items() for key, v in values.items()}
        structure.add_parameter_set("start", starts)
        of = {"ssp_path": job["ssp"]} if "ssp" in job else {"structure": structure}
        with EcosSimulation(**of, step_size=job["step"]) as simulation:
            if not simulation.init(parameter_set="start"):
                raise SystemExit(EcosLib.get_last_error())
            for k in range(job["steps"] + 1):
                if k:
                    simulation.step(1)
                rows.append([simulation.get_real(column) for column in columns])
            simulation.terminate()
    json.dump(rows, sys.stdout)


if __name__ == "__main__":
    main()
