"""Every type of FMI connected, recorded and started; versions, model exchange, and what is right from row 0."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cosim.core.errors import InputError
from cosim.files.results import Results
from cosim.master.master import StoppedRun, simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.run_signals import Run
from cosim.simulation.trial import coupling_error
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


def results_of(path: Path) -> Results:
    file = ScenarioFile(path)
    return simulate(build_system(file), file.scenario.steps, file.scenario.step)


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
    ("version", "start", "words"),
    [
        (3, "byte: 256", "[0, 255]"),
        (3, "byte: 1.5", "a whole number"),
        (3, "a: [1, 2]", "a list of 4 values"),
        (3, "a: [1, 2, 3, x]", "a number without a unit"),
        (3, "raw: xyz", "hexadecimal"),
        (3, "f: 1e+39", "[-3.40282e+38, 3.40282e+38]"),
        (3, "'a[3,1]': 1", 'no variable "a[3,1]"'),
        (3, "a: [1, 2, 3], 'a[1,1]': 1", "a list of 4 values"),
        (2, "i_in: 2147483648", "[-2.14748e+09, 2.14748e+09]"),
        (2, "r_in: true", "a number"),
        (2, "r_in: 1 m", "r_in"),
        (2, "b_in: 1", "true or false"),
        (2, "s_in: 1", "use text"),
    ],
)
def test_a_value_outside_its_type_is_a_fault(tmp_path: Path, version: int, start: str, words: str) -> None:
    typed_fmu(tmp_path, version)
    assert words in faults_of(scenario(tmp_path, started(start)))


def test_types_that_lose_values_are_not_connected(typed: Path) -> None:
    for wire in ("a.r_out>b.i_in", "a.i_out>b.b_in", "a.s_out>b.r_in"):
        assert "types do not agree" in faults_of(scenario(typed, TWO, wire))
    assert system_of(scenario(typed, TWO, "a.i_out>b.r_in a.b_out>b.i_in"))
    items: dict[str, Any] = {'"second"': '"third"'}
    typed_fmu(typed, name="other", **items)
    path = scenario(typed, f"{ONE}, b: {{fmu: other.fmu}}", "a.e_out>b.e_in")
    assert "enumerations Gear with different items" in faults_of(path)


# -- beginning --------------------------------------------------------------------------------------


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
        ('fmiVersion="3.0"', 'fmiVersion="3.0-beta.3"', "co-simulation", "is FMI 3.0-beta.3"),
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
        ('tolerance="0.003"', 'tolerance="log.csv"', "DefaultExperiment.*tolerance.*log.csv"),
        ('value="2"', 'value="rad"', "Item.*value.*rad"),
        ('factor="0.10471975511965977"', 'factor="x"', "has the wrong type"),
    ],
)
def test_text_in_place_of_a_number_in_a_description_is_told(tmp_path: Path, old: str, new: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        check_files([typed_fmu(tmp_path, **{old: new})])


# -- while it goes on -------------------------------------------------------------------------------


@pytest.mark.parametrize(("value", "place"), [("1e+39", "a.f at t = 0.5 s"), ("1e+20", "a.square at t = 0.6 s")])
def test_numbers_of_32_bits_become_no_infinity_unseen(tmp_path: Path, value: str, place: str) -> None:
    """Neither an input that is too large for the type, nor an output whose square is."""
    numbers_fmu(tmp_path)
    reference = f"r: {{block: reference, signals: {{f: {{start: 2, changes: [{{at: 0.5, to: {value}}}]}}}}}}"
    with pytest.raises(StoppedRun, match=place) as stopped:
        results_of(scenario(tmp_path, f"{reference}, {ONE}", "r.f>a.f"))
    assert set(stopped.value.results["a.square"].tolist()) == {4}


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (0.25, "use a whole multiple"),
        (2.0, "longer than the run of 1 s"),
        (0.3, "the last 0.1 s of the run"),
    ],
)
def test_a_longer_step_of_a_component_fits_into_the_run(typed: Path, step: float, words: str) -> None:
    path = scenario(typed, f"a: {{fmu: typed.fmu, step: {step}}}")
    assert words in (" ".join(system_of(path).warnings) if step == 0.3 else faults_of(path))


EARLIER = "{at: 0.5, set: {a.r_in: 1}}, {at: 0.45, set: {a.r_in: 3}}"  # at one communication point


@pytest.mark.parametrize(
    ("events", "words"),
    [
        ("{at: 0.5, set: {a.warn_at: 1}}", "tunable"),
        ("{at: 0.5, set: {a.h: 1}}", "tunable"),
        ("{at: 0.5, set: {b.x: 1}}", "tunable"),
        (f"{EARLIER}, {{at: 0.5, set: {{a.r_in: 2}}}}", "two values at 0.5 s: 1.0 and 2.0"),
        (EARLIER, ""),
    ],
)
def test_events_change_what_can_change_and_the_later_has_the_last_word(typed: Path, events: str, words: str) -> None:
    path = scenario(typed, started("r_in: 1"), more=f"events: [{events}]")
    if words:
        assert words in faults_of(path)
    else:
        assert results_of(path)["a.r_in"][5:].tolist() == [1] * 6


def test_a_warning_is_logged_once_and_debugging_only_where_asked_for(typed: Path) -> None:
    warnings = ran(scenario(typed, started("warn_at: 0.3"))).manifest["warnings"]
    assert [w for w in warnings if w.startswith("a: ")] == ["a: it runs hot", "a: fmi2DoStep returned Warning"]
    outcome = ran(scenario(typed, "a: {fmu: typed.fmu, logging: true}"))
    assert "a: debugging" in outcome.manifest["warnings"]


def test_a_fault_is_on_a_connection_and_has_what_its_kind_needs(typed: Path) -> None:
    def path(faults: str, wires: str = "a.s_out>b.s_in") -> Path:
        more = f"events: [{{at: 0.3, set: {{a.s_in: two}}}}]\nfaults: [{faults}]"
        return scenario(typed, f"{started('s_in: one')}, b: {{fmu: typed.fmu}}", wires, more)

    for fault, last in (("kind: freeze, from: 0.2", "one"), ("kind: delay, delay: 0.2", "two")):
        texts = results_of(path(f"{{on: b.s_in, {fault}}}")).exact["b.s_out"]
        assert (texts[4], texts[-1]) == ("one", last)
    assert "accepts no bias fault" in faults_of(path("{on: b.s_in, kind: bias, value: 1}"))
    told = faults_of(path("{on: a.r_in, kind: bias}, {on: a.r_in, kind: freeze, from: 7}", ""))
    for words in ("a.r_in is not connected", "bias needs value", "no communication point within"):
        assert words in told


# -- errors of coupling -----------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss-seidel"])
def test_the_coupling_error_is_the_change_by_half_the_step(tmp_path: Path, algorithm: str) -> None:
    """Two lags in a loop, each a step of Euler's: what halves change is known."""
    lag_fmu(tmp_path / "lag.fmu")
    parts = "a: {fmu: lag.fmu, start: {bias: 1}}, b: {fmu: lag.fmu, start: {T: 0.5}}"
    path = scenario(tmp_path, parts, "a.y>b.u b.y>a.u", f"algorithm: {algorithm}", "duration: 2\nstep: 0.1")

    def step(state: tuple[float, float], length: float) -> tuple[float, float]:
        a, b = state
        return a + length * (b + 1.0 - a), b + length / 0.5 * (a - b)  # no output depends on an input at once

    state, halves, most = (0.0, 0.0), (0.0, 0.0), 0.0
    for _ in range(20):
        state, halves = step(state, 0.1), step(step(halves, 0.05), 0.05)
        most = max(most, abs(state[0] - halves[0]))
    assert coupling_error(path)[0]["a.y"] == pytest.approx(most, rel=1e-9)
    assert ran(path)["a.y"][-1] == pytest.approx(state[0], rel=1e-12)
