"""FMUs for model exchange beside FMUs for co-simulation: their solvers are stepped by the loop in Python."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cosim.master.master import simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system
from tests.slider import slider_fmu


@pytest.mark.parametrize(("version", "algorithm"), [(2, "jacobi"), (3, "gauss-seidel")])
def test_mixed_interfaces_are_stepped_in_python(tmp_path: Path, version: int, algorithm: str) -> None:
    slider_fmu(tmp_path / "exchange.fmu", version, exchange=True)
    slider_fmu(tmp_path / "slider.fmu", version)
    components = {
        "m": {"fmu": "exchange.fmu", "start": {"damping": 1.0}},
        "slow": {"fmu": "exchange.fmu", "step": 0.1, "start": {"velocity_start": 2.0}},
        "s": {"fmu": "slider.fmu"},
        "r": {"block": "reference", "signals": {"u": {"start": 1, "changes": [{"at": 0.4, "to": -1}]}}},
    }
    wires = {"r.u": "m.force", "m.position": "s.force", "s.velocity": "slow.force"}
    connections = [{"from": origin, "to": target, "factor": 1} for origin, target in wires.items()]
    content = {"name": "m", "duration": 1, "step": 0.02, "components": components, "connections": connections}
    path = tmp_path / "m.yaml"
    path.write_text(json.dumps(content | {"algorithm": algorithm, "noise": True, "events": []}))
    file = ScenarioFile(path)
    results = simulate(build_system(file), file.scenario.steps, file.scenario.step, in_c=True)
    assert results.loop == f"Python: m is of FMI {version}.0 model-exchange"
    assert results["m.velocity"].min() < 0 < results["m.velocity"].max()
