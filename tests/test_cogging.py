"""Forces that repeat along a position: where they act in free runs of a machine that was pushed, and their period."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.estimation.posing import build_problem
from cosim.estimation.subject.candidates import Candidate, Free
from cosim.refinement.search import periods
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


@pytest.mark.parametrize("cycles", [37.0, 311.0])
def test_a_period_far_below_the_travel_is_a_line_of_the_innovations(cycles: float) -> None:
    rng, travel = np.random.default_rng(2), 250.0
    positions = [np.cumsum(rng.choice([-1.0, 1.0], 3001).cumsum() * 0.002) % travel for _ in range(2)]
    positions[0][0], positions[1][0] = 0.0, travel
    answers = [
        np.column_stack([0.4 * np.sin(math.pi * cycles * (q[:-1] + q[1:]) / travel + 1.0), np.zeros(3000)])
        + rng.standard_normal((3000, 2))
        for q in positions
    ]
    at_once = np.zeros((periods.LASTING, 2))
    at_once[0, 0] = 1.0
    lines = [*periods._lines(positions, answers, at_once, 1e-3 * travel, 0.5 * travel)]
    assert len(lines) == periods.LINES
    assert min(abs(travel / line - cycles) for line in lines) < 0.5


@pytest.mark.parametrize(("amplitude", "varied"), [(0.3, False), (3.0, True)])
def test_a_period_is_varied_only_if_the_term_may_be_fitted(
    monkeypatch: pytest.MonkeyPatch, amplitude: float, varied: bool
) -> None:
    """The truth lies between two usual periods, half a cycle over the travel from one, and no line shows it."""
    q, true, sigma = np.linspace(0.0, 1.0, 2000), 1.0 / 6.5, 1e-3
    monkeypatch.setattr(periods, "_along", lambda test, along: ([q], sigma, [np.zeros((q.size - 1, 1))]))
    monkeypatch.setattr(periods, "_by_row", lambda test, numbers: [numbers[1:, None]])
    names, asked = ("cogging.sine", "cogging.cosine", "cogging.period"), set[float]()
    residual = amplitude * np.sin(2.0 * math.pi * q / true) / math.sqrt(q.size) * 5.0

    def row(steps: Mapping[str, float]) -> Any:
        period = 0.25 + steps[names[2]]
        asked.add(round(1.0 / period, 6))
        angle = 2.0 * math.pi * q / period
        return np.sin(angle) if names[0] in steps else np.cos(angle)

    def gain(rows: Any) -> tuple[float, Any]:
        fitted = np.linalg.lstsq(np.array(rows).T, residual)[0] @ np.array(rows)
        return 0.5 * float(fitted @ fitted), None

    free = (*(Free(n, -2.0, 2.0, 0.05, neutral=0.0) for n in names[:2]), Free(names[2], 5e-4, 0.5, 0.02))
    starts = tuple({names[0]: 0.05, names[2]: 1.0 / cycles} for cycles in (3.0, 6.0, 12.0))
    cogging = Candidate("cogging", "effect", free, starts, repeats=(names[2], "position"))
    test: Any = SimpleNamespace(values={names[2]: 0.25}, row=row, gain=gain)
    (chosen,), found = periods.with_likely_periods(test, [cogging], (), lambda c: 10.0)
    assert (len(asked) > 6) == varied
    assert chosen.among == round(1.0 / (2.0 * math.pi * sigma))  # periods that travel and sensor tell apart
    assert chosen.free[2].low == 2.0 * math.pi * sigma
    assert chosen.starts == ({**starts[0], names[2]: found[names[2]]},)  # the scan has compared the others
    assert (abs(1.0 / found[names[2]] - 6.5) < 0.3) == varied
