"""Springs and dampers between two pairs of an FMU: probed, a place of terms; constancy of their numbers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.probing.places import probe_places
from cosim.terms.language import RatioFactor
from tests.blind.fmu_build import build
from tests.logs import integrated, times, write_log
from tests.test_refine_fmu import write_study

STEP, NOISE = 0.005, {"motor.phi": 2e-3, "motor.w": 0.05, "load.phi": 2e-3}
GAP = 0.01  # [rad]
MOTOR, LOAD, SPRING, DAMPER, BEARING = 0.01, 0.03, 40.0, 0.1, 0.02  # of tests/blind/fmus/drive.c


def run_drive(path: Path, seed: int) -> None:
    """Write a log of the drive with free play in its shaft."""
    rng = np.random.default_rng(seed)
    time = times(6.0, STEP)
    levels = rng.uniform(-1.5, 1.5, 16)
    torque = levels[(time // 0.4).astype(int)]

    def rates(x: Any, u: float) -> list[float]:
        a, w, b, v = x
        through = SPRING * math.copysign(max(0.0, abs(a - b) - GAP), a - b) + DAMPER * (w - v)
        return [w, (u - BEARING * w - through) / MOTOR, v, (through - 0.03 * v) / LOAD]

    states = integrated(rates, [0.0] * 4, torque, STEP).T
    readings = {n: y + NOISE[n] * rng.standard_normal(time.size) for n, y in zip(NOISE, states, strict=False)}
    write_log(path, {"time": time, "torque": torque, **readings})


def test_a_shaft_is_a_connection_and_a_shared_inertia_is_none(tmp_path: Path) -> None:
    (shaft,) = probe_places(build(tmp_path / "drive.fmu", "drive")).structure.connections
    assert (shaft.first.velocity, shaft.second.velocity) == ("motor.w", "load.w")
    assert (shaft.gear, shaft.ratio) == pytest.approx((1.0, MOTOR / LOAD))
    assert (shaft.stiffness, shaft.damping) == pytest.approx((SPRING / MOTOR, DAMPER / MOTOR))
    assert shaft.factors == (RatioFactor("motor.J", MOTOR, 0.0, 1.0), RatioFactor("load.J", LOAD, 0.0, -1.0))
    assert not probe_places(build(tmp_path / "pendulum.fmu", "pendulum")).structure.connections


def test_free_play_in_a_shaft_is_named_with_its_width(tmp_path: Path) -> None:
    names = [f"{k}_at_motor_w_against_load_w" for k in ("gap", "cubic_spring", "coulomb")]
    keys = {"noise": NOISE, "candidates": ["shaft.c", "bias_at_torque", *names], "tolerance": {"shaft.c": 0.02}}
    logs = [tmp_path / f"{n}.csv" for n in ("e1", "e2", "v1")]
    for seed, log in enumerate(logs):
        run_drive(log, seed)
    study = write_study(tmp_path, build(tmp_path / "drive.fmu", "drive"), logs[:2], logs[2:], **keys)
    record = cosim.refine(study, tmp_path / "refined").record
    assert record["verdict"] == "effect_found", record["sentence"]
    effects = {e["name"]: e["parameters"] for e in record["effects"]}
    assert names[0] in effects
    assert {*effects} <= {names[0], "shaft.c"}
    low, high = effects[names[0]]["width"]["ci95"]
    assert low - 0.05 * GAP < GAP < high + 0.05 * GAP
    after, before = (np.mean([*record["error"][n]["validation"].values()]) for n in ("after", "recalibrated"))
    assert after < 0.5 * before
