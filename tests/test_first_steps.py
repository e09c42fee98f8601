"""First steps with FMUs of other tools: `info`, a first scenario by `init`, and `simulate`."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.authoring.matching import Port, match_ports, text
from cosim.authoring.single import simulate
from cosim.blocks.component import Signal
from cosim.core.errors import CosimError
from cosim.files.results import read_results
from cosim.simulation.workflow import run
from cosim.verbs.checks import check as check_files
from cosim.verbs.cli import command_line
from tests.typed import typed_fmu

EXPERIMENT: Any = '<DefaultExperiment tolerance="0.003"/>'
RUNS: Any = '<DefaultExperiment startTime="0" stopTime="2" stepSize="0.5"/>'


def invoked(*arguments: object) -> Any:
    """Return the outcome of a command in this process."""
    return CliRunner().invoke(command_line(), [*map(str, arguments)])


def told(*arguments: object, code: int = 0) -> str:
    """What a command says on stdout, or of what is wrong, with its exit code."""
    done = invoked(*arguments)
    if isinstance(done.exception, CosimError):
        assert done.exception.exit_code == code, done.exception
        return str(done.exception)
    assert done.exit_code == code, done.output
    return done.stdout


def port(name: str, unit: str = "", kind: str = "Real") -> Port:
    component, _, variable = name.partition(".")
    return component, Signal(variable, unit, kind=kind)


# -- info -----------------------------------------------------------------------------------------


def test_info_lists_types_units_defaults_capabilities_platforms_and_states(tmp_path: Path) -> None:
    fmu = typed_fmu(tmp_path, units=("rpm", "rad/s"))
    shown = told("info", fmu)
    for line in (
        "  r_in  Real         rpm   0",
        "  e_in  Enumeration        1 (first)  1 first, 2 second",
        "  states: 2 (h, v)",
        "  default experiment: tolerance 0.003",
    ):
        assert line in shown, shown
    found = json.loads(told("info", fmu, "--json"))
    (r_in,) = (v for v in found["variables"] if v["name"] == "r_in")
    assert (r_in["causality"], r_in["unit"], r_in["start"]) == ("input", "rpm", "0")
    assert found["ways"] == ["co-simulation", "model-exchange"]


# -- which output goes to which input -------------------------------------------------------------


@pytest.mark.parametrize(
    ("outputs", "target", "source", "guess"),
    [
        ([port("a.x", "m"), port("b.x", "m")], port("b.x", "mm"), "a.x", ""),  # of another component
        ([port("tank.level"), port("pump.x")], port("control.tankLevel"), "tank.level", "similar name"),
        (
            [port("motor.speed", "rpm"), port("motor.torque", "N.m")], port("load.motor_speed", "rad/s"),
            "motor.speed", "similar name, same unit",
        ),
        ([port("a.y")], port("b.u"), "a.y", "the only fitting output left"),
    ],
)  # fmt: skip
def test_an_output_goes_to_the_input_of_its_name_or_by_a_guess(
    outputs: list[Port], target: Port, source: str, guess: str
) -> None:
    (made,) = match_ports(outputs, [target]).connections
    assert (text(made.source), made.guess) == (source, guess)


# -- init -----------------------------------------------------------------------------------------


def test_the_scenario_that_init_writes_checks_and_runs_and_converts_units(tmp_path: Path) -> None:
    rpm = typed_fmu(tmp_path, name="rpm", units=("rpm", "rpm"), **{EXPERIMENT: RUNS})
    si = typed_fmu(tmp_path, name="si", units=("rad/s", "rad/s"))
    written = tmp_path / "scenario.yaml"
    told("init", rpm, si, "--out", written)
    content = written.read_text()
    assert "{from: si.r_out, to: rpm.r_in} # guess: similar name, same unit; rad/s to rpm, converted" in content
    assert "# - {from: rpm.r_out, to: si.r_in}" in content  # the other way it would be an algebraic loop
    assert "duration: 2 # s: the default experiment of rpm" in content
    assert check_files(written) == []
    values = run(written, in_process=True, set={"components.si.start.r_in": 2 * math.pi})
    assert values["rpm.r_in"][-1] == pytest.approx(60, rel=1e-12)
    assert values.time[-1] == 2.0


def test_init_writes_over_no_file_and_nothing_of_fmus_that_cannot_be_connected(tmp_path: Path) -> None:
    fmu, written = typed_fmu(tmp_path), tmp_path / "scenario.yaml"
    written.write_text("mine")
    assert "already exists" in told("init", fmu, "--out", written, code=2)
    assert written.read_text() == "mine"
    deaf: Any = {'causality="input"': 'causality="local"'}
    fmus = [typed_fmu(tmp_path, name=name, **deaf) for name in ("one", "two")]
    words = "one.fmu and two.fmu cannot be connected"
    assert words in told("init", *fmus, "--out", tmp_path / "other.yaml", code=2)
    assert not (tmp_path / "other.yaml").exists()


# -- simulate -------------------------------------------------------------------------------------


def test_one_fmu_runs_over_its_default_experiment_and_its_scenario_repeats_it(tmp_path: Path) -> None:
    fmu, out = typed_fmu(tmp_path, **{EXPERIMENT: RUNS}), tmp_path / "out"
    told("simulate", "--in-process", fmu, "--set", "r_in=3", "--out", out)
    assert {p.name for p in out.iterdir()} == {"scenario.yaml", "results.csv", "manifest.json", "report.html"}
    rows = read_results(out / "results.csv")
    assert rows.time.tolist() == [0, 0.5, 1, 1.5, 2]
    assert rows["typed.r_out"][-1] == 3
    run(out / "scenario.yaml", tmp_path / "again", report=False, in_process=True)
    assert (tmp_path / "again" / "results.csv").read_bytes() == (out / "results.csv").read_bytes()


@pytest.mark.parametrize(
    ("options", "last"),
    [("--step 0.3", 2.1), ("--stop 1.1", 1.1), ("--stop 1 --step 0.3", 1.2), ("--stop 1.5", 1.5)],
)
def test_a_run_ends_at_a_whole_step(tmp_path: Path, options: str, last: float) -> None:
    fmu, out = typed_fmu(tmp_path, **{EXPERIMENT: RUNS}), tmp_path / "out"
    told("simulate", "--in-process", fmu, *options.split(), "--out", out, "--no-report")
    assert read_results(out / "results.csv").time[-1] == pytest.approx(last, rel=1e-15)


def test_a_run_begins_where_its_recording_begins_and_says_what_it_does_not_play(tmp_path: Path) -> None:
    fmu, log = typed_fmu(tmp_path), tmp_path / "log.csv"
    log.write_text("time,r_in,other\n" + "".join(f"{t:.1f},{t:.1f},0\n" for t in np.arange(5, 6.01, 0.1)))
    made = simulate(fmu, input=log, in_process=True)
    assert (made.time[0], made.time[-1]) == pytest.approx((5, 6))
    assert made["typed.r_out"] == pytest.approx(made.time, abs=1e-6)
    assert any("typed has no inputs other" in w for w in made.warnings)
