"""Every type of FMI connected, recorded and started; versions, model exchange, and what is right from row 0."""

from __future__ import annotations

import csv
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from cosim.core.errors import InputError
from cosim.files.results import Results
from cosim.master.master import StoppedRun, simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.coupling import coupling_error
from cosim.simulation.workflow import run
from cosim.system.system import System, build_system
from cosim.verbs.checks import check as check_files
from tests.lag import lag_fmu
from tests.typed import numbers_fmu, typed_fmu


def scenario(folder: Path, components: dict[str, Any], connections: Sequence[Any] = (), **more: Any) -> Path:
    path = folder / "scenario.yaml"
    wires = [c if isinstance(c, dict) else {"from": c[0], "to": c[1]} for c in connections]
    keys = {"name": "types", "duration": 1, "step": 0.1, "components": components, "connections": wires}
    path.write_text(json.dumps(keys | more))
    return path


def system_of(path: Path) -> System:
    return build_system(ScenarioFile(path))


def results_of(path: Path) -> Results:
    file = ScenarioFile(path)
    return simulate(build_system(file), file.scenario.steps, file.scenario.step)


def faults_of(path: Path) -> list[str]:
    with pytest.raises(InputError) as caught:
        system_of(path)
    return [fault.message for fault in caught.value.faults]


def test_integers_booleans_text_and_enumerations_go_from_fmu_to_fmu(tmp_path: Path) -> None:
    fmu = str(typed_fmu(tmp_path))
    start = {"r_in": 0.5, "i_in": -2147483648, "b_in": True, "s_in": 'a "b", c', "e_in": "second"}
    wires = tuple((f"a.{k}_out", f"b.{k}_in") for k in "ribse")
    path = scenario(tmp_path, {"a": {"fmu": fmu, "start": start}, "b": {"fmu": fmu}}, wires)
    run(path, tmp_path / "out", report=False, force=True)
    with (tmp_path / "out" / "results.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 11
    for row in (rows[0], rows[-1]):
        assert [row[f"b.{k}_out"] for k in "ribse"] == ["0.5", "-2147483648", "1", 'a "b", c', "2"]


def test_binary_data_that_comes_as_no_pointer_has_no_bytes(tmp_path: Path) -> None:
    fmu = str(typed_fmu(tmp_path, 3))
    path = scenario(tmp_path, {"a": {"fmu": fmu}, "b": {"fmu": fmu}}, (("a.raw_out", "b.raw"),))
    run(path, tmp_path / "out", report=False, force=True)
    with (tmp_path / "out" / "results.csv").open(newline="") as stream:
        assert [row["b.raw_out"] for row in csv.DictReader(stream)] == [""] * 11


@pytest.mark.parametrize(
    ("start", "words"),
    [
        ({"byte": 256}, "it lies in [0, 255]"),
        ({"n": 2**63}, "it lies in"),
        ({"byte": 1.5}, "it is a whole number"),
        ({"a": [1, 2]}, "it is a list of 4 values"),
        ({"raw": "xyz"}, "hexadecimal"),
        ({"f": 1e39}, "it lies in [-3.40282e+38, 3.40282e+38]"),
        ({"a[3,1]": 1}, 'no variable "a[3,1]"'),
        ({"a": [1, 2, 3], "a[1,1]": 1}, "it is a list of 4 values"),
    ],
)
def test_a_value_outside_its_type_is_a_fault(tmp_path: Path, start: dict[str, Any], words: str) -> None:
    path = scenario(tmp_path, {"a": {"fmu": str(typed_fmu(tmp_path, 3)), "start": start}})
    assert any(words in fault for fault in faults_of(path))


@pytest.mark.parametrize("in_c", [False, True])
def test_numbers_of_32_bits_become_no_infinity_unseen(tmp_path: Path, in_c: bool) -> None:
    """Neither an input that is too large for the type, nor an output whose square is."""
    fmu = str(numbers_fmu(tmp_path))
    for value, words in (
        (1e39, r"a\.f at t = 0\.5 s: the input 1e\+39 is outside"),
        (1e20, r"a\.square at t = 0\.6 s: the value is inf"),
    ):
        signals = {"f": {"start": 2, "changes": [{"at": 0.5, "to": value}]}}
        components = {"r": {"block": "reference", "signals": signals}, "a": {"fmu": fmu}}
        file = ScenarioFile(scenario(tmp_path, components, (("r.f", "a.f"),)))
        with pytest.raises(StoppedRun, match=words) as stopped:
            simulate(build_system(file), file.scenario.steps, file.scenario.step, in_c=in_c)
        assert set(stopped.value.results["a.square"].tolist()) == {4}


def test_single_elements_of_an_array_have_start_values(tmp_path: Path) -> None:
    a = {"fmu": str(typed_fmu(tmp_path, 3)), "start": {"a[2,1]": 9, "a[1,2]": 7}}
    results = results_of(scenario(tmp_path, {"a": a}))
    assert [results[f"a.twice[{k}]"][-1] for k in ("1,1", "1,2", "2,1", "2,2")] == [2, 14, 18, 8]


def test_types_that_lose_values_are_not_connected(tmp_path: Path) -> None:
    fmu = {"fmu": str(typed_fmu(tmp_path))}
    for source, target in (("r_out", "i_in"), ("i_out", "b_in"), ("s_out", "r_in")):
        path = scenario(tmp_path, {"a": fmu, "b": fmu}, ((f"a.{source}", f"b.{target}"),))
        assert any(fault.startswith("types do not agree") for fault in faults_of(path))
    assert system_of(scenario(tmp_path, {"a": fmu, "b": fmu}, (("a.i_out", "b.r_in"), ("a.b_out", "b.i_in"))))


def test_locals_and_parameters_are_recorded_on_request(tmp_path: Path) -> None:
    components = {"a": {"fmu": str(typed_fmu(tmp_path)), "start": {"gain": 3}}}
    assert "a.gain" not in results_of(scenario(tmp_path, components)).columns
    assert results_of(scenario(tmp_path, components, record=["a.g*"]))["a.gain"][-1] == 3
    assert results_of(scenario(tmp_path, components, record=["a.der*"]))["a.der(v)"][-1] == -9.81
    assert '"a.gian"' in faults_of(scenario(tmp_path, components, record=["a.gian"]))[0]


def test_outputs_are_read_again_after_initialization(tmp_path: Path) -> None:
    fmu = str(typed_fmu(tmp_path))
    results = results_of(scenario(tmp_path, {"a": {"fmu": fmu}, "b": {"fmu": fmu}}, (("a.late", "b.r_in"),)))
    assert results["a.late"][0] == 7  # 0 until initialization has ended
    assert results["b.r_out"][0] == 7  # and with no step between


def test_an_initialization_that_contracts_slowly_settles(tmp_path: Path) -> None:
    fmu = str(typed_fmu(tmp_path))
    # x = 0.9·(x + 1) has the fixed point 9, to which each exchange comes by a tenth
    components = {"a": {"fmu": fmu, "start": {"gain": 0.9}}, "b": {"fmu": fmu}}
    wires = ({"from": "a.r_out", "to": "b.r_in"}, {"from": "b.r_out", "to": "a.r_in", "noise": {"bias": 1}})
    path = scenario(tmp_path, components, wires, algorithm="jacobi")
    assert results_of(path)["a.r_out"][0] == pytest.approx(9, abs=1e-10)  # 1e-12 a sweep, over 1 − 0.9
    slow = scenario(tmp_path, components | {"a": {"fmu": fmu, "start": {"gain": 0.98}}}, wires, algorithm="jacobi")
    assert results_of(slow)["a.r_out"][0] == pytest.approx(49, abs=1e-8)  # some 1400 sweeps
    path = scenario(tmp_path, components | {"a": {"fmu": fmu, "start": {"gain": 1.1}}}, wires, algorithm="jacobi")
    with pytest.raises(
        StoppedRun,
        match=r"an algebraic loop that exchanging values does not settle.* a → b → a may be an algebraic loop",
    ):
        results_of(path)


def test_the_tolerance_is_the_components_else_the_scenarios_else_that_of_the_fmu(tmp_path: Path) -> None:
    a: dict[str, Any] = {"fmu": str(typed_fmu(tmp_path))}
    assert results_of(scenario(tmp_path, {"a": a}))["a.told"][0] == 0.003
    assert results_of(scenario(tmp_path, {"a": a}, tolerance=1e-6))["a.told"][0] == 1e-6
    assert results_of(scenario(tmp_path, {"a": a | {"tolerance": 1e-8}}, tolerance=1e-6))["a.told"][0] == 1e-8


def test_a_warning_is_logged_once_and_debugging_only_where_asked_for(tmp_path: Path) -> None:
    a: dict[str, Any] = {"fmu": str(typed_fmu(tmp_path)), "start": {"warn_at": 0.3}}
    outcome = run(scenario(tmp_path, {"a": a}), tmp_path / "out", report=False, force=True)
    told = [w for w in outcome.manifest["warnings"] if w.startswith("a: ")]
    assert told == ["a: it runs hot", "a: fmi2DoStep returned Warning"]
    assert len(outcome.results.time) == 11
    outcome = run(scenario(tmp_path, {"a": a | {"logging": True}}), tmp_path / "out", report=False, force=True)
    assert "a: debugging" in outcome.manifest["warnings"]


def test_an_fmu_that_ends_the_simulation_leaves_a_row_for_that_time(tmp_path: Path) -> None:
    a = {"fmu": str(typed_fmu(tmp_path)), "start": {"end_at": 0.55}}
    outcome = run(scenario(tmp_path, {"a": a}), tmp_path / "out", report=False, force=True)
    assert outcome.results.time[-2:] == pytest.approx([0.5, 0.55])
    assert outcome.manifest["status"] == "ok"
    assert any("a ended the simulation at t = 0.55 s" in w for w in outcome.manifest["warnings"])


def test_a_criterion_on_a_time_that_was_not_reached_is_missed(tmp_path: Path) -> None:
    a = {"fmu": str(typed_fmu(tmp_path)), "start": {"end_at": 0.5}}
    criteria = {"peak": {"of": "a.r_out", "after": 0.7, "max": 1}}
    outcome = run(scenario(tmp_path, {"a": a}, criteria=criteria), tmp_path / "out", report=False, force=True)
    assert [c["value"] for c in outcome.missed] == [None]


def test_a_component_with_a_longer_step_makes_it_at_its_end(tmp_path: Path) -> None:
    fmu = str(typed_fmu(tmp_path))
    ramp = {"block": "reference", "signals": {"u": {"start": 0, "changes": [{"at": 0, "to": 1, "rate": 1}]}}}
    components = {"r": ramp, "slow": {"fmu": fmu, "step": 0.5}, "fast": {"fmu": fmu}}
    wires = (("r.u", "slow.r_in"), ("slow.r_out", "fast.r_in"))
    results = results_of(scenario(tmp_path, components, wires))
    sampled = [0, 0, 0, 0, 0, 0.5, 0.5, 0.5, 0.5, 0.5, 1]
    assert results["slow.r_out"] == pytest.approx(sampled)
    assert results["fast.r_out"] == pytest.approx(sampled)
    components["slow"]["step"] = 0.25
    assert "use a whole multiple" in faults_of(scenario(tmp_path, components, wires))[0]
    components["slow"]["step"] = 2.0
    assert any("it would never step" in told for told in faults_of(scenario(tmp_path, components, wires)))
    components["slow"]["step"] = 0.3
    warnings = system_of(scenario(tmp_path, components, wires)).warnings
    assert any("its last 0.1 s of the run make no whole step" in w for w in warnings)


def test_events_change_parameters_and_free_inputs(tmp_path: Path) -> None:
    components = {"a": {"fmu": str(typed_fmu(tmp_path)), "start": {"r_in": 1}}}
    events = [{"at": 0.5, "set": {"a.gain": 4}}, {"at": 0.72, "set": {"a.r_in": 2, "a.e_in": "second"}}]
    results = results_of(scenario(tmp_path, components, events=events))
    assert results["a.r_out"].tolist() == [1, 1, 1, 1, 1, 4, 4, 4, 8, 8, 8]
    assert results["a.r_in"].tolist() == [1] * 8 + [2] * 3  # the row of 0.8 s holds what acts from then on
    assert results["a.e_in"][-1] == 2
    for wrong, words in (({"a.warn_at": 1}, "tunable"), ({"a.h": 1}, "tunable"), ({"b.x": 1}, "no FMU")):
        path = scenario(tmp_path, components, events=[{"at": 0.5, "set": wrong}])
        assert any(words in fault for fault in faults_of(path))


def test_of_events_at_one_point_the_later_has_the_last_word(tmp_path: Path) -> None:
    components = {"a": {"fmu": str(typed_fmu(tmp_path)), "start": {"r_in": 0}}}
    events: list[dict[str, Any]] = [{"at": 0.5, "set": {"a.r_in": 1}}, {"at": 0.45, "set": {"a.r_in": 3}}]
    results = results_of(scenario(tmp_path, components, events=events))
    assert results["a.r_in"][5:].tolist() == [1] * 6
    both = [*events, {"at": 0.5, "set": {"a.r_in": 2}}]
    assert "two values at 0.5 s: 1.0 and 2.0; keep one" in faults_of(scenario(tmp_path, components, events=both))
    assert not any("not connected" in w and "a.r_in" in w for w in system_of(scenario(tmp_path, components)).warnings)


def test_faults_that_let_values_pass_act_on_text_too(tmp_path: Path) -> None:
    fmu = {"fmu": str(typed_fmu(tmp_path))}
    components, wires = {"a": {**fmu, "start": {"s_in": "one"}}, "b": fmu}, (("a.s_out", "b.s_in"),)
    events = [{"at": 0.3, "set": {"a.s_in": "two"}}]
    for kind, more, last in (("freeze", {"from": 0.2}, "one"), ("delay", {"delay": 0.2}, "two")):
        fault = {"on": "b.s_in", "kind": kind, **more}
        results = results_of(scenario(tmp_path, components, wires, events=events, faults=[fault]))
        assert (results.exact["b.s_out"][4], results.exact["b.s_out"][-1]) == ("one", last)
    path = scenario(tmp_path, components, wires, faults=[{"on": "b.s_in", "kind": "bias", "value": 1}])
    assert "a.s_out to b.s_in: no bias fault on String" in faults_of(path)


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        ({"kind": "bias", "value": 10}, [0, 1, 12, 13, 14, 5]),
        ({"kind": "scale", "value": -1}, [0, 1, -2, -3, -4, 5]),
        ({"kind": "stuck", "value": 9}, [0, 1, 9, 9, 9, 5]),
        ({"kind": "freeze"}, [0, 1, 1, 1, 1, 5]),
        ({"kind": "dropout", "probability": 1.0}, [0, 1, 1, 1, 1, 5]),
        ({"kind": "spike", "value": 100}, [0, 1, 102, 3, 4, 5]),
        ({"kind": "delay", "delay": 2}, [0, 1, 0, 1, 2, 5]),
    ],
)
def test_a_fault_acts_on_its_connection_between_its_times(
    tmp_path: Path, fault: dict[str, Any], expected: list[float]
) -> None:
    ramp = {"block": "reference", "signals": {"u": {"start": 0, "changes": [{"at": 0, "to": 9, "rate": 1}]}}}
    components = {"r": ramp, "a": {"fmu": str(typed_fmu(tmp_path))}}
    faults = [{"on": "a.r_in", "from": 2, "to": 4} | fault]
    results = results_of(scenario(tmp_path, components, (("r.u", "a.r_in"),), duration=5, step=1, faults=faults))
    assert results["a.r_out"].tolist() == expected
    assert results["r.u"].tolist() == [0, 1, 2, 3, 4, 5]


def test_a_fault_is_on_a_connection_and_has_what_its_kind_needs(tmp_path: Path) -> None:
    components = {"a": {"fmu": str(typed_fmu(tmp_path))}}
    faults = [{"on": "a.r_in", "kind": "bias"}, {"on": "a.r_in", "kind": "freeze", "from": 7}]
    told = " ".join(faults_of(scenario(tmp_path, components, faults=faults)))
    assert "no connection to a.r_in" in told
    assert "bias needs value" in told
    assert "acts at no communication point" in told


def test_what_cannot_be_run_is_said_before_the_run(tmp_path: Path) -> None:
    only = typed_fmu(
        tmp_path, 3, **{"<CoSimulation": "<ScheduledExecution", ' canHandleVariableCommunicationStepSize="true"': ""}
    )
    path = scenario(tmp_path, {"a": {"fmu": str(only), "interface": "co-simulation"}})
    assert "offers scheduled-execution only" in faults_of(path)[0]
    later = typed_fmu(tmp_path, 3, **{'fmiVersion="3.0"': 'fmiVersion="3.0-beta.3"'})
    assert "is FMI 3.0-beta.3 for co-simulation" in faults_of(scenario(tmp_path, {"a": {"fmu": str(later)}}))[0]
    fmu = typed_fmu(tmp_path, 3)
    path = scenario(tmp_path, {"a": {"fmu": str(fmu), "interface": "model-exchange"}})
    assert "offers co-simulation only" in faults_of(path)[0]


def test_only_outputs_that_go_on_make_a_loop(tmp_path: Path) -> None:
    # r_out follows r_in, h does not: a loop over h is none, so it needs no order and no warning
    fmu = {"fmu": str(typed_fmu(tmp_path))}
    wires = (("a.h", "b.r_in"), ("b.r_out", "a.r_in"))
    system = system_of(scenario(tmp_path, {"b": fmu, "a": fmu}, wires))
    assert [stage.component.name for stage in system.stages] == ["a", "b"]
    assert not any("declare" in warning for warning in system.warnings)
    (loop,) = system_of(scenario(tmp_path, {"b": fmu, "a": fmu}, (("a.r_out", "b.r_in"), wires[1]))).loops
    assert set(loop.members) == {"a", "b"}


def test_the_coupling_error_of_a_held_input_falls_with_the_step(tmp_path: Path) -> None:
    # two balls, the second lifted by the height of the first: ∫∫ of an input held over h is off by about h/2 of it
    ball = {"fmu": str(typed_fmu(tmp_path)), "interface": "model-exchange", "tolerance": 1e-9}
    wires = (("a.h", "b.r_in"), ("b.h", "a.r_in"))
    errors = []
    for step in (0.02, 0.01):
        path = scenario(tmp_path, {"a": ball, "b": ball}, wires, duration=0.4, step=step, algorithm="jacobi")
        errors.append(coupling_error(path).of["a.h"])
    assert 1e-5 < errors[1] < errors[0]
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.1)  # of first order


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss-seidel"])
def test_a_step_that_is_taken_back_and_made_in_halves_tells_its_own_error(tmp_path: Path, algorithm: str) -> None:
    """Two lags in a loop, each a step of Euler's: what halves change is known."""
    lag = {"fmu": str(lag_fmu(tmp_path / "lag.fmu"))}
    parts, wires = (
        {"a": {**lag, "start": {"bias": 1.0}}, "b": {**lag, "start": {"T": 0.5}}},
        (("a.y", "b.u"), ("b.y", "a.u")),
    )
    h, steps = 0.1, 20
    path = scenario(tmp_path, parts, wires, duration=h * steps, step=h, algorithm=algorithm)

    def step(state: tuple[float, float], length: float) -> tuple[float, float]:
        a, b = state
        ahead = a + length * (b + 1.0 - a)
        return ahead, b + length / 0.5 * (a - b)  # no output depends on an input at once

    state, most = (0.0, 0.0), (0.0, 0.0)
    for k in range(steps):
        whole, halves = step(state, h), step(step(state, h / 2), h / 2)
        most = max(most, (abs(whole[0] - halves[0]), h * (k + 1)))
        state = whole
    error = coupling_error(path)
    assert error.without == ""
    assert error.steps["a.y"] == pytest.approx(most, rel=1e-9)
    assert "of a single step, taken back and made again in halves: a.y" in error.sentence
    assert run(path, tmp_path / "out", report=False, force=True).results["a.y"][-1] == pytest.approx(
        state[0], rel=1e-12
    )


def test_a_value_that_is_no_item_stops_the_run_when_it_comes_and_is_told_with_both_names(tmp_path: Path) -> None:
    fmu = {"fmu": str(typed_fmu(tmp_path))}
    signals = {"n": {"start": 2, "changes": [{"at": 0.5, "to": 7}]}}
    components = {"r": {"block": "reference", "signals": signals}, "a": fmu, "b": fmu}
    path = scenario(tmp_path, components, (("r.n", "a.i_in"), ("a.i_out", "b.e_in")))
    said = r"b\.e_in at t = 0\.5 s: 7, which comes from a\.i_out, is none of its items: first 1, second 2"
    with pytest.raises(StoppedRun, match=said) as stopped:
        results_of(path)
    assert list(stopped.value.results["b.e_out"]) == [2] * 5
    components["r"] = {"block": "reference", "signals": {"n": {"start": 7}}}
    with pytest.raises(StoppedRun, match=r"b\.e_in at t = 0 s: 7, which comes from a\.i_out"):
        results_of(scenario(tmp_path, components, (("r.n", "a.i_in"), ("a.i_out", "b.e_in"))))


def test_enumerations_of_one_name_with_other_items_are_not_connected(tmp_path: Path) -> None:
    one, other = typed_fmu(tmp_path), tmp_path / "other.fmu"
    with zipfile.ZipFile(one) as archive, zipfile.ZipFile(other, "w") as changed:
        for name in archive.namelist():
            changed.writestr(name, archive.read(name).replace(b'"second"', b'"third"'))
    path = scenario(tmp_path, {"a": {"fmu": str(one)}, "b": {"fmu": str(other)}}, (("a.e_out", "b.e_in"),))
    told = (
        "enumerations of one name, Gear, with other items: a.e_out has first 1, second 2, b.e_in has first 1, third 2"
    )
    assert told in faults_of(path)


@pytest.mark.thorough
@pytest.mark.parametrize("version", [2, 3])
def test_every_type_goes_through_an_fmu_in_a_process_of_its_own(tmp_path: Path, version: int) -> None:
    fmu, largest = str(typed_fmu(tmp_path, version)), 2**63 - 3
    if version == 2:
        start: dict[str, Any] = {"r_in": 0.5, "i_in": -5, "b_in": True, "s_in": 'a "b", c', "e_in": "second"}
        wires = [(f"a.{k}_out", f"b.{k}_in") for k in "ribse"]
        events = [{"at": 0.5, "set": {"a.s_in": "later", "a.e_in": "first", "a.r_in": 2}}]
    else:
        start = {"a": [1, 2, 3, 4], "n": largest, "byte": 255, "s": "text", "raw": "00ff"}
        pairs = ("twice", "a"), ("next", "n"), ("byte_out", "byte"), ("s_out", "s"), ("raw_out", "raw")
        wires = [(f"a.{output}", f"b.{taken}") for output, taken in pairs]
        events = []
    csv_of = []
    for process in ({}, {"process": "own"}):
        components = {"a": {"fmu": fmu, "start": start, **process}, "b": {"fmu": fmu, **process}}
        out = tmp_path / f"out{len(csv_of)}"
        run(scenario(tmp_path, components, wires, events=events, record=["a.*"]), out, report=False, force=True)
        csv_of.append((out / "results.csv").read_text())
    assert csv_of[0] == csv_of[1]
    assert ("later" if version == 2 else str(largest + 2)) in csv_of[0]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            'tolerance="0.003"',
            'tolerance="log.csv"',
            'tolerance of its default experiment is "log.csv", which is no number',
        ),
        ('value="2"', 'value="rad"', 'item second of Gear is "rad", which is no whole number'),
        ('factor="0.10471975511965977"', 'factor="x"', "a value in its modelDescription.xml is of the wrong kind"),
    ],
)
def test_text_in_place_of_a_number_in_a_description_is_told(tmp_path: Path, old: str, new: str, words: str) -> None:
    fmu = typed_fmu(tmp_path, **{old: new})
    with pytest.raises(InputError) as caught:
        check_files([fmu])
    assert [words in fault.message for fault in caught.value.faults] == [True]
    assert words in faults_of(scenario(tmp_path, {"a": {"fmu": str(fmu)}}))[0]
