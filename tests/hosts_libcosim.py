"""Run a system of FMUs in libcosim: a job as JSON on stdin, rows as JSON on stdout."""

from __future__ import annotations

import json
import sys
from typing import Any

from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
from libcosimpy.CosimObserver import CosimObserver
from libcosimpy.CosimSlave import CosimLocalSlave

from tests.hosts_fmpy import description_of


def of_ssp(job: dict[str, Any]) -> list[list[float]]:
    """Return the rows of an SSP, simulated with its own step or a given step."""
    forced = job.get("forced")
    execution = CosimExecution.from_ssp_file(job["ssp"], None if forced is None else round(forced * 1e9))
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer)
    index = {info.name.decode(): info.index for info in execution.slave_infos()}
    reference = {
        f"{name}.{v.name.decode()}": v.reference for name, k in index.items() for v in execution.slave_variables(k)
    }
    places = [(index[column.partition(".")[0]], reference[column]) for column in job["columns"]]

    def row() -> list[float]:
        return [observer.last_real_values(slave, [vr])[0] for slave, vr in places]

    rows = [row()]
    for _ in range(job["steps"]):
        assert execution.step()
        rows.append(row())
    return rows


def main() -> None:
    job = json.load(sys.stdin)
    log_output_level(CosimLogLevel.ERROR)
    if "ssp" in job:
        json.dump(of_ssp(job), sys.stdout)
        return
    execution = CosimExecution.from_step_size(round(job["step"] * 1e9))
    index = {n: execution.add_local_slave(CosimLocalSlave(path, n)) for n, path in job["fmus"].items()}
    reference = {
        f"{n}.{v.name}": v.valueReference
        for n, path in job["fmus"].items()
        for v in description_of(path).modelVariables
    }
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer)
    setters = {
        float: execution.real_initial_value,
        bool: execution.boolean_initial_value,
        str: execution.string_initial_value,
    }
    for name, values in job["start"].items():
        for key, value in values.items():
            assert setters[type(value)](index[name], reference[f"{name}.{key}"], value), key

    def place(signal: str) -> tuple[int, int]:
        return index[signal.partition(".")[0]], reference[signal]

    for source, target in job["connections"]:
        assert execution.connect_real_variables(*place(source), *place(target)) == 0, target

    def row() -> list[float]:
        return [observer.last_real_values(slave, [vr])[0] for slave, vr in map(place, job["columns"])]

    rows = [row()]
    for _ in range(job["steps"]):
        assert execution.step()
        rows.append(row())
    json.dump(rows, sys.stdout)


if __name__ == "__main__":
    main()
