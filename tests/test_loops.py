"""Algebraic loops: found from dependencies, solved at the start and at every communication point."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.errors import InputError, SimulationError
from cosim.core.messages import CheckNote, CheckWarning
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.workflow import run
from cosim.system.system import build_system
from cosim.verbs.checks import check
from examples.coupling.build import HERE, build_all
from tests.coupled import LINEAR, LOOP_A, LOOP_B, SQUARE, coupled_fmu, without_dependencies
from tests.deeds import deeds_scenario

TWO = "connections: [{from: a.y0, to: b.u0}, {from: b.y0, to: a.u0}]\n"
LOOP_808 = "connections: [{from: a.y0, to: b.u0}, {from: a.y1, to: b.u1}, {from: b.y0, to: a.u0}]\n"


def outcome_of(file: Path, name: str = "out", *overrides: str) -> Any:
    return run(file, file.parent / name, overrides, report=False, force=True, in_process=True)


def ran(
    folder: Path,
    a: dict[str, float],
    b: dict[str, float],
    connections: str = TWO,
    more: str = "",
    steps: int = 5,
    laws: tuple[int, int] = (LINEAR, LINEAR),
    order: str = "ab",
    **options: Any,
) -> Any:
    """Run a scenario of FMUs a and b with these start values and laws; return its results and its manifest."""
    for name, law in zip("ab", laws, strict=True):
        coupled_fmu(folder / f"{name}.fmu", law, **options)
    starts = {"a": a, "b": b}
    components = "".join(f"  {name}: {{fmu: {name}.fmu, start: {starts[name]}}}\n" for name in order)
    file = folder / "loop.yaml"
    head = f"name: loop\nduration: {0.1 * steps:g}\nstep: 0.1\nrecord: ['*.steps']\n"
    file.write_text(f"{head}components:\n{components}{connections}{more}")
    outcome = outcome_of(file)
    return outcome.results, outcome.manifest


def linear(folder: Path, gain: float, more: str = "", offset: float = 1.0, steps: int = 5, **options: Any) -> Any:
    """Run y_a = gain·y_b + offset, y_b = y_a; late: a answers only after a step (1), or never before it (2)."""
    a = {"p0": gain, "p1": offset, "late": options.pop("late", 0.0)}
    return ran(folder, a, {"p0": 1.0}, TWO, more, steps, **options)


def rows_written(folder: Path) -> int:
    return len((folder / "out" / "results.csv").read_text().splitlines()) - 1


# -- solutions ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("exchange", [False, True])
@pytest.mark.parametrize("slopes", [True, False])
def test_the_loop_of_omsimulator_808_is_solved_in_eight_iterations(
    exchange: bool, slopes: bool, tmp_path: Path
) -> None:
    results, manifest = ran(tmp_path, {}, {}, LOOP_808, laws=(LOOP_A, LOOP_B), slopes=slopes, exchange=exchange)
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
    laws = LOOP_A, LOOP_B  # the first outputs of a are outside the domain of b
    results, manifest = ran(tmp_path, {}, {"u0": refused}, LOOP_808, laws=laws, declares=False, order=order)
    a, b, c = results["a.y0"][-1], results["a.y1"][-1], results["b.y0"][-1]
    assert abs(a * a + b * b + c * c - 5) < 1e-7
    assert [*map(type, manifest["warnings"])] == [CheckNote]


@pytest.mark.parametrize(("method", "gain"), [("newton", 5.0), ("anderson", 5.0), ("anderson", -0.99)])
@pytest.mark.parametrize("offset", [1e-9, 1e-300])
def test_a_loop_of_tiny_signals_is_solved_relative_to_their_size(
    method: str, gain: float, offset: float, tmp_path: Path
) -> None:
    results, manifest = linear(tmp_path, gain, f"loops: {{method: {method}}}\n", offset)
    assert results["a.y0"] == pytest.approx(offset / (1.0 - gain), rel=1e-7, abs=0.0)
    assert manifest["warnings"] == []


def test_a_loop_through_noise_and_units_counts_them(tmp_path: Path) -> None:
    connections = TWO.replace("to: b.u0", "to: b.u0, factor: 3, noise: {variance: 0.01}")
    results, _ = ran(tmp_path, {"p0": 2.0, "p1": 1.0}, {"p0": 1.0}, connections, "seed: 3\n", steps=10)
    noise = results["b.u0"] - 3.0 * results["a.y0"]
    assert results["a.y0"] == pytest.approx((2.0 * noise + 1.0) / (1.0 - 6.0), abs=1e-6)
    assert np.std(noise) > 0.02
    assert len(set(noise.round(9))) == 11


def test_the_voltage_of_the_battery_is_that_at_the_current_of_the_same_time(tmp_path: Path) -> None:
    build_all(tmp_path, ("battery", "converter"))
    shutil.copy(HERE / "power.yaml", tmp_path)
    outcome = outcome_of(tmp_path / "power.yaml", "out", "duration=400")
    rows = outcome.results
    voltage, current, power = (rows[name] for name in ("converter.voltage", "battery.current", "converter.power"))
    assert np.max(np.abs(0.95 * voltage * current / power - 1.0)) < 1e-8
    rest = 48.0 * (0.8 + 0.2 * rows["battery.charge"] / 36e3)
    assert voltage == pytest.approx(0.5 * (rest + np.sqrt(rest**2 - 4.0 * 0.1 * power / 0.95)), rel=1e-6)
    assert outcome.manifest["loops"][0]["repeated"] == []  # FMUs of models answer to new inputs without a step


def test_a_loop_is_solved_at_the_points_of_controlled_steps_too(tmp_path: Path) -> None:
    """y_a = 0.5·u + 1 + x_a with x_a' = u − x_a, y_b = −2·u."""
    ran(tmp_path, {"p0": 0.5, "p1": 1.0, "p2": 1.0, "p3": 1.0}, {"p0": -2.0}, steps=20)
    outcome = outcome_of(tmp_path / "loop.yaml", "controlled", "step={max: 100 ms, min: 1 ms}", "record=[]")
    x = 0.5 * (np.exp(-2.0 * outcome.results.time) - 1.0)  # x' = −2·y − x with 2·y = 1 + x
    assert outcome.results["a.y0"] == pytest.approx(0.5 * (1.0 + x), abs=2e-3)
    assert outcome.manifest["loops"][0]["points"] == outcome.manifest["steps"]["communication_points"]


# -- where loops are ------------------------------------------------------------------------------------


def test_a_loop_that_no_fmu_declares_is_measured_and_solved(tmp_path: Path) -> None:
    after, manifest = linear(tmp_path, 5.0, declares=False)
    assert after["a.y0"] == pytest.approx(-0.25, rel=1e-8)
    assert manifest["loops"][0]["signals"] == ["b.u0", "a.u0"]
    assert [*map(type, manifest["warnings"])] == [CheckNote]
    repeated = outcome_of(tmp_path / "out" / "manifest.json", "again")
    assert repeated.results.values.tobytes() == after.values.tobytes()
    assert repeated.manifest["warnings"] == manifest["warnings"]
    (line,) = check(tmp_path / "loop.yaml")
    assert "a → b → a" in line
    after, manifest = linear(tmp_path, 5.0, "loops: {}\n", declares=False)
    assert after["a.y0"] == pytest.approx(-0.25, rel=1e-8)
    assert manifest["warnings"] == []


def test_feedthrough_stated_in_the_scenario_is_not_measured(tmp_path: Path) -> None:
    coupled_fmu(tmp_path / "a.fmu", LINEAR, declares=False)
    file = tmp_path / "stated.yaml"

    def written(a: str, b: str) -> ScenarioFile:
        components = f"components: {{a: {{fmu: a.fmu, {a}}}, b: {{fmu: a.fmu, {b}}}}}\n"
        file.write_text(f"name: stated\nduration: 1\nstep: 0.1\n{components}{TWO}")
        return ScenarioFile(file)

    direct = "feedthrough: [u0]"
    system = build_system(written(direct, "feedthrough: []"))
    assert (system.names, system.assumed, system.loops, system.warnings) == (["b", "a"], False, (), ())
    assert [loop.members for loop in build_system(written(direct, direct)).loops] == [("a", "b")]
    for wrong, words in (
        ("feedthrough: [y0]", r'stated\.yaml:4:.*b has no input "y0"'),
        (f"{direct}, step: 0.2", r"stated\.yaml:4:.*b has its own step"),
    ):
        with pytest.raises(InputError, match=words):
            build_system(written(direct, wrong))


def test_a_hang_in_the_measurement_is_limited_and_no_end_of_the_run(tmp_path: Path) -> None:
    file = deeds_scenario(tmp_path, "GetReal", "sleep", 20, limits="{total: 0.5 s}")
    for name in ("good.fmu", "bad.fmu"):
        without_dependencies(tmp_path / name)
    manifest = run(file, tmp_path / "out", report=False, force=True).manifest
    (warning,) = (w for w in manifest["warnings"] if type(w) is CheckWarning)
    assert "0.5 s" in warning


# -- faults -----------------------------------------------------------------------------------------


def test_a_loop_without_solution_is_named_with_residual_and_time_and_keeps_its_rows(tmp_path: Path) -> None:
    # a drifts: y_b = u + x_b, x_b' = 1·(u − x_b), so that y = y² + p0 + x_b loses its solution
    with pytest.raises(SimulationError) as failure:
        ran(tmp_path, {"p0": 0.1}, {"p0": 1.0, "p2": 1.0, "p3": 1.0}, steps=40, laws=(SQUARE, LINEAR))
    assert "a → b → a" in str(failure.value)
    assert failure.value.exit_code == 4
    assert failure.value.time > 0.0
    assert rows_written(tmp_path) == round(failure.value.time / 0.1)


def test_a_silent_fmu_without_states_is_coupled_with_a_delay(tmp_path: Path) -> None:
    """y_a = 0.5·y_b + 1 of the step before, from y = 0 on."""
    results, manifest = linear(tmp_path, 0.5, late=2.0, saves=False)
    assert results["a.y0"] == pytest.approx([0.0, 1.0, 1.5, 1.75, 1.875, 1.9375])
    assert "not_solved" in manifest["loops"][0]
    assert len(manifest["warnings"]) == 1
    results, _ = linear(tmp_path, 5.0, late=1.0)  # steps of an FMU with states are repeated
    assert results["a.y0"][-1] == pytest.approx(-0.25)
    assert results["b.steps"][-1] == 5


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("loops: {}\norder: [a, b]\n", "order"),
        ("loops: {}\nalgorithm: jacobi\n", "jacobi"),
        ("loops: {tolerance: 0}\n", "loops.tolerance"),
        ("loops: {iterations: 0}\n", "loops.iterations"),
        ("loops: {method: guess}\n", "loops.method"),
    ],
)
def test_keys_of_loops_that_contradict_are_named(more: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        linear(tmp_path, 0.5, more)
