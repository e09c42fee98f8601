"""Arm of the blind suite: two links under feedback, with dry friction in both joints and effects in no catalogue.

In every study the belt to joint 2 is slightly elastic, and the torques ripple by 2 % over a turn of the motor. Encoders
round to 0.1 mrad, and measured torques are wrong by about 1 %. In five of six studies both joints have dry friction, in
the sixth none. The simulation uses nothing of the project; `least_squares` supplies an error for comparison.
"""

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares as minimise
from scipy.signal import savgol_filter

from tests.blind.field_rig import LOGS, Array, Random, base_numbers, csv, log_uniform, random_stream, write_study

PLANT = Path(__file__).with_name("plants") / "arm.py"
STEP, ROWS, HORIZON = 0.005, 2000, 0.3  # [s], rows of a log, [s] of a prediction
TIME = STEP * np.arange(ROWS)
QUANTUM = 1e-4  # [rad] of the encoders
CREEP = 0.02  # [rad/s]
SHEET = {  # base number → (nominal, tolerance)
    "inertia_1": (0.12, 0.15), "inertia_2": (0.02, 0.15), "coupling": (0.025, 0.15), "gravity_1": (3.5, 0.1),
    "gravity_2": (0.8, 0.1), "rotor_2": (0.005, 0.2), "viscous_1": (0.15, 0.3), "viscous_2": (0.05, 0.3),
}  # fmt: skip
FRICTION = {"coulomb_1": (0.15, 0.6), "coulomb_2": (0.05, 0.2)}  # [N m]


@dataclass(frozen=True)
class ArmStudy:
    """True values of a study: friction, base parameters, belt, torque ripple and gains of the torque sensors."""

    seed: int
    truth: dict[str, dict[str, float]]
    base: dict[str, float]
    stiffness: float
    ripple: tuple[float, float, float]  # share, turns, phase
    gains: tuple[float, float]


Log = tuple[Array, Array]  # measured torques and encoder readings, with a row per sample
stream = partial(random_stream, 77261)


def draw(seed: int) -> ArmStudy:
    """Return the study of a seed."""
    rng = stream(seed, 0)
    base = base_numbers(SHEET, rng)
    truth = {name: {"level": log_uniform(rng, between)} for name, between in FRICTION.items()}
    stiffness, phase = float(rng.uniform(40.0, 90.0)), float(rng.uniform(0.0, 2.0 * math.pi))
    gains = tuple(1.0 + 0.01 * rng.standard_normal(2))
    return ArmStudy(seed, {} if seed % 6 == 5 else truth, base, stiffness, (0.02, 12.0, phase), (gains[0], gains[1]))


def _elastic(study: ArmStudy, x: Array, torque: Sequence[float]) -> list[float]:
    """Return the derivatives of q₁, motor angle of joint 2, q₂ and their rates, with elastic belt and ripple."""
    p, (share, turns, phase) = study.base, study.ripple
    q1, motor, q2, w1, spin, w2 = x
    dry = [study.truth.get(name, {}).get("level", 0.0) for name in FRICTION]
    push = [torque[0] * (1.0 + share * math.sin(turns * q1 + phase))]
    push.append(torque[1] * (1.0 + share * math.sin(turns * motor + phase)))
    belt = study.stiffness * (motor - q2) + 0.02 * (spin - w2)
    c, sin, cos = p["coupling"], math.sin(q2), math.cos(q2)
    lower = p["gravity_2"] * math.cos(q1 + q2)
    t1 = push[0] + c * sin * (2.0 * w1 + w2) * w2 - p["gravity_1"] * math.cos(q1) - lower
    t1 -= p["viscous_1"] * w1 + dry[0] * math.tanh(w1 / CREEP)
    t2 = belt - c * sin * w1 * w1 - lower
    m11, m12, m22 = p["inertia_1"] + p["inertia_2"] + 2.0 * c * cos, p["inertia_2"] + c * cos, p["inertia_2"]
    determinant = m11 * m22 - m12 * m12
    turned = push[1] - belt - p["viscous_2"] * spin - dry[1] * math.tanh(spin / CREEP)
    return [
        w1, spin, w2,
        (t1 * m22 - t2 * m12) / determinant, turned / p["rotor_2"], (t2 * m11 - t1 * m12) / determinant,
    ]  # fmt: skip


def _path(rng: Random) -> Array:
    """Return reference angles of both joints: six sines of different frequency around a posture."""
    paths = []
    for centre, reach in ((rng.uniform(-0.8, 0.8), 0.9), (rng.uniform(-0.8, 0.8), 1.1)):
        frequency, phase = np.exp(rng.uniform(np.log(0.1), np.log(1.6), 6)), rng.uniform(0.0, 2.0 * math.pi, 6)
        waves = (np.sin(2.0 * math.pi * np.outer(TIME, frequency) + phase) / np.sqrt(frequency)).sum(axis=1)
        paths.append(centre + reach * waves / np.max(np.abs(waves)))
    return np.column_stack(paths)


def record(study: ArmStudy, number: int) -> Log:
    """Simulate a log under PD feedback with compensation of the nominal gravity."""
    path = _path(stream(study.seed, 1, number))
    speed = np.gradient(path, STEP, axis=0)
    x = np.array([path[0, 0], path[0, 1], path[0, 1], *speed[0], speed[0, 1]])
    nominal = {name: value for name, (value, _) in SHEET.items()}
    angles, torques = np.empty((ROWS, 2)), np.empty((ROWS, 2))
    last = path[0]
    for k in range(ROWS):
        seen = np.round(x[:2] / QUANTUM) * QUANTUM
        angles[k] = seen
        rate, last = (seen - last) / STEP if k else speed[0], seen
        weight = nominal["gravity_2"] * math.cos(seen[0] + seen[1])
        hold = np.array([nominal["gravity_1"] * math.cos(seen[0]) + weight, weight])
        torque = hold + np.array([25.0, 6.0]) * (path[k] - seen) + np.array([1.2, 0.25]) * (speed[k] - rate)
        torques[k] = torque = np.round(np.clip(torque, [-12.0, -4.0], [12.0, 4.0]), 5)
        done = solve_ivp(lambda t, y, u=torque: _elastic(study, y, u), (0.0, STEP), x, "DOP853", rtol=1e-8, atol=1e-9)
        x = done.y[:, -1]
    return torques * study.gains, angles


def write(study: ArmStudy, folder: Path) -> Path:
    """Write study.yaml, the model file and the logs; return the path of study.yaml."""
    logs = []
    for number in range(len(LOGS)):
        rows = np.column_stack([TIME, *record(study, number)])
        logs.append(csv(["time", "torque_1", "torque_2", "angle_1", "angle_2"], (".7g", rows)))
    path = write_study(folder, "arm.py:Arm", logs)
    shutil.copyfile(PLANT, folder / "arm.py")
    return path


def answer(study: ArmStudy) -> str:
    """Return the answer as JSON, with the errors of the least-squares fits on the sealed log."""
    logs = [record(study, number) for number in range(3)]
    fits = {name: least_squares(logs[:2], dry=dry) for name, dry in (("without", False), ("with", True))}
    sealed = {name: np.sqrt(np.mean(missed(values, *logs[2]) ** 2, axis=0)).tolist() for name, values in fits.items()}
    told: dict[str, Any] = {"half": "arm", "kind": "known" if study.truth else "nothing", "plant": "arm"}
    return json.dumps(told | asdict(study) | {"sensors": ["encoder_offset_2"], "yardstick": sealed}, indent=1) + "\n"


# -- the yardstick ------------------------------------------------------------------------------------------


def least_squares(logs: Sequence[Log], *, dry: bool) -> Array:
    """Return base parameters, and with `dry` both frictions, fitted to predictions over 0.3 s."""
    start = np.array([value for value, _ in SHEET.values()] + ([0.1, 0.05] if dry else []))
    low, high = 0.3 * start, 3.0 * start
    if dry:
        low[-2:], high[-2:] = 0.0, 3.0
    scale = np.std(np.concatenate([missed(start, *log) for log in logs]), axis=0)

    def off(values: Array) -> Array:
        return np.concatenate([(missed(values, *log) / scale).ravel() for log in logs])

    return minimise(off, start, bounds=(low, high), x_scale=start, loss="linear", max_nfev=15).x


def missed(values: Array, torque: Array, angle: Array) -> Array:
    """Return the errors of consecutive predictions over 0.3 s, each started from smoothed rates."""
    length = round(HORIZON / STEP)
    starts = np.arange(10, ROWS - length - 10, length)
    dry = values[8:] if len(values) > 8 else np.zeros(2)
    a, b, c, g1, g2, rotor, d1, d2 = values[:8]
    rate = savgol_filter(angle, 11, 2, deriv=1, delta=STEP, axis=0)  # a parabola through eleven rows
    x = np.concatenate([angle[starts], rate[starts]], axis=1).T
    errors = np.empty((length, starts.size, 2))

    def slopes(x: Array, u: Array) -> Array:
        q1, q2, w1, w2 = x
        sin, cos = np.sin(q2), np.cos(q2)
        lower = g2 * np.cos(q1 + q2)
        t1 = u[0] + c * sin * (2 * w1 + w2) * w2 - g1 * np.cos(q1) - lower - d1 * w1
        t2 = u[1] - c * sin * w1**2 - lower - d2 * w2
        t1, t2 = t1 - dry[0] * np.tanh(w1 / CREEP), t2 - dry[1] * np.tanh(w2 / CREEP)
        m11, m12, m22 = a + b + 2 * c * cos, b + c * cos, b + rotor
        determinant = m11 * m22 - m12**2
        return np.stack([w1, w2, (t1 * m22 - t2 * m12) / determinant, (t2 * m11 - t1 * m12) / determinant])

    h = STEP / 2
    for k in range(length):
        u = torque[starts + k].T
        for _ in range(2):
            k1 = slopes(x, u)
            k2 = slopes(x + h / 2 * k1, u)
            k3 = slopes(x + h / 2 * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slopes(x + h * k3, u))
        errors[k] = (angle[starts + k + 1].T - x[:2]).T
    return np.clip(errors.reshape(-1, 2), -10.0, 10.0)
