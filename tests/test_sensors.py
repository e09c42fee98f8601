"""Sensors that sit off the centre, drift or are late, and an input of another gain: ready for any model."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.estimation.kernel.backend import kernel
from cosim.estimation.kernel.kernel import Data
from cosim.estimation.posing import build_problem
from cosim.fmi.building.file import own_model
from cosim.model import Model, Stepper
from cosim.model.namespaces import SCALAR
from cosim.refinement.proof.measure import Variant
from cosim.refinement.study import read_study
from plant.sensor_errors import MagnetometerDisturbance
from tests.logs import times, write_log
from tests.studies import holds, named, proven, replayed, study_of

STEP = 0.02
ROVER = '''
from dataclasses import dataclass

from cosim.model import Bias, Drift, Equations, Gain, Latency, LeverArm, Model, Quantity, parameter, size

SENSORS = (
    LeverArm.named(
        "marker_lever_arm", outputs=("x", "y"), others=("psi",), carried=lambda e, m, psi: (m.cos(psi), m.sin(psi))
    ),
    LeverArm.named(
        "accelerometer_lever_arm", output="ahead", others=("rate",), carried=lambda e, m, rate: (-rate * rate,)
    ),
    Bias.named("gyro_bias", output="rate", value=size("rad/s", (-1, 1), 0.02, "bias b")),
    Drift.named("gyro_drift", output="rate", value=size("rad/s2", (-1, 1), 2e-3, "drift d")),
    Latency.named("camera_latency", outputs=("x", "y")),
)


@dataclass(frozen=True, kw_only=True)
class Rover(Model):
    """A body that moves along its heading."""

    base_states = (
        Quantity("x", "m", ""), Quantity("y", "m", ""), Quantity("psi", "rad", "to the left"),
        Quantity("speed", "m/s", ""), Quantity("rate", "rad/s", ""),
    )
    inputs = (Quantity("force", "N", "forward"), Quantity("moment", "N.m", "to the left"))
    outputs = (*base_states[:3], base_states[4], Quantity("ahead", "m/s2", "acceleration along the heading"))
    catalogue, sensors = (Gain.named("motor_gain", input="force"),), SENSORS
    sensor_variance = {"x": 1e-6, "y": 1e-6, "psi": 4e-6, "rate": 2.5e-5, "ahead": 4e-4}
    forced, calibrated = ("speed", "rate"), ("mass",)
    mass: float = parameter(2.0, unit="kg", bounds=(0.1, 50), doc="mass")

    def equations(self, m):
        def ahead(state, command):
            return command[0] / self.mass - 0.8 * state[3]

        def derivative(t, state, command):
            psi, speed, rate = state[2:]
            return speed * m.cos(psi), speed * m.sin(psi), rate, ahead(state, command), command[1] / 0.1 - 1.5 * rate

        return Equations(derivative, lambda t, state, command: (*state[:3], state[4], ahead(state, command)))
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rover")
    (folder / "rover.py").write_text(ROVER, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def rover(folder: Path) -> Model:
    """The rover of one's own."""
    return own_model("rover.py:Rover", folder)


def commands(count: int) -> Array:
    """Force and moment, (rows, 2), held for half a second each."""
    rng = np.random.default_rng(3)
    return np.repeat(rng.uniform(-1, 1, (count // 25 + 1, 2)) * (3.0, 0.5), 25, axis=0)[:count]


def outputs_of(stepper: Stepper, rows: Array) -> Array:
    """Return the outputs of a run from rest."""
    moment, found = stepper.start(), []
    for command in rows.tolist():
        found.append(stepper.output(moment.t, moment.state, tuple(command)))
        moment = stepper.step(moment, tuple(command), STEP)
    return np.array(found)


def simulated(rover: Model, state: tuple[float, ...], data: Data, **values: float) -> Array:
    """Return the outputs of the kernel from a state."""
    compiled = kernel(rover, [q.name for q in rover.outputs])
    known = {p.name: p.default for p in rover.parameters} | {"disturbance.time": 0.15, "motor_gain.gain": 1.0} | values
    p = np.array([known.get(name, 0.0) for name in compiled.layout.parameters])
    start = np.array([*state, *np.zeros(len(compiled.layout.states) - 5)])
    return compiled.simulate(data, p, start, np.zeros(0)).outputs


# -- readings -----------------------------------------------------------------------------------


def test_the_kernel_reads_with_every_error_of_a_sensor_in_its_order(rover: Model) -> None:
    errors = {"marker_lever_arm": 0.1, "accelerometer_lever_arm": -0.2, "gyro_bias": 0.03, "gyro_drift": 0.004}
    data = Data(STEP, 5.0, np.zeros((1, 2)), np.zeros((1, 5)), 4)
    values = {f"{name}.value": value for name, value in errors.items()}
    (read,) = simulated(rover, (0.3, -0.2, 0.7, 0.5, 1.1), data, **values)
    expected = [0.3 + 0.1 * math.cos(0.7), -0.2 + 0.1 * math.sin(0.7), 0.7, 1.1 + 0.03 + 0.004 * 5.0]
    assert read == pytest.approx([*expected, -0.8 * 0.5 + 0.2 * 1.1**2], rel=1e-12)


def test_the_motors_turn_the_heading_that_a_magnetometer_reads_by_their_thrust_and_not_at_hover() -> None:
    hover = {"psi": 0.3, "thrust_right": 2.4973, "thrust_left": 2.4973}
    kind = MagnetometerDisturbance
    assert kind(value=0.05).readings(SCALAR, 1.0, hover) == {"psi": pytest.approx(0.3)}
    assert kind(value=0.05).readings(SCALAR, 1.0, hover | {"thrust_left": 3.4973}) == {"psi": pytest.approx(0.35)}
    assert kind().readings(SCALAR, 1.0, hover | {"thrust_left": 3.4973}) == {"psi": 0.3}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('outputs=("x", "y"), others', 'outputs=("x", "z"), others', 'no output "z"'),
        ("(m.cos(psi), m.sin(psi))", "(m.cos(psi),)", "marker_lever_arm raises"),
        ('input="force"', 'input="forse"', 'no input "forse"; did you mean "force"?'),
        ('value=size("rad/s",', 'more=size("rad/s",', '"value"'),
        ('output="rate", value=size("rad/s2"', 'outputs=("rate", "ahead"), value=size("rad/s2"',
         "`read` returns one output"),
    ],
)  # fmt: skip
def test_a_sensor_or_a_gain_of_what_is_not_there_is_told(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in ROVER
    (tmp_path / "rover.py").write_text(ROVER.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError) as error:
        own_model("rover.py:Rover", tmp_path)
    assert any(message in fault.message for fault in error.value.faults), error.value
    assert all(fault.line for fault in error.value.faults if "raises" not in fault.message)


# -- studies ------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_camera_that_is_three_rows_late_is_named_on_logs_of_the_craft(tmp_path: Path) -> None:
    """No other sensor is: the duty varies, so that a magnetometer that the motors disturb would show."""
    study = study_of(tmp_path / "study", {}, "nothing", duty_varied=True)
    few = "[camera_latency, actuator_delay, magnetometer_disturbance, gyro_bias]"
    study.write_text(study.read_text().partition("candidates:")[0] + f"candidates: {few}\n")
    for log in study.parent.glob("*.csv"):
        header, *rows = log.read_text().splitlines()
        table = np.array([row.split(",") for row in rows])
        for column in (header.split(",").index(name) for name in ("x_world", "y_world")):
            table[:, column] = ["", "", "", *table[:-3, column]]
        log.write_text("\n".join([header, *map(",".join, table.tolist())]) + "\n")
    r = proven(study, tmp_path / "out")
    assert (r.record["verdict"], named(r)) == ("sensor_error", {"camera_latency"})
    assert holds(r, "camera_latency", "value", 0.06)
    after, floor = r.record["error"]["after"]["validation"], r.record["noise_floor"]
    assert max(after[name] / floor[name] for name in ("x_world", "y_world")) < 1.2


# -- what was known by then ---------------------------------------------------------------------


def test_a_replay_knows_nothing_that_was_logged_after_its_start(folder: Path, rover: Model, tmp_path: Path) -> None:
    """With a camera that is 0.1 s late: the filter puts its readings five rows earlier, before they had arrived."""
    time = times(8.0)
    u, noise = commands(time.size), np.random.default_rng(100).standard_normal((time.size, 5))
    seen = outputs_of(Stepper(rover), u)
    seen[5:, :2] = seen[:-5, :2]
    seen += noise * (1e-3, 1e-3, 2e-3, 5e-3, 0.02)
    readings = {q.name: column for q, column in zip(rover.outputs, seen.T, strict=True)}
    write_log(folder / "e1.csv", {"time": time, "force": u[:, 0], "moment": u[:, 1], **readings})
    (folder / "study.yaml").write_text("model: rover.py:Rover\nlogs: {estimation: [e1.csv]}\n")
    read = read_study(folder / "study.yaml")
    log, subject = read.logs[0], read.subject
    posed = build_problem(subject, read.logs)
    values = {**posed.values, "camera_latency.value": 0.1}
    variant = Variant(subject, values, posed.plain)
    start = 200  # of the second replay, at 4 s
    rows = slice(start + 1, start + 100)

    def replay(first: int) -> Array:
        """Return a replay of the log with other readings from a row on."""
        changed = {n: np.where(np.arange(log.rows) >= first, y + 0.5, y) for n, y in log.outputs.items()}
        one = replayed(variant, posed, [replace(log, outputs=changed)], tmp_path)[subject.horizon][0][1]
        return np.column_stack([y[rows] for y in one.outputs.values()])

    untouched = replay(log.rows)
    np.testing.assert_array_equal(replay(start + 1), untouched)
    # and what had arrived does count: a reading of the row itself
    assert np.abs(replay(start) - untouched).max() > 1e-3
