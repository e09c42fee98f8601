"""Sensors that sit off the centre, drift or are late, and an input of another gain: ready for any model."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.estimation.kernel.backend import kernel
from cosim.estimation.kernel.kernel import Data
from cosim.estimation.posing import build_problem
from cosim.fmi.building.file import load_model, own_model
from cosim.fmi.fmu_build import build
from cosim.logs.log import read_log
from cosim.model import Model, SensorError, Stepper
from cosim.model.namespaces import SCALAR, arrays
from cosim.refinement.proof.measure import Variant
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.plots import compare_effects
from cosim.refinement.study import read_study
from cosim.residuals.drive import Drive
from cosim.residuals.windows import windows
from plant.hovercraft import Hovercraft
from plant.sensor_errors import (
    SENSORS,
    AccelerometerDrift,
    AccelerometerLeverArm,
    CameraLatency,
    GyroDrift,
    MagnetometerDisturbance,
)
from tests.logs import write_log
from tests.rover import ROVER, STEP, commands, rover_log, rover_study
from tests.studies import holds, named, proven, replayed, study_of


@pytest.fixture(scope="module")
def rover(tmp_path_factory: pytest.TempPathFactory) -> Model:
    """The rover of one's own."""
    folder = tmp_path_factory.mktemp("rover")
    (folder / "rover.py").write_text(ROVER, encoding="utf-8")
    return own_model("rover.py:Rover", folder)


def sensor_of(model: Model, name: str, value: float) -> SensorError:
    return next(kind for kind in model.sensors if kind.name == name)(value=value)


# -- readings -----------------------------------------------------------------------------------


def test_a_lever_arm_reads_what_a_point_of_the_turning_body_does(rover: Model) -> None:
    """The point in the complex plane, differentiated twice by differences: 1e-4 s apart they keep six digits."""
    arm, h, t = 0.17, 1e-4, 0.3

    def centre(t: float) -> complex:
        return complex(math.sin(2.0 * t), 0.4 * t * t)

    def heading(t: float) -> float:
        return 0.5 * math.sin(3.0 * t)

    def point(t: float) -> complex:
        return centre(t) + arm * complex(math.cos(heading(t)), math.sin(heading(t)))

    def ahead(of: Callable[[float], complex]) -> float:
        second = (of(t + h) - 2.0 * of(t) + of(t - h)) / h**2
        return (second * complex(math.cos(heading(t)), -math.sin(heading(t)))).real

    rate = (heading(t + h) - heading(t - h)) / (2.0 * h)
    there = {"x": centre(t).real, "y": centre(t).imag, "psi": heading(t), "rate": rate, "ahead": ahead(centre)}
    marker = sensor_of(rover, "marker_lever_arm", arm).readings(SCALAR, t, there)
    assert marker == pytest.approx({"x": point(t).real, "y": point(t).imag}, rel=1e-12)
    read = sensor_of(rover, "accelerometer_lever_arm", arm).readings(SCALAR, t, there)
    assert read["ahead"] == pytest.approx(ahead(point), rel=1e-6)
    of_craft = AccelerometerLeverArm(value=arm).readings(SCALAR, t, {"ax": there["ahead"], "psi_dot": rate})
    assert of_craft["ax"] == pytest.approx(ahead(point), rel=1e-6)


def test_a_drift_grows_with_the_clock_of_the_log_and_a_latency_changes_no_value() -> None:
    there = {"psi_dot": 0.2, "ax": -1.0, "x_world": 3.0, "y_world": 4.0}
    assert GyroDrift(value=1e-3).readings(SCALAR, 50.0, there) == {"psi_dot": pytest.approx(0.25)}
    assert AccelerometerDrift(value=-2e-2).readings(SCALAR, 50.0, there) == {"ax": pytest.approx(-2.0)}
    late = CameraLatency(value=0.06)
    assert late.readings(SCALAR, 50.0, there) == {"x_world": 3.0, "y_world": 4.0}
    assert late.affected() == ("x_world", "y_world")
    for kind in SENSORS:
        assert kind().dormant
        assert kind.affected() == tuple(n for n in kind.affected() if n in {q.name for q in Hovercraft.outputs})


def test_the_kernel_reads_with_every_error_of_a_sensor_in_its_order(rover: Model) -> None:
    compiled = kernel(rover, [q.name for q in rover.outputs])
    errors = {"marker_lever_arm": 0.1, "accelerometer_lever_arm": -0.2, "gyro_bias": 0.03, "gyro_drift": 0.004}
    values = {p.name: p.default for p in rover.parameters} | {"motor_gain.gain": 1.0, "disturbance.time": 0.15}
    values |= {f"{name}.value": value for name, value in errors.items()}
    p = np.array([values.get(name, 0.0) for name in compiled.layout.parameters])
    state, u = (0.3, -0.2, 0.7, 0.5, 1.1), np.zeros((1, 2))
    read = compiled.simulate(
        Data(0.02, 5.0, u, np.zeros((1, 5)), 4), p, np.array([*state, *np.zeros(len(compiled.layout.states) - 5)]),
        np.zeros(0),
    ).outputs[0]  # fmt: skip
    slowed = -0.8 * 0.5
    expected = [0.3 + 0.1 * math.cos(0.7), -0.2 + 0.1 * math.sin(0.7), 0.7, 1.1 + 0.03 + 0.004 * 5.0]
    assert read == pytest.approx([*expected, slowed + 0.2 * 1.1**2], rel=1e-12)


def test_the_motors_turn_the_heading_that_a_magnetometer_reads_by_their_thrust_and_not_at_hover() -> None:
    hover = {"psi": 0.3, "thrust_right": 2.4973, "thrust_left": 2.4973}
    kind = MagnetometerDisturbance
    assert kind(value=0.05).readings(SCALAR, 1.0, hover) == {"psi": pytest.approx(0.3)}
    assert kind(value=0.05).readings(SCALAR, 1.0, hover | {"thrust_left": 3.4973}) == {"psi": pytest.approx(0.35)}
    assert kind().readings(SCALAR, 1.0, hover | {"thrust_left": 3.4973}) == {"psi": 0.3}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('outputs, others = ("x", "y"), ("psi",)', 'outputs, others = ("x", "z"), ("psi",)', 'no output "z"'),
        ("return m.cos(psi), m.sin(psi)", "return (m.cos(psi),)", "`carried` of marker_lever_arm raises"),
        ('input = "force"', 'input = "forse"', 'motor_gain: no input "forse"; did you mean "force"?'),
        ('    input = "force"\n', "", "motor_gain: no input is named"),
        ('    name = "gyro_drift"\n    output = "rate"', '    name = "gyro_drift"\n    outputs = ("rate", "ahead")',
         "gyro_drift: `read` returns one output"),
    ],
)  # fmt: skip
def test_a_sensor_or_a_gain_of_what_is_not_there_is_told(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in ROVER
    (tmp_path / "rover.py").write_text(ROVER.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError) as error:
        own_model("rover.py:Rover", tmp_path)
    assert any(message in fault.message for fault in error.value.faults), error.value


# -- gain of an input ---------------------------------------------------------------------------


def test_a_gain_is_the_same_in_plant_batch_symbols_kernel_and_fmu(tmp_path: Path, rover: Model) -> None:
    """Everywhere what a command of 1.3 times the size does, in the output that takes the command too."""
    count = 40
    u, gain = commands(count, 3), 1.3
    more = u * (gain, 1.0)
    plain, gained = Stepper(rover), Stepper(rover.with_values({"motor_gain.gain": gain}))
    batch = Stepper(rover.with_values({"motor_gain.gain": np.array([1.0, gain])}), arrays())

    def run(stepper: Stepper, rows: Array) -> Array:
        moment, found = stepper.start(), []
        for command in rows.tolist():
            found.append([np.atleast_1d(v)[-1] for v in stepper.output(moment.t, moment.state, tuple(command))])
            moment = stepper.step(moment, tuple(command), STEP)
        return np.array(found)

    expected = run(plain, more)
    assert np.abs(expected - run(plain, u)).max() > 0.05
    np.testing.assert_allclose(run(gained, u), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run(batch, u), expected, rtol=0, atol=1e-12)
    compiled = kernel(rover, [q.name for q in rover.outputs])
    values = {p.name: p.default for p in rover.parameters} | {"motor_gain.gain": gain, "disturbance.time": 0.15}
    p = np.array([values.get(name, 0.0) for name in compiled.layout.parameters])
    data = Data(STEP, 0.0, u, np.full((count, 5), np.nan), 4)
    by_kernel = compiled.simulate(data, p, np.zeros(len(compiled.layout.states)), np.zeros(0)).outputs
    np.testing.assert_allclose(by_kernel, expected, rtol=0, atol=1e-10)
    (tmp_path / "rover.py").write_text(ROVER, encoding="utf-8")
    fmu = build(load_model("rover.py:Rover", tmp_path).recipe(), tmp_path / "rover.fmu")
    log = read_log(rover_log(tmp_path / "a.csv", 1, seconds=2.0), rover.inputs, rover.outputs)
    with Drive(log, fmu) as drive:
        replayed = windows(drive, {0: {"motor_gain.gain": gain}}, math.inf)
    by_fmu = run(gained, np.column_stack([log.inputs["force"], log.inputs["moment"]]))
    for k, q in enumerate(rover.outputs):
        np.testing.assert_allclose(replayed.outputs[q.name][1:], by_fmu[1:, k], rtol=0, atol=1e-9)


# -- studies ------------------------------------------------------------------------------------


def down_to_noise(r: Refinement, *channels: str) -> bool:
    """Replays through the FMU miss what the noise makes, a fifth more or less, where they missed twice that before."""
    for part, floor in r.record["noise_floors"].items():
        before, after = r.record["error"]["before"][part], r.record["error"]["after"][part]
        if not all(after[n] < 1.2 * floor[n] and before[n] > 2.0 * floor[n] for n in channels):
            return False
    return True


@pytest.mark.thorough
def test_a_camera_that_is_three_rows_late_is_named_on_logs_of_the_craft(tmp_path: Path) -> None:
    """No other sensor is: the duty varies, so that a magnetometer that the motors disturb would show."""
    study = study_of(tmp_path / "study", {}, "nothing", duty_varied=True)
    few = "[camera_latency, actuator_delay, magnetometer_disturbance, gyro_bias]"
    study.write_text(study.read_text().partition("candidates:")[0] + f"candidates: {few}\n")
    for name in ("e1.csv", "e2.csv", "v1.csv"):
        with (study.parent / name).open() as stream:
            header, *rows = csv.reader(stream)
        table = np.array(rows, dtype=float)
        for column in (header.index(n) for n in ("x_world", "y_world")):
            table[:, column] = np.concatenate([np.full(3, np.nan), table[:-3, column]])
        write_log(study.parent / name, dict(zip(header, table.T, strict=True)))
    r = proven(study, tmp_path / "out")
    assert (r.record["verdict"], named(r)) == ("sensor_error", {"camera_latency"})
    assert holds(r, "camera_latency", "value", 0.06)
    assert down_to_noise(r, "x_world", "y_world")
    (picture,) = compare_effects(r)
    assert picture.against.name.startswith("rate of ")
    slope, _ = np.polyfit(picture.against.values, picture.estimated, 1)
    assert slope == pytest.approx(-0.06, rel=0.05)  # late by T, a reading is off by −T·ẏ


# -- what was known by then ---------------------------------------------------------------------


def test_a_replay_knows_nothing_that_was_logged_after_its_start(tmp_path: Path) -> None:
    """With a camera that is 0.1 s late: the filter puts its readings five rows earlier, before they had arrived."""
    study = rover_study(tmp_path, late=0.1, seconds=8.0)
    read = read_study(study)
    log, subject = read.logs[0], read.subject
    posed = build_problem(subject, read.logs)
    values = {**posed.values, "camera_latency.value": 0.1}
    variant = Variant(subject, values, posed.plain)
    start = 200  # of the second replay, at 4 s
    after = log.time > log.time[start]
    other = replace(log, outputs={n: np.where(after, y + 0.5, y) for n, y in log.outputs.items()})
    runs = [replayed(variant, posed, [one], tmp_path)[subject.horizon][0][1] for one in (log, other)]
    rows = slice(start + 1, start + 100)
    for name, one in runs[0].outputs.items():
        np.testing.assert_array_equal(one[rows], runs[1].outputs[name][rows])
    # and what had arrived does count: a reading of the row itself
    before = replace(
        log, outputs={n: np.where(log.time >= log.time[start], y + 0.5, y) for n, y in log.outputs.items()}
    )
    counted = replayed(variant, posed, [before], tmp_path)[subject.horizon][0][1]
    assert np.abs(counted.outputs["x"][rows] - runs[0].outputs["x"][rows]).max() > 1e-3
