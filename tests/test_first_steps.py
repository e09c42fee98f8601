"""From FMUs of others to a run: what they have, a first scenario of them, one run without a file."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.authoring.draft_text import scalar
from cosim.authoring.matching import Matches, Port, match_ports, text
from cosim.authoring.parts import component_name
from cosim.base.errors import CosimError, InputError
from cosim.blocks.component import Signal
from cosim.blocks.coupling import DEFAULT
from cosim.scenario.scenario_file import ScenarioFile
from cosim.storage.kinds import LOG, next_step
from cosim.storage.results import read_results
from cosim.verbs.check_verb import check as check_files
from cosim.verbs.cli import app
from cosim.verbs.run_verb import run
from cosim.verbs.simulate_verb import simulate
from tests.typed import typed_fmu

EXPERIMENT = '<DefaultExperiment tolerance="0.003"/>'
RUNS = '<DefaultExperiment startTime="0" stopTime="2" stepSize="0.5"/>'


def told(*arguments: str | Path, code: int = 0) -> str:
    """What a command says on stdout, or of what is wrong, with its exit code."""
    done = CliRunner().invoke(app, [str(a) for a in arguments])
    if isinstance(done.exception, CosimError):
        assert done.exception.exit_code == code, done.exception
        return str(done.exception)
    assert done.exit_code == code, done.output
    return done.stdout


def connected(
    outputs: Sequence[Port], inputs: Sequence[Port], sizes: dict[str, int] | None = None
) -> dict[str, tuple[str, str]]:
    found = match_ports(outputs, inputs, sizes or {}).connections
    return {text(m.target): (text(m.source), m.guess) for m in found}


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


@pytest.mark.parametrize("verb", ["info", "init", "simulate"])
def test_what_is_no_fmu_is_named_with_the_command_that_reads_it(tmp_path: Path, verb: str) -> None:
    (tmp_path / "empty.fmu").touch()
    (tmp_path / "log.csv").write_text("time,x\n0,0\n")
    (tmp_path / "s.yaml").write_text("name: s\ncomponents: {}\n")
    for given, words in (
        (tmp_path, "is a folder, not an FMU"),
        (tmp_path / "none.fmu", "no such file; give an FMU"),
        (tmp_path / "empty.fmu", "is empty; give an FMU"),
        (tmp_path / "log.csv", f"is a log, not an FMU: {next_step(LOG, tmp_path / 'log.csv')}"),
        (tmp_path / "s.yaml", "is a scenario, not an FMU: `cosim run"),
    ):
        out = ["--out", tmp_path / "made.yaml"] if verb == "init" else []
        assert words in told(verb, given, *out, code=2)
    assert not (tmp_path / "made.yaml").exists()


def test_every_file_that_is_no_fmu_is_told_at_once(tmp_path: Path) -> None:
    assert len(told("info", tmp_path, tmp_path / "none.fmu", code=2).splitlines()) == 2


@pytest.mark.parametrize(
    ("stem", "model", "name"),
    [
        ("tank", "Plant.Tank", "tank"),
        ("2tanks", "", "fmu_2tanks"),
        ("Größe", "", "Groesse"),
        ("日本", "", "fmu"),
        ("ControlledTemperature_v2.1_linux64_cs", "ControlledTemperature", "ControlledTemperature"),
        ("Rotational_Examples_CoupledClutches_0_9", "Lib.Rotational.Clutches", "Clutches"),
        ("Drive.Train.Controller.v12.linux64", "", "Drive_Train_Controller"),
        ("x" * 60, "y" * 60, "y" * 24),
    ],
)
def test_a_component_has_a_name_that_is_short_to_read(stem: str, model: str, name: str) -> None:
    assert component_name(stem, model) == name


# -- which output goes to which input -------------------------------------------------------------


def test_the_same_name_connects_and_is_no_guess() -> None:
    found = connected([port("a.x", "m"), port("a.u", "V")], [port("b.u", "V"), port("b.x", "mm")])
    assert found == {"b.u": ("a.u", ""), "b.x": ("a.x", "")}


def test_a_name_of_another_dimension_or_type_is_not_connected() -> None:
    assert connected([port("a.x", "m")], [port("b.x", "s")]) == {}
    assert connected([port("a.x")], [port("b.x", kind="Boolean")]) == {}


def test_an_output_is_never_connected_to_its_own_component() -> None:
    assert connected([port("a.x")], [port("a.x")]) == {}


def test_similar_names_are_a_guess_the_likelier_with_one_unit() -> None:
    found = connected(
        [port("tank.level"), port("motor.speed", "rpm"), port("motor.torque", "N.m")],
        [port("control.tankLevel"), port("load.motor_speed", "rad/s")],
    )
    assert found == {
        "control.tankLevel": ("tank.level", "similar name"),
        "load.motor_speed": ("motor.speed", "similar name, same unit"),
    }


def test_a_measured_value_is_not_guessed_to_be_its_own_reference() -> None:
    sources = [port("plant.x", "m"), port("plant.y", "m")]
    assert connected(sources, [port("control.x", "m"), port("control.x_ref", "m")]) == {"control.x": ("plant.x", "")}


def test_what_alone_is_left_to_fit_is_a_guess() -> None:
    assert connected([port("a.y")], [port("b.u")]) == {"b.u": ("a.y", "nothing else is left that fits")}


def test_outputs_that_fit_alike_are_a_choice_that_is_left_to_the_user() -> None:
    for outputs, target in (
        ([port("a.x"), port("b.x")], port("c.x")),  # of one name
        ([port("pump.flow_left"), port("pump.flow_right"), port("pump.level")], port("tank.flow")),
    ):
        made = match_ports(outputs, [target])
        assert not made.connections
        assert made.choices == {text(target): tuple(map(text, outputs[:2]))}
        assert made.unconnected[0][1][:2] == tuple(map(text, outputs[:2]))


def test_an_output_that_another_input_takes_is_none_to_choose_from() -> None:
    outputs = [port("pump.flow_left"), port("pump.flow_right")]
    found = connected(outputs, [port("tank.flow"), port("tank.flow_left")])
    assert found == {
        "tank.flow": ("pump.flow_right", "similar name"),
        "tank.flow_left": ("pump.flow_left", ""),
    }


def test_an_array_fits_one_of_as_many_elements_alone() -> None:
    outputs = [port("a.u"), port("b.u"), port("b.w")]
    assert connected(outputs, [port("c.u")], {"a.u": 3, "c.u": 3}) == {"c.u": ("a.u", "")}
    assert connected(outputs, [port("c.u")], {"a.u": 3, "c.u": 2}) == {}
    assert connected(outputs, [port("c.u")], {"a.u": 3}) == {"c.u": ("b.u", "")}


# -- values with units --------------------------------------------------------------------------------


def test_a_value_is_converted_from_any_unit_of_its_dimension_and_others_are_offered(tmp_path: Path) -> None:
    fmu = typed_fmu(tmp_path, units=("V", "V"))
    quick = ["--stop", "0.1", "--step", "0.1", "--no-report", "--in-process", "--out", tmp_path / "o", "--force"]
    told("simulate", fmu, "--set", "r_in=500 mV", *quick)
    assert read_results(tmp_path / "o" / "results.csv")["typed.r_in"][0] == 0.5
    refused = told("simulate", fmu, "--set", "r_in=5 rpm", *quick, code=2)
    assert "it is a number [V], or text with a unit: 3 V, " in refused
    assert "3 mV" in refused


def test_a_unit_for_a_variable_that_declares_none_is_refused_with_the_cure(tmp_path: Path) -> None:
    fmu = typed_fmu(tmp_path)
    refused = told("simulate", fmu, "--set", "r_in=500 mV", "--out", tmp_path / "o", code=2)
    assert refused.endswith("it is a number alone: no unit of it is declared")


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


def test_what_init_offers_can_be_uncommented_where_nothing_was_connected(tmp_path: Path) -> None:
    from cosim.authoring.draft_text import scenario_text
    from cosim.authoring.parts import parts_of, times_of

    parts = parts_of([typed_fmu(tmp_path, name="one"), typed_fmu(tmp_path, name="two")])
    (target,) = (p for p in parts[1].ports[0] if p[1].name == "r_in")
    none = Matches((), ((target, ("one.r_out",)),))
    written = scenario_text(tmp_path, parts, none, times_of(parts), DEFAULT)
    (tmp_path / "as_is.yaml").write_text(written)
    assert not ScenarioFile(tmp_path / "as_is.yaml").faults
    (tmp_path / "taken.yaml").write_text(written.replace("  # - {from", "  - {from"))
    (connection,) = ScenarioFile(tmp_path / "taken.yaml").scenario.connections
    assert (connection.source, connection.target) == ("one.r_out", "two.r_in")


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


def test_two_of_one_name_get_names_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    fmus = [typed_fmu(tmp_path), typed_fmu(tmp_path / "a")]
    told("init", *fmus, "--out", tmp_path / "scenario.yaml")
    assert "  typed_2:" in (tmp_path / "scenario.yaml").read_text()


@pytest.mark.parametrize("value", ["on", "no", "a: b", "x # y", "p.e[1]", '"', "é ü", ""])
def test_a_name_that_yaml_would_misread_stands_in_quotes(value: str) -> None:
    from cosim.storage.yaml_nodes import Document

    assert Document(f"{{x: {scalar(value)}}}").data == {"x": value}


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


def test_a_recording_is_played_to_the_inputs_of_its_names_up_to_its_end(tmp_path: Path) -> None:
    fmu, log = typed_fmu(tmp_path), tmp_path / "log.csv"
    time = np.arange(0, 1.01, 0.1)
    log.write_text("time,r_in,other\n" + "".join(f"{t:.1f},{2 * t:.1f},0\n" for t in time))
    told("simulate", "--in-process", fmu, "--input", log, "--out", tmp_path / "out", "--no-report")
    rows = read_results(tmp_path / "out" / "results.csv")
    assert rows.time[-1] == pytest.approx(1.0)
    assert rows["typed.r_out"] == pytest.approx(2 * rows.time)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--set", "gian=2"], 'no variable "gian"; did you mean "gain"?'),
        (["--set", "gain"], "is not NAME=VALUE; for example --set mass=2"),
        (["--set", "gain=heavy"], "it is a number"),
        (["--step", "0"], "give a number of seconds above 0"),
        (["--stop", "-1"], "give a later --stop"),
        (["--stop", "nan"], "give a number of seconds"),
        (["--input", "LOG"], "no column is an input of typed.fmu (its columns: speed; inputs of typed: r_in, "),
        (["--input", "none.csv"], "no such file; give a log"),
        (["--record", "nothing"], 'no variable "typed.nothing"'),
    ],
)
def test_a_wrong_option_of_simulate_is_told_and_nothing_is_left(tmp_path: Path, options: list[str], words: str) -> None:
    fmu, log = typed_fmu(tmp_path), tmp_path / "log.csv"
    log.write_text("time,speed\n0,0\n1,1\n")
    options = [str(log) if o == "LOG" else o for o in options]
    assert words in told("simulate", "--in-process", fmu, *options, "--out", tmp_path / "out", code=2)
    assert not [*(tmp_path / "out").glob("*")]


def test_a_folder_of_another_run_or_a_scenario_of_ones_own_is_not_written_over(tmp_path: Path) -> None:
    first, second, out = typed_fmu(tmp_path), typed_fmu(tmp_path, name="second"), tmp_path / "out"
    told("simulate", "--in-process", first, "--out", out, "--no-report", "--stop", "0.1")
    before = (out / "results.csv").read_bytes()
    again = ["simulate", "--in-process", second, "--out", out, "--no-report", "--stop", "0.1"]
    told(*again, code=2)
    assert (out / "results.csv").read_bytes() == before
    told(*again, "--force")


@pytest.mark.parametrize(
    ("options", "duration", "step", "last", "words"),
    [
        (["--step", "0.3"], "2.1 # s: whole steps; the default experiment of typed is 2 s", "0.3 # s: given", 2.1,
         "the run ends at 2.1 s, not at 2 s"),
        (["--stop", "1.1"], "1.1 # s: given", "# s: 3 to the end; not 0.5 s, the step of typed", 1.1,
         "the step is 0.366667 s, not 0.5 s (the step of typed), to end at 1.1 s"),
        (["--stop", "1", "--step", "0.3"], "1.2 # s: whole steps; given is 1 s", "0.3 # s: given", 1.2,
         "the run ends at 1.2 s, not at 1 s (given)"),
        ([], "2 # s: the default experiment of typed", "0.5 # s: the step of typed", 2.0, ""),
        (["--stop", "1.5"], "1.5 # s: given", "0.5 # s: the step of typed", 1.5, ""),
    ],
)  # fmt: skip
def test_a_stop_or_step_that_is_not_kept_is_told_and_its_comment_is_true(
    tmp_path: Path, options: list[str], duration: str, step: str, last: float, words: str
) -> None:
    fmu, out = typed_fmu(tmp_path, **{EXPERIMENT: RUNS}), tmp_path / "out"
    done = CliRunner().invoke(app, ["simulate", "--in-process", str(fmu), *options, "--out", str(out), "--no-report"])
    assert done.exit_code == 0
    assert words in done.output
    assert words or "the run ends" not in done.output
    scenario = (out / "scenario.yaml").read_text()
    assert f"duration: {duration}\n" in scenario
    assert f"{step}\n" in scenario
    assert float((out / "results.csv").read_text().splitlines()[-1].partition(",")[0]) == last


def test_a_step_beyond_the_end_is_refused(tmp_path: Path) -> None:
    fmu, out = typed_fmu(tmp_path, **{EXPERIMENT: RUNS}), tmp_path / "out"
    message = told("simulate", "--in-process", fmu, "--step", "3", "--out", out, code=2)
    assert "is longer than the run, 2 s (the default experiment of typed)" in message
    assert not out.exists()


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


def test_an_input_is_not_both_set_and_played(tmp_path: Path) -> None:
    fmu, log = typed_fmu(tmp_path), tmp_path / "log.csv"
    log.write_text("time,r_in\n0,0\n1,1\n")
    asked = ["--input", log, "--set", "r_in=3", "--out", tmp_path / "out"]
    assert "--set r_in=3: log.csv plays it" in told("simulate", "--in-process", fmu, *asked, code=2)
    assert not (tmp_path / "out").exists()


def test_init_writes_yaml_alone(tmp_path: Path) -> None:
    assert "name a .yaml or .yml file" in told("init", typed_fmu(tmp_path), "--out", tmp_path / "x.csv", code=2)
    assert not (tmp_path / "x.csv").exists()


def test_results_go_to_the_name_of_the_fmu_without_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fmu = typed_fmu(tmp_path)
    monkeypatch.chdir(tmp_path)
    told("simulate", "--in-process", fmu, "--no-report", "--stop", "0.1")
    assert (tmp_path / "results" / "typed" / "0001" / "results.csv").is_file()


def test_wrong_start_values_are_all_told(tmp_path: Path) -> None:
    fmu = typed_fmu(tmp_path)
    with pytest.raises(InputError) as refused:
        simulate(fmu, in_process=True, set={"gain": "x", "e_in": "third"})
    assert len(refused.value.faults) == 2


def test_an_array_that_no_list_of_names_holds_is_no_valid_fmu(tmp_path: Path) -> None:
    fmu = typed_fmu(tmp_path, 3, **{'<Dimension start="2"/><Dimension start="2"/></Float64>\n    <Int64': HUGE})
    assert "its array twice is 9999999999×2" in told("info", fmu, code=3)


HUGE = '<Dimension start="9999999999"/><Dimension start="2"/></Float64>\n    <Int64'
