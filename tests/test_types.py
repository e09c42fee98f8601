"""Every type of FMI connected, recorded and started; versions, model exchange, and what is right from row 0."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest

from cosim.core.errors import InputError
from cosim.files.results import Results
from cosim.master.master import StoppedRun, simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.coupling import coupling_error
from cosim.simulation.run_signals import Run
from cosim.simulation.workflow import run
from cosim.system.system import System, build_system
from cosim.verbs.checks import check as check_files
from tests.lag import lag_fmu
from tests.typed import numbers_fmu, typed_fmu

ONE, TWO = "a: {fmu: typed.fmu}", "a: {fmu: typed.fmu}, b: {fmu: typed.fmu}"
RAMP = "r: {block: reference, signals: {u: {changes: [{at: 0, to: 9, rate: 1}]}}}"


def scenario(folder: Path, parts: str, wires: str = "", more: str = "", times: str = "duration: 1\nstep: 0.1") -> Path:
    """Write a scenario of components, connections as `source>target`, and further keys."""
    links = ["{{from: {}, to: {}}}".format(*wire.split(">")) for wire in wires.split()]
    path = folder / "scenario.yaml"
    path.write_text(f"name: types\n{times}\ncomponents: {{{parts}}}\nconnections: [{', '.join(links)}]\n{more}\n")
    return path


def started(values: str) -> str:
    return f"a: {{fmu: typed.fmu, start: {{{values}}}}}"


def results_of(path: Path, **how: Any) -> Results:
    file = ScenarioFile(path)
    return simulate(build_system(file), file.scenario.steps, file.scenario.step, **how)


def system_of(path: Path) -> System:
    return build_system(ScenarioFile(path))


def ran(path: Path) -> Run:
    return run(path, path.parent / "out", report=False, force=True)


def faults_of(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        system_of(path)
    return "\n".join(fault.message for fault in caught.value.faults)


@pytest.fixture
def typed(tmp_path: Path) -> Path:
    """A folder with an FMU of FMI 2.0."""
    typed_fmu(tmp_path)
    return tmp_path


# -- values of every type ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("version", "start", "wires", "found"),
    [
        (2, "r_in: 0.5, b_in: true, s_in: 'a \"b\", c', e_in: second",
         "a.r_out>b.r_in a.b_out>b.b_in a.s_out>b.s_in a.e_out>b.e_in",
         {"b.r_out": "0.5", "b.b_out": "1", "b.s_out": 'a "b", c', "b.e_out": "2"}),
        (3, "a: [1, 2, 3, 4], n: 9223372036854775805", "a.twice>b.a a.next>b.n a.s_out>b.s a.raw_out>b.raw",
         {"b.twice[2,1]": "12.0", "b.next": "9223372036854775807", "b.s_out": "", "b.raw_out": ""}),  # of no pointer
    ],
)  # fmt: skip
def test_every_type_goes_from_fmu_to_fmu_of_processes_of_their_own(
    tmp_path: Path, version: int, start: str, wires: str, found: dict[str, str]
) -> None:
    typed_fmu(tmp_path, version)
    parts = f"a: {{fmu: typed.fmu, process: own, start: {{{start}}}}}, b: {{fmu: typed.fmu, process: own}}"
    ran(scenario(tmp_path, parts, wires))
    with (tmp_path / "out" / "results.csv").open(newline="") as stream:
        *_, row = csv.DictReader(stream)
    assert {name: row[name] for name in found} == found


@pytest.mark.parametrize(
    ("version", "start", "words"),
    [
        (3, "byte: 256", "it lies in [0, 255]"),
        (3, "byte: 1.5", "it is a whole number"),
        (3, "a: [1, 2]", "it is a list of 4 values"),
        (3, "a: [1, 2, 3, x]", "it is a number alone"),
        (3, "raw: xyz", "hexadecimal"),
        (3, "f: 1e+39", "it lies in [-3.40282e+38, 3.40282e+38]"),
        (3, "'a[3,1]': 1", 'no variable "a[3,1]"'),
        (3, "a: [1, 2, 3], 'a[1,1]': 1", "it is a list of 4 values"),
        (2, "i_in: 2147483648", "it lies in [-2.14748e+09, 2.14748e+09]"),
        (2, "r_in: true", "it is a number"),
        (2, "r_in: 1 m", "it is a number alone: no unit of it is declared"),
        (2, "b_in: 1", "it is true or false"),
        (2, "s_in: 1", "it is text"),
    ],
)
def test_a_value_outside_its_type_is_a_fault(tmp_path: Path, version: int, start: str, words: str) -> None:
    typed_fmu(tmp_path, version)
    assert words in faults_of(scenario(tmp_path, started(start)))


@pytest.mark.parametrize("in_c", [False, True])
@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("1e+39", r"a\.f at t = 0\.5 s: the input 1e\+39 is outside"),
        ("1e+20", r"a\.square at t = 0\.6 s: the value is inf"),
    ],
)
def test_numbers_of_32_bits_become_no_infinity_unseen(tmp_path: Path, in_c: bool, value: str, words: str) -> None:
    """Neither an input that is too large for the type, nor an output whose square is."""
    numbers_fmu(tmp_path)
    reference = f"r: {{block: reference, signals: {{f: {{start: 2, changes: [{{at: 0.5, to: {value}}}]}}}}}}"
    with pytest.raises(StoppedRun, match=words) as stopped:
        results_of(scenario(tmp_path, f"{reference}, {ONE}", "r.f>a.f"), in_c=in_c)
    assert set(stopped.value.results["a.square"].tolist()) == {4}


def test_types_that_lose_values_are_not_connected(typed: Path) -> None:
    for wire in ("a.r_out>b.i_in", "a.i_out>b.b_in", "a.s_out>b.r_in"):
        assert "types do not agree" in faults_of(scenario(typed, TWO, wire))
    assert system_of(scenario(typed, TWO, "a.i_out>b.r_in a.b_out>b.i_in"))
    items: dict[str, Any] = {'"second"': '"third"'}
    typed_fmu(typed, name="other", **items)
    path = scenario(typed, f"{ONE}, b: {{fmu: other.fmu}}", "a.e_out>b.e_in")
    assert "enumerations of one name, Gear, with other items" in faults_of(path)


@pytest.mark.parametrize(("start", "at"), [(2, r"0\.5"), (7, "0")])
def test_a_value_that_is_no_item_stops_the_run_when_it_comes(typed: Path, start: int, at: str) -> None:
    reference = f"r: {{block: reference, signals: {{n: {{start: {start}, changes: [{{at: 0.5, to: 7}}]}}}}}}"
    said = rf"b\.e_in at t = {at} s: 7, which comes from a\.i_out, is none of its items: first 1, second 2"
    with pytest.raises(StoppedRun, match=said) as stopped:
        results_of(scenario(typed, f"{reference}, {TWO}", "r.n>a.i_in a.i_out>b.e_in"))
    assert start == 7 or list(stopped.value.results["b.e_out"]) == [2] * 5


# -- beginning --------------------------------------------------------------------------------------


def test_single_elements_have_start_values_and_parameters_are_recorded_on_request(tmp_path: Path) -> None:
    typed_fmu(tmp_path, 3)
    results = results_of(scenario(tmp_path, started("'a[2,1]': 9, 'a[1,2]': 7")))
    assert [results[f"a.twice[{k}]"][-1] for k in ("1,1", "1,2", "2,1", "2,2")] == [2, 14, 18, 8]
    typed_fmu(tmp_path)
    assert "a.gain" not in results_of(scenario(tmp_path, ONE)).columns
    assert results_of(scenario(tmp_path, started("gain: 3"), more="record: [a.g*]"))["a.gain"][-1] == 3


def test_outputs_are_read_again_after_initialization(typed: Path) -> None:
    results = results_of(scenario(typed, TWO, "a.late>b.r_in"))
    assert results["a.late"][0] == 7  # 0 until initialization has ended
    assert results["b.r_out"][0] == 7  # and with no step between


def test_an_initialization_that_contracts_slowly_settles(typed: Path) -> None:
    """x = gain·(x + 1) has the fixed point gain/(1 − gain), to which each exchange comes by 1 − gain."""

    def settled(gain: float) -> float:
        parts = f"{started(f'gain: {gain}')}, b: {{fmu: typed.fmu}}"
        path = scenario(typed, parts, "a.r_out>b.r_in b.r_out>a.r_in", "algorithm: jacobi")
        path.write_text(path.read_text().replace("to: a.r_in", "to: a.r_in, noise: {bias: 1}"))
        return float(results_of(path)["a.r_out"][0])

    assert settled(0.9) == pytest.approx(9, abs=1e-10)  # 1e-12 a sweep, over 1 − 0.9
    assert settled(0.98) == pytest.approx(49, abs=1e-8)  # some 1400 sweeps
    with pytest.raises(StoppedRun, match="a → b → a may be an algebraic loop"):
        settled(1.1)


@pytest.mark.parametrize(
    ("of_scenario", "of_component", "told"),
    [("", "", 0.003), ("tolerance: 1e-6", "", 1e-6), ("tolerance: 1e-6", ", tolerance: 1e-8", 1e-8)],
)
def test_the_tolerance_is_the_components_else_the_scenarios_else_that_of_the_fmu(
    typed: Path, of_scenario: str, of_component: str, told: float
) -> None:
    path = scenario(typed, f"a: {{fmu: typed.fmu{of_component}}}", more=of_scenario)
    assert results_of(path)["a.told"][0] == told


@pytest.mark.parametrize(
    ("old", "new", "interface", "words"),
    [
        ("<CoSimulation", "<ScheduledExecution", "co-simulation", "offers scheduled-execution only"),
        ('fmiVersion="3.0"', 'fmiVersion="3.0-beta.3"', "co-simulation", "is FMI 3.0-beta.3 for co-simulation"),
        ("typed", "typed", "model-exchange", "offers co-simulation only"),
    ],
)
def test_what_cannot_be_run_is_said_before_the_run(
    tmp_path: Path, old: str, new: Any, interface: str, words: str
) -> None:
    typed_fmu(tmp_path, 3, **{old: new, ' canHandleVariableCommunicationStepSize="true"': ""})
    assert words in faults_of(scenario(tmp_path, f"a: {{fmu: typed.fmu, interface: {interface}}}"))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('tolerance="0.003"', 'tolerance="log.csv"', "tolerance of its default experiment"),
        ('value="2"', 'value="rad"', "item second of Gear"),
        ('factor="0.10471975511965977"', 'factor="x"', "is of the wrong kind"),
    ],
)
def test_text_in_place_of_a_number_in_a_description_is_told(tmp_path: Path, old: str, new: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        check_files([typed_fmu(tmp_path, **{old: new})])


# -- while it goes on -------------------------------------------------------------------------------


def test_a_warning_is_logged_once_and_debugging_only_where_asked_for(typed: Path) -> None:
    warnings = ran(scenario(typed, started("warn_at: 0.3"))).manifest["warnings"]
    assert [w for w in warnings if w.startswith("a: ")] == ["a: it runs hot", "a: fmi2DoStep returned Warning"]
    outcome = ran(scenario(typed, "a: {fmu: typed.fmu, logging: true}"))
    assert "a: debugging" in outcome.manifest["warnings"]


def test_an_fmu_that_ends_the_simulation_leaves_a_row_for_that_time(typed: Path) -> None:
    outcome = ran(scenario(typed, started("end_at: 0.55"), more="criteria: {peak: {of: a.r_out, after: 0.7, max: 1}}"))
    assert outcome.time[-2:] == pytest.approx([0.5, 0.55])
    assert outcome.manifest["status"] == "ok"
    assert any("a ended the simulation at t = 0.55 s" in w for w in outcome.manifest["warnings"])
    assert [c["value"] for c in outcome.missed] == [None]  # its times were not reached


def test_a_component_with_a_longer_step_makes_it_at_its_end(typed: Path) -> None:
    def path(step: float) -> Path:
        parts = f"{RAMP}, slow: {{fmu: typed.fmu, step: {step}}}, fast: {{fmu: typed.fmu}}"
        return scenario(typed, parts, "r.u>slow.r_in slow.r_out>fast.r_in")

    results = results_of(path(0.5))
    for name in ("slow.r_out", "fast.r_out"):
        assert results[name] == pytest.approx([0, 0, 0, 0, 0, 0.5, 0.5, 0.5, 0.5, 0.5, 1])
    assert "use a whole multiple" in faults_of(path(0.25))
    assert "it would never step" in faults_of(path(2.0))
    assert any("its last 0.1 s of the run make no whole step" in w for w in system_of(path(0.3)).warnings)


def test_events_change_parameters_and_free_inputs(typed: Path) -> None:
    def path(events: str) -> Path:
        return scenario(typed, started("r_in: 1"), more=f"events: [{events}]")

    results = results_of(path("{at: 0.5, set: {a.gain: 4}}, {at: 0.72, set: {a.r_in: 2, a.e_in: second}}"))
    assert results["a.r_out"].tolist() == [1, 1, 1, 1, 1, 4, 4, 4, 8, 8, 8]
    assert results["a.r_in"].tolist() == [1] * 8 + [2] * 3  # the row of 0.8 s holds what acts from then on
    assert results["a.e_in"][-1] == 2
    for wrong, words in (("a.warn_at: 1", "tunable"), ("a.h: 1", "tunable"), ("b.x: 1", "no FMU")):
        assert words in faults_of(path(f"{{at: 0.5, set: {{{wrong}}}}}"))
    at_one_point = "{at: 0.5, set: {a.r_in: 1}}, {at: 0.45, set: {a.r_in: 3}}"  # the later has the last word
    assert results_of(path(at_one_point))["a.r_in"][5:].tolist() == [1] * 6
    told = faults_of(path(f"{at_one_point}, {{at: 0.5, set: {{a.r_in: 2}}}}"))
    assert "two values at 0.5 s: 1.0 and 2.0" in told


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        ("kind: stuck, value: 9", [0, 1, 9, 9, 9, 5]),
        ("kind: scale, value: -1", [0, 1, -2, -3, -4, 5]),
        ("kind: dropout, probability: 1", [0, 1, 1, 1, 1, 5]),
        ("kind: spike, value: 100", [0, 1, 102, 3, 4, 5]),
        ("kind: delay, delay: 2", [0, 1, 0, 1, 2, 5]),
    ],
)
def test_a_fault_acts_on_its_connection_between_its_times(typed: Path, fault: str, expected: list[float]) -> None:
    more = f"faults: [{{on: a.r_in, from: 2, to: 4, {fault}}}]"
    path = scenario(typed, f"{RAMP}, {ONE}", "r.u>a.r_in", more, "duration: 5\nstep: 1")
    assert results_of(path)["a.r_out"].tolist() == expected


def test_a_fault_is_on_a_connection_and_has_what_its_kind_needs(typed: Path) -> None:
    def path(faults: str, wires: str = "a.s_out>b.s_in") -> Path:
        more = f"events: [{{at: 0.3, set: {{a.s_in: two}}}}]\nfaults: [{faults}]"
        return scenario(typed, f"{started('s_in: one')}, b: {{fmu: typed.fmu}}", wires, more)

    for fault, last in (("kind: freeze, from: 0.2", "one"), ("kind: delay, delay: 0.2", "two")):
        texts = results_of(path(f"{{on: b.s_in, {fault}}}")).exact["b.s_out"]
        assert (texts[4], texts[-1]) == ("one", last)
    assert "no bias fault on String" in faults_of(path("{on: b.s_in, kind: bias, value: 1}"))
    told = faults_of(path("{on: a.r_in, kind: bias}, {on: a.r_in, kind: freeze, from: 7}", ""))
    for words in ("no connection to a.r_in", "bias needs value", "acts at no communication point"):
        assert words in told


# -- errors of coupling -----------------------------------------------------------------------------


def test_the_coupling_error_of_a_held_input_falls_with_the_step(typed: Path) -> None:
    # two balls, the second lifted by the height of the first: ∫∫ of an input held over h is off by about h/2 of it
    ball = "{fmu: typed.fmu, interface: model-exchange, tolerance: 1e-9}"
    errors = []
    for step in (0.02, 0.01):
        times = f"duration: 0.4\nstep: {step}"
        path = scenario(typed, f"a: {ball}, b: {ball}", "a.h>b.r_in b.h>a.r_in", "algorithm: jacobi", times)
        errors.append(coupling_error(path).of["a.h"])
    assert 1e-5 < errors[1] < errors[0]
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.1)  # of first order


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss-seidel"])
def test_a_step_that_is_taken_back_and_made_in_halves_tells_its_own_error(tmp_path: Path, algorithm: str) -> None:
    """Two lags in a loop, each a step of Euler's: what halves change is known."""
    lag_fmu(tmp_path / "lag.fmu")
    parts = "a: {fmu: lag.fmu, start: {bias: 1}}, b: {fmu: lag.fmu, start: {T: 0.5}}"
    path = scenario(tmp_path, parts, "a.y>b.u b.y>a.u", f"algorithm: {algorithm}", "duration: 2\nstep: 0.1")

    def step(state: tuple[float, float], length: float) -> tuple[float, float]:
        a, b = state
        return a + length * (b + 1.0 - a), b + length / 0.5 * (a - b)  # no output depends on an input at once

    state, most = (0.0, 0.0), (0.0, 0.0)
    for k in range(20):
        whole, halves = step(state, 0.1), step(step(state, 0.05), 0.05)
        most = max(most, (abs(whole[0] - halves[0]), 0.1 * (k + 1)))
        state = whole
    error = coupling_error(path)
    assert error.without == ""
    assert error.steps["a.y"] == pytest.approx(most, rel=1e-9)
    assert ran(path)["a.y"][-1] == pytest.approx(state[0], rel=1e-12)
