"""Outliers of the recorder are removed, sharp motion of the system is not."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from cosim.core.arrays import Array
from cosim.fmi.building.file import load_model
from cosim.fmi.building.own_run import predicted_outputs
from cosim.fmi.building.substep import with_substep
from cosim.logs.log import Log, read_log
from cosim.logs.spikes import drop_outliers, find_spikes
from cosim.refinement.study import read_study
from cosim.verbs.checks import check as check_files
from tests.logs import write_log
from tests.motor import motor_file, motor_log

ROWS, NOISE = 600, 0.01


def left_out(values: Array, step: float = 0.005) -> list[int]:
    time = step * np.arange(values.size)
    log = Log(Path("a.csv"), time, {"u": 0.0 * time}, {"y": values}, {"y": "m"}, step, {}, {})
    spikes = find_spikes(log)
    gone = np.flatnonzero(np.isfinite(values) & np.isnan(drop_outliers(log, spikes).outputs["y"])).tolist()
    assert {n: rows.tolist() for n, rows in spikes.items()} == ({"y": gone} if gone else {})
    return gone


@pytest.fixture
def moving() -> Array:
    """A slow swing, a tilt and noise."""
    k = np.arange(ROWS)
    swing = 0.8 * np.sin(2.0 * np.pi * k / 150.0) + 2e-3 * k
    return np.asarray(swing + NOISE * np.random.default_rng(3).standard_normal(ROWS))


@pytest.mark.parametrize(
    ("wild", "missing"),
    [
        ([200], [201]),
        ([200], [199, 202]),
        ([200, 201], []),
        ([200, 202, 203], []),
        ([200, 203], [201]),
        ([200, 400, 401], [402]),
    ],
)
def test_wild_readings_are_left_out_wherever_they_stand(moving: Array, wild: list[int], missing: list[int]) -> None:
    moving[wild] += 30.0 * NOISE * np.where(np.arange(len(wild)) % 3 == 1, -1.0, 1.0)
    moving[missing] = np.nan
    for step in (0.005, 60.0):
        assert left_out(moving, step) == wild


@pytest.mark.parametrize("size", [0.5, 1.0, 5.0])
def test_a_step_a_kink_a_pulse_and_a_quick_oscillation_are_motion(moving: Array, size: float) -> None:
    k = np.arange(ROWS)
    motions = {
        "step": size * (k > 200),
        "kink": 0.1 * size * np.maximum(0, k - 200),
        "pulse of three rows": size * ((k >= 200) & (k < 203)),
        "decay": size * np.where(k >= 200, np.exp(-(k - 200) / 4.0), 0.0),
        "oscillation of eight rows": size * np.sin(2.0 * np.pi * k / 8.0) * (k >= 200),
    }
    for name, motion in motions.items():
        seen = moving + motion
        assert left_out(seen) == [], name
        seen[[199, 205]] = np.nan
        assert left_out(seen) == [], f"{name} beside readings that are missing"


LIGHT = 4e-5  # kg.m2, a shaft that follows within a row: each step of the voltage is a reading or two of inrush current
PLANTED = [37, 160, 341, 520, 777, 922, 1130]  # rows, none within two of a step of the voltage


@pytest.mark.thorough
@pytest.mark.parametrize("inertia", [LIGHT, 1.3 * LIGHT, 0.75 * LIGHT])
def test_an_inrush_current_is_kept_and_a_recorders_reading_beside_it_is_not(tmp_path: Path, inertia: float) -> None:
    """Alike in check and refine, and with a model that is not exact."""
    text = motor_file(tmp_path).read_text()
    (tmp_path / "motor.py").write_text(text.replace("parameter(2e-4", f"parameter({inertia}"))
    name = f"{tmp_path / 'motor.py'}:Motor"
    model = with_substep(load_model(name, Path()))[0].model
    path = motor_log(tmp_path / "a.csv", 1, seconds=24.0, inertia=LIGHT)
    log = read_log(path, model.inputs, model.outputs)
    assert find_spikes(log, lambda _: {})["current"].size > 15  # by neighbours alone
    assert find_spikes(log, partial(predicted_outputs, model, log)) == {}
    assert find_spikes(log) == {}  # without a model: an output may answer a step

    log.outputs["current"][PLANTED] += 4.0
    write_log(path, {"time": log.time, **log.inputs, **log.outputs})
    (tmp_path / "study.yaml").write_text("model: motor.py:Motor\nlogs: {estimation: [a.csv]}\n")
    said = [text for text in read_study(tmp_path / "study.yaml").warnings if "current" in text]
    (checked,) = [line for line in check_files(path, name) if "current" in line and "readings" in line]
    for text in ("\n".join(said), checked):
        assert f"{len(PLANTED)} readings" in text
