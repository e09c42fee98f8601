"""Noise from 20 s at rest (5.44-5.46) and friction from the distance covered (§5.5), from logs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.errors import InputError
from cosim.fmi.building.file import read_model
from cosim.verbs.checks import check as check_files
from plant.hovercraft import SENSOR_VARIANCE, Hovercraft
from plant.identification.workflow import identify
from tests.independent import simulate
from tests.logs import write_log
from tests.tank import MODEL, OUTLET

IMU = ("psi", "psi_dot", "ax")


def noisy(rng: np.random.Generator, rows: int) -> dict[str, np.ndarray]:
    return {n: np.sqrt(SENSOR_VARIANCE[n]) * rng.standard_normal(rows) for n in IMU}


def at_rest(path: Path, seed: int, seconds: float = 20.0) -> Path:
    time = 0.02 * np.arange(round(seconds / 0.02) + 1)
    return write_log(path, {"time": time, **noisy(np.random.default_rng(seed), time.size)})


def flown(path: Path, seed: int, friction: float) -> float:
    """A run forward; what the tape measure says of it, to a centimetre."""
    rng, time = np.random.default_rng(seed), 0.02 * np.arange(151)
    commands = np.tile(Hovercraft().start_command(), (time.size, 1))
    commands[10:80, 2:] = 0.09 + 0.01 * seed
    shown, noise = simulate(commands[:-1], numbers={"c": friction}), noisy(rng, time.size)
    inputs = dict(zip((q.name for q in Hovercraft.inputs), commands.T, strict=True))
    write_log(path, {"time": time, **inputs, **{n: shown[n] + noise[n] for n in IMU}})
    return float(shown["x"][-1]) + 0.005 * float(rng.standard_normal())


def protocol(folder: Path, **content: object) -> Path:
    path = folder / "craft.yaml"
    path.write_text(json.dumps({"schema_version": 1, "name": "a craft", **content}))
    return path


def test_noise_and_friction_come_back_from_logs(tmp_path: Path) -> None:
    at_rest(tmp_path / "rest.csv", 1)
    covered = [flown(tmp_path / f"run{k}.csv", k, friction=0.32) for k in range(3)]
    files = [f"run{k}.csv" for k in range(3)]
    asked = {"parameter": "friction", "output": "x", "covered": covered, "files": files}
    path = protocol(tmp_path, rest={"files": ["rest.csv"]}, distance=asked)
    outcome = identify(path, tmp_path / "out")
    found = outcome.estimates
    for name in IMU:
        e = found[f"rest.{name}"]
        # 1001 rows: χ² gives ± 9 % at 95 %; five standard errors are 22 %
        assert e.value == pytest.approx(SENSOR_VARIANCE[name], rel=0.22)
        assert e.low < e.value < e.high
    friction = found["distance.friction"]
    assert friction.value == pytest.approx(0.32, abs=0.02)  # 5 mm of some 1.5 m, three runs
    assert friction.low < 0.32 < friction.high
    # the observer is told the accelerations and relies little on c: what it needs is off by more
    assert abs(friction.thesis - 0.32) > abs(friction.value - 0.32)
    left = read_model(tmp_path / "out" / "model.yaml")
    assert left.model.friction == friction.value  # type: ignore[attr-defined]
    assert json.loads((tmp_path / "out" / "identify.json").read_text())["estimates"]["rest.ax"]["unit"] == "m2/s4"
    assert check_files([path]) == []


def test_the_interval_of_a_variance_holds_it_in_95_of_100(tmp_path: Path) -> None:
    rng, time, names = np.random.default_rng(2), 0.02 * np.arange(1001), [q.name for q in Hovercraft.outputs]
    path, estimates = protocol(tmp_path, model="base", rest={"files": ["rest.csv"]}), list[Any]()
    while len(estimates) < 400:
        write_log(tmp_path / "rest.csv", {"time": time, **{n: 0.2 * rng.standard_normal(time.size) for n in names}})
        estimates += identify(path, tmp_path / f"out{len(estimates)}", report=False).estimates.values()
    share = np.mean([e.low <= 0.04 <= e.high for e in estimates])
    assert 0.92 <= share <= 0.98  # 95 % ± three standard errors of 1.1 %


def test_a_tank_s_area_is_found_from_how_far_it_fell(tmp_path: Path) -> None:
    (tmp_path / "tank.py").write_text(MODEL, encoding="utf-8")
    time, fallen, files = 0.5 * np.arange(81), [], ["0.csv", "1.csv", "2.csv"]
    for file, area in zip(files, (0.70, 0.71, 0.69), strict=True):
        level = (1.0 - 0.5 * OUTLET / area * time) ** 2  # Torricelli
        inflow = np.where(time < 40.0, 0.0, 0.01)  # a command has to change; this one acts after the last row
        write_log(tmp_path / file, {"time": time, "inflow": inflow, "level": level})
        fallen.append(level[-1] - 1.0)
    asked = {"parameter": "area", "output": "level", "covered": fallen, "files": files}
    found = identify(protocol(tmp_path, model="tank.py:Tank", distance=asked), tmp_path / "out", report=False).estimates
    assert found["distance.area"].value == pytest.approx(0.70, abs=2e-3)
    assert np.isnan(found["distance.area"].thesis)  # its observer is of a craft


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (
            {
                "rest": {"files": ["short.csv"]},
                "distance": {"parameter": "frictoin", "output": "z", "covered": [1.5, 1.5], "files": list("abc")},
            },
            ("frictoin", '"friction"', '"z"', "2 distances for 3 files", "a: no such file", ":1:"),
        ),
        ({"rest": {"files": ["short.csv", "moving.csv"]}}, ("26 rows of psi", "50", "moving.csv: psi")),
    ],
)
def test_every_fault_of_a_file_is_named(tmp_path: Path, content: dict[str, Any], named: tuple[str, ...]) -> None:
    at_rest(tmp_path / "short.csv", 1, seconds=0.5)
    time = 0.02 * np.arange(501)
    write_log(tmp_path / "moving.csv", {"time": time, "psi": 0.001 * np.sin(7 * time) + 0.1 * time})
    with pytest.raises(InputError) as error:
        identify(protocol(tmp_path, **content), tmp_path / "out")
    assert error.value.exit_code == 2
    assert not (tmp_path / "out" / "model.yaml").exists()
    assert [part for part in named if part not in str(error.value)] == []
