"""FMUs for model exchange beside FMUs for co-simulation: their solvers are stepped by the loop in Python."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from cosim.files.results import Results
from cosim.master.master import StoppedRun, simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system
from tests.slider import slider_fmu

REFERENCE = {"block": "reference", "signals": {"u": {"start": 1, "changes": [{"at": 0.4, "to": -1}]}}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place: Path = tmp_path_factory.mktemp("mixed")
    for version in (2, 3):
        slider_fmu(place / f"exchange{version}.fmu", version, exchange=True)
        slider_fmu(place / f"slider{version}.fmu", version)
    return place


def stepped(
    folder: Path, components: dict[str, Any], wires: list[tuple[str, str]], *, in_c: bool, **more: Any
) -> Results:
    connections = [{"from": origin, "to": target, "factor": 1} for origin, target in wires]
    content = {"name": "m", "duration": 1, "step": 0.02, "components": components, "connections": connections} | more
    path = folder / "m.yaml"
    path.write_text(json.dumps(content))
    file = ScenarioFile(path)
    return simulate(build_system(file), file.scenario.steps, file.scenario.step, in_c=in_c)


@pytest.mark.parametrize("algorithm", ["gauss-seidel", "jacobi"])
@pytest.mark.parametrize("version", [2, 3])
def test_mixed_interfaces_are_stepped_in_python(folder: Path, version: int, algorithm: str) -> None:
    components = {
        "m": {"fmu": f"exchange{version}.fmu", "start": {"damping": 1.0}},
        "slow": {"fmu": f"exchange{version}.fmu", "step": 0.1, "start": {"velocity_start": 2.0}},
        "s": {"fmu": f"slider{version}.fmu"},
        "r": REFERENCE,
    }
    wires = [("r.u", "m.force"), ("m.position", "s.force"), ("s.velocity", "slow.force")]
    more = {"algorithm": algorithm, "noise": True, "seed": 3, "events": []}
    results = stepped(folder, components, wires, in_c=True, **more)
    assert results.loop == f"Python: m is of FMI {version}.0 model-exchange"
    assert results["m.velocity"].min() < 0 < results["m.velocity"].max()


def test_an_interruption_during_a_step_is_not_lost(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from cosim.blocks.fmu import FmuBlock

    def interrupted(block: FmuBlock, t: float, h: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(FmuBlock, "advance", interrupted)
    components = {"m": {"fmu": "exchange2.fmu"}, "s": {"fmu": "slider2.fmu"}}
    with pytest.raises(StoppedRun) as stopped:
        stepped(folder, components, [], in_c=True)
    assert stopped.value.error.exit_code == 130


def test_model_exchange_alone_is_stepped_in_python(folder: Path) -> None:
    results = stepped(folder, {"m": {"fmu": "exchange2.fmu"}}, [], in_c=True)
    assert results.loop == "Python: m is of FMI 2.0 model-exchange"
