"""Algebraic loops: found from dependencies, solved at the start and at every communication point."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.errors import InputError, SimulationError
from cosim.core.messages import CheckNote, CheckWarning, Note
from cosim.master.root_finding import RootFinding
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation import undeclared
from cosim.simulation.workflow import run
from cosim.system.system import build_system
from cosim.verbs.checks import check
from tests.cases import some
from tests.coupled import LINEAR, LOOP_A, LOOP_B, SQUARE, coupled_fmu, without_dependencies
from tests.deeds import deeds_scenario
from tests.typed import typed_fmu

TWO = "connections: [{from: a.y0, to: b.u0}, {from: b.y0, to: a.u0}]\n"
LOOP_808 = "connections: [{from: a.y0, to: b.u0}, {from: a.y1, to: b.u1}, {from: b.y0, to: a.u0}]\n"


def ran(
    folder: Path,
    starts: dict[str, dict[str, float]],
    connections: str = TWO,
    more: str = "",
    steps: int = 5,
    laws: tuple[Any, Any] = (LINEAR, LINEAR),
    **options: Any,
) -> Any:
    """Run a scenario of FMUs a and b with these laws; return its results and its manifest."""
    for name, law in zip("ab", laws, strict=True):
        coupled_fmu(folder / f"{name}.fmu", law, **options)
    components = "".join(f"  {n}: {{fmu: {n}.fmu, start: {s}}}\n" for n, s in starts.items())
    file = folder / "loop.yaml"
    head = f"name: loop\nduration: {0.1 * steps:g}\nstep: 0.1\nrecord: ['*.steps']\n"
    file.write_text(f"{head}components:\n{components}{connections}{more}")
    outcome = run(file, folder / "out", report=False, force=True, in_process=True)
    return outcome.results, outcome.manifest


def linear(folder: Path, gain: float, more: str = "", **options: Any) -> Any:
    """Run y_a = gain·y_b + 1, y_b = y_a."""
    return ran(folder, {"a": {"p0": gain, "p1": 1.0}, "b": {"p0": 1.0}}, more=more, **options)


# -- solutions ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("gain", some([-40.0, -0.99, 5.0], every=3))
@pytest.mark.parametrize("slopes", [True, False])
def test_a_linear_loop_is_solved_whatever_its_gain(gain: float, slopes: bool, tmp_path: Path) -> None:
    results, manifest = linear(tmp_path, gain, slopes=slopes)
    assert results["a.y0"] == pytest.approx(1.0 / (1.0 - gain), rel=1e-8)
    assert results["b.u0"] == pytest.approx(results["a.y0"], rel=1e-8)
    (loop,) = manifest["loops"]
    assert loop["components"] == ["a", "b"]
    assert loop["unknowns"] == ["a.u0"]  # one connection leads back
    assert loop["iterations"]["start"] <= 3
    assert loop["iterations"]["most"] <= 1  # at rest, each point starts at its solution
    assert set(loop["derivatives"].values()) == {"directional" if slopes else "differences"}


@pytest.mark.parametrize("exchange", [False, True])
@pytest.mark.parametrize("slopes", [True, False])
def test_the_loop_of_omsimulator_808_is_solved_in_eight_iterations(
    exchange: bool, slopes: bool, tmp_path: Path
) -> None:
    laws = LOOP_A, LOOP_B
    results, manifest = ran(tmp_path, {"a": {}, "b": {}}, LOOP_808, laws=laws, slopes=slopes, exchange=exchange)
    a, b, c = results["a.y0"][-1], results["a.y1"][-1], results["b.y0"][-1]
    assert abs(a + b + c) < 1e-7
    assert abs(2 * a - 3 * b + 2 * c - 9) < 1e-7
    assert abs(a * a + b * b + c * c - 5) < 1e-7
    (loop,) = manifest["loops"]
    assert 1 <= loop["iterations"]["start"] <= 8
    assert loop["points"] == 5


@pytest.mark.parametrize("order", ["ab", "ba"])
@pytest.mark.parametrize("refused", [0.0, 3.0])
def test_a_loop_is_measured_where_an_fmu_refuses_its_start_values_or_those_of_the_other(
    order: str, refused: float, tmp_path: Path
) -> None:
    starts: dict[str, dict[str, float]] = {"a": {}, "b": {"u0": refused}}
    laws = LOOP_A, LOOP_B  # The first outputs of a are outside the domain of b.
    results, manifest = ran(tmp_path, {name: starts[name] for name in order}, LOOP_808, laws=laws, declares=False)
    a, b, c = results["a.y0"][-1], results["a.y1"][-1], results["b.y0"][-1]
    assert abs(a * a + b * b + c * c - 5) < 1e-7
    assert [*map(type, manifest["warnings"])] == [CheckNote]


def test_a_refusal_in_initialization_names_the_possible_loop_and_the_cure(tmp_path: Path) -> None:
    options: dict[str, Any] = {"laws": (LOOP_A, LOOP_B), "declares": False}
    with pytest.raises(SimulationError):
        ran(tmp_path, {"a": {}, "b": {"u0": 1e6}}, LOOP_808, **options)
    results, _ = ran(tmp_path, {"a": {}, "b": {"u0": 1e6}}, LOOP_808, "loops: {}\n", **options)
    assert results["a.y1"][-1] == -1.8


@pytest.mark.parametrize("method", ["newton", "anderson"])
@pytest.mark.parametrize("gain", [5.0, -0.99])
@pytest.mark.parametrize("offset", [1e-9, 1e-300])
def test_a_loop_of_tiny_signals_is_solved_relative_to_their_size(
    method: str, gain: float, offset: float, tmp_path: Path
) -> None:
    starts = {"a": {"p0": gain, "p1": offset}, "b": {"p0": 1.0}}
    results, manifest = ran(tmp_path, starts, TWO, f"loops: {{method: {method}}}\n")
    assert results["a.y0"] == pytest.approx(offset / (1.0 - gain), rel=1e-7, abs=0.0)
    assert manifest["warnings"] == []


def test_an_fmu_that_answers_only_after_a_step_repeats_it(tmp_path: Path) -> None:
    results, manifest = ran(tmp_path, {"a": {"p0": 5.0, "p1": 1.0, "late": 1.0}, "b": {"p0": 1.0}}, TWO)
    assert manifest["loops"][0]["repeated"] == ["a"]
    assert results["a.y0"] == pytest.approx(-0.25, rel=1e-7)
    assert results["a.steps"][-1] >= 5
    assert results["b.steps"][-1] == 5


def test_a_loop_through_noise_and_units_counts_them(tmp_path: Path) -> None:
    connections = (
        "connections:\n  - {from: a.y0, to: b.u0, factor: 3, noise: {variance: 0.01}}\n  - {from: b.y0, to: a.u0}\n"
    )
    results, _ = ran(tmp_path, {"a": {"p0": 2.0, "p1": 1.0}, "b": {"p0": 1.0}}, connections, "seed: 3\n", steps=10)
    noise = results["b.u0"] - 3.0 * results["a.y0"]
    assert results["a.y0"] == pytest.approx((2.0 * noise + 1.0) / (1.0 - 6.0), abs=1e-6)
    assert np.std(noise) > 0.02
    assert len(set(noise.round(9))) == 11


# -- where loops are ------------------------------------------------------------------------------------


@pytest.mark.parametrize("more", ["", "loops: {}\n"])
def test_a_loop_that_no_fmu_declares_is_measured_and_solved(tmp_path: Path, more: str) -> None:
    after, manifest = linear(tmp_path, 5.0, more, declares=False)
    assert after["a.y0"] == pytest.approx(-0.25, rel=1e-8)
    assert manifest["loops"][0]["signals"] == ["b.u0", "a.u0"]
    assert [*map(type, manifest["warnings"])] == ([] if more else [CheckNote])
    if more:
        return
    components = manifest["scenario"]["components"]
    assert [components[name]["feedthrough"] for name in "ab"] == [["u0"], ["u0"]]
    repeated = run(tmp_path / "out" / "manifest.json", tmp_path / "again", report=False, force=True, in_process=True)
    assert repeated.results.values.tobytes() == after.values.tobytes()
    assert repeated.manifest["warnings"] == manifest["warnings"]


def moving(folder: Path, order: str = "ab", more: str = "", **starts: float) -> Any:
    """Run y_a = 0.5·u + 1 and y_b = x, x' = u − x; FMUs that declare nothing, in this order of the file."""
    values = {"a": {"p0": 0.5, "p1": 1.0, **starts}, "b": {"p2": 1.0, "p3": 1.0}}
    return ran(folder, {name: values[name] for name in order}, TWO, more, declares=False)


def test_undeclared_inputs_without_feedthrough_cost_neither_warning_nor_bytes(tmp_path: Path) -> None:
    results, manifest = moving(tmp_path, "ba")
    assert "loops" not in manifest
    assert manifest["order"] == ["b", "a"]
    assert manifest["warnings"] == []
    assert manifest["scenario"]["components"]["b"]["feedthrough"] == []
    ordered, _ = moving(tmp_path, "ba", "order: [b, a]\n")
    assert results.values.tobytes() == ordered.values.tobytes()


def test_feedthrough_stated_in_the_scenario_is_not_measured(tmp_path: Path) -> None:
    for name in "ab":
        coupled_fmu(tmp_path / f"{name}.fmu", LINEAR, declares=False)
    file = tmp_path / "stated.yaml"
    components = "components: {a: {fmu: a.fmu, feedthrough: [u0]}, b: {fmu: b.fmu, feedthrough: [%s]}}\n"
    file.write_text(f"name: stated\nduration: 1\nstep: 0.1\n{components % ''}{TWO}")
    system = build_system(ScenarioFile(file))
    assert (system.names, system.assumed, system.loops, system.warnings) == (["b", "a"], False, (), ())
    file.write_text(file.read_text().replace("feedthrough: []", "feedthrough: [u0]"))
    assert [loop.members for loop in build_system(ScenarioFile(file)).loops] == [("a", "b")]
    file.write_text(file.read_text().replace("b.fmu, feedthrough: [u0]", "b.fmu, feedthrough: [y0]"))
    with pytest.raises(InputError, match=r'stated\.yaml:4:.*b has no input "y0"'):
        build_system(ScenarioFile(file))


@pytest.mark.parametrize("kind", ["i", "b", "e"])
def test_a_loop_of_whole_numbers_is_measured_and_the_stated_cure_works(tmp_path: Path, kind: str) -> None:
    fmu = without_dependencies(typed_fmu(tmp_path))
    wires = f"connections: [{{from: a.{kind}_out, to: b.{kind}_in}}, {{from: b.{kind}_out, to: a.{kind}_in}}]\n"
    file = tmp_path / "whole.yaml"
    components = f"components: {{a: {{fmu: {fmu.name}}}, b: {{fmu: {fmu.name}}}}}\n"
    file.write_text(f"name: whole\nduration: 1\nstep: 0.1\n{components}{wires}")
    warnings = run(file, tmp_path / "out", report=False, force=True, in_process=True).manifest["warnings"]
    assert type(warnings[-1]) is CheckWarning
    ordered = run(file, tmp_path / "ordered", ["order=[a, b]"], report=False, force=True, in_process=True).manifest[
        "warnings"
    ]
    assert ordered == warnings[:-1]


def test_a_hang_in_the_measurement_is_limited_told_and_no_end_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(undeclared, "SILENT", 0.0)
    file = deeds_scenario(tmp_path, "GetReal", "sleep", 20, limits="{total: 0.5 s}")
    for name in ("good.fmu", "bad.fmu"):
        without_dependencies(tmp_path / name)
    told: list[str] = []
    manifest = run(file, tmp_path / "out", report=False, force=True, tell=told.append).manifest
    assert [*map(type, told)] == [Note]
    (warning,) = (w for w in manifest["warnings"] if type(w) is CheckWarning)
    assert "0.5 s" in warning


def test_check_names_a_measured_loop(tmp_path: Path) -> None:
    linear(tmp_path, 5.0, declares=False)
    (line,) = check(tmp_path / "loop.yaml")
    assert ".yaml: note: a → b → a" in line
    (line,) = check(tmp_path / "loop.yaml", load=False)


def test_a_coarse_dependency_without_effect_costs_one_iteration_at_most(tmp_path: Path) -> None:
    results, manifest = ran(tmp_path, {"a": {"p2": 1.0, "p3": 1.0}, "b": {"p0": 1.0, "p1": 1.0}}, TWO, steps=20)
    assert manifest["loops"][0]["iterations"]["most"] <= 1
    assert results["b.u0"] == pytest.approx(results["a.y0"], abs=1e-12)


# -- faults -----------------------------------------------------------------------------------------


def test_a_loop_without_solution_is_named_with_residual_and_time_and_keeps_its_rows(tmp_path: Path) -> None:
    # a drifts: y_b = u + x_b, x_b' = 1·(u − x_b), so that y = y² + p0 + x_b loses its solution
    starts = {"a": {"p0": 0.1}, "b": {"p0": 1.0, "p2": 1.0, "p3": 1.0}}
    with pytest.raises(SimulationError) as failure:
        ran(tmp_path, starts, steps=40, laws=(SQUARE, LINEAR))
    message = str(failure.value)
    assert failure.value.exit_code == 4
    assert failure.value.time > 0.0
    for part in ("a → b → a", "a.u0", "b.u0"):
        assert part in message, message
    rows = (tmp_path / "out" / "results.csv").read_text().splitlines()
    assert len(rows) == 1 + round(failure.value.time / 0.1)


@pytest.mark.parametrize("offset", [1.0, 1e-9])
@pytest.mark.parametrize("declares", [True, False])
def test_a_loop_of_gain_one_has_no_solution_and_no_cure(offset: float, declares: bool, tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match="gain is 1") as failure:
        ran(tmp_path, {"a": {"p0": 1.0, "p1": offset}, "b": {"p0": 1.0}}, declares=declares)
    assert f"{offset:+.3g}" in str(failure.value)


@pytest.mark.parametrize("method", ["newton", "anderson"])
def test_more_iterations_are_proposed_where_they_ran_out(tmp_path: Path, method: str) -> None:
    more = f"loops: {{iterations: 1, method: {method}}}\n"
    with pytest.raises(SimulationError, match="iterations: 5"):
        ran(tmp_path, {"a": {"p0": 0.2}, "b": {"p0": 1.0}}, TWO, more, laws=(SQUARE, LINEAR))


def late(folder: Path, gain: float, more: str, late: float = 1.0, steps: int = 5, **options: Any) -> Any:
    """Run y_a = gain·y_b + 1, which answers only after a step."""
    return ran(folder, {"a": {"p0": gain, "p1": 1.0, "late": late}, "b": {"p0": 1.0}}, TWO, more, steps, **options)


def test_a_late_fmu_without_states_in_a_growing_loop_has_no_circular_cures(tmp_path: Path) -> None:
    with pytest.raises(SimulationError) as failure:
        late(tmp_path, 5.0, "", saves=False)
    # Without the loop in the steps, its equation at the start has a solution all the same.
    assert late(tmp_path, 5.0, "order: [a, b]\n", saves=False)[0]["a.y0"][0] == pytest.approx(-0.25)
    assert failure.value.exit_code == 4
    assert late(tmp_path, 5.0, "", saves=True)[0]["a.y0"][-1] == pytest.approx(-0.25)  # the named cure


def test_a_silent_fmu_without_states_is_coupled_with_a_delay_and_its_residual_is_measured(tmp_path: Path) -> None:
    """y_a = 0.5·y_b + 1 of the step before: from y = 0 on, the residual is 1 in the first step and halves in each."""
    results, manifest = late(tmp_path, 0.5, "", late=2.0, saves=False)
    assert results["a.y0"] == pytest.approx([0.0, 1.0, 1.5, 1.75, 1.875, 1.9375])
    record = manifest["loops"][0]["not_solved"]
    assert record["largest"] == {"signal": "a.u0", "time": pytest.approx(0.1), "value": 0.0, "residual": 1.0}
    assert record["last"]["residual"] == pytest.approx(1 / 16)
    assert record["relative"]["last"] == pytest.approx(1 / 31)
    assert len(manifest["warnings"]) == 1


@pytest.mark.parametrize("gain", [5.0, -1.5, 1e30])
def test_a_delayed_loop_that_grows_without_bound_ends_with_loop_residual_and_time(gain: float, tmp_path: Path) -> None:
    with pytest.raises(SimulationError) as failure:
        late(tmp_path, gain, "", late=2.0, saves=False, steps=100)
    assert failure.value.exit_code == 4
    assert 0.5 < failure.value.time < 7.0
    assert "a → b → a" in str(failure.value)
    assert len((tmp_path / "out" / "results.csv").read_text().splitlines()) == 1 + round(failure.value.time / 0.1)


def test_an_undeclared_fmu_that_answers_no_input_is_named_and_stated_feedthrough_is_the_cure(tmp_path: Path) -> None:
    _, manifest = late(tmp_path, 5.0, "loops: {}\n", late=2.0, declares=False)
    assert "not_solved" in manifest["loops"][0]
    stated = ["components.a.feedthrough=[u0]"]
    outcome = run(tmp_path / "loop.yaml", tmp_path / "stated", stated, report=False, force=True, in_process=True)
    assert outcome.results["a.y0"][-1] == pytest.approx(-0.25)
    assert outcome.manifest["warnings"] == []


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("loops: {}\norder: [a, b]\n", "leave one out"),
        ("loops: {}\nalgorithm: jacobi\n", "jacobi solves no algebraic loops"),
        ("loops: {tolerance: 0}\n", "loops.tolerance"),
        ("loops: {iterations: 0}\n", "loops.iterations"),
        ("loops: {method: guess}\n", "loops.method"),
        ("loops: {solver: newton}\n", "solver"),
    ],
)
def test_keys_of_loops_that_contradict_are_named(more: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        linear(tmp_path, 0.5, more)


def test_a_member_with_a_step_of_its_own_is_a_fault(tmp_path: Path) -> None:
    coupled_fmu(tmp_path / "a.fmu", LINEAR)
    file = tmp_path / "own.yaml"
    components = "components: {a: {fmu: a.fmu, step: 0.2}, b: {fmu: a.fmu}}\n"
    file.write_text(f"name: own\nduration: 1\nstep: 0.1\n{components}{TWO}")
    with pytest.raises(InputError, match=r"own\.yaml:4:.*a has a step of its own"):
        run(file, tmp_path / "out", report=False, force=True, in_process=True)


# -- numerics ---------------------------------------------------------------------------------------


def test_a_newton_step_that_leaves_the_domain_is_shortened() -> None:
    def g(z: Any) -> Any:  # z = sqrt(1 − z)/2: a full step from 0.99 leaves the domain
        return None if z[0] > 1.0 else 0.5 * np.sqrt(1.0 - z)

    def slopes(z: Any, value: Any, *, fresh: bool) -> Any:
        return np.array([[-0.25 / math.sqrt(1.0 - z[0])]])

    outcome = RootFinding(1e-10, 20, np.ones(1)).newton(g, np.array([0.999]), slopes)
    assert outcome.converged
    assert outcome.z[0] == pytest.approx(0.5 * math.sqrt(1.0 - outcome.z[0]), rel=1e-9)


def test_a_residual_that_is_small_beside_a_huge_unknown_is_no_solution_where_slopes_are_singular() -> None:
    """z = z + 1 with a slope of 1 − 1e-11: the first step leads to −1e11, where the corrected slope is 1."""
    roots = RootFinding(1e-8, 20, np.ones(1))
    outcome = roots.newton(lambda z: z + 1.0, np.zeros(1), lambda z, value, fresh: np.array([[1.0 - 1e-11]]))
    assert not outcome.converged


def test_wrong_derivatives_are_replaced_by_differences() -> None:
    asked: list[bool] = []

    def slopes(z: Any, value: Any, *, fresh: bool) -> Any:
        asked.append(fresh)
        return np.array([[5.0 if fresh else -1e-3]])

    outcome = RootFinding(1e-10, 20, np.ones(1)).newton(lambda z: 5.0 * z + 1.0, np.array([3.0]), slopes)
    assert outcome.converged
    assert (asked[0], asked[-1]) == (False, True)
