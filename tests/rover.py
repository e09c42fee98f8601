"""A rover as a model of one's own, and logs of one seen by sensors off its centre, drifting or late.

The truth is a rigid body in the complex plane, integrated by a code of its own in steps of a tenth of a row.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cosim.core.arrays import Array
from tests.logs import write_log

STEP, FINE = 0.02, 10  # [s], and steps of the truth to a row
MASS, INERTIA, DRAG, TURN_DRAG = 2.0, 0.1, 0.8, 1.5
NOISE = {"x": 1e-3, "y": 1e-3, "psi": 2e-3, "rate": 5e-3, "ahead": 0.02}
ROVER = '''"""A rover: a force forward, a moment, and drag."""

from dataclasses import dataclass

from cosim.model import Bias, Drift, Effect, Equations, Gain, Latency, LeverArm, Model, Quantity, overrides, parameter


class RoverEffect(Effect):
    """An acceleration that the base model lacks."""

    def slowed(self, m, speed):
        return 0.0


@dataclass(frozen=True, kw_only=True)
class AirDrag(RoverEffect):
    """Drag of the air."""

    name = "air_drag"
    equation = "acceleration -k*|v|*v"

    k: float = parameter(0.0, unit="1/m", bounds=(0, 10), neutral=0.0, typical=0.3, doc="drag over mass")

    def slowed(self, m, speed):
        return -self.k * m.where(speed >= 0.0, speed, -speed) * speed


@dataclass(frozen=True, kw_only=True)
class MotorGain(Gain, RoverEffect):
    """The motor is stronger than its sheet says."""

    name = "motor_gain"
    input = "force"


@dataclass(frozen=True, kw_only=True)
class MarkerLeverArm(LeverArm):
    """The marker that the camera sees is ahead of the centre."""

    name = "marker_lever_arm"
    outputs, others = ("x", "y"), ("psi",)

    def carried(self, m, psi):
        return m.cos(psi), m.sin(psi)


@dataclass(frozen=True, kw_only=True)
class AccelerometerLeverArm(LeverArm):
    """The accelerometer is ahead of the centre."""

    name = "accelerometer_lever_arm"
    output, others = "ahead", ("rate",)

    def carried(self, m, rate):
        return (-rate * rate,)


@dataclass(frozen=True, kw_only=True)
class GyroBias(Bias):
    """The gyroscope reads a rate at rest."""

    name = "gyro_bias"
    output = "rate"
    value: float = parameter(0.0, unit="rad/s", bounds=(-1, 1), neutral=0.0, typical=0.02, doc="bias b")


@dataclass(frozen=True, kw_only=True)
class GyroDrift(Drift):
    """The gyroscope warms up."""

    name = "gyro_drift"
    output = "rate"
    value: float = parameter(0.0, unit="rad/s2", bounds=(-1, 1), neutral=0.0, typical=2e-3, doc="drift d")


@dataclass(frozen=True, kw_only=True)
class CameraLatency(Latency):
    """The camera is late."""

    name = "camera_latency"
    outputs = ("x", "y")


@dataclass(frozen=True, kw_only=True)
class Rover(Model):
    """A body that moves along its heading."""

    base_states = (
        Quantity("x", "m", "position"), Quantity("y", "m", "position"), Quantity("psi", "rad", "heading, to the left"),
        Quantity("speed", "m/s", "along the heading"), Quantity("rate", "rad/s", "rate of the heading"),
    )
    inputs = (Quantity("force", "N", "forward"), Quantity("moment", "N.m", "to the left"))
    outputs = (*base_states[:3], base_states[4], Quantity("ahead", "m/s2", "acceleration along the heading"))
    catalogue = (MotorGain, AirDrag)
    sensors = (MarkerLeverArm, AccelerometerLeverArm, GyroBias, GyroDrift, CameraLatency)
    sensor_variance = {"x": 1e-6, "y": 1e-6, "psi": 4e-6, "rate": 2.5e-5, "ahead": 4e-4}
    start_variance = {"speed": 0.01, "rate": 0.01}
    forced = ("speed", "rate")
    calibrated = ("mass", "inertia", "drag", "turn_drag")

    mass: float = parameter(2.0, unit="kg", bounds=(0.1, 50), doc="mass")
    inertia: float = parameter(0.1, unit="kg.m2", bounds=(1e-3, 10), doc="inertia")
    drag: float = parameter(0.8, unit="1/s", bounds=(0, 20), doc="drag over mass")
    turn_drag: float = parameter(1.5, unit="1/s", bounds=(0, 20), doc="drag over inertia")

    def equations(self, m):
        terms = overrides(self.awake, "slowed", RoverEffect)

        def along(state, command):
            total = command[0] / self.mass - self.drag * state[3]
            for term in terms:
                total = total + term.slowed(m, state[3])
            return total

        def derivative(t, state, command):
            psi, speed, rate = state[2:]
            turning = command[1] / self.inertia - self.turn_drag * rate
            return speed * m.cos(psi), speed * m.sin(psi), rate, along(state, command), turning

        def output(t, state, command):
            return (*state[:3], state[4], along(state, command))

        return Equations(derivative, output)
'''


def commands(count: int, seed: int) -> Array:
    """Force and moment, (rows, 2), held for half a second each."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1, 1, (count // 25 + 1, 2)) * (3.0, 0.5), 25, axis=0)[:count]


def rover_log(
    path: Path, seed: int, *, seconds: float = 12.0, gain: float = 1.0, marker: float = 0.0, arm: float = 0.0,
    drift: float = 0.0, late: float = 0.0,
) -> Path:  # fmt: skip
    """A log of a rover from rest; what its sensors do wrong is done to vectors, not to the model's outputs."""
    count = round(seconds / STEP) + 1
    u, h = commands(count, seed), STEP / FINE
    place, psi, v, w = 0j, 0.0, 0.0, 0.0
    fine = []
    for k in range((count - 1) * FINE + 1):
        force, moment = u[k // FINE]
        ahead = gain * force / MASS - DRAG * v
        fine.append((place, psi, w, ahead))
        # the speeds exactly, the heading from its exact integral, the place by Simpson's rule
        ends = []
        for part in (0.5 * h, h):
            fade, turned = np.exp(-DRAG * part), np.exp(-TURN_DRAG * part)
            to, around = gain * force / MASS / DRAG, moment / INERTIA / TURN_DRAG
            heading = psi + around * part + (w - around) * (1.0 - turned) / TURN_DRAG
            ends.append((to + (v - to) * fade, around + (w - around) * turned, heading))
        (v1, _, p1), (v2, w2, p2) = ends
        place += h / 6.0 * (v * np.exp(1j * psi) + 4.0 * v1 * np.exp(1j * p1) + v2 * np.exp(1j * p2))
        psi, v, w = p2, v2, w2
    where, heading, rate, ahead = (np.array(column) for column in zip(*fine, strict=True))
    seen = where + marker * np.exp(1j * heading)
    # of a point that turns with the body: what e^(iψ) has for a second derivative, beside what turns it faster
    ahead = ahead + np.real(arm * (1j * rate) ** 2)
    rows, rng = np.arange(0, len(fine), FINE), np.random.default_rng(100 + seed)
    shown = np.maximum(0, rows - round(late / h))  # at rest before
    time = STEP * np.arange(count)
    columns = {
        "x": seen.real[shown], "y": seen.imag[shown], "psi": heading[rows], "rate": rate[rows] + drift * time,
        "ahead": ahead[rows],
    }  # fmt: skip
    noisy = {n: c + NOISE[n] * rng.standard_normal(count) for n, c in columns.items()}
    return write_log(path, {"time": time, "force": u[:, 0], "moment": u[:, 1], **noisy})


def rover_study(folder: Path, **truth: float) -> Path:
    """rover.py, three logs and a study."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rover.py").write_text(ROVER, encoding="utf-8")
    for seed, name in enumerate(("e1.csv", "e2.csv", "v1.csv")):
        rover_log(folder / name, seed, **truth)
    study = folder / "study.yaml"
    study.write_text("model: rover.py:Rover\nlogs:\n  estimation: [e1.csv, e2.csv]\n  validation: [v1.csv]\n")
    return study
