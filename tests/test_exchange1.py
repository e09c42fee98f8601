"""Model exchange of FMI 1.0: states, event indicators and events of every kind, equal to FMPy's."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.files.results import Results
from cosim.master.master import StoppedRun, simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system
from cosim.verbs.cli import command_line
from tests.bounce1 import bounce_fmu


def bounced(folder: Path, start: dict[str, float] | None = None, **more: Any) -> Results:
    component = {"fmu": str(bounce_fmu(folder / "bounce.fmu")), "start": start or {}}
    component |= {"solver": more.pop("solver")} if "solver" in more else {}
    path = folder / "bounce.yaml"
    content = {"name": "bounce", "duration": 2, "step": 0.01, "record": ["a.*"], "components": {"a": component}}
    components = content["components"] | more.pop("components", {})
    path.write_text(json.dumps(content | more | {"components": components}))
    file = ScenarioFile(path)
    return simulate(build_system(file), file.scenario.steps, file.scenario.step)


@pytest.mark.thorough
@pytest.mark.parametrize("start", [{}, {"kick_at": 0.3}, {"e": 0.9, "g": 3.7}, {"kick_at": 0.005, "e": 0.6}])
def test_it_is_what_fmpy_makes_of_it_to_the_last_bit(tmp_path: Path, start: dict[str, float]) -> None:
    import fmpy

    ours = bounced(tmp_path, start, duration=1.5)
    theirs = fmpy.simulate_fmu(
        str(tmp_path / "bounce.fmu"), stop_time=1.5, output_interval=0.01, relative_tolerance=1e-6, start_values=start,
        record_events=False, output=["h", "v", "events", "upwards"],
    )  # fmt: skip
    assert len(theirs) == len(ours.time) == 151
    for name in ("h", "v", "events", "upwards"):
        assert ours[f"a.{name}"].tolist() == theirs[name].tolist(), name
    assert ours["a.events"][-1] >= 1


def test_an_input_that_changes_is_an_event(tmp_path: Path) -> None:
    wind = {"block": "reference", "signals": {"u": {"start": 0, "changes": [{"at": 0.2, "to": 9.81}]}}}
    connections = [{"from": "w.u", "to": "a.wind"}]
    results = bounced(tmp_path, duration=0.4, components={"w": wind}, connections=connections)
    before, later = results["a.v"][results.time < 0.185], results["a.v"][results.time > 0.2 + 1e-9]
    assert np.diff(before) == pytest.approx(-0.01 * 9.81, abs=1e-5)
    assert np.diff(later) == pytest.approx(0.0, abs=1e-5)
    assert results["a.events"][-1] - results["a.events"][1] == 1


def test_a_call_that_fails_is_told_with_the_words_of_the_fmu(tmp_path: Path) -> None:
    with pytest.raises(StoppedRun, match=r"a at t = 0\.(2\d*|3) s: fmi1GetDerivatives returned Error: it has a hole"):
        bounced(tmp_path, {"fail_at": 0.3})


def test_every_verb_takes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bounce_fmu(tmp_path / "bounce.fmu")
    monkeypatch.chdir(tmp_path)

    def done(*command: str) -> str:
        result = CliRunner().invoke(command_line(), list(command))
        assert result.exit_code == 0, result.output
        return result.output

    told = done("info", "bounce.fmu")
    assert "FMI 1.0 for model-exchange" in told
    assert "states: 2" in told
    assert "no fault" in done("check", "bounce.fmu")
    done("simulate", "bounce.fmu", "--out", "alone", "--no-report")
    done("init", "bounce.fmu", "-o", "s.yaml")
    done("graph", "s.yaml")
    done("run", "s.yaml", "--out", "run", "--no-report")
    done("linearize", "bounce.fmu", "--out", "linear")
    linear = json.loads((tmp_path / "linear" / "linear.json").read_text())
    assert linear["states"] == ["h", "v"]  # by their value references, and not an alias of the other sign
    (model,) = linear["models"]
    assert np.array(model["A"]) == pytest.approx(np.array([[0, 1], [0, 0]]), abs=1e-6)
    assert np.array(model["B"]) == pytest.approx(np.array([[0], [1]]), abs=1e-6)
