"""The testing bench: power-train on three load cells, ch. 3, App. B and C; its FMU."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from fmpy.validation import validate_fmu

from cosim.fmi.building.build import build
from cosim.model import Stepper
from cosim.model.namespaces import SCALAR
from plant.bench import Bench
from plant.identification.recordings import Recording, play_on_fmu
from plant.powertrain import ground_effect, servo_angle, thrust_out_of_ground
from tests.bench_runs import play_plain

REST = (5.0, 7.5, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def after(bench: Bench, seconds: float, **inputs: float) -> dict[str, float]:
    """Outputs after some seconds of inputs held."""
    command = tuple(inputs.get(q.name, v) for q, v in zip(bench.inputs, REST, strict=True))
    stepper = Stepper(bench)
    moment = stepper.start()
    for _ in range(round(seconds / 0.02)):
        moment = stepper.step(moment, command, 0.02)
    outputs = stepper.output(moment.t, moment.state, command)
    return dict(zip((q.name for q in bench.outputs), outputs, strict=True))


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench")
    (folder / "bench.yaml").write_text("schema_version: 1\nmodel: bench\n")
    (built,) = build(folder, str(folder / "bench.yaml"))
    return built


def test_the_fmu_of_the_bench_is_valid(fmu: Path) -> None:
    assert validate_fmu(str(fmu)) == []


def test_the_fmu_reads_what_the_equations_read_as_arrays(fmu: Path) -> None:
    time, rng = 0.02 * np.arange(150), np.random.default_rng(3)
    duty, servo = 5.0 + 0.01 * np.arange(150), 7.5 + np.sin(time)
    noise, height = 0.01 * rng.standard_normal((3, 150)), np.full(150, 0.095)
    run = Recording("a run", time, duty, servo, height, low_pass=0.1, noise=noise, thrust=1.02)
    (by_fmu,), (plain,) = play_on_fmu(fmu, {"lag": 0.07}, [run]), play_plain(Bench(lag=0.07))([run])
    for cell in "zxm":
        np.testing.assert_allclose(by_fmu.volts[cell], plain.volts[cell], atol=1e-9)


def test_the_servo_stops_within_its_dead_band_from_either_side() -> None:
    bench = Bench()
    told = servo_angle(8.5, bench.servo_neutral, bench.servo_slope)
    assert after(bench, 3.0, servo_duty=8.5)["tilt_actual"] == pytest.approx(
        told - 0.5 * bench.servo_dead_band, abs=1e-9
    )
    told = servo_angle(6.5, bench.servo_neutral, bench.servo_slope)
    assert after(bench, 3.0, servo_duty=6.5)["tilt_actual"] == pytest.approx(
        told + 0.5 * bench.servo_dead_band, abs=1e-9
    )
    within = bench.servo_neutral + 0.4 * bench.servo_dead_band / bench.servo_slope
    assert after(bench, 3.0, servo_duty=within)["tilt_actual"] == 0.0


def test_forces_are_thrust_times_ground_effect_projected() -> None:
    bench = Bench()
    out = after(bench, 3.0, duty=6.3, servo_duty=8.0, height=0.095)
    thrust = thrust_out_of_ground(SCALAR, 6.3, -2076.0, 359.9, 9.81) * ground_effect(SCALAR, 0.095, 0.127, 1.902)
    assert out["thrust_actual"] == pytest.approx(thrust, rel=1e-9)
    assert out["force_x"] == pytest.approx(thrust * math.sin(out["tilt_actual"]), rel=1e-9)  # 4.8
    assert out["force_z"] == pytest.approx(thrust * math.cos(out["tilt_actual"]), rel=1e-9)  # 4.7
    assert out["moment"] == pytest.approx(0.145 * 9.81 * -1.170e-4 * math.sin(out["tilt_actual"]), rel=1e-9)  # 4.10
