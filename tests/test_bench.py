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
from plant.identification.recordings import Recording, play
from plant.powertrain import ground_effect, servo_angle, thrust_out_of_ground
from tests.hosts_fmpy import Instance

REST = (5.0, 7.5, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
GRAM = 9.81e-3  # [N]
CONVERTER_STEP = 3.3 / 4095  # [V]


def after(bench: Bench, seconds: float, **inputs: float) -> dict[str, float]:
    """Outputs after some seconds of inputs held."""
    command = tuple(inputs.get(q.name, v) for q, v in zip(bench.inputs, REST, strict=True))
    stepper = Stepper(bench)
    moment = stepper.start()
    for _ in range(round(seconds / 0.02)):
        moment = stepper.step(moment, command, 0.02)
    outputs = stepper.output(moment.t, moment.state, command)
    return dict(zip((q.name for q in bench.outputs), outputs, strict=True))


def test_the_fmu_of_the_bench_is_valid_and_reads_what_the_equations_read_as_arrays(tmp_path: Path) -> None:
    (tmp_path / "bench.yaml").write_text("schema_version: 1\nmodel: bench\n")
    (fmu,) = build(tmp_path, str(tmp_path / "bench.yaml"))
    assert validate_fmu(str(fmu)) == []
    time, rng = 0.02 * np.arange(150), np.random.default_rng(3)
    duty, servo = 5.0 + 0.01 * np.arange(150), 7.5 + np.sin(time)
    noise, height = 0.01 * rng.standard_normal((3, 150)), np.full(150, 0.095)
    run = Recording("a run", time, duty, servo, height, low_pass=0.1, noise=noise, thrust=1.02)
    (played,) = play(Bench(lag=0.07), [run])
    with Instance(fmu) as bench:
        bench.initialize({"lag": 0.07, "thrust_factor": 1.02, "filter_time": 0.1})
        for k in range(1, 150):
            commands = {"duty": duty[k - 1], "servo_duty": servo[k - 1], "height": 0.095}
            read = bench.step(time[k - 1], 0.02, commands | {f"noise_{c}": noise[j, k] for j, c in enumerate("zxm")})
            assert [read[f"volts_{c}"] for c in "zxm"] == pytest.approx([played.volts[c][k] for c in "zxm"], abs=1e-9)


def test_the_servo_stops_within_its_dead_band_from_either_side() -> None:
    bench = Bench()
    for duty, side in ((8.5, -0.5), (6.5, 0.5)):
        told = servo_angle(duty, bench.servo_neutral, bench.servo_slope)
        stopped = after(bench, 3.0, servo_duty=duty)["tilt_actual"]
        assert stopped == pytest.approx(told + side * bench.servo_dead_band, abs=1e-9)
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


def test_the_servo_is_never_faster_than_60_degrees_in_140_ms() -> None:
    bench = Bench()
    target = bench.servo_neutral + math.radians(80) / bench.servo_slope  # 1.4 rad over 0.0884 s would be 16 rad/s
    tilt = after(bench, 0.04, servo_duty=target)["tilt_actual"]
    assert tilt == pytest.approx(0.04 * math.radians(60) / 0.14, rel=1e-9)


def test_the_vertical_cell_of_app_c_ends_at_285_gf_and_so_test_1_saturates() -> None:
    bench = Bench()
    assert after(bench, 0.1, load_z=280 * GRAM)["volts_z"] > 5 * CONVERTER_STEP
    assert after(bench, 0.1, load_z=286 * GRAM)["volts_z"] == 0.0
    assert after(bench, 3.0, duty=6.53)["volts_z"] > 0.0  # 274 gf
    assert after(bench, 3.0, duty=7.0)["volts_z"] == 0.0  # 443 gf


def test_a_reading_is_a_whole_number_of_steps_of_12_bit() -> None:
    steps = after(Bench(), 1.0, load_x=0.7)["volts_x"] / CONVERTER_STEP
    assert steps == pytest.approx(round(steps), abs=1e-9)


def test_the_low_pass_lets_63_percent_through_after_its_time() -> None:
    bench = Bench(filter_time=0.5)
    rest, end = after(bench, 1.0)["volts_x"], after(bench, 10.0, load_x=1.0)["volts_x"]
    now = after(bench, 0.5, load_x=1.0)["volts_x"]
    assert (now - rest) / (end - rest) == pytest.approx(1.0 - math.exp(-1.0), abs=0.002)  # steps of the converter
