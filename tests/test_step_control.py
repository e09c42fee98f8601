"""Controlled communication steps and courses of inputs: errors, counts, and their limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cosim.core.errors import InputError, SimulationError
from cosim.simulation.workflow import run
from tests.coupled import LINEAR, WHEEL, coupled_fmu, truck

HALVING = "step: {max: 20 ms, min: 0.1 ms, tolerance: 1e-4}\n"


def ran(folder: Path, step: str, seconds: float, **wheel: bool) -> Any:
    """Run the truck with a wheel of these options; return its manifest."""
    components, _ = truck(folder)
    coupled_fmu(folder / "wheel.fmu", WHEEL, **wheel)
    ends = "connections: [{from: chassis.y0, to: wheel.u0}, {from: wheel.y0, to: chassis.u0}]\n"
    file = folder / "truck.yaml"
    file.write_text(f"name: truck\nduration: {seconds:g}\n{step}components: {components}\n{ends}")
    return run(file, folder / "out", report=False, force=True, in_process=True).manifest


def test_the_estimator_follows_from_what_the_fmus_can_do(tmp_path: Path) -> None:
    manifest = ran(tmp_path, HALVING, seconds=0.1, saves=False)
    assert manifest["steps"]["estimator"] == "residual"
    with pytest.raises(InputError, match=r"truck\.yaml:3:.*wheel cannot save its state"):
        ran(tmp_path, HALVING.replace("1e-4", "1e-4, estimator: halving"), seconds=0.1, saves=False)


def test_no_step_is_shorter_than_the_minimum(tmp_path: Path) -> None:
    """Where min divides no interval between rows, too."""
    manifest = ran(tmp_path, "step: {max: 20 ms, min: 11 ms, tolerance: 1e-6}\n", seconds=1.5)
    assert manifest["steps"]["sizes"]["0 %"] >= 0.011
    manifest = ran(tmp_path, "step: {max: 20 ms, min: 3 ms, rows: 25 ms, tolerance: 1e-6}\n", seconds=1.5)
    assert manifest["steps"]["sizes"]["0 %"] >= 0.003
    assert manifest["steps"]["sizes"]["100 %"] <= 0.020


def test_components_with_a_step_of_their_own_step_at_rows(tmp_path: Path) -> None:
    """A sampled FMU counts its steps: one for each two rows."""
    truck(tmp_path)
    coupled_fmu(tmp_path / "count.fmu", LINEAR, variable_step=False)
    file = tmp_path / "own.yaml"
    components = "components: {chassis: {fmu: chassis.fmu, start: {p0: 400}}, count: {fmu: count.fmu, step: 40 ms}}\n"
    file.write_text(f"name: own\nduration: 0.4\nrecord: [count.steps]\n{HALVING}{components}")
    outcome = run(file, tmp_path / "out", report=False, in_process=True)
    assert outcome.results["count.steps"].tolist() == [k // 2 for k in range(21)]
    file.write_text(file.read_text().replace(", step: 40 ms", ""))
    with pytest.raises(InputError, match="count accepts only one step length"):
        run(file, tmp_path / "none")


@pytest.mark.parametrize(
    ("step", "words"),
    [
        ("{max: 10 ms, min: 20 ms}", r"truck\.yaml:3:25.*min must not exceed max"),
        ("{max: 20 ms, min: 1 ms, rows: 10 ms}", "max must not exceed rows"),
        ("{max: 20 ms}", "step.min"),
        ("{max: 20 ms, min: 1e-16}", "too short"),
        ("{max: 20 ms, min: 1 ms, estimator: guess}", "step.estimator"),
        ("{max: 20 ms, min: 1 ms, estimator: energy}", "energy, and no other, needs bonds"),
        ("{max: 30 ms, min: 1 ms}", "multiple"),
        (
            "{max: 20 ms, min: 1 ms, estimator: residual, bonds: [{effort: wheel.y0, flow: chassis.y0}]}",
            "energy, and no other, needs bonds",
        ),
        ("{max: 20 ms, min: 1 ms, bonds: [{effort: wheel.y9, flow: chassis.y0}]}", 'no output "wheel.y9"'),
        ("{max: 20 ms, min: 1 ms, bonds: [{effort: wheel.y0, flow: wheel.y0}]}", "connection to wheel"),
    ],
)
def test_keys_that_contradict_each_other_are_named(step: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        ran(tmp_path, f"step: {step}\n", seconds=0.1)


def test_an_fmu_that_does_not_restore_its_state_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from cosim.blocks.fmu import FmuBlock

    monkeypatch.setattr(FmuBlock, "restore_state", lambda self, state, keep=False: None)
    with pytest.raises(SimulationError, match=r"(chassis|wheel) at .* its outputs differ after a saved state"):
        ran(tmp_path, HALVING.replace("min: 0.1 ms", "min: 20 ms"), seconds=1.2)
