"""From FMUs of others to a run: what they have, a first scenario of them, one run without a file."""

from __future__ import annotations

import json
import math
from pathlib import Path

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

EXPERIMENT = '<DefaultExperiment tolerance="0.003"/>'
RUNS = '<DefaultExperiment startTime="0" stopTime="2" stepSize="0.5"/>'


def told(*arguments: str | Path, code: int = 0) -> str:
    """What a command says on stdout, or of what is wrong, with its exit code."""
    done = CliRunner().invoke(command_line(), [str(a) for a in arguments])
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
        "  co-simulation: canHandleVariableCommunicationStepSize",
        "  platforms: linux64",
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
    ("outputs", "inputs", "found"),
    [
        (
            [port("a.x", "m"), port("b.x", "m"), port("a.u", "V")],  # of another component
            [port("b.u", "V"), port("b.x", "mm")],
            {"b.u": ("a.u", ""), "b.x": ("a.x", "")},
        ),
        (
            [port("tank.level"), port("motor.speed", "rpm"), port("motor.torque", "N.m")],
            [port("control.tankLevel"), port("load.motor_speed", "rad/s")],
            {
                "control.tankLevel": ("tank.level", "similar name"),
                "load.motor_speed": ("motor.speed", "similar name, same unit"),
            },
        ),
        ([port("a.y")], [port("b.u")], {"b.u": ("a.y", "nothing else is left that fits")}),
    ],
)
def test_an_output_goes_to_the_input_of_its_name_or_by_a_guess(
    outputs: list[Port], inputs: list[Port], found: dict[str, tuple[str, str]]
) -> None:
    made = match_ports(outputs, inputs).connections
    assert {text(m.target): (text(m.source), m.guess) for m in made} == found


def test_outputs_that_fit_alike_are_a_choice_that_is_left_to_the_user() -> None:
    for outputs, target in (
        ([port("a.x"), port("b.x")], port("c.x")),  # of one name
        ([port("pump.flow_left"), port("pump.flow_right"), port("pump.level")], port("tank.flow")),
    ):
        made = match_ports(outputs, [target])
        assert not made.connections
        assert made.choices == {text(target): tuple(map(text, outputs[:2]))}
        assert made.unconnected[0][1][:2] == tuple(map(text, outputs[:2]))


# -- values with units --------------------------------------------------------------------------------


def test_a_value_is_converted_from_any_unit_of_its_dimension_and_others_are_offered(tmp_path: Path) -> None:
    fmu = typed_fmu(tmp_path, units=("V", "V"))
    quick = ["--stop", "0.1", "--step", "0.1", "--no-report", "--in-process", "--out", tmp_path / "o", "--force"]
    told("simulate", fmu, "--set", "r_in=500 mV", *quick)
    assert read_results(tmp_path / "o" / "results.csv")["typed.r_in"][0] == 0.5
    refused = told("simulate", fmu, "--set", "r_in=5 rpm", *quick, code=2)
    assert "it is a number [V], or text with a unit: 3 V, " in refused
    assert "3 mV" in refused


# -- init -----------------------------------------------------------------------------------------


def test_the_scenario_that_init_writes_checks_and_runs_and_converts_units(tmp_path: Path) -> None:
    rpm = typed_fmu(tmp_path, name="rpm", units=("rpm", "rpm"), **{EXPERIMENT: RUNS})
    si = typed_fmu(tmp_path, name="si", units=("rad/s", "rad/s"))
    written = tmp_path / "scenario.yaml"
    said = told("init", rpm, si, "--out", written)
    assert "si.r_out → rpm.r_in   guess: similar name, same unit" in said
    content = written.read_text()
    assert "{from: si.r_out, to: rpm.r_in} # guess: similar name, same unit; rad/s to rpm, converted" in content
    assert "# - {from: rpm.r_out, to: si.r_in}" in content  # the other way it would be an algebraic loop
    assert "duration: 2 # s: the default experiment of rpm" in content
    assert check_files(written) == []
    values = run(written, in_process=True, set={"components.si.start.r_in": 2 * math.pi})
    assert values["rpm.r_in"][-1] == pytest.approx(60, rel=1e-12)
    assert values.time[-1] == 2.0


def test_init_never_writes_over_a_file(tmp_path: Path) -> None:
    fmu, written = typed_fmu(tmp_path), tmp_path / "scenario.yaml"
    written.write_text("mine")
    assert "is there already; it is never written over" in told("init", fmu, "--out", written, code=2)
    assert written.read_text() == "mine"


def test_fmus_that_cannot_be_connected_are_told_why_and_nothing_is_written(tmp_path: Path) -> None:
    deaf = {'causality="input"': 'causality="local"'}
    fmus = [typed_fmu(tmp_path, name=name, **deaf) for name in ("one", "two")]
    words = "one.fmu and two.fmu cannot be connected: they have no inputs"
    assert words in told("init", *fmus, "--out", tmp_path / "scenario.yaml", code=2)
    assert not (tmp_path / "scenario.yaml").exists()


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


def test_a_folder_of_another_run_or_a_scenario_of_ones_own_is_not_written_over(tmp_path: Path) -> None:
    first, second, out = typed_fmu(tmp_path), typed_fmu(tmp_path, name="second"), tmp_path / "out"
    told("simulate", "--in-process", first, "--out", out, "--no-report", "--stop", "0.1")
    before = (out / "results.csv").read_bytes()
    again = ["simulate", "--in-process", second, "--out", out, "--no-report", "--stop", "0.1"]
    told(*again, code=2)
    assert (out / "results.csv").read_bytes() == before
    told(*again, "--force")


@pytest.mark.parametrize(
    ("options", "last"),
    [
        (["--step", "0.3"], 2.1),
        (["--stop", "1.1"], 1.1),
        (["--stop", "1", "--step", "0.3"], 1.2),
        ([], 2.0),
        (["--stop", "1.5"], 1.5),
    ],
)  # fmt: skip
def test_a_run_ends_at_a_whole_step(tmp_path: Path, options: list[str], last: float) -> None:
    fmu, out = typed_fmu(tmp_path, **{EXPERIMENT: RUNS}), tmp_path / "out"
    done = CliRunner().invoke(
        command_line(), ["simulate", "--in-process", str(fmu), *options, "--out", str(out), "--no-report"]
    )
    assert done.exit_code == 0
    assert float((out / "results.csv").read_text().splitlines()[-1].partition(",")[0]) == last


def test_a_run_begins_where_its_recording_begins_and_says_what_it_does_not_play(tmp_path: Path) -> None:
    fmu, log = typed_fmu(tmp_path), tmp_path / "log.csv"
    log.write_text("time,r_in,other\n" + "".join(f"{t:.1f},{t:.1f},0\n" for t in np.arange(5, 6.01, 0.1)))
    made = simulate(fmu, input=log, in_process=True)
    assert made.time[0] == 5
    assert made.time[-1] == pytest.approx(6)
    assert made["typed.r_out"] == pytest.approx(made.time, abs=1e-6)
    assert "the run begins at 5 s, where log.csv does" in made.warnings
    assert any("typed has no inputs other: they drive nothing" in w for w in made.warnings)
    late = typed_fmu(tmp_path, name="late", **{EXPERIMENT: '<DefaultExperiment startTime="5.5" stopTime="7"/>'})
    made = simulate(late, input=log, in_process=True)
    assert (made.time[0], made.time[-1]) == pytest.approx((5.5, 6))
    assert "log.csv: begins at 5 s, the run at 5.5 s as late says" in made.warnings
