"""Forces that repeat along a position: where they act in free runs of a machine that was pushed, and their period."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from cosim.estimation.posing import build_problem
from cosim.refinement.study import read_study
from tests.blind.fmu_build import build
from tests.logs import write_log

STEP, ROWS, FINE = 0.01, 500, 20
PERIOD, SIZE = 0.9, 0.01  # rad, N·m
NOISE = {"current": 0.01, "angle": 0.02, "speed": 0.3}


def pushed_motor(path: Path) -> Path:
    """Write a log of the blind suite's motor with cogging; an unknown torque moves it by some periods."""
    rng, h = np.random.default_rng(4), STEP / FINE
    voltage = np.repeat(rng.uniform(-1.5, 1.5, ROWS // 50), 50)
    push = np.where((np.arange(ROWS) > 150) & (np.arange(ROWS) < 190), 0.008, 0.0)

    def rates(x: Any, u: float, torque: float) -> Any:
        i, q, w = x
        cogging = SIZE * math.sin(2.0 * math.pi * q / PERIOD)
        return np.array([(u - 1.2 * i - 0.05 * w) / 6e-3, w, (0.05 * i - 1e-4 * w - cogging + torque) / 2e-4])

    x, states = np.zeros(3), []
    for u, torque in zip(voltage, push, strict=True):
        states.append(x)
        for _ in range(FINE):
            half = x + 0.5 * h * rates(x, u, torque)
            x = x + h * rates(half, u, torque)
    readings = np.array(states) + rng.standard_normal((ROWS, 3)) * [*NOISE.values()]
    columns = {"time": STEP * np.arange(ROWS), "voltage": voltage, "load_torque": np.zeros(ROWS)}
    return write_log(path, columns | dict(zip(NOISE, readings.T, strict=True)))


def test_a_force_along_a_position_acts_where_the_filter_sees_the_machine(tmp_path: Path) -> None:
    fmu, log = build(tmp_path / "motor.fmu", "dc_motor", ways=("co_simulation",)), pushed_motor(tmp_path / "e1.csv")
    path = tmp_path / "study.yaml"
    path.write_text(json.dumps({"model": fmu.name, "logs": {"estimation": [log.name], "validation": []}}))
    study = read_study(path)
    problem = build_problem(study.subject, study.logs, noise=NOISE)
    truth = {"cogging_at_speed.sine": SIZE, "cogging_at_speed.cosine": 0.0, "cogging_at_speed.period": PERIOD}
    plain, right = (problem.score({**problem.values, **values}, problem.plain) for values in ({}, truth))
    assert right.nll < plain.nll - 200.0
    p, start = problem.numbers({**problem.values, **truth}), problem.x0[0]
    run = problem.kernel.simulate(problem.logs[0], p, start, np.zeros(problem.layout.memory))
    away = run.outputs[-1, 1] - problem.logs[0].y[-1, 1]
    assert abs(away) > 0.5 * PERIOD  # a replay knows nothing of the push
