"""Run an SSP or a system of FMUs in libcosim: a job as JSON on stdin, rows as JSON on stdout."""

from __future__ import annotations

import json
import sys

from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
from libcosimpy.CosimObserver import CosimObserver
from libcosimpy.CosimSlave import CosimLocalSlave


def main() -> None:
    job = json.load(sys.stdin)
    log_output_level(CosimLogLevel.ERROR)
    if "ssp" in job:
        execution = CosimExecution.from_ssp_file(job["ssp"], None)
    else:
        execution = CosimExecution.from_step_size(round(job["step"] * 1e9))
        for name, path in job["fmus"].items():
            execution.add_local_slave(CosimLocalSlave(path, name))
    place = {
        f"{slave.name.decode()}.{variable.name.decode()}": (slave.index, variable.reference)
        for slave in execution.slave_infos()
        for variable in execution.slave_variables(slave.index)
    }
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer)
    setters = {float: execution.real_initial_value, bool: execution.boolean_initial_value}
    for name, values in job.get("start", {}).items():
        for key, value in values.items():
            assert setters[type(value)](*place[f"{name}.{key}"], value), key
    for source, target in job.get("connections", []):
        assert execution.connect_real_variables(*place[source], *place[target]) == 0, target
    rows = []
    for k in range(job["steps"] + 1):
        assert k == 0 or execution.step()
        signals = (place[column] for column in job["columns"])
        rows.append([observer.last_real_values(slave, [reference])[0] for slave, reference in signals])
    json.dump(rows, sys.stdout)


if __name__ == "__main__":
    main()
