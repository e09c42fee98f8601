"""Springs and dampers between two pairs of an FMU: probed, a place of terms; constancy of their numbers."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import cosim
from cosim.probing.places import probe_places
from cosim.terms.language import RatioFactor
from tests.blind.fmu_build import build
from tests.logs import write_log
from tests.test_refine_fmu import write_study

STEP, NOISE = 0.005, {"motor.phi": 2e-3, "motor.w": 0.05, "load.phi": 2e-3}
GAP = 0.01  # [rad]
MOTOR, LOAD, SPRING, DAMPER, BEARING = 0.01, 0.03, 40.0, 0.1, 0.02  # of tests/blind/fmus/drive.c


def run_drive(path: Path, seed: int, gap: float, seconds: float = 6.0) -> Path:
    """Write a log of the drive with free play in its shaft."""
    rng = np.random.default_rng(seed)
    time = STEP * np.arange(round(seconds / STEP) + 1)
    levels = rng.uniform(-1.5, 1.5, 1 + int(seconds / 0.4))
    torque = levels[(time // 0.4).astype(int)]

    def rates(_: float, x: Any, u: float) -> list[float]:
        a, w, b, v = x
        through = SPRING * math.copysign(max(0.0, abs(a - b) - gap), a - b) + DAMPER * (w - v)
        return [w, (u - BEARING * w - through) / MOTOR, v, (through - 0.03 * v) / LOAD]

    rows = [np.zeros(4)]
    for u in torque[:-1]:
        rows.append(solve_ivp(rates, (0.0, STEP), rows[-1], "RK45", args=(u,), rtol=1e-6, atol=1e-8).y[:, -1])
    states = np.array(rows).T
    readings = {n: states[k] + NOISE[n] * rng.standard_normal(time.size) for n, k in zip(NOISE, (0, 1, 2), strict=True)}
    return write_log(path, {"time": time, "torque": torque, **readings})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    build(folder / "drive.fmu", "drive")
    for k, name in enumerate(("e1", "e2", "v1")):
        run_drive(folder / f"{name}.csv", k, GAP)
    return folder


def refine_drive(folder: Path, candidates: list[str]) -> dict[str, Any]:
    """Return the record of a refinement with the given candidates."""
    logs = [folder / f"{n}.csv" for n in ("e1", "e2")]
    keys = {"noise": NOISE, "candidates": candidates, "tolerance": {"shaft.c": 0.02}}
    study = write_study(folder, folder / "drive.fmu", logs, [folder / "v1.csv"], **keys)
    cosim.refine(study, folder / "refined", force=True)
    return dict(json.loads((folder / "refined" / "refine.json").read_text()))


def test_a_shaft_is_a_connection_and_a_shared_inertia_is_none(tmp_path: Path) -> None:
    (shaft,) = probe_places(build(tmp_path / "drive.fmu", "drive")).structure.connections
    assert (shaft.first.velocity, shaft.second.velocity) == ("motor.w", "load.w")
    assert (shaft.gear, shaft.ratio) == pytest.approx((1.0, MOTOR / LOAD))
    assert (shaft.stiffness, shaft.damping) == pytest.approx((SPRING / MOTOR, DAMPER / MOTOR))
    assert shaft.factors == (RatioFactor("motor.J", MOTOR, 0.0, 1.0), RatioFactor("load.J", LOAD, 0.0, -1.0))
    assert not probe_places(build(tmp_path / "pendulum.fmu", "pendulum")).structure.connections


def test_free_play_in_a_shaft_is_named_with_its_width(folder: Path) -> None:
    places = ("gap", "cubic_spring", "coulomb")
    record = refine_drive(folder, ["shaft.c", "bias_at_torque", *(f"{k}_at_motor_w_against_load_w" for k in places)])
    assert record["verdict"] == "effect_found", record["sentence"]
    (gap,) = (e for e in record["effects"] if e["name"] == "gap_at_motor_w_against_load_w")
    low, high = gap["parameters"]["width"]["ci95"]
    assert low - 0.05 * GAP < GAP < high + 0.05 * GAP
    assert {e["name"] for e in record["effects"]} <= {gap["name"], "shaft.c"}
    after, before = (np.mean([*record["error"][n]["validation"].values()]) for n in ("after", "recalibrated"))
    assert after < 0.5 * before
