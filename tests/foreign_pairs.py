"""Pairs of other people's FMUs, coupled by `cosim`, libcosim and ecos: `python -m tests.foreign_pairs FOLDER`.

Jacobi in all three. Prints the largest |a − b| / max(1, |b|) of our rows from libcosim's and ecos'.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

PAIRS: dict[str, dict[str, Any]] = {
    "mass, spring and damper (20-sim)": {
        "fmus": {"a": "resources_MassSpringDamper1.fmu", "b": "resources_MassSpringDamper2.fmu"},
        "connections": [("b.fk", "a.fk"), ("a.x1", "b.x1"), ("a.v1", "b.v1")],
        "columns": ["a.x1", "a.v1", "b.x2", "b.v2", "b.fk"],
        "step": 0.0078125,  # sums of it are exact: ecos adds, libcosim and we count
        "steps": 500,
    },
    "quarter truck (libcosim)": {
        "fmus": {"a": "quarter_truck_Chassis.fmu", "b": "quarter_truck_Wheel.fmu"},
        "connections": [("b.out_spring_damper_f", "a.force"), ("a.velocity", "b.in_vel")],
        "columns": ["a.position", "a.velocity", "a.acceleration", "b.position", "b.velocity", "b.out_tire_f"],
        "step": 0.01,
        "steps": 200,
    },
}


def ours(job: dict[str, Any]) -> np.ndarray:
    from cosim.master.master import simulate
    from cosim.scenario.scenario_file import ScenarioFile
    from cosim.system.system import build_system

    scenario = {
        "name": "pair",
        "duration": job["step"] * job["steps"],
        "step": job["step"],
        "algorithm": "jacobi",
        "components": {name: {"fmu": path} for name, path in job["fmus"].items()},
        "connections": [{"from": source, "to": target} for source, target in job["connections"]],
    }
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "pair.yaml"
        file.write_text(json.dumps(scenario))
        results = simulate(build_system(ScenarioFile(file)), job["steps"], job["step"])
    return np.column_stack([results[c] for c in job["columns"]])


def theirs(host: str, job: dict[str, Any]) -> np.ndarray | str:
    done = subprocess.run(
        [sys.executable, "-m", f"tests.hosts_{host}"],
        input=json.dumps(job),
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "LD_LIBRARY_PATH": str(Path(sysconfig.get_path("data")) / "lib")},
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("[[")]
    return np.array(json.JSONDecoder().raw_decode(lines[-1])[0]) if lines else f"fails: {done.stderr.strip()[-150:]}"


def main() -> None:
    files = sorted(p.resolve() for p in Path(sys.argv[1]).rglob("*.fmu"))
    for name, pair in PAIRS.items():
        found = {n: next((str(p) for p in files if p.name.endswith(end)), "") for n, end in pair["fmus"].items()}
        if not all(found.values()):
            print(f"{name}: not there")
            continue
        job = {**pair, "fmus": found, "start": {}}
        a = ours(job)
        print(f"{name}: ours, {job['columns'][0]} at row 1: {a[1, 0]:.8g}")
        for host, first in (("libcosim", 1), ("ecos", 0)):  # libcosim shows nothing before its first step
            b = theirs(host, job)
            if isinstance(b, str):
                print(f"  {host} {b}")
                continue
            difference = np.abs(a[first:] - b[first:]) / np.maximum(1.0, np.abs(b[first:]))
            print(f"  from {host}: {difference.max():.1e}; {job['columns'][0]} at row 1: {b[1, 0]:.8g}")


if __name__ == "__main__":
    main()
