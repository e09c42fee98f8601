"""A leak of a tank in co-simulation: where it acts, its refinement, and the FMU and the SSP that have it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import cosim
from cosim.estimation.posing import build_problem
from cosim.refinement.study import read_study
from tests.blind.fmu_build import build
from tests.logs import write_log

STEP, ROWS, LEAK, NOISE = 1.0, 600, 8e-4, 1e-3
PIPE, OUTLET, GAIN, AREA = 1.2e-4, 1.2e-4, 6e-6, 0.02  # of tests/blind/fmus


def leaking_tanks(path: Path, seed: int) -> Path:
    """Write a log of the blind suite's tanks, of which the right one leaks."""
    rng = np.random.default_rng(seed)
    pumps = np.repeat(rng.uniform(3.0, 8.0, (ROWS // 40, 2)), 40, axis=0)

    def rates(t: float, h: np.ndarray) -> list[float]:
        left, right = pumps[min(int(t / STEP), ROWS - 1)]
        pipe = PIPE * np.sign(h[0] - h[1]) * np.sqrt(abs(h[0] - h[1]))
        out = OUTLET * np.sqrt(max(h[1], 0.0))
        return [(GAIN * left - pipe) / AREA, (GAIN * right + pipe - out) / AREA - LEAK * h[1]]

    levels, h = [np.array([0.3, 0.25])], np.array([0.3, 0.25])
    for k in range(ROWS - 1):
        h = solve_ivp(rates, (k * STEP, (k + 1) * STEP - 1e-9), h, rtol=1e-8, atol=1e-10).y[:, -1]
        levels.append(h)
    gauges = np.array(levels) + NOISE * rng.standard_normal((ROWS, 2))
    columns = {"time": STEP * np.arange(ROWS), "pump_left": pumps[:, 0], "pump_right": pumps[:, 1]}
    return write_log(path, columns | {"gauge_left": gauges[:, 0], "gauge_right": gauges[:, 1]})


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("storages")
    fmu = build(folder / "tanks.fmu", "tanks", ways=("co_simulation",))
    logs = [leaking_tanks(folder / f"{name}.csv", seed).name for seed, name in enumerate(("e1", "e2", "v1"))]
    content = {"model": fmu.name, "logs": {"estimation": logs[:2], "validation": logs[2:]}, "tolerance": 0.02}
    path = folder / "study.yaml"
    path.write_text(json.dumps(content))
    return path


def test_a_leak_comes_in_through_the_pump_of_its_tank(study: Path) -> None:
    given = read_study(study)
    problem = build_problem(given.subject, given.logs, noise={"gauge_left": NOISE, "gauge_right": NOISE})
    plain, right, wrong = (
        problem.score({**problem.values, f"leak_at_{name}.coefficient": value}, problem.plain).nll
        for name, value in (("gauge_right", 0.0), ("gauge_right", LEAK), ("gauge_left", LEAK))
    )
    assert right < min(plain, wrong) - 500.0


@pytest.mark.thorough
@pytest.mark.xfail(strict=True, reason="ambiguous: a further part beside the leak")
def test_a_leak_of_a_tank_is_named_in_co_simulation(study: Path, tmp_path: Path) -> None:
    result = cosim.refine(study, tmp_path / "out").record
    (found,) = result["effects"]
    assert (found["name"], result["grade"]) == ("leak_at_gauge_right", "claimed")
    value = found["parameters"]["coefficient"]
    assert value["unit"] == "1/s"
    low, high = value["ci95"]
    assert low < LEAK < high
    after, floor = result["error"]["after"]["validation"], result["noise_floor"]
    assert after["gauge_right"] < 1.2 * floor["gauge_right"]
