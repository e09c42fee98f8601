"""Rows of a log at any ratio to the step of its model, whole or not, faster or slower: refine and replay take them.

The motor is made for 20 ms, with RK4 substeps of 5 ms; the tank for 500 ms. Between two rows a command is held.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from cosim.logs.log import Finding
from cosim.residuals.workflow import replay
from tests.logs import write_log
from tests.studies import holds, named, proven
from tests.tank import LEAK, MODEL, tank_log
from tests.test_refine_conditions import MOTOR

GAIN, TIME = 20.0, 0.4  # [rad/s/V], [s] of the motor: k/k² and J/k²
FAN = 5e-6


def motor_log(path: Path, seed: int, step: float) -> None:
    """A motor with a fan, on steps of its voltage, by Euler's rule in 1000 steps a time constant."""
    rng = np.random.default_rng(seed)
    rows, fine = max(500, round(10.0 / step)), math.ceil(step / TIME * 1000.0)
    every = max(1, round(0.4 / step))
    u = 6.0 * np.repeat(rng.uniform(-1, 1, rows // every + 1), every)[:rows]
    speed, tacho = 0.0, []
    for command in u.tolist():
        tacho.append(0.02 * speed)
        for _ in range(fine):
            speed += step / fine * ((GAIN * command - speed) / TIME - FAN / 1e-3 * speed * speed)
    read = np.array(tacho) + 1e-2 * rng.standard_normal(rows)
    write_log(path, {"time": step * np.arange(rows), "voltage": u, "tacho": read})


def findings(folder: Path, plant: Path) -> tuple[Finding, ...]:
    """The log that was sealed, replayed through the refined FMU: nothing is missing."""
    comparison = replay(folder / "c.csv", folder / "replayed", plant, report=False).comparison
    assert all(c.is_matched for c in comparison.channels), comparison.channels
    return tuple(comparison.findings)


@pytest.mark.thorough
@pytest.mark.parametrize("step", [1.0 / 33.0, 0.007])
def test_a_motor_is_refined_and_replayed_at_any_rate(tmp_path: Path, step: float) -> None:
    (tmp_path / "motor.py").write_text(MOTOR)
    for seed, name in enumerate("abc"):
        motor_log(tmp_path / f"{name}.csv", seed, step)
    study = tmp_path / "study.yaml"
    study.write_text("model: motor.py:Motor\nlogs: {estimation: [a.csv, b.csv], validation: [c.csv]}\n")
    r = proven(study, tmp_path / "out")
    assert named(r) == {"fan"}
    assert holds(r, "fan", "factor", FAN)
    assert r.record["error"]["after"]["validation"]["tacho"] < 1.1 * r.record["noise_floor"]["tacho"]
    slower = [f for f in findings(tmp_path, r.folder / "plant.fmu") if f.kind == "rate" and f.severity == "warning"]
    assert bool(slower) == (step > 0.03)


@pytest.mark.thorough
@pytest.mark.parametrize(("step", "seconds"), [(1.0 / 0.7, 400.0), (1.0 / 33.0, 30.0)])
def test_a_tank_is_refined_and_replayed_at_any_rate(tmp_path: Path, step: float, seconds: float) -> None:
    (tmp_path / "tank.py").write_text(MODEL.replace("horizon = 0.5, 0.125, 20.0", "horizon = 0.5, 0.125, 10.0"))
    for seed, name in enumerate("abc"):
        tank_log(tmp_path / f"{name}.csv", seed, seconds, step)
    study = tmp_path / "study.yaml"
    study.write_text("model: tank.py:Tank\nlogs: {estimation: [a.csv, b.csv], validation: [c.csv]}\n")
    r = proven(study, tmp_path / "out")
    assert named(r) == {"leak"}
    assert holds(r, "leak", "rate", LEAK)
    assert r.record["error"]["after"]["validation"]["level"] < 1.1 * r.record["noise_floor"]["level"]
    findings(tmp_path, r.folder / "plant.fmu")
