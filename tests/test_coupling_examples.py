"""The examples of coupling: a truck with controlled steps, and a battery in an algebraic loop with a converter."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from cosim.simulation.workflow import run
from examples.coupling.build import HERE, build_all
from tests.native import NEEDS_COMPILER

pytestmark = NEEDS_COMPILER


def test_the_truck_takes_long_steps_on_the_flat_road_and_short_ones_on_the_bump(tmp_path: Path) -> None:
    build_all(tmp_path, ("chassis", "wheel"))
    shutil.copy(HERE / "truck.yaml", tmp_path)
    outcome = run(tmp_path / "truck.yaml", tmp_path / "out", report=False, in_process=True)
    assert not outcome.missed
    steps = outcome.manifest["steps"]
    assert steps["estimator"] == "halving"
    assert steps["above_tolerance"] == 0
    assert steps["sizes"]["100 %"] == pytest.approx(0.02)
    assert steps["sizes"]["10 %"] < 0.004
    assert steps["communication_points"] < 5.0 / 1e-3  # fewer than with equal steps of 1 ms


def test_the_voltage_of_the_battery_is_that_at_the_current_of_the_same_time(tmp_path: Path) -> None:
    build_all(tmp_path, ("battery", "converter"))
    shutil.copy(HERE / "power.yaml", tmp_path)
    outcome = run(tmp_path / "power.yaml", tmp_path / "out", ["duration=400"], report=False, in_process=True)
    rows = outcome.results
    voltage, current, power = rows["converter.voltage"], rows["battery.current"], rows["converter.power"]
    assert np.max(np.abs(0.95 * voltage * current / power - 1.0)) < 1e-8
    rest = 48.0 * (0.8 + 0.2 * rows["battery.charge"] / 36e3)
    assert voltage == pytest.approx(0.5 * (rest + np.sqrt(rest**2 - 4.0 * 0.1 * power / 0.95)), rel=1e-6)
    (loop,) = outcome.manifest["loops"]
    assert loop["iterations"]["most"] <= 10
    assert loop["repeated"] == []  # FMUs of models answer to new inputs without a step
