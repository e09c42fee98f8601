"""The FMUs of the blind suite: sound in FMPy, and each fault of `fmu_build` is what it says."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

from cosim.fmi.native.compiler import compiler
from tests.blind.fmu_build import FAULTS, PLANTS, WAYS, build

pytestmark = pytest.mark.skipif(
    compiler() is None or platform.system() != "Linux", reason="needs a C compiler and Linux folders"
)
ROOT = Path(__file__).resolve().parent.parent
KINDS = {"model_exchange": "ModelExchange", "co_simulation": "CoSimulation"}


def simulated(path: Path, plant: str, way: str, count: int = 50, **more: Any) -> np.ndarray:
    """Simulate 50 rows with constant inputs in FMPy."""
    declared = PLANTS[plant]
    starts = {v.name: v.start + 0.2 for v in declared.inputs}
    step = 10.0 * declared.inner
    more = {"output_interval": step, "start_values": starts, "logger": lambda *_: None} | more
    if way == "model_exchange":
        more |= {"relative_tolerance": 1e-6}
    result = fmpy.simulate_fmu(str(path), fmi_type=KINDS[way], stop_time=count * step, record_events=False, **more)
    return np.column_stack([result[n] for n in declared.output_names])


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("plant", PLANTS)
def test_both_ways_of_both_versions_agree_in_fmpy(tmp_path: Path, plant: str, version: int) -> None:
    path = build(tmp_path / "plant.fmu", plant, version, ways=WAYS)
    exchange, steps = (simulated(path, plant, way) for way in WAYS)
    assert exchange.shape == steps.shape == (51, len(PLANTS[plant].outputs))
    assert np.all(np.ptp(steps, axis=0) > 0.0)
    assert np.max(np.abs(exchange - steps) / np.ptp(steps, axis=0)) < 1e-3


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_a_valid_fmu(tmp_path: Path, fault: str) -> None:
    for version in (2, 3):
        path = build(tmp_path / f"{version}.fmu", "drive", version, ways=WAYS, fault=fault)
        description = fmpy.read_model_description(str(path))
        assert description.modelExchange
        assert description.coSimulation
        assert bool([v for v in description.modelVariables if v.causality == "parameter"]) == FAULTS[fault].parameters


def test_the_binary_names_no_variable_and_no_function_of_the_plant(tmp_path: Path) -> None:
    with zipfile.ZipFile(build(tmp_path / "a.fmu", "drive")) as archive:
        (binary,) = [archive.read(n) for n in archive.namelist() if n.endswith(".so")]
        assert not any(n.endswith(".c") for n in archive.namelist())
    assert b"fmi2DoStep" in binary
    assert not any(word in binary for word in (b"rates", b"runge_kutta", b"motor", b"stiffness"))


def fmu(tmp_path: Path, fault: str) -> Path:
    return build(tmp_path / f"{fault}.fmu", "drive", ways=WAYS, fault=fault)


def test_parameters_are_forgotten_when_set_before_initialization(tmp_path: Path) -> None:
    sound, bad = fmu(tmp_path, ""), fmu(tmp_path, "forgets_parameters")
    heavy = {"torque": 1.0, "load.J": 0.3}  # FMPy sets fixed parameters before initialization mode
    plain = simulated(sound, "drive", "co_simulation", start_values={"torque": 1.0})
    assert np.max(np.abs(simulated(sound, "drive", "co_simulation", start_values=heavy) - plain)) > 1e-3
    assert np.array_equal(simulated(bad, "drive", "co_simulation", start_values=heavy), plain)


def test_two_runs_differ(tmp_path: Path) -> None:
    sound, counts, clock = (fmu(tmp_path, fault) for fault in ("", "counts", "clock"))
    for way in WAYS:
        assert np.array_equal(simulated(sound, "drive", way), simulated(sound, "drive", way))
    assert not np.array_equal(*(simulated(clock, "drive", "co_simulation") for _ in range(2)))
    folder = fmpy.extract(str(counts), str(tmp_path / "unzipped"))  # a library is loaded once
    instance = fmpy.instantiate_fmu(folder, fmpy.read_model_description(folder), "CoSimulation")
    runs = [simulated(Path(folder), "drive", "co_simulation", fmu_instance=instance) for _ in range(2)]
    instance.freeInstance()
    assert not np.array_equal(*runs)


def test_the_working_directory_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bad, runs = fmu(tmp_path, "working_directory"), []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        runs.append(simulated(bad, "drive", "co_simulation"))
    assert np.max(np.abs(runs[0] - runs[1])) > 1e-6


@pytest.mark.parametrize("fault", ["own_step", "hidden_own_step"])
def test_short_steps_are_whole_own_steps(tmp_path: Path, fault: str) -> None:
    def angle(fault: str, step: float) -> float:
        path, steps = str(fmu(tmp_path, fault)), {"step_size": step, "output_interval": step, "stop_time": 0.1}
        result = fmpy.simulate_fmu(path, fmi_type="CoSimulation", start_values={"torque": 0.2}, **steps)
        return float(result["motor.phi"][-1])

    assert angle(fault, 0.05) == pytest.approx(angle("", 0.05), rel=0.05)
    assert angle(fault, 0.01) > 4.0 * angle("", 0.01)


def test_instances_leak(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from tests.test_blind_fmu import resident; "
        "print(resident(Path(sys.argv[1])))"
    )
    grown = {}
    for fault in ("", "leaks"):
        done = subprocess.run(
            [sys.executable, "-c", code, str(fmu(tmp_path, fault))],
            capture_output=True,
            text=True,
            check=True,
            cwd=ROOT,
        )
        grown[fault] = int(done.stdout.split()[-1])
    assert grown["leaks"] > 16 << 20 > grown[""]


def resident(path: Path) -> int:
    """Return how much a process grows [bytes] by eight runs after the first."""

    def size() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")

    simulated(path, "drive", "co_simulation", 2)
    before = size()
    for _ in range(8):
        simulated(path, "drive", "co_simulation", 2)
    return size() - before


@pytest.mark.parametrize("fault", ["crashes", "hangs"])
def test_a_parameter_above_its_limit_ends_the_process(tmp_path: Path, fault: str) -> None:
    code = (
        "import sys; from pathlib import Path; from tests.test_blind_fmu import simulated; "
        "simulated(Path(sys.argv[1]), 'drive', 'co_simulation', 2, start_values={'motor.J': float(sys.argv[2])})"
    )
    command = [sys.executable, "-c", code, str(fmu(tmp_path, fault))]
    assert subprocess.run([*command, "0.0104"], check=False, capture_output=True, cwd=ROOT).returncode == 0
    if fault == "crashes":
        assert subprocess.run([*command, "0.0106"], check=False, capture_output=True, cwd=ROOT).returncode < 0
    else:
        with pytest.raises(subprocess.TimeoutExpired):
            subprocess.run([*command, "0.0106"], check=False, capture_output=True, cwd=ROOT, timeout=3)
