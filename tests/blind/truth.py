"""Blind studies of the laboratory half: `draw(seed)` draws a study, `write(study, folder)` writes its logs.

A study has two estimation logs and a sealed log of 40 s at 50 Hz, in closed loop with the pilot of `field_craft` and
the craft of `truth_craft`. Row k holds the measurement at t_k and the command that acts from t_k on.

Consecutive seeds are dealt from shuffled decks: any twenty contain 11 known, 5 nothing and 4 outside, and effects
alternate. Sizes are those of a real rig (docs/blind.md).
"""

import json
import math
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np

from tests.blind.field_craft import CraftRig, Pilot, craft, fly_craft, moving_start
from tests.blind.field_rig import (
    BLOCK,
    LOGS,
    Array,
    Course,
    Random,
    Run,
    Truth,
    coloured,
    csv,
    dealt,
    random_stream,
    write_study,
)
from tests.blind.truth_craft import OUTSIDE, SHEET, STEP, Craft, stranger


def sizes(rng: Random) -> dict[str, dict[str, float]]:
    """Return random parameters of every effect and sensor error, in SI."""
    degree, between = math.pi / 180.0, rng.uniform

    def sign() -> float:
        return float(rng.choice([-1.0, 1.0]))

    def near(value: float) -> float:
        return value * float(between(0.8, 1.2))

    return {
        "coulomb_friction": {"force": between(0.025, 0.08)},
        "stribeck_friction": {
            "force": between(0.025, 0.035),
            "static_force": between(0.07, 0.08),
            "speed": between(0.1, 0.2),
        },
        "quadratic_drag": {"coefficient": near(0.5)},
        "yaw_damping": {"coefficient": near(0.004)},
        "yaw_coulomb_friction": {"moment": near(0.003)},
        "actuator_second_order": {"natural_frequency": between(13.0, 15.0), "damping_ratio": between(0.35, 0.55)},
        "actuator_delay": {"time": near(0.06)},
        "servo_rate_limit": {"rate": near(0.8)},
        "servo_backlash": {"width": between(1.0, 2.0) * degree},
        "servo_dead_band": {"width": between(1.0, 2.0) * degree},
        "tilt_offset": {side: sign() * near(degree) for side in ("right", "left")},
        "thrust_asymmetry": {"ratio": sign() * near(0.02)},
        "battery_sag": {"drop": near(0.2), "time": near(15.0)},
        "inflow_thrust_loss": {"coefficient": near(0.25)},
        "com_offset": {"right": sign() * near(0.004)},
        "table_tilt": {axis: sign() * near(0.2 * degree) for axis in ("x", "y")},
        "coriolis": {"gain": 1.0},
        "accelerometer_bias": {"value": sign() * near(0.1)},
        "accelerometer_scale": {"value": 1.0 + sign() * near(0.12)},
        "gyro_bias": {"value": sign() * near(0.02)},
    }


def size(name: str, rng: Random) -> dict[str, float]:
    """Return random parameters of an effect, base parameter or sensor error, in SI (thrust_slope in gf/%)."""
    if name not in BASE:
        return {p: float(v) for p, v in sizes(rng)[name].items()}
    if name == "thrust_slope":
        # 7 % less slope is 72 % less thrust at the nominal duty: the line's offset does not shrink with it
        wrong_by = float(rng.choice([-1.0, 1.0])) * float(rng.uniform(0.03, 0.07))
    else:
        wrong_by = float(rng.uniform(0.1, 0.7) if rng.random() < 0.5 else -rng.uniform(0.1, 0.45))
    return {"value": SHEET[name] * (1.0 + wrong_by)}


BASE = ("mass", "izz", "friction", "lag", "thrust_slope")
SENSORS = ("accelerometer_bias", "accelerometer_scale", "gyro_bias")
EFFECTS = tuple(name for name in sizes(np.random.default_rng()) if name not in SENSORS)
# what the accelerometer and the heading do not show without any position (docs/blind.md says why)
NEED_POSITION = {
    *("coulomb_friction", "stribeck_friction", "quadratic_drag", "thrust_asymmetry", "com_offset", "table_tilt"),
    *("coriolis", "mass", "friction", "accelerometer_bias", "accelerometer_scale"),
    *("gust", "tether", "ratchet_friction", "growing_friction", "table_bumps", "gyroscopic"),
}
NEED_DUTY = {"thrust_slope", "torque_reaction"}
PAIR, BASE_PAIR = "two effects", "two base parameters"
KNOWN_DECK = (*EFFECTS, *BASE, *SENSORS, *(PAIR,) * 6, *(BASE_PAIR,) * 2)
NOTHING_DECK = ("clean", "disturbed")

DURATION = 40.0  # [s]
DISTURBANCE = (0.004, 0.004, 0.0002)  # forward, starboard [N], yaw [N m]: standard deviations
CORRELATION_TIME = 1.0  # [s]

SUITE = 9137
stream, card = partial(random_stream, SUITE), partial(dealt, SUITE)


@dataclass(frozen=True)
class Study:
    """Answer of a study: hidden effects, and the conditions of its logs."""

    seed: int
    kind: str  # known, nothing, outside
    truth: Truth
    disturbed: bool
    position: bool
    duty_varied: bool


def _names_of_card(card: str, rng: Random) -> list[str]:
    if card == BASE_PAIR:
        return [str(n) for n in rng.choice(BASE[:4], 2, replace=False)]
    if card != PAIR:
        return [card]
    while True:
        pair = {str(n) for n in rng.choice(EFFECTS, 2, replace=False)}
        if not any(pair <= family for family in CraftRig.families):
            return sorted(pair)


def draw(seed: int) -> Study:
    """Return the study of a seed, reproducible byte for byte."""
    kind, number = card(BLOCK, seed, 1)
    rng = stream(seed, 2)
    disturbed, imu_alone, duty = rng.random(3) < (0.5, 0.4, 0.5)
    truth: Truth = {}
    if kind == "known":
        truth = {name: size(name, rng) for name in _names_of_card(card(KNOWN_DECK, number, 3)[0], rng)}
    elif kind == "outside":
        name, _ = card(tuple(OUTSIDE), number, 4)
        truth = {name: stranger(name, rng)}
    else:
        disturbed = card(NOTHING_DECK, number, 5)[0] == "disturbed"
    imu_alone &= not truth.keys() & NEED_POSITION
    duty |= bool(truth.keys() & NEED_DUTY)
    return Study(seed, kind, truth, bool(disturbed), not imu_alone, bool(duty))


def craft_of(study: Study) -> Craft:
    """Return the craft of a study."""
    base = {n: v["value"] for n, v in study.truth.items() if n in BASE}
    return craft(base, {n: v for n, v in study.truth.items() if n not in BASE})


def fly(study: Study, number: int, duration: float = DURATION) -> tuple[Run, Course, Array]:
    """Return log `number` of a study: its inputs, its course, and what is logged of the sensors."""
    count = round(duration / STEP) + 1
    manoeuvre, noise, shove = (stream(study.seed, 10 + number, purpose) for purpose in range(3))
    start = moving_start(manoeuvre)
    if start:
        start |= {f"tilt_{side}": float(manoeuvre.normal(0.0, 0.03)) for side in ("right", "left")}
    made = craft_of(study)
    pilot = Pilot(manoeuvre, study.duty_varied, count, start.get("psi", 0.0))
    pushes = np.zeros((count, 3))
    if study.disturbed:
        pushes = coloured(shove, count, DISTURBANCE, STEP, CORRELATION_TIME)
    errors = np.column_stack([sigma * noise.standard_normal(count) for sigma in CraftRig.outputs.values()])
    channels = 5 if study.position else 3
    inputs = np.arange(count) * STEP, pushes, errors
    run, course = fly_craft(made, start, pilot, study.truth, inputs, channels)
    return run, course, (course.readings + errors)[:, :channels]


def write(study: Study, folder: Path, duration: float = DURATION) -> Path:
    """Write study.yaml and the three logs, without the answer; return the path of study.yaml."""
    logs = []
    for number in range(len(LOGS)):
        run, _, cells = fly(study, number, duration)
        names = ["time", *CraftRig.inputs, *[*CraftRig.outputs][: cells.shape[1]]]
        logs.append(csv(names, (".2f", run.times[:, None]), (".6g", run.commands), (".6g", cells)))
    return write_study(folder, "base", logs)


def answer(study: Study) -> str:
    """Return the answer as JSON, to be opened after the verdict."""
    return json.dumps(asdict(study), indent=1) + "\n"
